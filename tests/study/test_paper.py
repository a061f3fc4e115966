"""The paper's tables as text: ours in the first column, the paper's beside it."""

import dataclasses

import pytest

from rta.constraints.names import CONSTRAINTS
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate, Results, measured, tables


@pytest.fixture
def results() -> Results:
    return {
        "metrics": {name: {"iqm": 2.0, "ci95": [1.25, 3.0]} for name in PAPER_METRICS},
        "violations_percent": dict.fromkeys(PAPER_VIOLATIONS, 0.04),
        "outcomes": {"success": 0.75, "crash": 0.25, "timeout": 0.0},
        "rta": {"period_s": 5.0, "intervention_percent": 12.345, "qp_failures": 2},
        "episodes": 300,
    }


def test_rows_hold_ours_and_the_papers(results: Results) -> None:
    lines = tables(results).splitlines()
    assert lines[0] == "Table 2: interquartile mean (the mean of the middle half) over 300 episodes"
    assert lines[2] == f"{'':23}{'this one':>29}{'paper, no RTA':>24}{'paper, RTA':>24}"
    reward = f"{'2.0000 [1.2500, 3.0000]':>29}{'2.1486 [2.1444, 2.1527]':>24}{'2.0235 [2.0175, 2.0293]':>24}"
    assert lines[4] == f"{'Total reward':23}{reward}"
    assert lines[9] == "Table 3: mean safety violation, % of steps; PSM is passive safety"
    assert lines[11] == f"{'Any constraint':23}{'0.040':>16}{'4.736':>16}{'0.215':>16}"
    assert len(lines) == 3 + len(PAPER_METRICS) + 3 + len(PAPER_VIOLATIONS) + 3
    assert lines[-2] == "Outcomes: 75 % success, 25 % crash"


def test_the_tables_fit_into_100_columns_where_numbers_are_long(results: Results) -> None:
    results["metrics"]["delta_v_m_s"] = {"iqm": 3060.0, "ci95": [3059.0, 3060.0]}
    results["metrics"]["reward"] = {"iqm": -61.0, "ci95": [-61.5, -60.5]}
    results["metrics"]["episode_length_s"] = {"iqm": 12240.0, "ci95": [12240.0, 12240.0]}
    results["violations_percent"] = dict.fromkeys(PAPER_VIOLATIONS, 100.0)
    names = ("success", "crash", "out_of_bounds", "out_of_power", "timeout")
    results["outcomes"] = dict.fromkeys(names, 0.2)
    results["rta"] = {"period_s": 10.0, "intervention_percent": 100.0, "qp_failures": 1_000_000}
    lines = tables(results).splitlines()
    assert max(map(len, lines)) <= 100
    for line in lines[3:8]:  # the columns stay apart
        assert len(line.replace(", ", ",").replace(" [", "[").split()) >= 4


def test_the_filter_is_named(results: Results) -> None:
    assert tables(results).endswith("RTA at 5 s: intervened at 12.35 % of its calls, 2 unsolved problems")
    results["rta"]["period_s"] = None
    assert tables(results).endswith("RTA: off")


def test_what_is_measured_goes_by_name(results: Results) -> None:
    assert measured(results, "reward") == Estimate(2.0, (1.25, 3.0))
    assert measured(results, "any") == Estimate(0.04)
    assert measured(results, "success") == Estimate(75.0)
    with pytest.raises(KeyError):
        measured(results, "comfort")


def test_the_papers_numbers_are_complete_and_cannot_be_changed() -> None:
    assert next(iter(PAPER_VIOLATIONS)) == "any"
    assert set(PAPER_VIOLATIONS) == {"any", *CONSTRAINTS}
    for published in (PAPER_METRICS | PAPER_VIOLATIONS).values():
        assert list(published.by_arm) == ["no_rta", "rta"]
    for published in PAPER_METRICS.values():
        for number in published.by_arm.values():
            low, high = number.interval
            assert low < number.value < high
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER_METRICS["reward"].by_arm["rta"].value = 3.0

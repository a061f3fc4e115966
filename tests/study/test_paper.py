"""The paper's tables as text: ours in the first column, the paper's beside it."""

import pytest

from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Results, measured, tables


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
    assert measured(results, "success").value == 75.0
    lines = tables(results).splitlines()
    assert lines[0] == "Table 2: interquartile mean (the mean of the middle half) over 300 episodes"
    assert lines[2] == f"{'':23}{'this one':>29}{'paper, no RTA':>24}{'paper, RTA':>24}"
    reward = f"{'2.0000 [1.2500, 3.0000]':>29}{'2.1486 [2.1444, 2.1527]':>24}{'2.0235 [2.0175, 2.0293]':>24}"
    assert lines[4] == f"{'Total reward':23}{reward}"
    assert lines[9] == "Table 3: mean safety violation, % of steps; PSM is passive safety"
    assert lines[11] == f"{'Any constraint':23}{'0.040':>16}{'4.736':>16}{'0.215':>16}"
    assert len(lines) == 3 + len(PAPER_METRICS) + 3 + len(PAPER_VIOLATIONS) + 3
    assert lines[-2] == "Outcomes: 75 % success, 25 % crash"

"""The report's tables against numbers worked out by hand."""

import csv
import math
from pathlib import Path
from typing import Any

import pytest

from inspection.transition import METRICS
from rta.names import CONSTRAINTS
from study.config import StudyConfig
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS
from study.report import tables
from study.report.inputs import Inputs


def evaluation(value: float) -> dict[str, Any]:
    """Returns an evaluation with IQMs of `value`, intervals one to either side, and percentages a tenth of `value`."""
    summary = {"iqm": value, "mean": value, "ci95": [value - 1.0, value + 1.0]}
    summary |= {"p5": value - 2.0, "p95": value + 2.0, "max": value + 3.0}
    return {
        "metrics": dict.fromkeys(METRICS, summary),
        "violations_percent": dict.fromkeys(("any", *CONSTRAINTS), value / 10.0),
        "violations_percent_of_seconds": {"any": value / 20.0},
        "outcomes": {"success": 0.75, "clean_success": 0.5},
        "rta": {"intervention_percent": 12.5, "qp_failures": 3},
        "episodes": 8,
    }


def arm(value: float) -> dict[str, Any]:
    """Returns the results of an arm of two seeds."""
    seeds = [evaluation(value - 0.5), evaluation(value + 0.5)]
    return evaluation(value) | {
        "seeds": [4, 5],
        "interactions": 600,
        "wall_clock_s": 30.0,
        "per_seed": seeds,
    }


@pytest.fixture
def inputs(tmp_path: Path) -> Inputs:
    """Returns the inputs of the tables."""
    (tmp_path / "report").mkdir()
    arms = {"no_rta": arm(2.0), "rta": arm(3.0)}
    return Inputs(
        study=tmp_path,
        config=StudyConfig(),
        arms=arms,
        provenance={"device": "abacus", "ranks": 3, "threads": 2},
        front={"quick": evaluation(4.0)},
        worlds={"harsh": {"rta": {"robust": evaluation(9.0)}}},
        progress={},
        sunlight={},
        cross={name: {"off": evaluation(1.0), "on": own} for name, own in arms.items()},
        frequency={"1": arms["rta"], "5": evaluation(5.0), "10": evaluation(6.0)},
        baselines={"random": {"off": evaluation(7.0), "on": evaluation(8.0)}},
        training={},
        violation={},
        episodes={},
        demonstrations={},
    )


def test_the_papers_numbers_are_beside_ours() -> None:
    columns = {"rta": arm(3.0), "other": evaluation(7.0)}
    table = {row["metric"]: row for row in tables.comparison("metric", PAPER_METRICS, columns)}
    assert list(table) == list(METRICS[:5])
    assert table["delta_v_m_s"] == {
        "metric": "delta_v_m_s",
        "label": "Delta v (m/s)",
        "rta_iqm": 3.0,
        "rta_low": 2.0,
        "rta_high": 4.0,
        "rta_paper_iqm": 15.9381,
        "rta_paper_low": 15.6616,
        "rta_paper_high": 16.2219,
        "rta_difference": pytest.approx(-12.9381),
        "other_iqm": 7.0,
        "other_low": 6.0,
        "other_high": 8.0,
    }
    shares = tables.comparison("constraint", PAPER_VIOLATIONS, columns)
    assert {row["constraint"] for row in shares} == {"any", *CONSTRAINTS}
    assert shares[0] == {
        "constraint": "any",
        "label": "Any constraint",
        "rta_percent": pytest.approx(0.3),
        "rta_paper_percent": 0.215,
        "rta_difference": pytest.approx(0.085),
        "other_percent": 0.7,
    }


def test_training_summarises_seeds_and_cases_at_every_point() -> None:
    points = [(100, 0.0), (100, 4.0), (200, 1.0), (200, 1.0)]  # two seeds at either
    evaluations = [
        {"interactions": interactions, "cases": {name: [first, first + 1.0] for name in METRICS}}
        for interactions, first in points
    ]
    table = tables.training("rta", evaluations)
    assert [(row["interactions"], row["metric"]) for row in table] == [
        (n, name) for n in (100, 200) for name in METRICS
    ]
    # the four scores 0, 1, 4, 5: resamples of the two seeds in either case range from 0.5 to 4.5
    assert [table[0][key] for key in ("arm", "iqm", "low", "high")] == ["rta", 2.5, 0.5, 4.5]
    # 1, 2, 1, 2: seeds agree
    assert [table[6][key] for key in ("iqm", "low", "high")] == [1.5, 1.5, 1.5]


def test_files_hold_a_row_per_evaluation(inputs: Inputs) -> None:
    tables.write(inputs)

    def rows(name: str, *columns: str) -> list[tuple[str, ...]]:
        with (inputs.directory / f"{name}.csv").open(newline="") as file:
            return [tuple(row[column] for column in columns) for row in csv.DictReader(file)]

    flown = [("no_rta", "off", "1.0"), ("no_rta", "on", "2.0"), ("rta", "off", "1.0"), ("rta", "on", "3.0")]
    assert rows("cross", "arm", "filter", "reward_iqm") == flown
    random = [("random", "off", "7.0"), ("random", "on", "8.0")]
    assert rows("baselines", "controller", "filter", "reward_iqm") == random
    assert rows("worlds", "plant", "arm", "filter", "reward_iqm") == [("harsh", "rta", "robust", "9.0")]
    assert rows("frequency", "period_s", "reward_high") == [("1", "4.0"), ("5", "6.0"), ("10", "7.0")]
    shares = rows("frequency", "collision_mean_percent", "success_percent", "intervention_percent")
    assert shares[1] == ("0.5", "75.0", "12.5")
    assert rows("frequency", "unsolved_programs")[1] == ("3",)
    assert rows("table2", "guidance_iqm") == [("4.0",)] * 5
    assert rows("table3", "guidance_percent") == [("0.4",)] * 14
    speed = rows("throughput", "arm", "seeds", "interactions_per_s", "device", "ranks", "threads")
    assert speed[1] == ("rta", "2", "40.0", "abacus", "3", "2")


def test_the_interval_over_seeds_is_students() -> None:
    low, high = tables.over_seeds(arm(3.0), "reward")  # of two seeds, 2.5 and 3.5: 3 +- 12.706 * 0.5
    assert (low, high) == pytest.approx((-3.353, 9.353), abs=1e-3)
    lone = arm(3.0) | {"per_seed": [evaluation(3.0)]}
    assert all(math.isnan(end) for end in tables.over_seeds(lone, "reward"))

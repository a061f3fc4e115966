"""Single calls next to the filter's limits: where the states are, what is found, and how it is counted."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.result import FilterResult
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.verification import boundary, limits
from study.verification.boundary import Boundary, run, table, tried

BATCH = 48


def experiment_in(plant: dict[str, Any]) -> Experiment:
    train = {"compile": "on", "device": "cpu"}
    return Experiment(override(Config(), {"train": train, "plant": plant}, "test"), BATCH * boundary.TRIES)


@pytest.fixture(scope="module")
def nominal() -> Experiment:
    return experiment_in({})


@pytest.fixture(scope="module")
def near(nominal: Experiment) -> limits.NearLimits:
    """Returns states with gaps that few bisections find."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "BISECTIONS", (4, 10))
        patch.setattr(limits, "GAP", (1e-3, 1e-1))
        barriers_at = partial(limits.barriers, safety_filter=nominal.filter)
        return limits.near_limits(BATCH, 3, nominal.filter, barriers_at, "cpu")


@pytest.fixture(autouse=True)
def drawn_once(near: limits.NearLimits, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boundary, "near_limits", lambda *_: near)


def report_of(experiment: Experiment, draws: int = BATCH, path: Path | None = None) -> dict[str, Any]:
    return list(run(Boundary(1.0, 5, BATCH), draws, experiment, path))[-1]


def test_states_are_safe_and_next_to_what_they_were_aimed_at(
    near: limits.NearLimits, nominal: Experiment
) -> None:
    assert nominal.filter.is_safe(near.state).all()
    values = limits.barriers(near.state, nominal.filter)
    scale = torch.tensor(limits.gap_units(nominal.filter), dtype=torch.float64)
    left = values.gather(0, near.targets) / scale[near.targets]
    assert ((left >= 0.0) & (left <= limits.GAP[1])).all()
    assert (values >= 0.0).all()
    assert len(near.limits[0].unique()) > 7
    pair = near.limits[0] != near.limits[1]
    assert pair.any() and not pair.all()


def test_nothing_is_violated_in_the_model(nominal: Experiment) -> None:
    report = report_of(nominal)
    assert report["draws"] == BATCH
    assert report["violating_draws"]["any"] == 0 == report["unsolved"]
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / BATCH))
    parts = [*report["limits"].values(), *report["pairs"].values()]
    assert sum(part["draws"] for part in parts) == BATCH
    case = report["worst"]["keep_in_zone"][0]
    assert case["value"] == report["worst_value"]["keep_in_zone"]
    assert nominal.filter.is_safe(torch.tensor(case["state"], dtype=torch.float64)[:, None]).all()


def test_a_heavier_plant_is_reported_with_what_shows_it(nominal: Experiment) -> None:
    heavy = experiment_in({"mass_factor": 2.0})
    heavy.filter, heavy.safety = nominal.filter, nominal.safety
    report = report_of(heavy)
    violated = [name for name in CONSTRAINTS if report["violating_draws"][name]]
    assert {"dynamic_speed", "keep_in_zone"} & set(violated)
    assert (
        sum(part["violating"] for part in (*report["limits"].values(), *report["pairs"].values()))
        == (report["violating_draws"]["any"])
    )
    assert all(f"{name} {report['violating_draws'][name]}" in table(report) for name in violated)
    case = report["worst"][violated[0]][0]
    assert case["value"] < 0.0
    # flown again
    x, desired = (
        torch.tensor(case[name], dtype=torch.float64)[:, None] for name in ("state", "control_desired")
    )
    env = heavy.env(1, None, 1.0, boundary.CHECK_BETWEEN)
    again = tried(env, x, desired[None], torch.tensor([case["plant"]]).double())
    assert again.smallest[CONSTRAINTS.index(violated[0]), 0].item() == pytest.approx(case["value"], abs=1e-9)


def test_what_a_filter_without_effect_leaves_is_violated(
    near: limits.NearLimits, nominal: Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    correct = SafetyFilter.correct

    def passed(safety_filter: SafetyFilter, x: torch.Tensor, desired: torch.Tensor) -> FilterResult:
        result = correct(safety_filter, x, desired)
        result.control = desired
        return result

    monkeypatch.setattr(SafetyFilter, "correct", passed)
    experiment = experiment_in({})
    experiment.filter = nominal.filter
    experiment.safety = nominal.filter.safety()
    report = report_of(experiment)
    assert report["violating_draws"]["any"] > 5


@pytest.mark.campaign
def test_more_draws_go_on_where_the_report_ends(nominal: Experiment, tmp_path: Path) -> None:
    for path, counts in ((tmp_path / "on.json", (1, 2 * BATCH)), (tmp_path / "once.json", (2 * BATCH,))):
        for draws in counts:
            report_of(nominal, draws, path)
    on, once = ((tmp_path / f"{name}.json").read_bytes() for name in ("on", "once"))
    assert on == once and json.loads(on)["draws"] == 2 * BATCH

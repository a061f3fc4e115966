"""Starts next to the filter's limits: where they are, and that a campaign of them finds a filter without effect."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from rta.result import FilterResult
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.verification import campaign, limits
from study.verification.campaign import run
from study.verification.findings import Campaign

BATCH = 48
ADVERSARIAL = Campaign("adversarial", 1.0, 1.0, 5, BATCH, check_every=0.1, starts="limits")


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    train = {"compile": "on", "device": "cpu"}
    return Experiment(override(Config(), {"train": train}, "test"), BATCH)


@pytest.fixture(scope="module")
def near(experiment: Experiment) -> limits.NearLimits:
    """Returns states with gaps that few bisections find."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "BISECTIONS", (4, 10))
        patch.setattr(limits, "GAP", (1e-3, 1e-1))
        barriers_at = partial(limits.barriers, safety_filter=experiment.filter)
        return limits.near_limits(BATCH, 3, experiment.filter, barriers_at, "cpu")


@pytest.fixture(autouse=True)
def drawn_once(near: limits.NearLimits, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "near_limits", lambda *_: near)


def test_states_are_safe_and_next_to_what_they_were_aimed_at(
    near: limits.NearLimits, experiment: Experiment
) -> None:
    assert experiment.filter.is_safe(near.state).all()
    values = limits.barriers(near.state, experiment.filter)
    scale = torch.tensor(limits.gap_units(experiment.filter), dtype=torch.float64)
    left = values.gather(0, near.targets) / scale[near.targets]
    assert ((left >= 0.0) & (left <= limits.GAP[1])).all()
    assert (values >= 0.0).all()
    assert len(near.limits[0].unique()) > 7
    pair = near.limits[0] != near.limits[1]
    assert pair.any() and not pair.all()


def report_of(experiment: Any) -> dict[str, Any]:
    return list(run(ADVERSARIAL, BATCH, experiment, None, None))[-1]


def test_the_filter_keeps_every_limit_and_none_at_all_does_not(experiment: Experiment) -> None:
    found = report_of(experiment)
    assert found["episodes"] == BATCH
    assert not found["violating_episodes"]["any"] and not found["unsolved"]
    filtered = experiment.safety

    def passed(x: torch.Tensor, desired: torch.Tensor) -> FilterResult:
        assert filtered.correct
        return replace(filtered.correct(x, desired), control=desired)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "safety", replace(filtered, correct=passed))
        assert report_of(experiment)["violating_episodes"]["any"] > 5

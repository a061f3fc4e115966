"""A campaign: its random numbers, the starts that it leaves out, what tells it from another, and its flags."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.model.state import THETA_S
from inspection.sight import Sight
from settings import override
from study.config import Config
from study.experiment import Experiment
from study.flight.fly import Starts
from study.verification.campaign import Campaign, run
from study.verification.counter_examples import refly_file
from study.verification.starts import initial_states

EXPERIMENT = Experiment(override(Config(), {"train": {"compile": "on", "device": "cpu"}}, "test"), 64)


class Flown(Exception):
    """Signals a flight that would begin."""


def test_starts_and_first_controls_share_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every random number that a batch draws, compared with every other."""
    drawn: list[ndarray] = []
    rand = torch.rand

    def recorded(*arguments: Any, **more: Any) -> Tensor:
        drawn.append(rand(*arguments, **more))
        return drawn[-1]

    def first_control(env: InspectionEnv, controller: Any, starts: Starts, *_: Any) -> None:
        before = len(drawn)
        controller(0.0, starts.x)
        assert len(drawn) > before
        raise Flown

    monkeypatch.setattr(torch, "rand", recorded)
    monkeypatch.setattr("study.verification.campaign.fly", first_control)
    campaign = Campaign("random", 1.0, 10, 0, 64)
    with pytest.raises(Flown):
        list(run(campaign, 64, EXPERIMENT, None, None))
    numbers = np.concatenate([part.flatten().numpy() for part in drawn])
    assert numbers.size > 10 * 64 and np.unique(numbers).size == numbers.size


def test_starts_that_the_filter_refuses_are_counted() -> None:
    """Recounted from the starts of the batch."""
    campaign = Campaign("random", 1.0, 20, 4, 32)
    report = list(run(campaign, 12, EXPERIMENT, None, None))[-1]
    case = report["worst_case"]["collision"]
    x, _, rejected = initial_states(32, case["batch_seed"], EXPERIMENT.filter)
    assert report["starts_rejected"] == rejected > 0
    for case in report["worst_case"].values():
        assert case["column"] < 12 and case["initial_state"] == x[:, case["column"]].tolist()
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / 12))


@pytest.mark.parametrize(("check_every", "seen"), [(1.0, 0), (0.1, 5)])
def test_a_violation_between_two_seconds_is_seen_where_it_is_looked_for(
    check_every: float, seen: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Planted from 3.25 to 3.75 s of every episode; its counter-example is flown with the same checks."""
    values = InspectionEnv.constraint_values

    def planted(env: InspectionEnv, x: Tensor) -> Tensor:
        h = values(env, x)
        seconds = ((x[THETA_S] - env.x[THETA_S]) / env.c.mean_motion).abs()
        h[0] -= torch.where((seconds > 3.25) & (seconds < 3.75), 1000.0 + seconds, 0.0)
        return h

    monkeypatch.setattr(InspectionEnv, "constraint_values", planted)
    path = tmp_path / "report.json"
    campaign = Campaign("random", 1.0, 6, 0, 8, check_every=check_every)
    report = list(run(campaign, 4, EXPERIMENT, None, path))[-1]
    assert report["steps"] == 4 * (1 + 6 / check_every) and sum(report["filter_calls"].values()) == 4 * 6
    assert report["violating_steps"]["collision"] == 4 * seen
    assert report["violating_episodes"]["collision"] == (4 if seen else 0)
    if seen:
        assert report["worst_case"]["collision"]["time_s"] == pytest.approx(3.7)
        assert "at 3.7 s" in refly_file(f"{path}.collision.npz")


def test_an_agent_looks_at_the_chief_in_every_period(monkeypatch: pytest.MonkeyPatch) -> None:
    times: list[float] = []
    monkeypatch.setattr(Sight, "look", lambda sight, x, time: times.append(time[0].item()))
    network = EXPERIMENT.policy(EXPERIMENT.generators())
    list(run(Campaign("checkpoint:F", 1.0, 30, 0, 8), 4, EXPERIMENT, network, None))
    assert times == [10.0, 20.0, 30.0]

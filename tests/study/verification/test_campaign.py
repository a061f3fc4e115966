"""A campaign: its random numbers, its starts beyond braking, what tells it from another, and its flags."""

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
from rta.filter import SafetyFilter
from settings import override
from study.config import Config
from study.experiment import Experiment, make_policy
from study.verification.campaign import Campaign, blamed, digest, run
from study.verification.counter_examples import refly_file
from study.verification.starts import initial_states
from tests.test_main import assert_refused

EXPERIMENT = Experiment(override(Config(), {"train": {"compile": "off", "device": "cpu"}}, "test"), 64)


class Flown(Exception):
    """Raised in place of a flight."""


def test_starts_and_first_controls_share_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every random number that a batch draws, compared with every other."""
    drawn: list[ndarray] = []
    rand = torch.rand

    def recorded(*arguments: Any, **more: Any) -> Tensor:
        drawn.append(rand(*arguments, **more))
        return drawn[-1]

    def first_control(env: InspectionEnv, controller: Any, x: Tensor, *_: Any) -> None:
        before = len(drawn)
        controller(0.0, x)
        assert len(drawn) > before
        raise Flown

    monkeypatch.setattr(torch, "rand", recorded)
    monkeypatch.setattr("study.verification.campaign.fly", first_control)
    campaign = Campaign("random", 1.0, 10, 0, 64)
    with pytest.raises(Flown):
        list(run(campaign, 64, EXPERIMENT, None, None))
    numbers = np.concatenate([part.flatten().numpy() for part in drawn])
    assert numbers.size > 10 * 64 and np.unique(numbers).size == numbers.size


def test_starts_beyond_braking_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recounted from the starts of the batch."""
    monkeypatch.setattr(SafetyFilter, "can_brake", lambda _, x: x[6].abs() < 0.6)
    campaign = Campaign("random", 1.0, 20, 4, 32)
    report = list(run(campaign, 12, EXPERIMENT, None, None))[-1]
    case = report["worst_case"]["collision"]
    x, _, rejected = initial_states(32, case["batch_seed"], EXPERIMENT.filter)
    held = x[6].abs().numpy() < 0.6
    flown = int(np.flatnonzero(held)[11]) + 1
    assert report["starts_beyond_braking"]["episodes"] == (~held[:flown]).sum() > 0
    assert report["starts_rejected_by_margin"] == rejected
    for tally, theirs in ((report, held), (report["starts_beyond_braking"], ~held)):
        assert all(theirs[case["column"]] and case["column"] < flown for case in tally["worst_case"].values())
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / 12))


def test_progress_is_told_every_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of a violation, from the second on at which it is planted."""
    values = InspectionEnv.constraint_values
    seconds = iter(range(1000))

    def planted(env: InspectionEnv, x: Tensor) -> Tensor:
        h = values(env, x)
        if next(seconds) >= 5:
            h[0, 0] = -1.0
        return h

    monkeypatch.setattr(InspectionEnv, "constraint_values", planted)
    told: list[tuple[float, int, int]] = []
    campaign = Campaign("random", 1.0, 10, 0, 64)
    list(run(campaign, 4, EXPERIMENT, None, None, tell=lambda *now: told.append(now)))
    assert [flown for flown, _, _ in told] == pytest.approx([0.4 * second for second in range(1, 11)])
    assert [violating for _, violating, _ in told] == [0] * 4 + [1] * 6
    assert {begun for _, _, begun in told} == {4}


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


def test_checks_between_the_calls_change_no_control() -> None:
    """But for the rounding of shorter integration steps."""
    reports = [
        list(run(Campaign("adversarial", 1.0, 3, 0, 8, check_every=every), 4, EXPERIMENT, None, None))[-1]
        for every in (1.0, 0.1)
    ]
    assert reports[0]["filter_calls"] == reports[1]["filter_calls"]
    for name, coarse in reports[0]["worst_value"].items():
        assert reports[1]["worst_value"][name] <= coarse + 1e-6 * max(1.0, abs(coarse))


def test_a_duration_that_does_not_fit_is_refused_before_anything_is_built(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("study.verification.campaign.Experiment", lambda *_, **__: pytest.fail("built"))
    assert_refused(["verify", "--duration", "25", "--rta-period", "10"], ["--duration 25", "10 s"], capsys)


def test_a_retrained_policy_is_another_campaign() -> None:
    policies = [make_policy(Config(), [torch.Generator().manual_seed(seed)]) for seed in (0, 0, 1)]
    first, same, other = (digest(policy) for policy in policies)
    assert first == same != other
    with torch.no_grad():
        next(policies[1].parameters()).flatten()[0] += 1e-6
    assert digest(policies[1]) != first


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--policy", "nobody"], ["--policy", "'nobody'", "lookahead", "learned:F", "checkpoint:F"]),
        (["--policy", "checkpoint:nowhere.pt"], ["nowhere.pt", "no such checkpoint"]),
        (["--duration", "25", "--rta-period", "10"], ["--duration 25", "10 s"]),
        (["--duration", "0"], ["--duration", "'0'"]),
        (["--check-every", "0.3"], ["checked every 0.3 s", "must be a multiple of 0.3 s"]),
        (["--check-every", "2"], ["--check-every 2", "at most 1 s", "the filter's period"]),
        (["--episodes", "0"], ["--episodes", "'0'"]),
        (["--no-rta"], ["--no-rta"]),
        (["--json", "nowhere/x.json"], ["--json", "cannot write"]),
    ],
)
def test_bad_flags_are_refused(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(["verify", *arguments], words, capsys)


def test_bounds_are_named_that_may_leave_no_start() -> None:
    told = override(Config(), {"uncertainty": {"position": 200.0, "health": True}}, "test")
    assert blamed(told) == "[uncertainty] health = True, position = 200.0"
    assert blamed(Config()) == "[inspection] and [rta]"


@pytest.mark.parametrize(("policy", "looks"), [("checkpoint:F", 3), ("random", 0)])
def test_the_chief_is_looked_at_for_who_observes_it(
    policy: str, looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every 10 s of an agent's flight, and at no cost for the others."""
    times: list[float] = []
    monkeypatch.setattr(Sight, "look", lambda sight, x, time: times.append(time[0].item()))
    network = EXPERIMENT.policy(EXPERIMENT.generators()) if looks else None
    list(run(Campaign(policy, 1.0, 30, 0, 8), 4, EXPERIMENT, network, None))
    assert times == [10.0, 20.0, 30.0][:looks]

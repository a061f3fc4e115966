"""Tallies of flights against sums over each episode's own recount."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rta.names import CONSTRAINTS
from rta.result import Status
from study.verification import tally
from tests.oracles import PSM_TOLERANCE
from tests.study.verification.test_flight import SECONDS, recounted, six_episodes

ORIGIN = {"batch_seed": 17, "batch_size": 20}


ALL = torch.ones(6, dtype=torch.bool)


def added(report: dict[str, Any], chosen: Tensor = ALL, **origin: int) -> dict[str, Any]:
    """Returns the six episodes, of columns 3 to 8 of a batch, or some of them added to a report."""
    flight = six_episodes()
    tally.add(report, flight.record, flight.tape, chosen, ORIGIN | origin)
    return report


def test_a_report_adds_its_flights_up() -> None:
    flight, episodes = six_episodes(), recounted()
    report = added(added(tally.empty_tally()), batch_seed=18)
    violating = np.array([one["violating"] for one in episodes])
    worst = np.array([one["worst"] for one in episodes])
    assert (report["episodes"], report["steps"]) == (12, 12 * (SECONDS + 1))
    assert (violating[:, -1] > 0).sum() > 0 and (violating.sum(0) > 0).sum() >= 3
    for i, name in enumerate((*CONSTRAINTS, "any")):
        assert report["violating_steps"][name] == 2 * violating[:, i].sum()
        assert report["violating_episodes"][name] == 2 * (violating[:, i] > 0).sum()
    for i, name in enumerate(CONSTRAINTS):
        assert report["worst_value"][name] == pytest.approx(worst[:, i].min(), abs=PSM_TOLERANCE)
        case = report["worst_case"][name]
        assert (case["batch_seed"], case["batch_size"]) == (17, 20)  # the first of equals
        start = torch.cat(flight.starts[:2])[:, case["column"] - 3]
        np.testing.assert_array_equal(case["initial_state"] + case["priority"], start)
    calls = 2 * sum(one["status"] for one in episodes)
    assert list(report["filter_calls"].values()) == list(calls)
    assert report["backup_calls"] == 2 * sum(one["backup"] for one in episodes)
    assert report["unsolved"] == calls[Status.UNSOLVED] and report["controls_outside_bounds"] == 0


def test_one_step_beyond_a_limit_makes_an_episode_a_violating_one(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = six_episodes().record.limits
    violating = torch.zeros_like(limits.violating)
    violating[2, 1] = violating[-1, 1] = 1.0
    violating[2, 4] = violating[-1, 4] = 3.0
    monkeypatch.setattr(limits, "violating", violating)
    report = added(tally.empty_tally())
    for name in (CONSTRAINTS[2], "any"):
        assert (report["violating_steps"][name], report["violating_episodes"][name]) == (4, 2)

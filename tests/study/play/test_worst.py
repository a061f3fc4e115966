"""The shipped page's world whose errors are worst, flown by Node: beside Python, and what the page promises of it."""

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import main
from inspection.model.state import OMEGA, THRUST, TORQUE, P, Q, V
from rta.filter import SafetyFilter
from rta.result import FilterResult
from study.verification.adversaries import Greedy
from tests.study.play.test_flight import LIMIT, U1, columns, controls, fly
from tests.test_main import assert_refused

STARTS = ("case 0", "ram", "leaving", "battery")
PILOTS = ("keys", "random", "outward", "adversary")
LIGHT, HEAVY = 0, 4  # plants by their mass
SECONDS = 300  # of each flight of a promise
ERRORS = np.repeat([0.6, 0.006, np.radians(0.3), np.radians(0.03)], 3)  # of U1, three sigmas


@pytest.fixture(scope="module")
def flights() -> list[dict[str, Any]]:
    """With every call."""
    asked = [
        {"start": start, "pilot": pilot, "plant": plant, "seconds": 20, "seed": 3}
        for start in STARTS
        for pilot in ("keys", "adversary")
        for plant in (LIGHT, HEAVY)
    ]
    return fly(*(each | {"erring": True, "calls": True} for each in asked))


@pytest.fixture(scope="module")
def told() -> SafetyFilter:
    """That of the page, solved as its C does."""
    return SafetyFilter(U1.inspection, replace(U1.rta, qp_solver="batched"), known=U1.uncertainty)


def sent(flight: dict[str, Any]) -> torch.Tensor:
    """(1, 6, calls) what had been held since the state was measured that a call saw, NaN where it was new."""
    held = columns(flight["calls"], "control")
    return torch.cat((torch.full_like(held[:, :1], torch.nan), held[:, :-1]), 1)[None]


@pytest.fixture(scope="module")
def result(flights: list[dict[str, Any]], told: SafetyFilter) -> FilterResult:
    """What Python answers to the calls of all flights."""
    calls = [call for flight in flights for call in flight["calls"]]
    given = columns(calls, "seen"), columns(calls, "desired"), torch.cat([sent(each) for each in flights], -1)
    return told.correct(given[0], given[1], sent=given[2])


def test_the_told_filter_answers_as_in_python(flights: list[dict[str, Any]], result: FilterResult) -> None:
    calls = [call for flight in flights for call in flight["calls"]]
    status, verified, backup = columns(calls, "answer")
    np.testing.assert_array_equal(result.status, status)
    np.testing.assert_array_equal(result.verified, verified)
    np.testing.assert_array_equal(result.backup, backup)
    np.testing.assert_array_equal(result.active, columns(calls, "active"))
    flown = ~torch.tensor([call["missed"] for call in calls])  # what else was answered is not
    assert 100 < flown.sum() < len(calls) and (result.status > 0).sum() > 100
    apart = ((columns(calls, "control") - result.control).T.numpy() / LIMIT)[flown].T
    assert np.abs(apart[THRUST]).max() < 1e-9 and np.abs(apart[TORQUE]).max() < 1e-8


def test_the_sensors_err_by_their_bounds_and_a_call_late(flights: list[dict[str, Any]]) -> None:
    """Of each axis, in the direction that the corner says; the rate is the gyro's less that of Hill's frame."""
    for flight in flights:
        calls = flight["calls"]
        x, seen = columns(calls, "state").numpy(), columns(calls, "seen").numpy()
        error = ERRORS[:, None] * (2.0 * columns(calls, "corner").numpy()[:12] - 1.0)
        then = np.maximum(np.arange(len(calls)) - 1, 0)
        x, error = x[:, then], error[:, then]
        attitude = Rotation.from_quat(x[Q].T)
        turned = (attitude.inv() * Rotation.from_quat(seen[Q].T)).as_rotvec().T
        of_frame = attitude.inv().apply([0.0, 0.0, U1.inspection.mean_motion]).T
        found = (seen[P] - x[P], seen[V] - x[V], turned, seen[OMEGA] - x[OMEGA] + of_frame)
        np.testing.assert_allclose(np.concatenate(found), error, rtol=0, atol=1e-9)


def test_the_corners_are_those_of_the_adversary(flights: list[dict[str, Any]], told: SafetyFilter) -> None:
    """Where its slopes are no rounding."""
    calls = [call for flight in flights for call in flight["calls"]]
    x, held, corner = (columns(calls, name) for name in ("state", "control", "corner"))
    before = torch.cat([sent(flight) for flight in flights], -1)[0].nan_to_num()
    greedy = Greedy(told)
    slopes = greedy.slopes(x, before)[0], -greedy.slopes(x, held)[1] * held
    for slope, chosen in zip(slopes, (corner[:12], corner[12:18]), strict=True):
        is_clear = slope.abs() > 1e-9
        assert is_clear.float().mean() > 0.2
        np.testing.assert_array_equal((slope > 0.0)[is_clear], chosen[is_clear] > 0.0)


def test_a_call_is_missed_where_the_last_command_does_more_harm(
    flights: list[dict[str, Any]], told: SafetyFilter, result: FilterResult
) -> None:
    """By Python's margins of the last command and of Python's answer; two in a row at most, none of them the first."""
    greedy, kept = Greedy(told), 0
    answers = result.control.split([len(flight["calls"]) for flight in flights], 1)
    for flight, answer in zip(flights, answers, strict=True):
        calls = flight["calls"]
        x, before = columns(calls, "state"), sent(flight)[0].nan_to_num()
        nothing = x.new_zeros(12, len(calls))
        harms = greedy.ahead(x, nothing, before) < greedy.ahead(x, nothing, answer)
        in_a_row = 0
        for i, call in enumerate(calls):
            may_be = i > 0 and in_a_row < 2
            assert call["missed"] == (may_be and bool(harms[i])), i
            kept += may_be and not call["missed"]
            in_a_row = in_a_row + 1 if call["missed"] else 0
            assert not call["missed"] or call["control"] == calls[i - 1]["control"]
        assert any(call["missed"] for call in calls)
    assert kept > 10  # also those that may be missed are not all


def test_a_saved_flight_is_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command that the page prints, with every error where it was; the filter is switched off on the way."""
    asked = {"start": "case 7", "pilot": "keys", "seconds": 90, "toggle": 60, "seed": 5, "plant": HEAVY}
    (flight,) = fly(asked | {"erring": True, "calls": True})
    monkeypatch.chdir(tmp_path)
    Path("flight.toml").write_text(flight["settings"])
    Path("flight.json").write_text(flight["saved_state"])
    Path("flight.npy").write_bytes(base64.b64decode(flight["saved_controls"]))
    simulate, _ = (each.removeprefix("python main.py ").split() for each in flight["command"].split(" && "))
    assert main.main(simulate) == 0
    flown = np.load("flight.npz")
    x = np.array([*flight["states"], flight["end"]])
    names = ("position", "velocity", "quaternion", "angular_velocity", "temperature", "energy", "sun_angle")
    again = np.concatenate([flown[name].reshape(len(x), -1) for name in names], 1)
    np.testing.assert_allclose(again, x, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(flown["control_applied"][:-1], controls(flight)[:, :6])
    assert flight["score"] == pytest.approx(flown["inspected_score"][-1], abs=1e-12)
    # its corners say nothing in a world without errors
    assert_refused(
        [word for word in simulate if word not in ("--config", "flight.toml")], ["corners"], capsys
    )


def test_nothing_is_violated() -> None:
    """In the lightest and the heaviest of plants; and so flown without the filter, every flight is."""
    asked = [
        {"start": start, "pilot": pilot, "plant": plant, "seconds": SECONDS, "seed": 11, "erring": True}
        for start in STARTS
        for pilot in PILOTS
        for plant in (LIGHT, HEAVY)
    ]
    for each, flight in zip(asked, fly(*asked), strict=True):
        assert flight["broken"] == {} and flight["outcome"] is None, each
        assert flight["statuses"][1] > 0 and flight["statuses"][3] == 0, each
    off = [each | {"filtered": False} for each in asked]
    for each, flight in zip(off, fly(*off), strict=True):
        assert flight["broken"], each

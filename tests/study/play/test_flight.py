"""The shipped page's flight, flown by Node: beside Python, and what the page promises."""

import base64
import io
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation

import main
from inspection.model.dynamics import step
from inspection.model.state import THRUST, TORQUE, P
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from settings import load
from study.config import Config
from study.files import ROOT
from study.play.printed import PILOT

AGENT = ROOT / "runs/reference/study/rta/seed0/policy.pt"
PAGE = ROOT / "runs/reference/play.html"
C = Config()
U1 = load("configs/plants/u1.toml", Config())
U1 = replace(U1, plant=replace(U1.plant, errors="worst"))  # the page's other world
LIMIT = np.array(C.inspection.control_limit)
STARTS = ("case 0", "case 7", "ram", "leaving", "battery")
PILOTS = ("keys", "random", "outward", "adversary")
SECONDS = 600  # of each flight of a promise


def fly(*flights: dict[str, Any], page: Path = PAGE) -> list[dict[str, Any]]:
    """What `fly.js` says of flights of a page."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no Node here")
    done = subprocess.run(
        [node, str(Path(__file__).with_name("fly.js")), str(page)],
        input=json.dumps(flights),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout))


def columns(calls: list[dict[str, Any]], name: str) -> torch.Tensor:
    """(size, calls)"""
    return torch.tensor([call[name] for call in calls], dtype=torch.float64).T


def filtered(period: float) -> SafetyFilter:
    """The page's filter, solved as its C does."""
    return SafetyFilter(C.inspection, replace(C.rta, period=period, qp_solver="batched"))


@pytest.fixture(scope="module")
def beside() -> dict[float, list[dict[str, Any]]]:
    """Flights by period, with every call."""
    asked = [
        {"start": start, "pilot": pilot, "period": period, "seconds": 30 * period, "seed": 3, "calls": True}
        for period in PERIODS
        for pilot in ("random", "adversary")
        for start in STARTS
    ]
    found = fly(*asked)
    return {
        period: [each for one, each in zip(asked, found, strict=True) if one["period"] == period]
        for period in PERIODS
    }


@pytest.mark.parametrize("period", PERIODS)
def test_the_filter_answers_as_in_python(period: float, beside: dict[float, list[dict[str, Any]]]) -> None:
    calls = [call for flight in beside[period] for call in flight["calls"]]
    assert len(calls) == 300
    x, desired = columns(calls, "state"), columns(calls, "desired")
    safety_filter = filtered(period)
    result = safety_filter.correct(x, desired)
    status, verified, backup = columns(calls, "answer")
    assert (result.control != desired).any(0).sum() > 150  # it has something to do
    np.testing.assert_array_equal(result.status, status)
    np.testing.assert_array_equal(result.verified, verified)
    np.testing.assert_array_equal(result.backup, backup)
    np.testing.assert_array_equal(result.active, columns(calls, "active"))
    apart = ((columns(calls, "control") - result.control).T.numpy() / LIMIT).T
    assert np.abs(apart[TORQUE]).max() < 1e-8
    # the browser's sine and cosine have other last digits, which rows through ten seconds may multiply
    far = np.abs(apart[THRUST]).max(0) > 1e-9
    assert far.mean() < 0.01 and np.abs(apart[THRUST]).max() < 1e-7
    np.testing.assert_allclose(columns(calls, "h"), safety_filter.values(x), rtol=1e-9, atol=1e-9)


def controls(flight: dict[str, Any]) -> np.ndarray:
    """The controls (seconds, 6) that a flight saves."""
    return np.load(io.BytesIO(base64.b64decode(flight["saved_controls"])))


@pytest.mark.parametrize("period", PERIODS)
def test_the_model_moves_as_in_python(period: float, beside: dict[float, list[dict[str, Any]]]) -> None:
    for flight in beside[period]:
        x = torch.tensor(flight["states"], dtype=torch.float64).T
        after = step(x, torch.from_numpy(controls(flight).T.copy()), 1.0, C.inspection)
        found = np.column_stack((x[:, 1:], flight["end"]))
        np.testing.assert_allclose(found, after, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("period", PERIODS)
def test_the_way_to_rest_begins_behind_the_hold_and_stays_clear(
    period: float, beside: dict[float, list[dict[str, Any]]]
) -> None:
    for flight in beside[period]:
        for call in flight["calls"]:
            x, u = (torch.tensor(call[name], dtype=torch.float64)[:, None] for name in ("state", "control"))
            for _ in range(round(period)):
                x = step(x, u, 1.0, C.inspection)
            shown = np.reshape(call["way"], (-1, 3))[: call["places"]]
            assert len(shown) > 0
            # the backup steps over a hold in fewer steps
            np.testing.assert_allclose(shown[0], x[P, 0], rtol=0, atol=1e-4)
            distance = np.linalg.norm(shown, axis=1)
            assert (distance > C.inspection.collision_radius).all()
            assert (distance < C.inspection.max_distance).all()


def test_free_flight_is_that_of_the_equations(beside: dict[float, list[dict[str, Any]]]) -> None:
    n = C.inspection.mean_motion
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4], a[4, 3], a[5, 2] = 3 * n**2, 2 * n, -2 * n, -(n**2)
    for flight in beside[1.0]:
        places = np.reshape(flight["ahead"], (-1, 3))
        for i, place in enumerate(places):
            there = scipy.linalg.expm(a * (500.0 / len(places)) * i) @ flight["end"][:6]
            np.testing.assert_allclose(place, there[:3], rtol=0, atol=1e-6)


def test_a_saved_flight_is_flown_again(tmp_path: Path) -> None:
    """The filter is switched off on the way, and somebody holds keys."""
    (flight,) = fly(
        {
            "start": "case 7",
            "pilot": "keys",
            "seconds": 150,
            "toggle": 60,
            "calls": True,
            "period": 1,
            "seed": 5,
        }
    )
    assert len(flight["calls"]) == 60 and flight["time"] == 150
    start, actions, out = (tmp_path / name for name in ("flight.json", "flight.npy", "flight.npz"))
    start.write_text(flight["saved_state"])
    actions.write_bytes(base64.b64decode(flight["saved_controls"]))
    words = ["simulate", "--no-rta", "--controller", "recorded", "--actions", str(actions), "--step", "1"]
    words += ["--initial-state", str(start), "--duration", "150", "--out", str(out)]
    assert main.main(words) == 0
    flown = np.load(out)
    x = np.array([*flight["states"], flight["end"]])
    names = ("position", "velocity", "quaternion", "angular_velocity", "temperature", "energy", "sun_angle")
    again = np.concatenate([flown[name].reshape(len(x), -1) for name in names], 1)
    np.testing.assert_allclose(again, x, rtol=0, atol=1e-9)
    assert 0.0 < flight["score"] == pytest.approx(flown["inspected_score"][-1], abs=1e-12)
    np.testing.assert_array_equal(flown["inspected"][-1], np.array(flight["inspected"]) > 0.0)
    thrust = np.abs(controls(flight)[:, :3]).sum() / C.inspection.mass
    assert flight["deltaV"] == pytest.approx(thrust)


@pytest.mark.parametrize("axis", range(3))
def test_thrust_along_the_orbits_axes_is_turned_into_the_body(axis: int) -> None:
    thrust = np.eye(3)[axis]
    keys = {"thrust": thrust.tolist(), "torque": [0, 0, 0]}
    asked = {"start": "case 7", "pilot": "you", "axes": "hill", "keys": keys, "filtered": False, "period": 1}
    (flight,) = fly(asked | {"seconds": 30, "calls": True})
    attitude = Rotation.from_quat(np.array(flight["states"])[:, 6:10])
    along = attitude.apply(controls(flight)[:, :3]) / C.inspection.max_thrust
    np.testing.assert_allclose(along, np.tile(thrust, (30, 1)), rtol=0, atol=1e-9)


# what the page promises


@pytest.fixture(scope="module")
def attempts() -> list[dict[str, Any]]:
    return [
        {"start": start, "pilot": pilot, "period": period, "seconds": SECONDS, "seed": seed}
        for start in STARTS
        for pilot in PILOTS
        for period in PERIODS
        for seed in (11, 12)
    ]


def test_with_the_filter_on_nothing_is_violated(attempts: list[dict[str, Any]]) -> None:
    for asked, flight in zip(attempts, fly(*attempts), strict=True):
        assert flight["broken"] == {} and flight["outcome"] in (None, "success"), asked
        assert flight["time"] == SECONDS or flight["outcome"] == "success"
        assert flight["statuses"][1] > 0 and flight["statuses"][3] == 0, asked


def test_with_the_filter_off_the_same_commands_break_every_flight(attempts: list[dict[str, Any]]) -> None:
    """So that what is above could fail."""
    off = [each | {"filtered": False} for each in attempts if each["period"] == 1]
    for asked, flight in zip(off, fly(*off), strict=True):
        assert flight["broken"], asked


@pytest.mark.parametrize(
    ("start", "outcome", "limit"),
    [
        ("ram", "crash", "passive_safety"),
        ("leaving", "out_of_bounds", "keep_in_zone"),
        ("battery", "out_of_power", "battery"),
    ],
)
def test_a_start_ends_badly_without_a_hand_and_without_the_filter(
    start: str, outcome: str, limit: str
) -> None:
    free = {"start": start, "pilot": "you", "seconds": SECONDS, "period": 1}
    off, on = fly(free | {"filtered": False}, free)
    assert off["outcome"] == outcome and limit in off["broken"] and off["time"] < SECONDS
    assert on["outcome"] is None and on["broken"] == {}


def test_the_agent_flies_as_in_python(tmp_path: Path) -> None:
    """A whole episode; the network is of single precision there and of double here."""
    flies_as_in_python("agent", tmp_path, "policy", "--checkpoint", str(AGENT))


def test_the_guidance_flies_as_in_python(tmp_path: Path) -> None:
    flies_as_in_python("guide", tmp_path, PILOT, "--rta")


def flies_as_in_python(pilot: str, directory: Path, *controller: str) -> None:
    """From a common case to its success, beside `simulate` with a controller and its flags."""
    (flight,) = fly({"start": "case 0", "pilot": pilot, "seconds": 6000, "period": 1, "calls": True})
    assert flight["outcome"] == "success" and flight["broken"] == {}
    assert flight["score"] >= C.inspection.success_score
    start, out = directory / "start.json", directory / "flight.npz"
    start.write_text(flight["saved_state"])
    words = ["simulate", "--controller", *controller, "--initial-state", str(start)]
    assert main.main([*words, "--duration", str(flight["time"]), "--out", str(out)]) == 0
    flown = np.load(out)
    places = np.array([*flight["states"], flight["end"]])[:, :3]
    assert np.abs(flown["position"] - places).max() < 1e-3
    assert flown["inspected_score"][-1] == pytest.approx(flight["score"], abs=1e-9)

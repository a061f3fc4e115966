"""The shipped page's flight, flown by Node: beside Python, and what the page promises; with errors, and without."""

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
import torch
from scipy.spatial.transform import Rotation

import main
from inspection.model.dynamics import step
from inspection.model.state import OMEGA, THRUST, TORQUE, P, Q, V
from rta.fast.filter import batched
from rta.filter import SafetyFilter
from rta.parameters import PERIODS
from settings import load
from study.config import Config
from study.experiment import filter_of
from study.files import ROOT
from study.verification.adversaries import Greedy
from study.web.module import PILOT

AGENT = ROOT / "runs/reference/from_nothing/rta/seed0/policy.pt"
PAGE = ROOT / "runs/reference/play.html"
C = Config()
U1 = load("configs/plants/u1.toml", Config())
LIMIT = np.array(C.inspection.control_limit)
STARTS = ("case 0", "case 7", "ram", "leaving", "battery")
LIGHT, HEAVY = 0, 4  # plants by their mass
WORLDS = (*PERIODS, "errors")  # by the filter's period; that with errors
ERRORS = np.repeat([0.6, 0.006, np.radians(0.3), np.radians(0.03)], 3)  # of U1, three sigmas
STATE = ("position", "velocity", "quaternion", "angular_velocity", "temperature", "energy", "sun_angle")
Flight = dict[str, Any]


def fly(*flights: Flight) -> list[Flight]:
    """Returns the output of `fly.js` for flights of the page."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no Node here")
    words = [node, str(Path(__file__).with_name("fly.js")), str(PAGE)]
    done = subprocess.run(words, input=json.dumps(flights), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return list(json.loads(done.stdout))


def of_world(world: float | str) -> Flight:
    return {"erring": True} if world == "errors" else {"period": world}


def columns(calls: list[Flight], name: str) -> torch.Tensor:
    """Returns an array (size, calls)."""
    return torch.tensor([call[name] for call in calls], dtype=torch.float64).T


def controls(flight: Flight) -> np.ndarray:
    """Returns the controls (seconds, 6), with errors and corners (seconds, 25), that a flight saves."""
    return np.load(io.BytesIO(base64.b64decode(flight["saved_controls"])))


@pytest.fixture(scope="module")
def flights() -> dict[float | str, list[Flight]]:
    """Flights by world, with every call."""
    common = {"seed": 3, "calls": True}
    asked = [
        common | of_world(world) | {"start": start, "pilot": pilot, "seconds": 15 * world}
        for world in PERIODS
        for pilot in ("random", "adversary")
        for start in STARTS
    ]
    asked += [
        common | of_world("errors") | {"start": start, "pilot": pilot, "plant": plant, "seconds": 20}
        for start in STARTS
        for pilot in ("keys", "adversary")
        for plant in (LIGHT, HEAVY)
    ]
    found: dict[float | str, list[Flight]] = {world: [] for world in WORLDS}
    for one, flight in zip(asked, fly(*asked), strict=True):
        found[one.get("period", "errors")].append(flight)
    return found


def filtered(world: float | str) -> SafetyFilter:
    """Returns the page's filter, solved as its C does."""
    if world == "errors":
        return batched(filter_of(U1))
    return batched(filter_of(replace(C, rta=replace(C.rta, period=world))))


def sent(flight: Flight) -> torch.Tensor:
    """Returns the controls (1, 6, calls) held since the state that a call saw was measured, NaN if it was new."""
    held = columns(flight["calls"], "control")
    return torch.cat((torch.full_like(held[:, :1], torch.nan), held[:, :-1]), 1)[None]


@pytest.mark.parametrize("world", WORLDS)
def test_the_filter_answers_as_in_python(
    world: float | str, flights: dict[float | str, list[Flight]]
) -> None:
    calls = [call for flight in flights[world] for call in flight["calls"]]
    safety_filter, seen, desired = filtered(world), columns(calls, "seen"), columns(calls, "desired")
    told = {"sent": torch.cat([sent(each) for each in flights[world]], -1)} if world == "errors" else {}
    result = safety_filter.correct(seen, desired, **told)
    status, verified, backup = columns(calls, "answer")
    assert (result.control != desired).any(0).sum() > 0.4 * len(calls) >= 60  # it has something to do
    np.testing.assert_array_equal(result.status, status)
    np.testing.assert_array_equal(result.verified, verified)
    np.testing.assert_array_equal(result.backup, backup)
    np.testing.assert_array_equal(result.active, columns(calls, "active"))
    given = ~torch.tensor([call["missed"] for call in calls])  # the other calls were missed
    apart = ((columns(calls, "control") - result.control).T.numpy() / LIMIT)[given].T
    assert apart.shape[1] > 100 and np.abs(apart[TORQUE]).max() < 1e-8
    # the browser's sine and cosine have other last digits, which rows through ten seconds may multiply
    far = np.abs(apart[THRUST]).max(0) > 1e-9
    assert far.mean() < 0.01 and np.abs(apart[THRUST]).max() < 1e-7
    x = columns(calls, "state")
    np.testing.assert_allclose(columns(calls, "values"), safety_filter.values(x), rtol=1e-9, atol=1e-9)


def test_the_model_moves_as_in_python(flights: dict[float | str, list[Flight]]) -> None:
    for flight in flights[1.0]:
        x = torch.tensor(flight["states"], dtype=torch.float64).T
        after = step(x, torch.from_numpy(controls(flight).T.copy()), 1.0, C.inspection)
        found = np.column_stack((x[:, 1:], flight["end"]))
        np.testing.assert_allclose(found, after, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("period", PERIODS)
def test_the_way_to_rest_begins_behind_the_hold_and_stays_clear(
    period: float, flights: dict[float | str, list[Flight]]
) -> None:
    calls = [call for flight in flights[period] for call in flight["calls"]]
    x, u = columns(calls, "state"), columns(calls, "control")
    for _ in range(round(period)):
        x = step(x, u, 1.0, C.inspection)
    for call, first in zip(calls, x[P].T, strict=True):
        shown = np.reshape(call["way"], (-1, 3))[: call["places"]]
        assert len(shown) > 0
        # the backup takes fewer steps over a hold
        np.testing.assert_allclose(shown[0], first, rtol=0, atol=1e-4)
        distance = np.linalg.norm(shown, axis=1)
        assert C.inspection.collision_radius < distance.min() and distance.max() < C.inspection.max_distance


def test_the_sensors_err_by_their_bounds_and_a_call_late(flights: dict[float | str, list[Flight]]) -> None:
    """Of each axis, in the direction that the corner says; the rate is the gyro's less that of Hill's frame."""
    for flight in flights["errors"]:
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


@pytest.mark.campaign
def test_corners_and_missed_calls_are_those_of_the_adversary(
    flights: dict[float | str, list[Flight]],
) -> None:
    """Where its slopes are no rounding. Calls are missed, two in a row at most, where that does more harm."""
    told, kept = filtered("errors"), 0
    greedy, calls = Greedy(told), [call for flight in flights["errors"] for call in flight["calls"]]
    last = torch.cat([sent(flight) for flight in flights["errors"]], -1)
    x, held, corner = (columns(calls, name) for name in ("state", "control", "corner"))
    before, nothing = last[0].nan_to_num(), x.new_zeros(12, len(calls))
    slopes = greedy.slopes(x, before)[0], -greedy.slopes(x, held)[1] * held
    for slope, chosen in zip(slopes, (corner[:12], corner[12:18]), strict=True):
        is_clear = slope.abs() > 1e-9
        assert is_clear.float().mean() > 0.2
        np.testing.assert_array_equal((slope > 0.0)[is_clear], chosen[is_clear] > 0.0)
    answer = told.correct(columns(calls, "seen"), columns(calls, "desired"), sent=last).control
    harms = iter((greedy.ahead(x, nothing, before) < greedy.ahead(x, nothing, answer)).tolist())
    for flight in flights["errors"]:
        in_a_row = 0
        for i, (call, harm) in enumerate(zip(flight["calls"], harms, strict=False)):
            may_be = i > 0 and in_a_row < 2
            assert call["missed"] == (may_be and harm), i
            kept += may_be and not call["missed"]
            in_a_row = in_a_row + 1 if call["missed"] else 0
            assert not call["missed"] or call["control"] == flight["calls"][i - 1]["control"]
        assert any(call["missed"] for call in flight["calls"])
    assert kept > 10  # also those that may be missed are not all


@pytest.mark.parametrize("world", [1.0, "errors"])
def test_a_saved_flight_is_flown_again(
    world: float | str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the commands that the page prints. The filter is switched off on the way, and somebody holds keys."""
    asked = {"start": "case 7", "pilot": "keys", "seconds": 150, "toggle": 60, "seed": 5, "plant": HEAVY}
    (flight,) = fly(asked | of_world(world) | {"calls": True})
    assert len(flight["calls"]) == 60 and flight["time"] == 150
    monkeypatch.chdir(tmp_path)
    Path("flight.toml").write_text(flight["settings"])
    Path("flight.json").write_text(flight["saved_state"])
    Path("flight.npy").write_bytes(base64.b64decode(flight["saved_controls"]))
    for command in flight["command"].split(" && "):
        assert main.main(command.removeprefix("python main.py ").split()) == 0
    flown, x = np.load("flight.npz"), np.array([*flight["states"], flight["end"]])
    again = np.concatenate([flown[name].reshape(len(x), -1) for name in STATE], 1)
    np.testing.assert_allclose(again, x, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(flown["control_applied"][:-1], controls(flight)[:, :6])
    assert 0.0 < flight["score"] == pytest.approx(flown["inspected_score"][-1], abs=1e-12)
    np.testing.assert_array_equal(flown["inspected"][-1], np.array(flight["inspected"]) > 0.0)
    if world != "errors":
        thrust = np.abs(controls(flight)[:, :3]).sum() / C.inspection.mass
        assert flight["deltaV"] == pytest.approx(thrust)


@pytest.mark.parametrize(
    ("pilot", "controller", "seconds"),
    [
        ("agent", f"policy {AGENT}", 500),
        pytest.param("agent", f"policy {AGENT}", 6000, marks=pytest.mark.campaign),
        pytest.param("guide", f"{PILOT} --rta", 6000, marks=pytest.mark.campaign),
    ],
)
def test_an_episode_is_flown_as_in_python(pilot: str, controller: str, seconds: int, tmp_path: Path) -> None:
    """Its beginning, or all of it. The network is of single precision there and of double here."""
    (flight,) = fly({"start": "case 0", "pilot": pilot, "seconds": seconds, "period": 1, "calls": True})
    is_whole = flight["outcome"] == "success"
    assert is_whole == (seconds == 6000) and flight["broken"] == {}
    assert (flight["score"] >= C.inspection.success_score) == is_whole and flight["score"] > 0.0
    start, out = tmp_path / "start.json", tmp_path / "flight.npz"
    start.write_text(flight["saved_state"])
    words = ["simulate", "--controller", *controller.replace("policy", "policy --checkpoint", 1).split()]
    words += ["--initial-state", str(start), "--duration", str(flight["time"]), "--out", str(out)]
    assert main.main(words) == 0
    flown = np.load(out)
    places = np.array([*flight["states"], flight["end"]])[:, :3]
    assert np.abs(flown["position"] - places).max() < 1e-3
    assert flown["inspected_score"][-1] == pytest.approx(flight["score"], abs=1e-9)


# what the page promises


def test_with_the_filter_on_nothing_is_violated_and_with_it_off_every_flight_is() -> None:
    asked = [
        of_world(world) | {"start": start, "pilot": pilot, "plant": plant, "seconds": seconds, "seed": seed}
        for start in STARTS
        for pilot in ("keys", "random", "adversary")
        for world in WORLDS
        for seed, plant, seconds in (
            [(11, LIGHT, 300), (11, HEAVY, 300)] if world == "errors" else [(11, 0, 600), (12, 0, 600)]
        )
    ]
    for one, flight in zip(asked, fly(*asked), strict=True):
        assert flight["broken"] == {} and flight["outcome"] in (None, "success"), one
        assert flight["time"] == one["seconds"] or flight["outcome"] == "success"
        assert flight["statuses"][1] > 0 and flight["statuses"][3] == 0, one
    off = [one | {"filtered": False} for one in asked if one.get("period", 1) == 1]
    for one, flight in zip(off, fly(*off), strict=True):
        assert flight["broken"], one

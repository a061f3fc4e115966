"""The offline filter's file: its programs are solved again by another method, its rows checked by differences."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import nnls

import main
from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from rta.backup.nominal_check import NominalBackup
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.qp.programs import Status
from study.flight import offline_filter
from study.flight.offline_filter import filter_states
from tests.oracles import Problems, given_slack, held, paper, thrust_fall
from tests.rta.test_filter import PRIORITY, commands, near_the_limits
from tests.test_main import assert_refused

C = InspectionParameters()
LIMIT = np.array(C.control_limit)
COUNT = 3000  # a few of them can keep every row, but not every margin


@pytest.fixture(scope="module")
def given() -> dict[str, ndarray]:
    """States near the limits with random commands; some fly outward so fast that only slack helps.

    Every tenth command is far beyond what the actuators can do.
    """
    desired = commands(COUNT).numpy().T.copy()
    desired[::10] *= 50.0
    return {"state": near_the_limits(COUNT).T.copy(), "control_desired": desired}


def written(given: dict[str, ndarray], directory: Path) -> dict[str, ndarray]:
    """What the command writes for these states."""
    np.savez(directory / "states.npz", **given)
    arguments = ["--states", str(directory / "states.npz"), "--out", str(directory / "out.npz")]
    assert main.main(["filter", *arguments, "--device", "cpu", "--qp-solver", "piqp"]) == 0
    return dict(np.load(directory / "out.npz"))


@pytest.fixture(scope="module")
def result(given: dict[str, ndarray], tmp_path_factory: pytest.TempPathFactory) -> dict[str, ndarray]:
    """What the command writes for them."""
    return written(given, tmp_path_factory.mktemp("offline"))


@pytest.fixture(scope="module")
def solution(given: dict[str, ndarray], tmp_path_factory: pytest.TempPathFactory) -> dict[str, ndarray]:
    """What it writes without the check of its controls, `rta.backup`: what the programs answer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NominalBackup, "of", lambda c, period: None)
        return written(given, tmp_path_factory.mktemp("programs"))


def optimum(u_desired: ndarray, a: ndarray, b: ndarray, weight: ndarray) -> ndarray:
    """u (6,) of min |(u - u_desired) / limit|^2 + sum weight delta^2, a u + b >= delta, |u| <= limit.

    Lawson and Hanson's reduction of the least-distance program to non-negative least squares: with
    z = ((u - u_desired) / limit, sqrt(weight) delta) it is the shortest z with G z >= h.
    """
    soft = np.isfinite(weight)
    relief = -np.diag(1.0 / np.sqrt(np.where(soft, weight, 1.0)))[:, soft]
    scaled = a * LIMIT
    box = np.hstack((np.vstack((np.eye(6), -np.eye(6))), np.zeros((12, soft.sum()))))
    g = np.vstack((np.hstack((scaled, relief)), box))
    v = u_desired / LIMIT
    h = np.concatenate((-b - scaled @ v, -1.0 - v, -1.0 + v))
    length = np.linalg.norm(g, axis=1)
    length[length == 0.0] = 1.0
    g, h = g / length[:, None], h / length
    dual, _ = nnls(np.vstack((g.T, h)), np.append(np.zeros(g.shape[1]), 1.0), maxiter=10_000)
    remainder = np.append(g.T @ dual, h @ dual - 1.0)
    return (v - remainder[:6] / remainder[-1]) * LIMIT


def test_the_file_holds_what_is_promised(result: dict[str, ndarray]) -> None:
    rows = len(result["constraint_of_row"])
    shapes = {name: array.shape[1:] for name, array in result.items() if array.shape[0] == COUNT}
    assert shapes == {
        "control_safe": (6,),
        "h": (13,),
        "A": (13, 6),
        "b": (13,),
        "active": (13,),
        "slack": (13,),
        "status": (),
        "violated": (),
        "verified": (),
        "backup": (),
        "shortfall": (13,),
        "A_all": (rows, 6),
        "b_all": (rows,),
        "slack_weight": (rows,),
        "with_margins": (2,),
    }
    assert tuple(result["constraints"]) == CONSTRAINTS
    assert (result["active"].dtype, result["status"].dtype.kind) == (bool, "i")


def test_another_solver_finds_the_same_controls(
    given: dict[str, ndarray], solution: dict[str, ndarray]
) -> None:
    chosen = [i for status in range(3) for i in np.flatnonzero(solution["status"] == status)[:40]]
    assert {status: (solution["status"][chosen] == status).sum() >= 20 for status in (1, 2)} == {1: 1, 2: 1}
    without_margins = (solution["status"] == Status.HARD) & ~solution["with_margins"].all(1)
    chosen += list(np.flatnonzero(without_margins)[:20])
    assert without_margins.any()
    for i in chosen:
        a, b, weight = (solution[name][i] for name in ("A_all", "b_all", "slack_weight"))
        floor = np.maximum(b, -100.0 * np.maximum(np.linalg.norm(a * LIMIT, axis=1), 1e-6))
        desired = given["control_desired"][i]
        again = optimum(desired, a, floor, weight)
        # at a bound that is reached without a force, an interior point stops the root of its tolerance short of it
        tolerance = 1e-5 if (np.abs(desired) > LIMIT).any() else 1e-6
        np.testing.assert_allclose(again / LIMIT, solution["control_safe"][i] / LIMIT, atol=tolerance)


def test_slack_weights_are_those_of_the_stage_used(solution: dict[str, ndarray]) -> None:
    """Of the rows that must be given slack for some control to satisfy the others, by linear programming."""
    yielded = solution["status"] == Status.SLACK
    assert np.isinf(solution["slack_weight"][solution["status"] < Status.SLACK]).all()
    names = solution["constraints"][solution["constraint_of_row"]]
    weight = np.array([PRIORITY.get(name, 1e3) for name in names])
    stages = set()
    for group in (slice(0, 3), slice(3, 6)):
        own = np.array([name in (CONSTRAINTS[:7] if group.start == 0 else CONSTRAINTS[7:]) for name in names])
        a, b, found = (solution[name][yielded][:, own] for name in ("A_all", "b_all", "slack_weight"))
        a = a[..., group] * LIMIT[group]
        length = np.linalg.norm(a, axis=2).clip(1e-6)
        a, b = a / length[..., None], (b / length).clip(-100.0, 2.0)
        given = given_slack(Problems(np.zeros((len(a), 3)), a, b, b, weight[own]))
        np.testing.assert_allclose(found, given / length**2, rtol=1e-9)
        stages |= {(group.start, *np.unique(row[np.isfinite(row)])) for row in given}
    assert {(0,), (0, 1e3), (3,), (3, 1e3), (3, 1e3, 1e4)} <= stages


def test_each_constraints_row_is_the_one_that_binds(result: dict[str, ndarray]) -> None:
    u = result["control_safe"][:, None]  # a product of matrices would round by their size
    left, shown = ((result[a] * u).sum(2) + result[b] for a, b in (("A_all", "b_all"), ("A", "b")))
    for i in range(13):
        own = left[:, result["constraint_of_row"] == i]
        np.testing.assert_array_equal(shown[:, i], own.min(1))
    assert (result["constraint_of_row"] == CONSTRAINTS.index("passive_safety")).sum() == 5


def test_only_the_backup_changes_what_the_programs_answer(
    result: dict[str, ndarray], solution: dict[str, ndarray]
) -> None:
    """And slack is unsaid, of whole programs, where limits are known to be kept."""
    changed = (result["control_safe"] != solution["control_safe"]).any(1)
    np.testing.assert_array_equal(changed, result["backup"])
    assert 0.0 < changed.mean() < 1.0
    assert not (solution["verified"] | solution["backup"]).any()
    fell = (result["status"] != solution["status"]) & ~changed
    assert (fell & result["verified"]).any()
    assert (solution["status"][fell] == Status.SLACK).all() and (result["status"][fell] == Status.HARD).all()
    unsaid = result["shortfall"] != solution["shortfall"]
    assert (result["shortfall"][unsaid] == 0.0).all()
    assert (result["shortfall"][result["verified"]] == 0.0).all()


def test_conditions_hold_to_within_the_slack(solution: dict[str, ndarray]) -> None:
    shown = (solution["A"] @ solution["control_safe"][..., None])[..., 0] + solution["b"]
    length = np.linalg.norm(solution["A"] * LIMIT, axis=2)
    assert (shown >= solution["slack"] - 1e-6 * length - 1e-12).all()
    assert (solution["slack"] <= 0).all()
    assert (solution["slack"][solution["status"] <= Status.HARD] == 0).all()
    assert (solution["slack"] < 0).any()
    assert (solution["slack"][:, CONSTRAINTS.index("collision")] == 0)[
        solution["status"] < Status.UNSOLVED
    ].all()


def test_rows_are_the_rates_of_the_papers_constraints(
    given: dict[str, ndarray], result: dict[str, ndarray]
) -> None:
    """L_f h + L_g h u of dynamic speed against central differences along the simulated flight.

    Beyond the limit the row asks for no more than the 1/12 m/s^2 that 1 N gives.
    """
    i = CONSTRAINTS.index("dynamic_speed")
    x, u, dt = torch.from_numpy(given["state"].T), torch.from_numpy(result["control_safe"].T), 1e-3
    y = torch.from_numpy(held(x.numpy()))  # thrust acts along the attitude of mid-period
    ahead, behind = (paper(step(y, u, duration, C).numpy())[i] for duration in (dt, -dt))
    rate = (ahead - behind) / (2 * dt)
    pushed, h = (result["A"][:, i] * result["control_safe"]).sum(1), paper(x.numpy())[i]
    left = pushed + result["b"][:, i]
    expected = rate + RtaParameters().speed_gain * h - thrust_fall(x.numpy())[i]
    expected = np.where(h < 0.0, np.maximum(expected, pushed - 1 / 12), expected)
    fast = x[3:6].norm(dim=0).numpy() > 0.1  # |v| bends too much for differences at rest
    np.testing.assert_allclose(left[fast], expected[fast], atol=1e-6)


def test_chunks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offline_filter, "CHUNK", 200)
    safety = SafetyFilter(C, RtaParameters())
    x, u = torch.from_numpy(near_the_limits(203)), commands(203)
    whole, end = filter_states(safety, x, u), filter_states(safety, x[:, -5:], u[:, -5:])
    for name in ("control_safe", "A_all", "b_all", "status"):
        np.testing.assert_allclose(whole[name][-5:], end[name], rtol=1e-12, atol=1e-12)


def state(**changes: Any) -> ndarray:
    """(4, 16) good states, the last one changed by component: i3=5.0 sets component 3."""
    x = np.zeros((4, 16))
    x[:, 0], x[:, 9], x[:, 13], x[:, 14] = 60.0, 1.0, 5.0, 6.0
    for name, value in changes.items():
        x[-1, int(name[1:])] = value
    return x


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"state": state()}, ["control_desired is missing"]),
        ({"control_desired": np.zeros((4, 6))}, ["state is missing"]),
        ({"state": state()[:, :15]}, ["(4, 15)", "(N, 16)"]),
        ({"state": state()[0]}, ["(16,)", "(N, 16)"]),
        ({"state": np.float64(3.0)}, ["()", "(N, 16)"]),
        ({"state": state(), "control_desired": np.zeros((3, 6))}, ["(3, 6)", "same N"]),
        ({"state": np.zeros((0, 16)), "control_desired": np.zeros((0, 6))}, ["(0, 16)", "from 1"]),
        ({"state": state().astype(str)}, ["state", "numbers"]),
        ({"state": np.array([{}])}, ["not a .npz file of numbers"]),
        ({"state": state(i4=math.nan)}, ["state in row 3", "finite"]),
        ({"state": state(i4=math.inf)}, ["state in row 3", "finite"]),
        ({"state": state(i6=0.5)}, ["quaternion", "row 3", "length 1"]),
        ({"state": state(i0=0.0)}, ["position in row 3", "centre"]),
        ({"state": state(i13=-300.0)}, ["temperature in row 3", "-273.15"]),
        ({"state": state(i14=-1.0)}, ["energy in row 3", "negative"]),
        ({"state": state(), "control_desired": np.full((4, 6), np.nan)}, ["control_desired", "finite"]),
    ],
)
def test_bad_states_are_refused(
    content: dict[str, ndarray], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "states.npz"
    if "state" in content and len(words) > 1:
        content = {"control_desired": np.zeros((4, 6))} | content
    np.savez(path, **content)
    arguments = ["filter", "--states", str(path), "--out", str(tmp_path / "out.npz")]
    assert_refused(arguments, [str(path), *words], capsys)
    assert not (tmp_path / "out.npz").exists()

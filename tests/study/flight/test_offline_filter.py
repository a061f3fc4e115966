"""The offline filter's file: its programs are solved again by another method, its rows checked by differences."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray

import main
from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from rta.limits import PAPER
from rta.names import CONSTRAINTS
from rta.paper import GIVEN
from rta.result import Status
from study.flight import offline_filter
from tests.oracles import PAPERS_WEIGHTS, PSM_TOLERANCE, by_nnls, paper
from tests.support.flights import commands, near_the_limits
from tests.test_main import assert_refused

C = InspectionParameters()
LIMIT = np.array(C.control_limit)
COUNT = 1000


@pytest.fixture(scope="module")
def given() -> dict[str, ndarray]:
    """Returns states near the limits with random commands; some fly outward so fast that only slack helps.

    Every tenth command is far beyond what the actuators can do.
    """
    desired = commands(COUNT).numpy().T.copy()
    desired[::10] *= 50.0
    return {"state": near_the_limits(COUNT).T.copy(), "control_desired": desired}


def written(given: dict[str, ndarray], directory: Path, *more: str) -> dict[str, ndarray]:
    """Returns the command's output for these states."""
    np.savez(directory / "states.npz", **given)
    arguments = ["--states", str(directory / "states.npz"), "--out", str(directory / "out.npz")]
    assert main.main(["filter", *arguments, "--device", "cpu", *more]) == 0
    return dict(np.load(directory / "out.npz"))


@pytest.fixture(scope="module")
def result(given: dict[str, ndarray], tmp_path_factory: pytest.TempPathFactory) -> dict[str, ndarray]:
    """Returns the command's output for the given states."""
    return written(given, tmp_path_factory.mktemp("offline"))


@pytest.fixture(scope="module")
def solution(given: dict[str, ndarray], tmp_path_factory: pytest.TempPathFactory) -> dict[str, ndarray]:
    """Returns the command's output for the given states with the paper's filter."""
    return written(given, tmp_path_factory.mktemp("paper"), "--rta-filter", "paper")


def test_the_file_holds_what_is_promised(given: dict[str, ndarray], result: dict[str, ndarray]) -> None:
    shapes = {name: array.shape[1:] for name, array in result.items() if array.shape[0] == COUNT}
    rows = dict.fromkeys(("h", "b", "active", "slack"), (13,))
    single = dict.fromkeys(("status", "violated", "verified", "backup"), ())
    assert shapes == {"control_safe": (6,), "A": (13, 6), **rows, **single}
    assert tuple(result["constraints"]) == CONSTRAINTS
    assert (result["active"].dtype, result["status"].dtype.kind) == (bool, "i")
    weights = [limit.weight or np.inf for limit in PAPER.values()]
    np.testing.assert_array_equal(result["slack_weight"], weights)
    for name, h, expected in zip(CONSTRAINTS, result["h"].T, paper(given["state"].T), strict=True):
        np.testing.assert_allclose(
            h, expected, rtol=0, atol=PSM_TOLERANCE if name == "passive_safety" else 1e-9
        )


def test_another_solver_finds_the_same_controls(
    given: dict[str, ndarray], solution: dict[str, ndarray]
) -> None:
    """To 1e-6 of a limit; with slack, whose weight of 1e12 leaves few digits, half of them."""
    chosen = np.concatenate([np.flatnonzero(solution["status"] == status)[:60] for status in range(3)])
    again = np.stack(
        [
            by_nnls(
                solution["A"][i] * LIMIT,
                solution["b"][i],
                given["control_desired"][i] / LIMIT,
                PAPERS_WEIGHTS,
            )
            for i in chosen
        ]
    )
    off = np.abs(again - solution["control_safe"][chosen] / LIMIT).max(1)
    slack = solution["status"][chosen] == Status.SLACK
    assert len(chosen) == 180 and off[~slack].max() < 1e-6
    assert np.median(off[slack]) < 1e-6 and off[slack].max() < 1e-2


def test_a_verified_control_has_no_slack_and_the_paper_s_filter_verifies_none(
    result: dict[str, ndarray], solution: dict[str, ndarray]
) -> None:
    assert 0.0 < result["backup"].mean() < 1.0 and 0.0 < result["verified"].mean() < 1.0
    assert not (solution["verified"] | solution["backup"]).any()
    assert (result["slack"][result["verified"]] == 0.0).all()
    assert (result["status"][result["verified"]] <= Status.HARD).all()
    np.testing.assert_array_equal(result["h"], solution["h"])
    np.testing.assert_array_equal(result["violated"], (result["h"] < 0.0).any(1))


def test_conditions_hold_to_within_the_slack(solution: dict[str, ndarray]) -> None:
    shown = (solution["A"] @ solution["control_safe"][..., None])[..., 0] + solution["b"]
    solved = solution["status"] < Status.UNSOLVED
    assert solved.any() and (shown >= solution["slack"] - GIVEN)[solved].all()
    assert (solution["slack"] <= 0).all()
    assert (solution["slack"][solution["status"] <= Status.HARD] == 0).all()
    assert (solution["slack"] < 0).any()
    assert (solution["slack"][:, CONSTRAINTS.index("collision")] == 0)[solved].all()


def test_conditions_are_the_rates_of_the_papers_constraints(
    given: dict[str, ndarray], result: dict[str, ndarray]
) -> None:
    """L_f h + L_g h u of dynamic speed against central differences along the simulated flight."""
    i = CONSTRAINTS.index("dynamic_speed")
    x, u, dt = torch.from_numpy(given["state"].T), torch.from_numpy(result["control_safe"].T), 1e-3
    ahead, behind = (paper(step(x, u, duration, C).numpy())[i] for duration in (dt, -dt))
    expected = (ahead - behind) / (2 * dt) + PAPER["dynamic_speed"].gains[0] * paper(x.numpy())[i]
    left = (result["A"][:, i] * result["control_safe"]).sum(1) + result["b"][:, i]
    fast = x[3:6].norm(dim=0).numpy() > 0.1  # |v| bends too much for differences at rest
    np.testing.assert_allclose(left[fast], expected[fast], atol=1e-6)


def test_chunks_do_not_show(
    given: dict[str, ndarray],
    solution: dict[str, ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(offline_filter, "CHUNK", 900)
    again = written(given, tmp_path, "--rta-filter", "paper")
    for name in ("control_safe", "A", "b", "status"):
        np.testing.assert_allclose(again[name], solution[name], rtol=1e-9, atol=1e-9)


def state(**changes: Any) -> ndarray:
    """Returns good states (4, 16), the last one changed by component: i3=5.0 sets component 3."""
    x = np.zeros((4, 16))
    x[:, 0], x[:, 9], x[:, 13], x[:, 14] = 60.0, 1.0, 5.0, 6.0
    for name, value in changes.items():
        x[-1, int(name[1:])] = value
    return x


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"state": state()[:, :15]}, ["(4, 15)", "(N, 16)"]),
        ({"state": np.float64(3.0)}, ["()", "(N, 16)"]),
        ({"state": state().astype(str)}, ["state", "numbers"]),
        ({"state": state(i4=math.nan)}, ["state in row 3", "finite"]),
        ({"state": state(i6=0.5)}, ["quaternion", "row 3", "length 1"]),
        ({"state": state(i0=0.0)}, ["position in row 3", "centre"]),
        ({"state": state(i13=-300.0)}, ["temperature in row 3", "-273.15"]),
        ({"state": state(i14=-1.0)}, ["energy in row 3", "negative"]),
        ({"control_desired": np.full((4, 6), np.nan)}, ["control_desired", "finite"]),
    ],
)
def test_bad_states_are_refused(
    content: dict[str, ndarray], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "states.npz"
    np.savez(path, **{"state": state(), "control_desired": np.zeros((4, 6))} | content)
    arguments = ["filter", "--states", str(path), "--out", str(tmp_path / "out.npz")]
    assert_refused(arguments, [str(path), *words], capsys)
    assert not (tmp_path / "out.npz").exists()

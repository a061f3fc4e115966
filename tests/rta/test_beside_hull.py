"""Collision and passive safety beside a convex hull, against distances along flights of an adaptive integrator."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from inspection.chief.hull import clearance, with_hull
from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P, Q, V
from rta.beside_hull import passive_safety
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from study.verification.adversaries import adversarial
from tests.inspection.chief.test_hull import MESHES, corners, distance, hull_of, some_positions

PAPER = InspectionParameters()
N = PAPER.mean_motion


def beside_the_chief(count: int, mesh: str, speed: float) -> tuple[torch.Tensor, InspectionParameters]:
    """Returns states 1 to 40 m from the deputy's touching the hull, with a speed in any direction; and the task."""
    c = with_hull(PAPER, hull_of(mesh))
    p = some_positions(40 * count, 7.0, 60.0)
    left = clearance(p, c)
    p = p[:, (left > 1.0) & (left < 40.0)][:, :count]
    x = torch.zeros(16, count, dtype=torch.float64)
    x[P], x[V], x[9] = p, speed * some_positions(count, 1.0, 1.0).flip(1), 1.0
    x[13], x[14], x[15] = c.initial_temperature[0], c.initial_energy[1], 2.0  # the Sun is behind the camera
    return x, c


def coasting(y: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Positions (times, 3) from a position and velocity (6,), Clohessy and Wiltshire's equations."""

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [*y[3:], 3 * N**2 * y[0] + 2 * N * y[4], -2 * N * y[3], -(N**2) * y[2]]

    return solve_ivp(rate, (0.0, times[-1]), y, "DOP853", times, rtol=1e-9, atol=1e-9).y[:3].T


@pytest.mark.parametrize("mesh", MESHES)
def test_passive_safety_is_never_above_what_a_flight_keeps(mesh: str) -> None:
    x, c = beside_the_chief(24, mesh, 0.15)
    h, body = passive_safety(x, c).numpy(), corners(mesh)
    assert (SafetyFilter(c).values(x)[CONSTRAINTS.index("passive_safety")].numpy() == h).all()
    times, lost = np.linspace(0.0, PAPER.passive_safety_horizon, 251), []
    for column, value in zip(x[:6].T.numpy(), h, strict=True):
        path = coasting(column, times)
        near = path[np.argsort(np.linalg.norm(path, axis=1))[:60]]
        true = min(distance(p, body) for p in near) - PAPER.deputy_radius
        lost.append(true - value)
    assert min(lost) > -0.02, "within what 2 s of flight between samples hide"
    assert np.median(lost) < 1.0 and max(lost) < 5.0


@pytest.mark.campaign
@pytest.mark.parametrize("mesh", MESHES)
@torch.no_grad()
def test_pushed_against_the_chief_it_comes_nearer_than_the_sphere_and_never_too_near(mesh: str) -> None:
    x, c = beside_the_chief(48, mesh, 0.0)
    safety = fast(SafetyFilter(c), "cpu", 48)
    x = x[:, safety.is_safe(x)]
    assert adversarial(safety)(0.0, x).isfinite().all()  # its rows are compiled, too
    body, nearest = corners(mesh), math.inf
    for _ in range(150):
        # all thrust towards the chief, in a body that does not turn
        desired = torch.zeros(6, x.shape[1], dtype=torch.float64)
        desired[:3] = -(x[P] / x[P].norm(dim=0)) * 2.0
        x = step(x, safety.correct(x, desired.clamp(-1.0, 1.0)).control, 1.0, c)
        assert (safety.values(x) >= 0.0).all()
        nearest = min(nearest, float(x[P].norm(dim=0).min()))
    assert min(distance(p, body) for p in x[P].T.numpy()) >= PAPER.deputy_radius
    assert nearest < PAPER.collision_radius - 3.0


@torch.no_grad()
def test_a_slow_flight_that_is_turned_stays_clear_of_the_next_corner() -> None:
    """Pushed at the chief along a panel at 0.17 m/s; with a single segment of 60 s h fell from 0.33 to -0.18 m in 1 s.

    Found by adversaries that start near the hull.
    """
    c = with_hull(PAPER, hull_of(MESHES[0]))
    safety = batched(SafetyFilter(c))
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[P, 0] = torch.tensor([-3.78524, -1.05287, -7.57457]).double()
    x[V, 0] = torch.tensor([-0.149214, 0.0271352, 0.0811173]).double()
    x[Q, 0] = torch.tensor([0.661589, -0.358741, 0.205219, 0.625692]).double()
    x[10:, 0] = torch.tensor([-0.0033, -0.0349, 0.03348, 3.14286, 4.27482, 2.94621]).double()
    desired = torch.tensor([[1.0, 0.569412, -0.63377, 0.0, -0.001, 0.0]], dtype=torch.float64).T
    for _ in range(4):
        assert safety.values(x).min() >= 0.0
        x = step(x, safety.correct(x, desired).control, 1.0, c)
    assert safety.values(x).min() >= 0.0

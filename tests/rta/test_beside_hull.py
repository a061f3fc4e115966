"""Collision and passive safety beside a convex hull, against distances along flights of an adaptive integrator."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from inspection.chief.hull import clearance, with_hull
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P, V
from rta.beside_hull import passive_safety
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from tests.inspection.chief.test_hull import MESHES, corners, distance, hull_of, some_positions
from tests.oracles import motion

PAPER = InspectionParameters()
N = PAPER.mean_motion


def beside_the_chief(count: int, mesh: str, speed: float) -> tuple[torch.Tensor, InspectionParameters]:
    """Returns states 1 to 40 m from the deputy's touching the hull, with a speed in any direction; and the task."""
    c = with_hull(PAPER, hull_of(mesh))
    p = some_positions(40 * count, 7.0, 60.0)
    left = clearance(p, c)
    x = torch.zeros(16, count, dtype=torch.float64)
    x[P] = p[:, (left > 1.0) & (left < 40.0)][:, :count]
    x[V] = speed * some_positions(count, 1.0, 1.0).flip(1)
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


@pytest.mark.parametrize("mesh", MESHES)
def test_safe_separation_is_that_of_the_best_plane(mesh: str) -> None:
    x, c = beside_the_chief(200, mesh, 0.5)
    x[P, ::2] *= 0.5  # within the hull, too
    h = SafetyFilter(c).values(x)[CONSTRAINTS.index("collision")].numpy()
    expected = motion(x[P].numpy(), x[V].numpy(), c, None)[0]
    np.testing.assert_allclose(h, expected, rtol=0, atol=1e-12)
    assert (h < 0.0).any() and (h > 0.0).any()

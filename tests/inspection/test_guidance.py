"""Classical controllers against what defines them."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch

from inspection import guidance
from inspection.model.dynamics import step
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, V
from inspection.orbits import Orbit
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from study.flight.state_files import read_state

C = InspectionParameters()
FILTER = SafetyFilter(C, RtaParameters())
DEMONSTRATION = str(Path(__file__).parents[2] / "configs" / "demonstration.json")


def at_rest(batch: int = 1) -> torch.Tensor:
    x = torch.zeros(SIZE, batch, dtype=torch.float64)
    x[P] = torch.tensor([[70.0], [-30.0], [20.0]], dtype=torch.float64)
    x[Q.start + 3] = 1.0
    x[THETA_S] = 0.4
    return x


def test_lqr_gain_solves_the_riccati_equation_and_stabilises() -> None:
    n = C.mean_motion
    gain = guidance.lqr_gain(C)
    a = np.array(
        [
            [0, 0, 0, 1, 0, 0],
            [0, 0, 0, 0, 1, 0],
            [0, 0, 0, 0, 0, 1],
            [3 * n**2, 0, 0, 0, 2 * n, 0],
            [0, 0, 0, -2 * n, 0, 0],
            [0, 0, -(n**2), 0, 0, 0],
        ]
    )
    b = np.vstack((np.zeros((3, 3)), np.eye(3) / C.mass))
    assert np.linalg.eigvals(a - b @ gain).real.max() < 0
    # with R = I the optimal cost matrix S gives K = B' S, and A' S + S A - K' K + Q = 0
    cost = scipy.linalg.solve_continuous_lyapunov(
        (a - b @ gain).T, -(np.diag([1e-4] * 3 + [1.0] * 3) + gain.T @ gain)
    )
    np.testing.assert_allclose(b.T @ cost, gain, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("a", [0.0, 30.0])
def test_natural_motion_needs_no_thrust_on_its_ellipse_whose_drift_never_ends_in_the_chief(a: float) -> None:
    x = at_rest()
    b, n, theta = Orbit().semi_minor, C.mean_motion, x[THETA_S]
    x[P] = torch.stack((b * theta.cos(), 2 * b * theta.sin(), a * theta.sin()))
    x[V] = n * torch.stack((b * theta.sin(), -2 * b * theta.cos(), -a * theta.cos()))
    assert guidance.natural_motion(C, orbit=Orbit(out_of_plane=a))(0.0, x)[:3].abs().max() < 1e-12
    orbit = free_flight(x[P], x[V], torch.linspace(0.0, 2 * math.pi / n, 1000).double()[:, None], n)
    assert orbit[[0, 2]].norm(dim=0).min() == pytest.approx(min(a, b), abs=0.1)  # from the line y


@pytest.mark.parametrize(("every", "points"), [(10.0, True), (12.5, False)])
def test_pointing_that_is_held_is_stable_where_its_frequency_suits_the_hold(
    every: float, points: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not points:
        monkeypatch.setattr(guidance, "HELD", 1.1)  # the bound that is derived is 1
    x = at_rest()
    x[P, 0], x[E] = torch.tensor([40.0, -10.0, 0.0]).double(), 5.0
    control = guidance.natural_motion(C, every)
    for _ in range(80):
        u = control(0.0, x)
        u[:3] = 0.0
        for _ in range(round(every / 2.5)):
            x = step(x, u, 2.5, C)
    assert (x[OMEGA].abs().max() < 0.1 * C.max_rate) == points


def test_natural_motion_leads_around_the_chief_to_its_sunlit_side() -> None:
    x = at_rest(5)
    azimuth = torch.tensor([0.0, 0.5, 1.5, 2.5, 3.1]).double()  # from the far side of the Sun to the near one
    azimuth, elevation = azimuth + x[THETA_S] + math.pi, torch.tensor([0.0, -0.5, 0.3, 0.1, 1.2]).double()
    across = elevation.cos()
    x[P] = 60.0 * torch.stack((azimuth.cos() * across, azimuth.sin() * across, elevation.sin()))
    x[E] = 5.0
    control, states = guidance.natural_motion(C), [x]
    for i in range(1000):
        x = step(x, control(2.0 * i, x), 2.0, C)
        states.append(x)
    way = torch.stack(states)
    assert way[:, P].norm(dim=1).min() > C.collision_radius
    half_a_turn = math.pi / C.max_rate  # s, in the dark at most, until the panels face the Sun
    assert way[:, E].min() > 5.0 - C.power_draw / 1000.0 * half_a_turn
    b, theta = Orbit().semi_minor, x[THETA_S]
    ellipse = torch.stack((b * theta.cos(), 2 * b * theta.sin(), torch.zeros(5)))
    torch.testing.assert_close(x[P], ellipse, atol=2.0, rtol=0.0)
    camera = guidance.rotate(x[Q], torch.eye(3, dtype=torch.float64)[:, :1])
    assert (-camera * x[P] / x[P].norm(dim=0)).sum(0).min() > math.cos(0.05)


def tour(duration: float, interval: float, safety: SafetyFilter | None = None) -> torch.Tensor:
    """Returns states (16, steps + 1) of the demonstration, from its state file."""
    x, _ = read_state(DEMONSTRATION, C)
    control, states = guidance.lqr_pd(C), [x]
    for i in range(round(duration / interval)):
        u = control(i * interval, x)
        x = step(x, safety.correct(x, u).control if safety else u, interval, C)
        states.append(x)
    return torch.cat(states, 1)


def test_the_demonstration_crosses_every_boundary_without_the_filter() -> None:
    states = tour(2000.0, 2.0)
    crossed = (FILTER.values(states) < 0.0).any(1).tolist()
    assert crossed == [True] * 10 + [False] * 3  # the plant saturates body rates at their limits
    assert (states[OMEGA].abs().amax(1) == C.max_rate).all()


def test_the_filter_holds_the_demonstration_at_its_first_boundaries() -> None:
    states = tour(140.0, 1.0, fast(FILTER))
    h = dict(zip(CONSTRAINTS, FILTER.values(states), strict=True))
    assert min(h[name].min() for name in CONSTRAINTS) >= 0.0
    alone = dict(zip(CONSTRAINTS, FILTER.values(tour(140.0, 1.0)), strict=True))
    # as near as the paper's gains let it come before they slow it down, m/s and rad
    for name, near in (("dynamic_speed", 0.2), ("attitude_exclusion", math.radians(6))):
        assert h[name].min() < near and alone[name].min() < 0.0


def test_lqr_pd_rests_at_its_set_point_with_the_thermal_side_in_the_sun() -> None:
    start, position = guidance.SET_POINTS[1]
    x = at_rest()
    x[P] = torch.tensor(position, dtype=torch.float64)[:, None]
    x[THETA_S] = -math.pi / 2  # of the unturned body, -n_y faces it
    assert guidance.lqr_pd(C)(start, x).abs().max() < 1e-12
    before = guidance.lqr_pd(C)(start - 1.0, x)[:3, 0]
    assert before @ (torch.tensor(guidance.SET_POINTS[0][1]) - x[P, 0]) > 0.0

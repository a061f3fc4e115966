"""Motion in Hill's frame against an inertial frame, matrix exponentials and brute force."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from inspection.model.dynamics import drift, integrate
from inspection.model.orbit import closest_pass, free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, P, Q, V
from tests.inspection.model.test_dynamics import A, N


def at(p, v):
    """Returns states at these positions and velocities, all else zero."""
    return torch.cat((p, v, p.new_zeros(SIZE - 6, p.shape[1])))


def clearance_by_brute_force(p, v, horizon, spacing):
    """Returns smallest distance on a dense grid, each column's positions from one matrix exponential per sample."""
    propagate, state = expm(A * spacing), np.concatenate((p, v))
    nearest = np.full(p.shape[1], np.inf)
    for _ in range(round(horizon / spacing) + 1):
        nearest = np.minimum(nearest, np.linalg.norm(state[:3], axis=0))
        state = propagate @ state
    return nearest


def test_free_flight_is_the_matrix_exponential(c, random_states):
    x, times = random_states(3), [0.0, 17.0, 500.0, 172800.0]
    path = free_flight(x[P, None], x[V, None], torch.tensor(times).double()[:, None], c.mean_motion)
    for k, t in enumerate(times):
        np.testing.assert_allclose(path[:, k], (expm(A * t) @ x[:6].numpy())[:3], rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("orbits", [1.0, pytest.param(5.7, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("drift", [1e-5, 1e-3])
def test_clearance_over_several_orbits_is_that_of_a_dense_sampling(c, orbits, drift):
    """Slow and quick drifts along the track, towards the chief and away from it."""
    g = torch.Generator().manual_seed(3)
    p, v = (torch.randn(3, 60, generator=g, dtype=torch.float64) for _ in range(2))
    p, v = 60.0 * p, 0.05 * v
    v[1] = -2 * c.mean_motion * p[0] + drift * v[1] / 0.05
    horizon = round(orbits * 2 * math.pi / c.mean_motion)
    brute = clearance_by_brute_force(p.numpy(), v.numpy(), horizon, 1.0)
    for spacing, error in ((10.0, 0.1), (100.0, 1.0)):
        found = closest_pass(at(p, v), horizon, c, spacing).norm(dim=0).numpy()
        later = clearance_by_brute_force(p.numpy(), v.numpy(), horizon + spacing, 1.0)  # the last chord's end
        assert (found < brute + error).all() and (found > later - error).all()
    assert (brute < 15.0).any() and (brute > 30.0).any()


def test_clearance_sees_a_pass_between_two_samples(c):
    p = torch.tensor([[25.0], [3.0], [0.0]], dtype=torch.float64)
    v = torch.tensor([[-5.0], [0.0], [0.0]], dtype=torch.float64)
    on_the_grid = torch.arange(0.0, 501.0, 10.0, dtype=torch.float64)
    sampled = free_flight(p, v, on_the_grid, c.mean_motion).norm(dim=0).min()
    clearance = closest_pass(at(p, v), 500.0, c).norm(dim=0)
    brute = clearance_by_brute_force(p.numpy(), v.numpy(), 500.0, 0.01)
    assert sampled > 24.0
    np.testing.assert_allclose(clearance, brute, rtol=0, atol=0.15)
    assert clearance < 3.5


def test_clohessy_and_wiltshires_is_the_slope_of_the_exact_acceleration_at_the_chief():
    """Two bodies about a point mass, seen from a frame that turns with the chief."""
    mu = 3.986004418e14
    chief, turning = torch.tensor([[(mu / N**2) ** (1 / 3), 0.0, 0.0], [0.0, 0.0, N]], dtype=torch.float64)

    def exact(s):
        p, v = s[:3], s[3:]
        r = chief + p
        coriolis, centrifugal = (
            torch.linalg.cross(turning, part) for part in (2 * v, torch.linalg.cross(turning, r))
        )
        return -mu * r / r.norm() ** 3 - coriolis - centrifugal

    assert exact(torch.zeros(6).double()).norm() < 1e-12  # the chief stays where it is
    slope = torch.func.jacfwd(exact)(torch.zeros(6).double())
    np.testing.assert_allclose(slope, A[3:], rtol=1e-9, atol=1e-14)


def test_nothing_natural_exceeds_the_largest_drift_and_the_worst_comes_near():
    c, g = InspectionParameters(mean_motion=0.0011), torch.Generator().manual_seed(0)
    x = torch.randn(SIZE, 200_000, generator=g, dtype=torch.float64)
    x[P] *= c.max_distance / x[P].norm(dim=0)
    x[V] *= 5.0 / x[V].norm(dim=0)
    x[Q] /= x[Q].norm(dim=0)
    found = drift(x, c)[V].norm(dim=0).max().item()
    most = c.largest_drift(c.max_distance, 5.0)
    assert 0.75 * most < found <= most


def test_attitude_relative_to_hills_frame_is_the_inertial_one_turned_back(random_states):
    """A gyro's rate stays as it is where no torque acts on a body with equal moments."""
    x, seconds = random_states(6), 200.0
    c = InspectionParameters(hill_rotation=True)
    end = integrate(x, torch.zeros(6, 6).double(), 1.0, c, round(seconds))
    np.testing.assert_allclose(end[OMEGA], x[OMEGA], rtol=0, atol=1e-15)
    for i in range(6):
        before, after = (Rotation.from_euler("z", -s[THETA_S, i].item()) for s in (x, end))
        body = before * Rotation.from_quat(x[Q, i]) * Rotation.from_rotvec(seconds * x[OMEGA, i].numpy())
        left = (body.inv() * after * Rotation.from_quat(end[Q, i])).magnitude()
        assert math.degrees(left) < 4e-6

"""The chief's orbit against integration in an inertial frame, matrix exponentials and brute force."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from inspection.model.dynamics import drift, integrate
from inspection.model.orbit import chief_at, closest_pass, coast, free_flight, sun_angle_after, two_body
from inspection.model.orbit import kepler as orbit_after
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, P, Q, V

N, MU = 0.001027, 3.986004418e14
A = np.zeros((6, 6))  # Clohessy-Wiltshire
A[:3, 3:] = np.eye(3)
A[3, 0], A[3, 4], A[4, 3], A[5, 2] = 3 * N**2, 2 * N, -2 * N, -(N**2)
ECCENTRIC = [pytest.param(0.0, marks=pytest.mark.campaign), 0.3]
SECONDS = 1000.0


def at(p, v):
    """States at these positions and velocities, all else zero."""
    return torch.cat((p, v, p.new_zeros(SIZE - 6, p.shape[1])))


def clearance_by_brute_force(p, v, horizon, spacing):
    """Smallest distance on a dense grid, each column's positions from one matrix exponential per sample."""
    propagate, state = expm(A * spacing), np.concatenate((p, v))
    nearest = np.full(p.shape[1], np.inf)
    for _ in range(round(horizon / spacing) + 1):
        nearest = np.minimum(nearest, np.linalg.norm(state[:3], axis=0))
        state = propagate @ state
    return nearest


@pytest.mark.parametrize("eccentricity", ECCENTRIC)
def test_the_suns_angle_falls_by_the_true_anomaly(eccentricity: float) -> None:
    """In steps of 10 s over an orbit, by Kepler's equation E - e sin E = n t."""
    c = InspectionParameters(orbit="two-body", eccentricity=eccentricity, sun_from_perigee=0.4)
    angle = torch.tensor([0.4]).double()  # at perigee
    for step in range(1, 601):
        angle = sun_angle_after(angle, 10.0, c)
        anomaly = brentq(lambda E, t=10.0 * step: E - eccentricity * math.sin(E) - N * t, 0.0, 8.0)
        true = 2 * math.atan2(
            math.sqrt(1 + eccentricity) * math.sin(anomaly / 2),
            math.sqrt(1 - eccentricity) * math.cos(anomaly / 2),
        )
        assert abs(math.remainder(0.4 - true - angle.item(), 2 * math.pi)) < 1e-8


def test_free_flight_is_the_matrix_exponential(c, random_states):
    x, times = random_states(3), [0.0, 17.0, 500.0, 172800.0]
    path = free_flight(x[P, None], x[V, None], torch.tensor(times).double()[:, None], c.mean_motion)
    for k, t in enumerate(times):
        np.testing.assert_allclose(path[:, k], (expm(A * t) @ x[:6].numpy())[:3], rtol=1e-9, atol=1e-7)


def test_clearance_is_the_smallest_distance_of_a_dense_sampling(c, random_states):
    x = random_states(20)
    clearance = closest_pass(x, 3000.0, c).norm(dim=0)
    brute = clearance_by_brute_force(x[P].numpy(), x[V].numpy(), 3000.0, 0.1)
    np.testing.assert_allclose(clearance, brute, rtol=0, atol=0.1)


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


def orbit(eccentricity, **other):
    return InspectionParameters(
        orbit="two-body", eccentricity=eccentricity, sun_from_perigee=0.7, hill_rotation=True, **other
    )


def in_space(x, c):
    """The chief's and the deputy's position and velocity (12,) in an inertial frame, x towards the Sun.

    From the orbit's elements, by the rotating frame's rule for velocities.
    """
    e, f = c.eccentricity, c.sun_from_perigee - x[THETA_S]
    p = (MU / N**2) ** (1 / 3) * (1 - e**2)
    r, h = p / (1 + e * np.cos(f)), np.sqrt(MU * p)
    hill = Rotation.from_euler("z", -x[THETA_S])
    chief_r, chief_v = hill.apply([r, 0, 0]), hill.apply([MU / h * e * np.sin(f), h / r, 0])
    relative = x[V] + np.cross([0, 0, h / r**2], x[P])
    return np.concatenate((chief_r, chief_v, chief_r + hill.apply(x[P]), chief_v + hill.apply(relative)))


def from_space(s):
    """Position and velocity (6,) in Hill's frame, and the Sun's angle, from those of `in_space`."""
    (r, v), (d_r, d_v) = (s[:3], s[3:6]), (s[6:9], s[9:])
    hill = Rotation.from_euler("z", math.atan2(r[1], r[0])).inv()
    turning = np.cross(r, v) / (r @ r)
    return hill.apply(d_r - r), hill.apply(d_v - v - np.cross(turning, d_r - r)), -math.atan2(r[1], r[0])


def attraction(_, s):
    return np.concatenate(
        [
            part
            for r, v in ((s[:3], s[3:6]), (s[6:9], s[9:]))
            for part in (v, -MU * r / np.linalg.norm(r) ** 3)
        ]
    )


def flown(x, c, seconds):
    """`from_space` after so many seconds of DOP853 in the inertial frame."""
    s = solve_ivp(attraction, (0.0, seconds), in_space(x, c), "DOP853", rtol=1e-13, atol=1e-9).y[:, -1]
    return from_space(s)


ENDS = {}  # of coasting without any control, by eccentricity: two tests look at other parts of the same states


def coasted(eccentricity, random_states):
    """The orbit, six random states, and where the simulator has them SECONDS later."""
    c, x = orbit(eccentricity), random_states(6)
    if eccentricity not in ENDS:
        ENDS[eccentricity] = x, integrate(x, torch.zeros(6, 6).double(), 1.0, c, round(SECONDS))
    start, end = ENDS[eccentricity]
    assert torch.equal(x, start)
    return c, x, end


@pytest.mark.parametrize("eccentricity", ECCENTRIC)
def test_two_bodies_fly_as_in_an_inertial_frame(random_states, eccentricity):
    c, x, end = coasted(eccentricity, random_states)
    end = end.numpy()
    for i in range(6):
        p, v, sun = flown(x[:, i].numpy(), c, SECONDS)
        np.testing.assert_allclose(end[P, i], p, rtol=0, atol=1e-6)
        np.testing.assert_allclose(end[V, i], v, rtol=0, atol=1e-9)
        assert abs(math.remainder(end[THETA_S, i] - sun, 2 * math.pi)) < 1e-11


@pytest.mark.parametrize("eccentricity", ECCENTRIC)
def test_coasting_on_keplers_orbits_is_where_two_bodies_arrive(random_states, eccentricity):
    c, x = orbit(eccentricity), random_states(6)
    times = torch.tensor([0.0, 300.0, 50_000.0], dtype=torch.float64)
    path = coast(x[:, None], times[:, None], c).numpy()
    np.testing.assert_allclose(path[:, 0], x[P], rtol=0, atol=1e-8)
    for i in range(6):
        for k, t in ((1, 300.0), (2, 50_000.0)):
            np.testing.assert_allclose(path[:, k, i], flown(x[:, i].numpy(), c, t)[0], rtol=0, atol=2e-5)


def test_keplers_equation_converges_everywhere_on_the_most_eccentric_orbit():
    """Two days on, by anomaly: the chief is where a root finder has it."""
    c, t = orbit(0.3), 172_800.0
    x = torch.zeros(SIZE, 50, dtype=torch.float64)
    x[P.start], x[THETA_S] = 1.0, torch.linspace(0.0, 2 * math.pi, 50)
    assert coast(x[:, None], torch.full((1, 1), t).double(), c).isfinite().all()
    e = c.eccentricity
    for i in range(50):
        f = c.sun_from_perigee - x[THETA_S, i].item()
        anomaly = 2 * math.atan(math.sqrt((1 - e) / (1 + e)) * math.tan(f / 2))
        mean = anomaly - e * math.sin(anomaly) + N * t
        then = brentq(lambda a, mean=mean: a - e * math.sin(a) - mean, mean - 1, mean + 1, xtol=1e-14)
        true = 2 * math.atan(math.sqrt((1 + e) / (1 - e)) * math.tan(then / 2))
        s = in_space(x[:, i].numpy(), c)
        later = orbit_after(
            torch.from_numpy(s[:3, None]), torch.from_numpy(s[3:6, None]), torch.tensor([t]), MU
        )
        angle = math.atan2(later[1, 0], later[0, 0]) + c.sun_from_perigee
        assert abs(math.remainder(angle - true, 2 * math.pi)) < 1e-9


def test_clohessy_and_wiltshires_is_the_slope_of_the_exact_acceleration_at_the_chief():
    c = orbit(0.0)

    def exact(s):
        return torch.stack(two_body(s[:3], s[3:], chief_at(torch.tensor(1.0).double(), c), MU))

    slope = torch.func.jacfwd(exact)(torch.zeros(6).double())
    np.testing.assert_allclose(slope, A[3:], rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize("eccentricity", ECCENTRIC)
@pytest.mark.parametrize("mean_motion", [0.001027, 0.0011])
def test_nothing_natural_exceeds_the_largest_drift_and_the_worst_comes_near(eccentricity, mean_motion):
    c, g = orbit(eccentricity, mean_motion=mean_motion), torch.Generator().manual_seed(0)
    x = torch.randn(SIZE, 200_000, generator=g, dtype=torch.float64)
    x[P] *= c.max_distance / x[P].norm(dim=0)
    x[V] *= 5.0 / x[V].norm(dim=0)
    x[THETA_S] = c.sun_from_perigee - 0.3 * x[THETA_S]  # around perigee
    x[Q] /= x[Q].norm(dim=0)
    found = drift(x, c)[V].norm(dim=0).max().item()
    most = c.largest_drift(c.max_distance, 5.0)
    assert 0.75 * most < found <= most


@pytest.mark.parametrize("eccentricity", ECCENTRIC)
def test_attitude_relative_to_hills_frame_is_the_inertial_one_turned_back(random_states, eccentricity):
    """A gyro's rate stays as it is where no torque acts on a body with equal moments."""
    _, x, end = coasted(eccentricity, random_states)
    np.testing.assert_allclose(end[OMEGA], x[OMEGA], rtol=0, atol=1e-15)
    for i in range(6):
        before, after = (Rotation.from_euler("z", -s[THETA_S, i].item()) for s in (x, end))
        body = before * Rotation.from_quat(x[Q, i]) * Rotation.from_rotvec(SECONDS * x[OMEGA, i].numpy())
        left = (body.inv() * after * Rotation.from_quat(end[Q, i])).magnitude()
        assert math.degrees(left) < 2e-5


def test_the_closest_pass_of_two_bodies_is_that_of_a_dense_sampling(random_states):
    c, x = orbit(0.05), random_states(5)
    x[P] *= 0.3
    x[V] *= 0.05
    times = np.arange(0.0, 12_000.0, 1.0)
    for i, found in enumerate(closest_pass(x, 12_000.0, c).norm(dim=0)):
        dense = solve_ivp(
            attraction, (0.0, times[-1]), in_space(x[:, i].numpy(), c), "DOP853", times, rtol=1e-12, atol=1e-8
        ).y
        nearest = np.linalg.norm(dense[6:9] - dense[:3], axis=0).min()
        assert abs(found - nearest) < 0.1

"""Dynamics against closed forms, scipy's DOP853 and the paper's equations written out in numpy."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from inspection.model import dynamics
from inspection.model.state import OMEGA, THETA_S, E, Q, T, V

N, MASS = 0.001027, 12.0
UNEQUAL = (0.0573, 0.04, 0.075)
A = np.zeros((6, 6))  # Clohessy-Wiltshire
A[:3, 3:] = np.eye(3)
A[3, 0], A[3, 4], A[4, 3], A[5, 2] = 3 * N**2, 2 * N, -2 * N, -(N**2)
BODY_TO_HILL = {  # attitudes that put the body axes where a thermal or power balance is easy
    "identity": (0.0, 0.0, 0.0, 1.0),
    "n_y along +x": (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)),
}


def hamilton(a, b):
    """Returns quaternion product, scalar first."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate(([scalar], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])))


def to_hill(q, a):
    """Returns h(H(q, [0, a]), q*) for a scalar-last q."""
    scalar_first = np.array([q[3], *q[:3]])
    conjugate = scalar_first * [1, -1, -1, -1]
    return hamilton(hamilton(scalar_first, np.array([0.0, *a])), conjugate)[1:]


def paper_rate(x, u, inertia):
    """Returns the paper's x' written out for one spacecraft, panels on -n_x, thermal node on -n_y."""
    (q1, q2, q3, q4), (w1, w2, w3), (j1, j2, j3) = x[6:10], x[10:13], inertia
    acceleration = A[3:] @ x[:6] + to_hill(x[6:10], u[:3]) / MASS
    spin = 0.5 * np.array([[q4, -q3, q2], [q3, q4, -q1], [-q2, q1, q4], [-q1, -q2, -q3]]) @ x[10:13]
    sun, earth = np.array([math.cos(x[15]), math.sin(x[15]), 0.0]), np.array([-1.0, 0.0, 0.0])
    node, panel = to_hill(x[6:10], [0, -1, 0]), to_hill(x[6:10], [-1, 0, 0])
    view = 0.8 * max(node @ earth, 0.0)
    absorbed = 0.13 * 0.03 * 1367 * (max(node @ sun, 0.0) + 0.27 * view)
    infrared = 5.67051e-8 * 0.06 * 0.03 * (view * 255**4 - (x[13] + 273.15) ** 4)
    return np.array(
        [
            *x[3:6],
            *acceleration,
            *spin,
            ((j2 - j3) * w2 * w3 + u[3]) / j1,
            ((j3 - j1) * w1 * w3 + u[4]) / j2,
            ((j1 - j2) * w1 * w2 + u[5]) / j3,
            (absorbed + infrared) / (2.0 * 900.0),
            (983.3 * 0.77 * 0.03 * max(panel @ sun, 0.0) - 15.0) / 1000.0,
            -N,
        ]
    )


def integrate(x, u, steps, c, duration=1.0):
    for _ in range(steps):
        x = dynamics.step(x, u, duration, c)
    return x


def still(attitude="identity", theta_s=0.0, temperature=5.0):
    """Returns one state (16, 1) at rest 60 m in front of the chief."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[1], x[T], x[E], x[THETA_S] = 60.0, temperature, 6.0, theta_s
    x[Q, 0] = torch.tensor(BODY_TO_HILL[attitude], dtype=torch.float64)
    return x


def test_rate_of_change_is_the_papers(c, random_states):
    c = replace(c, inertia=UNEQUAL)
    x, u = random_states(20), torch.linspace(-1.0, 1.0, 120, dtype=torch.float64).reshape(6, 20)
    expected = [paper_rate(x[:, i].numpy(), u[:, i].numpy(), UNEQUAL) for i in range(20)]
    np.testing.assert_allclose(torch.stack(dynamics.derivative(x, u, c)).T, expected, rtol=1e-11, atol=1e-13)


def test_control_matrix_is_the_slope_of_the_papers_rate(c, random_states):
    x = random_states(3)
    g = dynamics.control_matrix(x, replace(c, inertia=UNEQUAL))
    for i in range(3):
        rates = [paper_rate(x[:, i].numpy(), u, UNEQUAL) for u in (*np.eye(6), np.zeros(6))]
        np.testing.assert_allclose(g[..., i].T, np.array(rates[:6]) - rates[6], rtol=1e-9, atol=1e-13)


def dop853(x, u, seconds):
    return solve_ivp(
        lambda _, s: paper_rate(s, u.numpy(), UNEQUAL),
        (0.0, seconds),
        x.numpy(),
        method="DOP853",
        rtol=1e-10,
        atol=1e-12,
        max_step=1.0,  # so that no kink at the terminator is stepped over
    ).y[:, -1]


def test_full_state_follows_dop853(c):
    c = replace(c, inertia=UNEQUAL, saturate_rates=False)
    x = still("n_y along +x", theta_s=0.75 * math.pi)  # the panels and the node stay lit
    x[V, 0] = torch.tensor([0.3, -0.2, 0.1])
    x[OMEGA, 0] = torch.tensor([0.002, -0.0015, 0.002])
    u = torch.tensor([0.6, -0.9, 0.4, 2e-6, -1.5e-6, 1e-6], dtype=torch.float64)[:, None]
    end, exact = integrate(x, u, 120, c)[:, 0], dop853(x[:, 0], u[:, 0], 120.0)
    np.testing.assert_allclose(end, exact, rtol=1e-9, atol=1e-10)


def test_fast_tumbling_follows_dop853(c, random_states):
    c = replace(c, inertia=UNEQUAL, saturate_rates=False)
    x = random_states(2)
    u = torch.tensor([0.6, -0.9, 0.4, 2e-5, -1.5e-5, 1e-5], dtype=torch.float64)[:, None].expand(6, 2)
    end = integrate(x, u, 240, c, duration=0.25).numpy()
    for i in range(2):
        exact = dop853(x[:, i], u[:, i], 60.0)
        smooth = [*range(13), THETA_S]
        np.testing.assert_allclose(end[smooth, i], exact[smooth], rtol=1e-8, atol=1e-8)
        # a kink, where light is lost, costs at most slope h^2 / 24: 22.7 W 0.1 rad/s (0.25 s)^2 / 24 for E
        np.testing.assert_allclose(end[[T, E], i], exact[[T, E]], rtol=0, atol=3 * 6e-6)


def test_step_keeps_the_quaternion_unit(c, random_states):
    end = integrate(random_states(4), torch.ones(6, 4, dtype=torch.float64), 20, c, duration=5.0)
    np.testing.assert_allclose(end[Q].norm(dim=0), 1.0, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("saturate", "expected"), [(True, math.radians(2.0)), (False, 0.5)])
def test_body_rates_saturate_only_if_asked_to(c, saturate, expected):
    u = torch.zeros(6, 1, dtype=torch.float64)
    u[3:] = 0.0573 * 0.05  # 0.05 rad/s^2 about every axis for 10 s
    end = integrate(still(), u, 10, replace(c, saturate_rates=saturate))
    np.testing.assert_allclose(end[OMEGA, 0], expected, rtol=1e-12)


# -n_y towards the Sun: absorbed 0.13 * 0.03 m^2 * 1367 W/m^2 = 5.3313 W
# -n_y towards the Earth: albedo 5.3313 * 0.27 * 0.8 = 1.151561 W, infrared 0.345259 W
# emitted: 1.0206918e-10 T^4 W, so T = (absorbed / 1.0206918e-10)^(1/4)
@pytest.mark.parametrize(
    ("attitude", "theta_s", "kelvin"),
    [
        ("identity", -math.pi / 2, 478.06244),
        ("n_y along +x", 0.0, 347.99159),
        ("n_y along +x", math.pi, 508.57105),
    ],
)
def test_temperature_rests_where_absorbed_equals_emitted(c, attitude, theta_s, kelvin):
    rate = dynamics.drift(still(attitude, theta_s, kelvin - 273.15), c)[T]
    # 0.01 K off would give 4 sigma eps A T^3 0.01 / 1800 = 2.5e-7 K/s at 478 K
    assert abs(rate.item()) < 1e-9


@pytest.mark.parametrize(
    ("axis", "theta_s", "watts"),
    [("-x", math.pi, 7.71423), ("+x", 0.0, 7.71423), ("+x", math.pi, -15.0)],
)
def test_battery_balance(c, axis, theta_s, watts):
    # full Sun: 983.3 * 0.77 * 0.03 - 15 W; behind the panels only the draw
    rate = dynamics.drift(still(theta_s=theta_s), replace(c, solar_panel_axis=axis))[E]
    np.testing.assert_allclose(1000.0 * rate, watts, rtol=1e-12)

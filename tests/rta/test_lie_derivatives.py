"""Every barrier row against central finite differences of the paper's constraints along an independent f and g.

Rows of relative degree two difference Psi_1, whose own L_f h is an exact complex-step derivative.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from rta.barrier import Rows
from rta.constraints.names import CONSTRAINTS
from rta.constraints.vehicle import scaled
from rta.filter import SafetyFilter
from rta.lie_derivatives import lie_derivative, lie_derivatives
from rta.parameters import RtaParameters
from tests.rta.constraints.test_constraints import (
    MEAN_MOTION,
    body_axis,
    cosines,
    keep_in_curve,
    length,
    orientation,
    paper,
    passive_safety,
    positive,
    speed_limit,
    tensor,
)

R = RtaParameters(incidence_rounding=0.0)  # the rows of the paper's own form
SEGMENTS = tuple(itertools.pairwise(R.passive_safety_segments))
SPACECRAFT = {
    "paper": InspectionParameters(),
    "unequal_moments": InspectionParameters(inertia=(0.04, 0.06, 0.09), solar_panel_axis="+x"),
}


def before_scaling(c: InspectionParameters) -> RtaParameters:
    """Parameters that a filter scales to R for its vehicle."""
    own = vars(scaled(R, c))
    given = {name: divided(getattr(R, name), own[name]) for name in own if own[name] != getattr(R, name)}
    if "pole_angle" in given:
        given["pole_angle"] = math.atan(math.tan(R.pole_angle) ** 2 / math.tan(own["pole_angle"]))
    return replace(R, **given)


def divided(ours: float | tuple[float, ...], own: float | tuple[float, ...]) -> float | tuple[float, ...]:
    """ours^2 / own."""
    if isinstance(ours, tuple):
        return tuple(divided(*pair) for pair in zip(ours, own, strict=True))
    return ours**2 / own


K1 = np.array([*R.exclusion_gains[:1], *R.temperature_gains[:1], *R.battery_gains[:1]])
# m/s^2: all thrusters at once, the same with the worst natural acceleration, and how far from the attitude of
# mid-period a turn at 2 deg/s about each axis, quickened by 1 deg/s^2 about each, takes the thrust in the mean over
# 1 s: |omega|^2 t^2 / 24 and |alpha| t^2 / 6
THRUST_MOST = math.sqrt(3) / 12
MOST = THRUST_MOST + 3 * MEAN_MOTION**2 * 800 + 2 * MEAN_MOTION * 5
ASTRAY = THRUST_MOST * (3 * math.radians(2) ** 2 / 24 + math.sqrt(3) * 0.017453 / 6)
# (gain in 1/s, margin, what h can fall in 1 s below its linear prediction) of each row at a period of 1 s; passive
# safety has one row per segment. At the limit v^2 falls by |a|^2 t^2 + 2 v t times what the thrust goes astray.
THRUST = np.array(
    [
        (R.collision_gain, R.collision_margin, ASTRAY),
        (R.speed_gain, 0.0, ASTRAY),  # and what `speed_fall` adds
        (R.keep_in_gain, R.keep_in_margin, ASTRAY + (0.2 + 7.5 * MEAN_MOTION * 800) * THRUST_MOST / 800),
        *[(R.passive_safety_gain, R.passive_safety_margin, 0.0)] * 5,
        *[(R.velocity_gain, 0.0, MOST**2 + 10 * ASTRAY)] * 3,
    ]
).T[..., None]
TORQUE = np.array(
    [
        (R.exclusion_gains[1], K1[0] * R.exclusion_margin),
        (R.temperature_gains[1], K1[1] * R.temperature_margin),
        (R.battery_gains[1], K1[2] * R.battery_margin),
        *[(R.rate_gain, R.rate_margin)] * 3,
    ]
).T[..., None]
# Measured on these states: 4e-8 everywhere but for passive safety, whose time of the closest pass is
# refined to some ms: 6e-3 m/s per N of at most 41, and 3e-4 m/s along f of at most 6.
TOLERANCE = 1e-7
PSM_PUSH_TOLERANCE, PSM_DRIFT_TOLERANCE = 1e-2, 1e-3
PSM = slice(3, 8)
ROWS_OF_THRUST = (*CONSTRAINTS[:3], *["passive_safety"] * 5, *CONSTRAINTS[4:7])
ROWS_OF_TORQUE = CONSTRAINTS[7:]


def panel(c: InspectionParameters) -> float:
    return -1.0 if c.solar_panel_axis == "-x" else 1.0


def drift(x: ndarray, c: InspectionParameters) -> ndarray:
    """The paper's f(x), (16, B)."""
    n, (q1, q2, q3, q4), (w1, w2, w3), (j1, j2, j3) = MEAN_MOTION, x[6:10], x[10:13], c.inertia
    _, on_panel, sun, earth = cosines(x, panel(c))
    view = 0.8 * positive(earth)
    solar, albedo = 0.13 * 0.03 * 1367 * positive(sun), 0.13 * 0.03 * 1367 * 0.27 * view
    infrared, rejected = 5.67051e-8 * 0.06 * 0.03 * np.stack((view * 255.0**4, (x[13] + 273.15) ** 4))
    rates = (
        *x[3:6],
        3 * n**2 * x[0] + 2 * n * x[4],
        -2 * n * x[3],
        -(n**2) * x[2],
        (q4 * w1 - q3 * w2 + q2 * w3) / 2,
        (q3 * w1 + q4 * w2 - q1 * w3) / 2,
        (-q2 * w1 + q1 * w2 + q4 * w3) / 2,
        (-q1 * w1 - q2 * w2 - q3 * w3) / 2,
        (j2 - j3) * w2 * w3 / j1,
        (j3 - j1) * w1 * w3 / j2,
        (j1 - j2) * w1 * w2 / j3,
        (solar + albedo + infrared - rejected) / (2 * 900),
        (983.3 * 0.77 * 0.03 * positive(on_panel) - 15) / 1000,
        np.full(x.shape[1], -n),
    )
    return np.stack(rates)


def push(x: ndarray, axis: int) -> ndarray:
    """g's column of the thrust along a body axis, (16, B)."""
    out = np.zeros_like(x)
    out[3:6] = body_axis(x[6:10], axis) / 12
    return out


def held(x: ndarray) -> ndarray:
    """The states with the attitude half a second later, along which a thrust held for 1 s acts in the mean."""
    (q1, q2, q3, q4), (w1, w2, w3) = x[6:10], 0.25 * x[10:13]
    ahead = x.copy()
    ahead[6:10] += (
        q4 * w1 - q3 * w2 + q2 * w3,
        q3 * w1 + q4 * w2 - q1 * w3,
        -q2 * w1 + q1 * w2 + q4 * w3,
        -q1 * w1 - q2 * w2 - q3 * w3,
    )
    ahead[6:10] /= length(ahead[6:10])
    return ahead


def turn(x: ndarray, axis: int, c: InspectionParameters) -> ndarray:
    """g's column of the torque about a body axis, (16, B)."""
    out = np.zeros_like(x)
    out[10 + axis] = 1 / c.inertia[axis]
    return out


def slope(h: Callable[[ndarray], ndarray], x: ndarray, direction: ndarray, step: float) -> ndarray:
    """Central difference of h along a direction."""
    return (h(x + step * direction) - h(x - step * direction)) / (2 * step)


def thrust_values(x: ndarray) -> ndarray:
    """The paper's h of each row, (11, B), one passive safety row per segment."""
    h = paper(x)
    return np.stack((*h[:3], *(passive_safety(x, *span) for span in SEGMENTS), *h[4:7]))


def thrust_barriers(x: ndarray) -> ndarray:
    """(11, B), the keep-in zone by the thrust left."""
    h = thrust_values(x)
    h[2] = keep_in_curve(x)
    return h


def thrust_gain(psi: ndarray) -> ndarray:
    """alpha's factor, (11, B): that of passive safety doubles at 30 m, and none exceeds half a call per second."""
    rising = np.zeros_like(psi)
    rising[PSM] = (psi[PSM] / R.passive_safety_doubling) ** 2
    return np.minimum(THRUST[0] * (1 + rising), 0.5)


def thrust_fall(x: ndarray) -> ndarray:
    """(11, B). |v| curves by |a|^2 / (2 |v|); no more of it all counts than half of alpha at rest."""
    fall = np.broadcast_to(THRUST[2], (11, x.shape[1])).copy()
    fall[1] = np.minimum(fall[1] + MOST**2 / (2 * speed_limit(x)), 0.5 * R.speed_gain * speed_limit(x))
    return fall


def first_psi(x: ndarray, c: InspectionParameters) -> ndarray:
    """L_f h + alpha(h) without margins, (3, B), of exclusion, temperature and battery at a period of 1 s.

    k1 h, and beyond a limit k2 h, at most half of the rate of a turn, of cooling in the dark, of full charge.
    """
    along = orientation(x + 1e-30j * drift(x, c), panel(c)).imag / 1e-30
    h = orientation(x, panel(c))
    cooling, charge = 5.67051e-8 * 0.06 * 0.03 * 283.15**4 / 1800, (983.3 * 0.77 * 0.03 - 15) / 1000
    half = np.array([[math.radians(2)], [cooling], [charge]]) / 2
    return along + np.where(h < 0, np.maximum(TORQUE[0][:3] * h, -half), K1[:, None] * h)


def torque_values(x: ndarray, c: InspectionParameters) -> ndarray:
    """The paper's h, (6, B)."""
    return np.concatenate((orientation(x, panel(c)), np.radians(2) ** 2 - x[10:13] ** 2))


def torque_barriers(x: ndarray, c: InspectionParameters) -> ndarray:
    """(6, B)."""
    return np.concatenate((first_psi(x, c), torque_values(x, c)[3:]))


def torque_fall(x: ndarray, c: InspectionParameters) -> ndarray:
    """(6, B): omega^2 bends by alpha^2 t^2 beyond its limit, within it the plant saturates."""
    fall = np.zeros((6, x.shape[1]))
    bent = min((c.max_torque / min(c.inertia)) ** 2, 0.5 * R.rate_gain * math.radians(2) ** 2)
    fall[3:] = np.where(torque_values(x, c)[3:] < 0, bent, 0.0)
    return fall


def attainable(b: ndarray, a: ndarray, h: ndarray, names: tuple[str, ...], limit: float) -> ndarray:
    """b (R, B), where a row's h (R, B) is negative no lower than what actuators give along a (R, 3, B).

    That is `limit` |a|, at most what the rows of the body rates leave about each axis; for the chief all of that.
    """
    room = np.full_like(a, limit)
    for i, name in enumerate(names):
        if name.startswith("angular_velocity"):
            axis = "xyz".index(name[-1])
            left = np.clip(b[i] / np.abs(a[i, axis]), 0, limit)
            room[:, axis] = np.where(a[:, axis] * a[i, axis] < 0, left, limit)
    everything = (np.abs(a) * room).sum(1)
    along = np.minimum(limit * np.sqrt((a**2).sum(1)), everything)
    chief = np.array(names)[:, None] == "collision"
    return np.where(h < 0, np.maximum(b, -np.where(chief, everything, along)), b)


def flying(count: int = 100) -> ndarray:
    """(16, count) states in flight, clear of the kinks of the paper's constraints and of free falls into the centre."""
    rng = np.random.default_rng(1)
    p, v, q = rng.standard_normal((3, 4, 10 * count))
    p, v = (a[:3] / length(a[:3]) for a in (p, v))
    p *= rng.choice((20.0, 60.0, 300.0, 750.0), 10 * count) * rng.uniform(1, 1.06, 10 * count)
    v *= rng.choice((0.1, 0.5, 5.0), 10 * count)
    rest = (
        rng.uniform(-0.035, 0.035, (3, 10 * count)),
        rng.uniform((3, 1, 0), (11, 7, 6.28), (10 * count, 3)).T,
    )
    x = np.vstack((p, v, q / length(q), *rest))
    angle = np.abs(cosines(x))
    clear = (angle > 0.02).all(0) & (angle < 0.97).all(0) & (passive_safety(x) > -13)
    return x[:, clear][:, :count]


def beyond_the_limits() -> ndarray:
    """(16, 100) states in flight, outside the zone, many too fast, too hot, too low or turning too fast."""
    rng, x, count = np.random.default_rng(2), flying(), 100
    x[:3] *= (800 + rng.uniform(1, 20, count)) / length(x[:3])
    x[3:6] *= rng.uniform(1, 8, count) / length(x[3:6])
    x[10:13] *= rng.uniform(0.5, 2, count)
    x[13], x[14] = rng.uniform(9, 12, count), rng.uniform(0.5, 1.5, count)
    return x


X, BEYOND = flying(), beyond_the_limits()


@pytest.fixture(scope="module", params=SPACECRAFT)
def case(request: pytest.FixtureRequest) -> tuple[InspectionParameters, Rows, Rows]:
    c = SPACECRAFT[request.param]
    return c, *(group(tensor(X)) for group in SafetyFilter(c, before_scaling(c)).groups)


def near(actual: Tensor, expected: ndarray, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("axis", range(3))
def test_thrust_rows_equal_finite_differences(case: tuple, axis: int) -> None:
    expected = slope(thrust_barriers, X, push(held(X), axis), 1e-3)
    near(case[1].a[PSM, axis], expected[PSM], PSM_PUSH_TOLERANCE)
    expected[PSM] = case[1].a[PSM, axis]
    near(case[1].a[:, axis], expected)


@pytest.mark.parametrize("axis", range(3))
def test_torque_rows_equal_finite_differences(case: tuple, axis: int) -> None:
    c, _, torque = case
    near(torque.a[:, axis], slope(lambda x: torque_barriers(x, c), X, turn(X, axis, c), 1e-4))


def test_thrust_rows_without_control_equal_finite_differences(case: tuple) -> None:
    c, thrust, _ = case
    psi = thrust_barriers(X)
    alpha = thrust_gain(psi) * (psi - THRUST[1])
    asked = slope(thrust_barriers, X, drift(X, c), 3e-4) + alpha - thrust_fall(X)
    expected = attainable(asked, thrust.a.numpy(), thrust_values(X), ROWS_OF_THRUST, 1.0)
    assert ((expected > asked).sum(1) > 0)[[0, 1]].all()
    near(thrust.b[PSM], expected[PSM], PSM_DRIFT_TOLERANCE)
    expected[PSM] = thrust.b[PSM]
    near(thrust.b, expected)


def test_torque_rows_without_control_equal_finite_differences(case: tuple) -> None:
    c, _, torque = case
    gain, margin = TORQUE
    along = slope(lambda x: torque_barriers(x, c), X, drift(X, c), 1e-3)
    asked = along + gain * (torque_barriers(X, c) - margin) - torque_fall(X, c)
    near(torque.b, attainable(asked, torque.a.numpy(), torque_values(X, c), ROWS_OF_TORQUE, c.max_torque))


@pytest.mark.parametrize("name", SPACECRAFT)
def test_thrust_rows_beyond_the_limits_equal_finite_differences(name: str) -> None:
    c, x = SPACECRAFT[name], BEYOND
    h, psi, margin = thrust_values(x), thrust_barriers(x), THRUST[1]
    gain = thrust_gain(psi)
    asked = slope(thrust_barriers, x, drift(x, c), 3e-4) + gain * (psi - margin) - thrust_fall(x)
    a = np.stack([slope(thrust_barriers, x, push(held(x), i), 1e-3) for i in range(3)], 1)
    assert_rows_beyond(
        SafetyFilter(c, before_scaling(c)).groups[0](tensor(x)), h, a, asked, gain * margin, 1.0
    )


@pytest.mark.parametrize("name", SPACECRAFT)
def test_torque_rows_beyond_the_limits_equal_finite_differences(name: str) -> None:
    c, x, (gain, margin) = SPACECRAFT[name], BEYOND, TORQUE
    barriers, h = partial(torque_barriers, c=c), torque_values(x, c)
    asked = slope(barriers, x, drift(x, c), 3e-4) + gain * (barriers(x) - margin) - torque_fall(x, c)
    a = np.stack([slope(barriers, x, turn(x, i, c), 1e-4) for i in range(3)], 1)
    assert_rows_beyond(
        SafetyFilter(c, before_scaling(c)).groups[1](tensor(x)), h, a, asked, gain * margin, c.max_torque
    )


def assert_rows_beyond(
    rows: Rows, h: ndarray, a: ndarray, asked: ndarray, margin: ndarray, limit: float
) -> None:
    """All but those of the chief and of passive safety, which are fulfilled out there."""
    names = ROWS_OF_THRUST if len(h) == len(ROWS_OF_THRUST) else ROWS_OF_TORQUE
    chosen = [i for i, name in enumerate(names) if name not in ("collision", "passive_safety")]
    assert ((h < 0).sum(1) >= 5)[chosen].all()
    near(rows.a[chosen], a[chosen])
    near(rows.b[chosen], attainable(asked, a, h, names, limit)[chosen])
    near(rows.b_bare[chosen], attainable(asked + margin, a, h, names, limit)[chosen])


def test_first_psi_has_its_margin_spent(case: tuple) -> None:
    c, _, torque = case
    near(torque.psi, torque_barriers(X, c) - TORQUE[1])


def double_integrator(y: Tensor) -> Tensor:
    return torch.stack((y[1], torch.zeros_like(y[0])))


def high_order(y: Tensor) -> Tensor:
    """Psi_1 = dh/dt + 3 h of h = 1 - p^2 along p' = v."""
    h, rate = lie_derivative(lambda z: 1 - z[:1] ** 2, y, double_integrator(y))
    return rate + 3 * h


def test_lie_derivatives_of_a_high_order_barrier() -> None:
    # L_f Psi_1 = (-2 v - 6 p) v and L_g Psi_1 = -2 p for v' = u
    p, v = y = torch.randn(2, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    g = torch.stack((torch.zeros_like(p), torch.ones_like(p)))[:, None]
    _, along_f, along_g = lie_derivatives(high_order, y, double_integrator(y), g)
    torch.testing.assert_close(along_f, ((-2 * v - 6 * p) * v)[None])
    torch.testing.assert_close(along_g, (-2 * p)[None, None])


@pytest.mark.parametrize("number", [float, torch.tensor])
def test_every_operation_of_what_does_not_depend_is_differentiated(
    number: Callable[[float], float | Tensor],
) -> None:
    def function(y: Tensor) -> Tensor:
        one, two, three, four = (number(each) for each in (1.0, 2.0, 3.0, 4.0))
        return three - (two * y - one) / four + (one + y) * 5 - 7

    y, along = torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5])
    value, slope = lie_derivative(function, y, along)
    torch.testing.assert_close((value, slope), (3.0 - (2.0 * y - 1.0) / 4.0 + 5.0 * y - 2.0, 4.5 * along))

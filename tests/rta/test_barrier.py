"""What the barriers and their rows promise, in flight: braking in the keep-in zone, and no barrier falls too far."""

import numpy as np
import pytest
from numpy import ndarray

from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from tests.oracles import (
    drift,
    held,
    keep_in_curve,
    length,
    push,
    root,
    slope,
    speed_limit,
    tensor,
    thrust_fall,
    turn,
)

C = InspectionParameters()
R = RtaParameters()
FILTER = SafetyFilter(C, R)
LIMIT = np.array(C.control_limit)[:, None]


def rate(x: ndarray, u: ndarray) -> ndarray:
    """f + g u, (16, B), of the paper's equations."""
    return drift(x, C) + sum(u[i] * push(x, i) + u[3 + i] * turn(x, i, C) for i in range(3))


def expected_rate(x: ndarray, u: ndarray) -> ndarray:
    """f + g u as the rows have it: with thrust along the attitude of mid-period."""
    return rate(x, u) + sum(u[i] * (push(held(x), i) - push(x, i)) for i in range(3))


def fly(x: ndarray, u: ndarray, steps: int = 20) -> ndarray:
    """One second with u held, by RK4; the wheels hold each rate within its limit."""
    dt = 1.0 / steps
    for _ in range(steps):
        k1 = rate(x, u)
        k2 = rate(x + dt / 2 * k1, u)
        k3 = rate(x + dt / 2 * k2, u)
        k4 = rate(x + dt * k3, u)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        x[6:10] /= length(x[6:10])
        x[10:13] = x[10:13].clip(-C.max_rate, C.max_rate)
    return x


def controls(count: int, rng: np.random.Generator) -> ndarray:
    """(6, count), most components at their limit."""
    full = rng.choice([-1.0, 1.0], (6, count))
    return np.where(rng.random((6, count)) < 0.6, full, rng.uniform(-1, 1, (6, count))) * LIMIT


def flights(count: int, distance: tuple[float, float], speed: tuple[float, float]) -> ndarray:
    """(16, count) at speeds in units of the limit there, half of all body rates at theirs."""
    rng = np.random.default_rng(0)
    p, v, q = rng.standard_normal((3, 4, count))
    p = p[:3] / length(p[:3]) * rng.uniform(*distance, count)
    v = v[:3] / length(v[:3]) * rng.uniform(*speed, count) * speed_limit(p)
    omega = controls(count, rng)[:3] * C.max_rate
    rest = rng.uniform(3, 10, count), rng.uniform(1, 5, count), rng.uniform(0, 2 * np.pi, count)
    return np.vstack((p, v, q / length(q), omega, *rest))


# The keep-in barrier


def outward(y: ndarray) -> ndarray:
    """v_pr."""
    return (y[:3] * y[3:6]).sum(0) / length(y[:3])


def zone(y: ndarray) -> ndarray:
    """The paper's keep-in zone."""
    return root(800 - length(y[:3])) - outward(y)


# The margins: how far a barrier can fall within one period


def test_speed_and_velocity_fall_no_further_than_their_rows_expect() -> None:
    """At the speed limit, where the derivation of its `intersample_drop` begins."""
    x = flights(8000, (15.2, 795), (1.0, 1.0))
    u = controls(x.shape[1], np.random.default_rng(1))

    def h(y: ndarray) -> ndarray:
        return np.concatenate(((speed_limit(y) - length(y[3:6]))[None], 25 - y[3:6] ** 2))

    within = (np.abs(x[3:6]) <= 5).all(0)
    excess = h(x) + slope(h, x, expected_rate(x, u), 1e-4) - h(fly(x, u))
    share = (excess / thrust_fall(x)[[1, 8, 9, 10]])[:, within]
    assert share.max() < 1.0
    assert share[0].max() > 0.8  # the bound is no larger than it must be


ROWS = {  # row, distances in m, speeds in units of the limit, the barrier, and values of it that matter
    "collision": (0, (15.0, 16.5), (0.0, 1.0), lambda x: root(length(x[:3]) - 15) + outward(x), 0.2),
    "dynamic_speed": (1, (15.2, 795.0), (0.0, 1.0), lambda x: speed_limit(x) - length(x[3:6]), 0.2),
    "keep_in_curve": (2, (700.0, 799.9), (0.05, 1.0), keep_in_curve, 0.3),
    "velocity_x": (8, (500.0, 790.0), (0.8, 1.0), lambda x: 25 - x[3] ** 2, 3.0),
}


@pytest.mark.parametrize("name", ROWS)
def test_a_control_that_satisfies_its_row_keeps_the_barrier_for_a_period(name: str) -> None:
    """The least correction of a random control, checked after one second of flight."""
    row, distance, speed, h, near = ROWS[name]
    x = flights(30_000, distance, speed)
    rows, _ = FILTER.rows(tensor(x))
    psi, a, b = rows.psi[row].numpy(), rows.a[row].numpy(), rows.b[row].numpy()
    chosen = np.flatnonzero((psi >= 0) & (h(x) < near))[:4000]
    x, a, b = x[:, chosen], a[:, chosen], b[chosen]
    u = controls(x.shape[1], np.random.default_rng(2))
    low, high = np.zeros(x.shape[1]), np.full(x.shape[1], 1e4)

    def pushed(by: ndarray) -> ndarray:
        return (u[:3] + by * a).clip(-1, 1)

    wrong = (a * u[:3]).sum(0) + b < 0
    for _ in range(60):
        middle = (low + high) / 2
        enough = (a * pushed(middle)).sum(0) + b >= 0
        low, high = np.where(enough, low, middle), np.where(enough, middle, high)
    u[:3] = np.where(wrong, pushed(high), u[:3])
    kept = (a * u[:3]).sum(0) + b >= -1e-9
    assert kept.mean() > 0.99 and (wrong & kept).sum() > 200
    assert h(fly(x, u))[kept].min() >= 0.0

"""The Monte Carlo campaign: its starts, policies, bookkeeping and files, and the physics its margins rest on."""

import dataclasses
import itertools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.stats import binom, kstest
from torch import Tensor

from inspection.environment import InspectionEnv, Safety
from inspection.parameters import InspectionParameters
from rta import constraints
from rta.constraints import CONSTRAINTS
from rta.filter import SafetyFilter, make_solver
from rta.parameters import RtaParameters
from rta.qp import Status
from rta.rows import Barriers
from study import build, verification
from study.config import Config, from_toml
from study.verification import LONGEST_HOLD, upper_bound
from tests.test_barrier import drift, held, push, slope, thrust_fall, turn
from tests.test_constraints import (
    MEAN_MOTION,
    PSM_TOLERANCE,
    cosines,
    keep_in_curve,
    length,
    paper,
    positive,
    root,
    speed_limit,
    tensor,
)
from tests.test_main import assert_refused, call

C = InspectionParameters()
R = RtaParameters()
BARRIERS, BARRIERS_10_S = Barriers(C, R, 1.0), Barriers(C, R, 10.0)
LIMIT = np.array(C.control_limit)[:, None]
COUNT = 1500


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


# The safe set's initial states


class Everything(Barriers):
    """Barriers that keep every state, to see what is drawn."""

    def __init__(self) -> None:
        super().__init__(C, R, 1.0)

    def is_in_safe_set(self, x: Tensor) -> Tensor:
        return torch.ones(x.shape[1], dtype=torch.bool)


@pytest.fixture(scope="module")
def start() -> tuple[ndarray, ndarray]:
    x, priority, _ = verification.safe_set(COUNT, 0, BARRIERS)
    return x.numpy(), priority.numpy()


@pytest.fixture(scope="module")
def drawn() -> tuple[ndarray, ndarray]:
    x, priority, _ = verification.safe_set(COUNT, 0, Everything())
    return x.numpy(), priority.numpy()


def oriented(x: ndarray) -> ndarray:
    """Attitude exclusion, temperature and battery, (3, B), the light's edge a parabola 2 w wide."""
    boresight, panel, *side = (np.arccos(cosine.clip(-1, 1)) for cosine in cosines(x))
    w, height = R.incidence_rounding, [np.pi / 2 - angle for angle in side]
    sun, earth = (np.where(np.abs(z) < w, (z + w) ** 2 / (4 * w), positive(z)) for z in height)
    return np.stack(
        (boresight - np.pi / 6 - np.pi / 18, 10 - x[13] - 0.05 * sun - 0.01 * earth, x[14] - 1 - 0.05 * panel)
    )


def test_every_start_satisfies_every_constraint(start: tuple[ndarray, ndarray]) -> None:
    x = start[0]
    assert x.shape == (16, COUNT)
    assert paper(x).min() >= -PSM_TOLERANCE
    assert np.delete(paper(x), 3, 0).min() >= 0.0
    np.testing.assert_allclose(length(x[6:10]), 1.0, atol=1e-12)


def test_starts_beyond_braking_belong_to_the_safe_set() -> None:
    """Seldom: far out and fast across, with the keep-in zone's h positive and its curve negative."""
    x = verification.safe_set(6000, 0, BARRIERS)[0].numpy()
    beyond = x[:, keep_in_curve(x) < 0]
    assert 5 < beyond.shape[1] < 60
    assert zone(beyond).min() >= 0 and length(beyond[:3]).min() > 600


def test_states_that_only_the_margins_reject_are_counted_up_to_the_last_one_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = []

    class Recording(Barriers):
        def is_in_safe_set(self, x: Tensor) -> Tensor:
            drawn.append(x.numpy())
            return super().is_in_safe_set(x)

    x, _, rejected = verification.safe_set(500, 3, Recording(C, R, 1.0))
    every = np.hstack(drawn)
    last = np.flatnonzero((every == x[:, -1:].numpy()).all(0))[0]
    every = every[:, : last + 1]

    def exact(y: ndarray) -> ndarray:
        return paper(y)[[7, 8, 9]]

    k1 = np.array([[R.exclusion_gains[0]], [R.temperature_gains[0]], [R.battery_gains[0]]])
    psi = slope(exact, every, drift(every, C), 1e-4) + k1 * exact(every)
    expected = ((paper(every) >= 0).all(0) & (psi >= 0).all(0)).sum() - 500
    both = (
        ~(psi >= 0).all(0)[np.isin(every[0], x[0].numpy())]
    ).sum()  # the rounded terminator also admits states
    assert rejected > 0
    assert abs(rejected - expected - both) <= 1  # a difference across the edge of the light


def test_every_start_satisfies_every_first_psi(start: tuple[ndarray, ndarray]) -> None:
    x = start[0]
    x = x[:, (np.abs(cosines(x)) < math.cos(R.pole_angle)).all(0)]
    assert x.shape[1] > COUNT / 2
    k1 = np.array([[R.exclusion_gains[0]], [R.temperature_gains[0]], [R.battery_gains[0]]])
    margin = np.array([[R.exclusion_margin], [R.temperature_margin], [R.battery_margin]])
    psi = slope(oriented, x, drift(x, C), 1e-4) + k1 * (oriented(x) - margin)
    assert (psi.min(1) >= -1e-6).all()  # a difference across the edge of the light
    assert ((psi >= 0).mean(1) > 0.999).all()


def test_starts_fill_their_ranges_before_rejection(drawn: tuple[ndarray, ndarray]) -> None:
    x, priority = drawn
    sides = np.concatenate((x[:3] / length(x[:3]), x[3:6] / length(x[3:6]), priority))
    shares = {
        "distance": (length(x[:3]) - 15) / (795 - 15),
        "speed": length(x[3:6]) / speed_limit(x),
        "temperature": (x[13] - 3) / 7,
        "energy": (x[14] - 1) / 6,
        "sun": x[15] / (2 * np.pi),
        **{f"rate {i}": x[10 + i] / C.max_rate / 2 + 0.5 for i in range(3)},
        **{f"direction {i}": side / 2 + 0.5 for i, side in enumerate(sides)},  # Archimedes
    }
    for name, share in shares.items():
        assert kstest(share, "uniform").pvalue > 1e-4, name


def test_attitudes_are_uniform_before_rejection(drawn: tuple[ndarray, ndarray]) -> None:
    q = drawn[0][6:10]
    angle = 2 * np.arccos(np.abs(q[3]))  # of a uniform rotation: density (1 - cos) / pi
    assert kstest((angle - np.sin(angle)) / np.pi, "uniform").pvalue > 1e-4
    for component in q:  # of a uniform 4-D direction: density 2 sqrt(1 - q^2) / pi
        share = 0.5 + (component * np.sqrt(1 - component**2) + np.arcsin(component)) / np.pi
        assert kstest(share, "uniform").pvalue > 1e-4
    second = q @ q.T / q.shape[1]
    np.testing.assert_allclose(second, np.eye(4) / 4, atol=4 * 0.25 / math.sqrt(q.shape[1]))


def test_all_drawn_quantities_are_independent(drawn: tuple[ndarray, ndarray]) -> None:
    """Rank correlations of uniform shares, also of their distance from the middle."""
    x, priority = drawn
    p, v = x[:3] / length(x[:3]), x[3:6] / length(x[3:6])
    azimuths = [np.arctan2(side[1], side[0]) for side in (p, v, priority)]
    attitude = [np.arctan2(x[6], x[7]), np.arctan2(x[8], x[9]), np.hypot(x[6], x[7])]
    columns = [length(x[:3]), length(x[3:6]) / speed_limit(x), p[2], v[2], priority[2]]
    columns = np.stack([*columns, *azimuths, *attitude, *x[10:16]])
    assert columns.shape[0] == 17
    rank = columns.argsort(1).argsort(1) / COUNT - 0.5
    folded = np.abs(rank) - 0.25
    correlation = np.corrcoef(np.vstack((rank, folded))) - np.eye(34)
    assert np.abs(correlation).max() < 5 / math.sqrt(COUNT)


class Flown(Exception):
    """Raised in place of a flight."""


def test_starts_and_first_controls_share_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every random number that a batch draws, compared with every other."""
    drawn: list[ndarray] = []
    rand = torch.rand

    def recorded(*arguments: Any, **more: Any) -> Tensor:
        drawn.append(rand(*arguments, **more))
        return drawn[-1]

    def first_control(env: InspectionEnv, controller: Any, x: Tensor, *_: Any) -> None:
        before = len(drawn)
        controller(0.0, x)
        assert len(drawn) > before
        raise Flown

    monkeypatch.setattr(torch, "rand", recorded)
    monkeypatch.setattr(verification, "fly", first_control)
    safety = SafetyFilter(C, R)
    env = InspectionEnv(64, C, [torch.Generator()], safety.safety())
    campaign = verification.Campaign("random", 1.0, 10, 0, 64)
    with pytest.raises(Flown):
        list(verification.run(campaign, 64, safety, lambda _: env, None, None, Config()))
    numbers = np.concatenate([part.flatten().numpy() for part in drawn])
    assert numbers.size > 10 * 64 and np.unique(numbers).size == numbers.size


def test_rejection_leaves_starts_near_every_limit(start: tuple[ndarray, ndarray]) -> None:
    x = start[0]
    assert length(x[:3]).min() < 60 and length(x[:3]).max() > 780
    assert (length(x[3:6]) / speed_limit(x)).max() > 0.97
    assert x[13].max() > 9.8 and x[14].min() < 1.3
    assert (np.abs(x[10:13]).max(1) > 0.99 * C.max_rate).all()


def test_starts_depend_on_the_seed_alone(start: tuple[ndarray, ndarray]) -> None:
    again, other = (verification.safe_set(COUNT, seed, BARRIERS)[0].numpy() for seed in (0, 1))
    np.testing.assert_array_equal(start[0], again)
    assert not (start[0] == other).all(0).any()


def test_an_empty_safe_set_is_refused() -> None:
    nothing = Everything()
    nothing.is_in_safe_set = lambda x: torch.zeros(x.shape[1], dtype=torch.bool)
    with pytest.raises(RuntimeError, match="0 of 1 initial states"):
        verification.safe_set(1, 0, nothing)


def test_half_of_the_starts_are_the_papers() -> None:
    x, priority, _ = verification.initial_states(101, 0, BARRIERS)
    first, second = x[:, ::2], x[:, 1::2]
    distance = first[:3].norm(dim=0)
    assert ((distance >= 50) & (distance <= 100)).all() and (first[3:6] == 0).all()
    assert second.shape == (16, 50) and (second[3:6].norm(dim=0) > 0).all()
    np.testing.assert_allclose(priority.norm(dim=0), 1.0)


# The keep-in barrier


def at_the_curve(count: int, value: Callable[[ndarray, ndarray], ndarray]) -> tuple[ndarray, ndarray]:
    """Positions and velocities within the speed limits that fly outwards at `value` of (distance, speed across)."""
    rng = np.random.default_rng(0)
    p, side = rng.standard_normal((2, 3, 40 * count))
    out = p / length(p)
    side = np.cross(out, side, axis=0)
    distance = rng.uniform(500, 799.5, 40 * count)
    across = rng.uniform(0.6, 1.0, 40 * count) * speed_limit(distance * out)
    v = out * value(distance, across) + side / length(side) * across
    p = distance * out
    slow = (length(v) <= speed_limit(p)) & (np.abs(v) <= 5).all(0)
    return p[:, slow][:, :count], v[:, slow][:, :count]


def braking(distance: ndarray, across: ndarray) -> ndarray:
    """The speed outwards at which the keep-in barrier is zero."""
    return np.sqrt(2 * (C.max_acceleration - across**2 / distance) * (800 - distance))


def coasting(t: float, y: ndarray, force: ndarray) -> ndarray:
    """Clohessy and Wiltshire's equations under a constant force (3,)."""
    n, (x, _, z, vx, vy, vz) = MEAN_MOTION, y
    natural = np.array([3 * n**2 * x + 2 * n * vy, -2 * n * vx, -(n**2) * z])
    return np.concatenate(([vx, vy, vz], natural + force / 12))


def flown(p: ndarray, v: ndarray, force: ndarray, duration: float) -> ndarray:
    """(6, 11) states over `duration` s by DOP853."""
    t = np.linspace(0, duration, 11)
    y = np.concatenate((p, v))
    return solve_ivp(coasting, (0, duration), y, "DOP853", t, args=(force,), rtol=1e-10, atol=1e-12).y


def outward(y: ndarray) -> ndarray:
    """v_pr."""
    return (y[:3] * y[3:6]).sum(0) / length(y[:3])


def zone(y: ndarray) -> ndarray:
    """The paper's keep-in zone."""
    return root(800 - length(y[:3])) - outward(y)


def test_keep_in_curve_is_never_above_the_keep_in_zone() -> None:
    x = flights(5000, (15, 810), (0, 1.2))
    curve = constraints.keep_in_curve(tensor(x), C).numpy()
    inside = length(x[:3]) <= 800
    assert (curve <= zone(x))[inside].all() and (curve < zone(x))[inside].mean() > 0.9


def test_one_newton_inwards_holds_the_keep_in_curve() -> None:
    p, v = at_the_curve(400, braking)
    assert np.abs(keep_in_curve(np.vstack((p, v)))).max() < 1e-9
    lowest = np.array(
        [keep_in_curve(flown(*y, -y[0] / length(y[0]), 1.0)).min() for y in zip(p.T, v.T, strict=True)]
    )
    # a_max counts Coriolis at 5 m/s, the velocity limit per axis; across two axes up to 6.4 m/s are allowed
    beyond = 2 * MEAN_MOTION * np.maximum(np.hypot(v[0], v[1]) - 5.0, 0.0)
    assert (lowest >= -beyond - 1e-9).all()
    assert (lowest[beyond == 0] >= -1e-9).all() and (beyond == 0).sum() > 100


def test_on_the_papers_boundary_no_thrust_of_one_newton_outweighs_a_fast_curve() -> None:
    """The best of all corners, edges and faces of the thrust cube, one of whose axes points at the chief."""
    p, v = at_the_curve(200, lambda distance, across: root(800 - distance))
    fast = keep_in_curve(np.vstack((p, v))) < -0.25 * root(800 - length(p))
    p, v = p[:, fast][:, :12], v[:, fast][:, :12]
    assert p.shape[1] == 12
    for position, velocity in zip(p.T, v.T, strict=True):
        assert zone(np.concatenate((position, velocity))[:, None])[0] >= -1e-9
        out = position / length(position)
        side = velocity - out * (out @ velocity)
        axes = np.stack((out, side / length(side), np.cross(out, side / length(side))), 1)
        best = max(
            zone(flown(position, velocity, axes @ np.array(u), 1.0)).min()
            for u in itertools.product((-1.0, 0.0, 1.0), repeat=3)
        )
        assert best < -0.002


# The margins: how far a barrier can fall within one period


def test_speed_and_velocity_fall_no_further_than_their_rows_expect() -> None:
    """At the speed limit, where the derivation of `Row.fall` begins."""
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
    rows, _ = BARRIERS(tensor(x))
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


# The policies


def test_random_controls_are_held_for_up_to_a_minute() -> None:
    count, steps = 50, 400
    policy = verification.held_at_random(C, torch.Generator().manual_seed(3), count)
    part = verification.held_at_random(C, torch.Generator().manual_seed(3), count, 10)
    x = torch.zeros(16, count, dtype=torch.float64)
    u = torch.stack([policy(float(t), x) for t in range(steps)]).numpy()
    assert all((part(float(t), x[:, :5]).numpy() == u[t][:, 10:15]).all() for t in range(steps))
    assert (np.abs(u) <= LIMIT).all() and (np.abs(u).max((0, 2)) > 0.99 * LIMIT[:, 0]).all()
    changes = (np.diff(u, axis=0) != 0).any(1)
    assert (changes == (np.diff(u, axis=0) != 0).all(1)).all()  # all six at once
    holds = np.concatenate([np.diff(np.flatnonzero(changes[:, k])) for k in range(count)])
    assert holds.min() >= 1 and holds.max() <= LONGEST_HOLD
    assert (
        kstest((holds - np.random.default_rng(0).random(holds.size)) / LONGEST_HOLD, "uniform").pvalue > 1e-4
    )


def test_adversary_descends_the_row_that_zero_control_comes_closest_to_breaking() -> None:
    x = flights(2000, (16, 790), (0.05, 0.95))
    safety = SafetyFilter(C, R)
    u = verification.adversarial(safety)(0.0, tensor(x)).numpy()
    np.testing.assert_allclose(np.abs(u[:3]).max(0), 1.0)
    np.testing.assert_allclose(np.abs(u[3:]).max(0), C.max_torque)
    thrust, _ = safety.rows(tensor(x))
    worst = (thrust.b / thrust.a.norm(dim=1)).argmin(0).numpy()
    barriers = {row: h for row, *_, h, _ in ROWS.values()}
    seen = 0
    for row, h in barriers.items():
        y = x[:, worst == row]
        if y.size:
            gradient = np.stack([slope(h, y, push(held(y), i), 1e-3) for i in range(3)])
            np.testing.assert_allclose(u[:3, worst == row], -gradient / np.abs(gradient).max(0), atol=1e-6)
            assert (h(y + 1e-3 * sum(u[i, worst == row] * push(held(y), i) for i in range(3))) < h(y)).all()
            seen += y.shape[1]
    assert seen > 300


# Counting


def lax() -> SafetyFilter:
    """A filter that believes in wider limits than those that are counted."""
    wide = dataclasses.replace(
        C, docking_speed=0.4, speed_slope=0.012, max_temperature=11.0, min_energy=0.5, field_of_view=0.5
    )
    return SafetyFilter(wide, R, 5.0)


@pytest.fixture(scope="module")
def flight() -> verification.Flight:
    """Six episodes of 60 s that decide every 10 s and are filtered every 5 s."""
    safety = Safety(CONSTRAINTS, lambda x: constraints.values(x, C), None, lax(), 5.0)
    env = InspectionEnv(6, C, [torch.Generator().manual_seed(0)], safety)
    x, priority, _ = verification.safe_set(6, 32, BARRIERS)
    x[13], x[14] = 9.9, 1.1
    policy = verification.held_at_random(C, torch.Generator().manual_seed(0), 6)
    return verification.fly(env, policy, x, priority, 60, 10)


def recount(flight: verification.Flight, column: int) -> dict[str, ndarray]:
    """One episode again, second by second, from its start and what the policy desired every 10 s."""
    safety, x = lax(), flight.start[:16, column : column + 1].numpy()
    states, statuses, slacks, largest = [x], [], [], 0.0
    u = np.zeros((6, 1))
    for second in range(60):
        if second % 10 == 0:
            u = flight.desired[second, :, column : column + 1].numpy()
        if second % 5 == 0:
            result = safety(tensor(x), tensor(u))
            u = result.control.numpy()
            statuses.append(int(result.status))
            slacks.append(result.slack[:, 0].numpy())
            largest = max(largest, (np.abs(u) / LIMIT).max())
        x = fly(x, u, steps=1)
        states.append(x)
    h = paper(np.hstack(states)).T
    violated = h < -1e-12  # a rate at its limit is rounded either way
    return {
        "violating": np.append(violated.sum(0), violated.any(1).sum()),
        "worst": h.min(0),
        "when": h.argmin(0),
        "status": np.bincount(statuses, minlength=4),
        "yielded": (np.array(slacks) > 0).sum(0),
        "slack": np.max(slacks, 0),
        "excess": largest,
    }


@pytest.fixture(scope="module")
def recounted(flight: verification.Flight) -> list[dict[str, ndarray]]:
    return [recount(flight, column) for column in range(6)]


def test_a_flight_counts_what_a_loop_of_its_own_counts(
    flight: verification.Flight, recounted: list[dict[str, ndarray]]
) -> None:
    for column, expected in enumerate(recounted):
        actual = {name: getattr(flight, name)[..., column].numpy() for name in expected}
        np.testing.assert_array_equal(actual["violating"], expected["violating"])
        np.testing.assert_allclose(actual["worst"], expected["worst"], rtol=0, atol=PSM_TOLERANCE)
        np.testing.assert_array_equal(actual["status"], expected["status"])
        np.testing.assert_array_equal(actual["yielded"], expected["yielded"])
        np.testing.assert_allclose(actual["slack"], expected["slack"], rtol=0, atol=1e-7)
        np.testing.assert_allclose(actual["excess"], expected["excess"], rtol=0, atol=1e-9)
        sharp = [i for i in range(13) if i != 3 and i < 10]
        np.testing.assert_array_equal(actual["when"][sharp], expected["when"][sharp])


def test_a_report_adds_its_flights_up(
    flight: verification.Flight, recounted: list[dict[str, ndarray]]
) -> None:
    report = verification.empty_tally()
    verification.add(report, flight, verification.Origin(17, 20, 3))
    verification.add(report, flight, verification.Origin(18, 20, 9))
    violating = np.array([one["violating"] for one in recounted])
    worst = np.array([one["worst"] for one in recounted])
    assert (report["episodes"], report["steps"]) == (12, 12 * 61)
    assert (violating[:, -1] > 0).sum() > 0 and (violating.sum(0) > 0).sum() >= 3
    for i, name in enumerate((*CONSTRAINTS, "any")):
        assert report["violating_steps"][name] == 2 * violating[:, i].sum()
        assert report["violating_episodes"][name] == 2 * (violating[:, i] > 0).sum()
    for i, name in enumerate(CONSTRAINTS):
        assert report["worst_value"][name] == pytest.approx(worst[:, i].min(), abs=PSM_TOLERANCE)
        case = report["worst_case"][name]
        assert (case["batch_seed"], case["batch_size"]) == (17, 20)  # the first of equals
        start = flight.start[:, case["column"] - 3]
        np.testing.assert_array_equal(case["initial_state"] + case["priority"], start)
        assert report["yielded_calls"][name] == 2 * sum(one["yielded"][i] for one in recounted)
    calls = 2 * sum(one["status"] for one in recounted)
    assert list(report["filter_calls"].values()) == list(calls)
    assert report["unsolved"] == calls[Status.UNSOLVED] and report["controls_outside_bounds"] == 0


def test_chosen_episodes_are_those_of_the_flight(flight: verification.Flight) -> None:
    chosen = torch.tensor([False, True, False, True, True, False])
    part = flight[chosen]
    assert part.column.tolist() == [1, 3, 4]
    assert part.applied.shape == (60, 6, 3) and (part.worst == flight.worst[:, [1, 3, 4]]).all()
    yielded = flight.yielded[:, chosen].sum()
    assert (part.conflicts.slack > 0).sum() == yielded


def test_calls_with_slack_are_shown_and_counted(
    flight: verification.Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked again, the filter has the same slack in each of them."""
    monkeypatch.setattr(verification, "SHOWN", 2)
    tally = verification.empty_tally()
    verification.add(tally, flight, verification.Origin(17, 20, 3))
    together = tally["slack_together"]
    programs = sum(int((slack > 0).any(0).sum()) for slack in flight.conflicts.slack.split((7, 6)))
    assert sum(same["calls"] for same in together.values()) == programs > 5
    for i, name in enumerate(CONSTRAINTS):
        mine = [same for key, same in together.items() if name in key.split(" + ")]
        assert sum(same["calls"] for same in mine) == tally["yielded_calls"][name]
        assert max((same["largest_slack"][name] for same in mine), default=0.0) == flight.slack[i].max()
        shown = sum(name in one["slack"] for one in tally["conflicts"])
        assert shown >= min(tally["yielded_calls"][name], verification.SHOWN)
    assert len(tally["conflicts"]) < flight.conflicts.column.numel()
    for one in tally["conflicts"]:
        x, u = (np.array(one[key])[:, None] for key in ("state", "control_desired"))
        again = lax()(tensor(x), tensor(u))
        expected = [one["slack"].get(name, 0.0) for name in CONSTRAINTS]
        np.testing.assert_allclose(again.slack[:, 0], expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(list(one["h"].values()), paper(x)[:, 0], rtol=0, atol=PSM_TOLERANCE)
        second, column = int(one["time_s"]), one["column"] - 3
        wanted = flight.applied[second - 1] if second % 10 else flight.desired[second]
        np.testing.assert_array_equal(one["control_desired"], wanted[:, column])


def test_the_calls_shown_do_not_depend_on_how_episodes_are_divided(
    flight: verification.Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verification, "SHOWN", 2)
    whole, parts = verification.empty_tally(), verification.empty_tally()
    origin = verification.Origin(17, 20, 3)
    verification.add(whole, flight, origin)
    for chosen in ([0, 1], [2, 3, 4, 5]):
        mask = torch.zeros(6, dtype=torch.bool)
        mask[chosen] = True
        verification.add(parts, flight[mask], origin)
    assert whole == parts


def test_nan_is_a_violation_without_end(flight: verification.Flight) -> None:
    one = dataclasses.replace(
        flight, violating=torch.zeros(14, 2), worst=torch.full((13, 2), torch.inf), when=torch.zeros(13, 2)
    )
    h = torch.ones(13, 2)
    h[4, 1] = torch.nan
    verification.note_state(one, h, 3.0)
    assert (one.violating[:, 0] == 0).all() and one.violating[[4, 13], 1].tolist() == [1, 1]
    assert one.worst[4].tolist() == [1.0, -torch.inf] and one.when[4, 1] == 3.0


def clopper_pearson(events: int, trials: int) -> float:
    """p at which so few events have a chance of 5 %."""
    if events == trials:
        return 1.0
    return brentq(lambda p: binom.cdf(events, trials, p) - 0.05, 0.0, 1.0, xtol=1e-16)


@pytest.mark.parametrize("trials", [1, 10, 1000, 30_000])
def test_bound_without_events_is_the_closed_form(trials: int) -> None:
    assert upper_bound(0, trials) == pytest.approx(1 - 0.05 ** (1 / trials), rel=1e-9)
    assert upper_bound(trials, trials) == 1.0


def test_thirty_thousand_safe_episodes_bound_a_violation_below_one_in_ten_thousand() -> None:
    assert upper_bound(0, 30_000) == pytest.approx(9.985e-5, rel=1e-4)


@pytest.mark.parametrize(("events", "trials"), [(1, 10), (3, 100), (99, 100), (7, 30_000)])
def test_bound_solves_the_binomial_tail(events: int, trials: int) -> None:
    assert upper_bound(events, trials) == pytest.approx(clopper_pearson(events, trials), rel=1e-9)


# The command


def verify(path: Path, *more: str) -> list[str]:
    flags = ["--compile", "off", "--device", "cpu", "--json", str(path)]
    return ["verify", "--episodes", "16", "--duration", "20", *flags, *more]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a finished campaign."""
    import main

    path = tmp_path_factory.mktemp("verify") / "report.json"
    assert main.main(verify(path)) == 0
    return path


def test_verify_writes_the_promised_json(finished: Path) -> None:
    report = json.loads(finished.read_text())
    promised = {
        "episodes",
        "violating_steps",
        "violating_episodes",
        "worst_value",
        "upper_bound_95",
        "unsolved",
    }
    assert promised <= set(report)
    assert set(report["violating_steps"]) == set(report["violating_episodes"]) == {*CONSTRAINTS, "any"}
    assert set(report["worst_value"]) == set(CONSTRAINTS)
    assert (report["episodes"], report["steps"], report["unsolved"]) == (16, 16 * 21, 0)
    assert sum(report["filter_calls"].values()) == 16 * 20
    assert report["violating_steps"]["any"] == 0
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / 16))
    assert report["starts_beyond_braking"]["episodes"] == 0
    assert list(finished.parent.iterdir()) == [finished]


def test_a_worst_case_is_found_again_from_its_seed(finished: Path) -> None:
    report = json.loads(finished.read_text())
    for case in report["worst_case"].values():
        x, priority, _ = verification.initial_states(case["batch_size"], case["batch_seed"], BARRIERS)
        np.testing.assert_array_equal(x[:, case["column"]], case["initial_state"])
        np.testing.assert_array_equal(priority[:, case["column"]], case["priority"])
    assert len({case["column"] for case in report["worst_case"].values()}) > 3


def test_a_finished_report_flies_nothing_more(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    monkeypatch.setattr(verification, "fly", lambda *_: pytest.fail("flew"))
    code, out, err = call(verify(finished), capsys)
    assert code == 0, err
    assert "16 episodes, 336 steps" in out
    assert finished.read_bytes() == before


def test_a_report_that_holds_more_than_asked_for_says_so(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    code, out, err = call(verify(finished, "--episodes", "8"), capsys)
    assert code == 0 and "16 episodes" in out
    assert f"{finished}: holds 16 episodes already, more than asked for" in err
    assert finished.read_bytes() == before


def test_a_longer_campaign_goes_on_where_the_report_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the middle of a batch, over the next one's beginning and past starts beyond braking."""
    monkeypatch.setattr(verification, "BATCH", 16)
    monkeypatch.setattr(Barriers, "can_brake", lambda _, x: x[6].abs() < 0.6)
    texts = []
    for path, counts in ((tmp_path / "on.json", (5, 9, 18)), (tmp_path / "once.json", (18,))):
        for count in counts:
            assert call(verify(path, "--episodes", str(count)), capsys)[0] == 0
            assert json.loads(path.read_text())["episodes"] == count
        texts.append(json.loads(path.read_text()))
    beyond = texts[0]["starts_beyond_braking"]
    assert beyond["episodes"] > 0 and beyond["steps"] == 21 * beyond["episodes"]
    # the rounding of other batch sizes
    for name in CONSTRAINTS:
        for tally in ("worst_value", "largest_slack"):
            assert texts[0][tally].pop(name) == pytest.approx(texts[1][tally].pop(name), rel=1e-9, abs=1e-9)
    assert texts[0] == texts[1]


def test_starts_beyond_braking_are_told_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Recounted from the starts of the batch."""
    monkeypatch.setattr(verification, "BATCH", 32)
    monkeypatch.setattr(Barriers, "can_brake", lambda _, x: x[6].abs() < 0.6)
    campaign = verification.Campaign("random", 1.0, 20, 4, 32)
    safety = SafetyFilter(C, R)
    reports = verification.run(
        campaign,
        12,
        safety,
        lambda count: InspectionEnv(count, C, [torch.Generator()], safety.safety()),
        None,
        None,
        Config(),
    )
    report = list(reports)[-1]
    case = report["worst_case"]["collision"]
    x, _, rejected = verification.initial_states(32, case["batch_seed"], safety.barriers)
    held = x[6].abs().numpy() < 0.6
    flown = int(np.flatnonzero(held)[11]) + 1
    assert report["starts_beyond_braking"]["episodes"] == (~held[:flown]).sum() > 0
    assert report["starts_rejected_by_margin"] == rejected
    for tally, theirs in ((report, held), (report["starts_beyond_braking"], ~held)):
        assert all(theirs[case["column"]] and case["column"] < flown for case in tally["worst_case"].values())
    assert report["upper_bound_95"] == pytest.approx(1 - 0.05 ** (1 / 12))


def test_the_filter_is_compiled_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    used, elsewhere = [], torch.device("meta")
    monkeypatch.setattr(SafetyFilter, "compile", lambda _, device, batch: used.append(device))
    monkeypatch.setattr(build, "resolve_device", lambda _: elsewhere)
    build.make_filter(Config(), 1.0, compiled=True)
    assert used == [elsewhere]


def test_a_retrained_policy_is_another_campaign() -> None:
    policies = [build.make_policy(Config(), [torch.Generator().manual_seed(seed)]) for seed in (0, 0, 1)]
    first, same, other = (verification.digest(policy) for policy in policies)
    assert first == same != other
    with torch.no_grad():
        next(policies[1].parameters()).flatten()[0] += 1e-6
    assert verification.digest(policies[1]) != first


@pytest.mark.parametrize(
    "other", [["--seed", "1"], ["--policy", "adversarial"], ["--rta-period", "10"], ["--duration", "30"]]
)
def test_another_campaigns_report_is_refused(
    other: list[str], finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = finished.read_bytes()
    assert_refused(verify(finished, *other), [str(finished), "another campaign"], capsys)
    assert finished.read_bytes() == before


@pytest.mark.parametrize("text", ["{", "[]", "{}", "3"])
def test_what_is_no_report_is_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "report.json"
    path.write_text(text)
    assert_refused(verify(path), [str(path), "no report"], capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--policy", "nobody"], ["--policy", "'nobody'", "checkpoint:F"]),
        (["--policy", "checkpoint:nowhere.pt"], ["nowhere.pt", "no such checkpoint"]),
        (["--duration", "25", "--rta-period", "10"], ["--duration 25", "10 s"]),
        (["--duration", "0"], ["--duration", "'0'"]),
        (["--episodes", "0"], ["--episodes", "'0'"]),
        (["--no-rta"], ["--no-rta"]),
        (["--json", "nowhere/x.json"], ["--json", "cannot write"]),
        (["--replay", "nowhere.npz"], ["nowhere.npz", "no such file"]),
        (["--replay", "x.npz", "--qp-solver", "piqp"], ["--replay", "drop --qp-solver"]),
        (["--replay", "x.npz", "--rta-period", "1", "--seed", "0"], ["drop --rta-period, --seed"]),
        (["--replay", "x.npz", "--policy", "random", "--episodes", "5"], ["--policy", "--episodes"]),
        (["--replay", "x.npz", "--json", "x.json", "--duration", "9"], ["--duration", "--json"]),
    ],
)
def test_bad_flags_are_refused(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(["verify", *arguments], words, capsys)


@pytest.fixture(scope="module")
def violated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with violations: an adversary that a filter every 10 s cannot hold."""
    import main

    path = tmp_path_factory.mktemp("violated") / "report.json"
    config = path.with_name("weak.toml")
    config.write_text("[inspection]\nmax_thrust = 1.5\n")
    arguments = ["--policy", "adversarial", "--rta-period", "10", "--duration", "60", "--episodes", "128"]
    arguments += ["--qp-solver", "piqp"]
    assert main.main(verify(path, *arguments, "--config", str(config))) == 0
    return path


def test_a_violation_leaves_a_counter_example_that_replays_exactly(
    violated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = json.loads(violated.read_text())
    names = [name for name in CONSTRAINTS if report["violating_steps"][name]]
    files = {path.name for path in violated.parent.glob("*.npz")}
    assert names and files == {f"{violated.name}.{name}.npz" for name in names}
    for name in names:
        path = violated.with_name(f"{violated.name}.{name}.npz")
        example: dict[str, Any] = dict(np.load(path))
        case = report["worst_case"][name]
        np.testing.assert_array_equal(example["state"], case["initial_state"])
        assert example["value"] == report["worst_value"][name] < 0
        assert len(example["control_desired"]) == case["time_s"]
        assert np.abs(example["control_applied"]).max() <= 1.5
        code, out, err = call(["verify", "--replay", str(path)], capsys)
        assert code == 0, err
        words = out.split()
        value, when = float(words[words.index("to") + 1]), float(words[words.index("at") + 1])
        assert value == pytest.approx(report["worst_value"][name], rel=0, abs=1e-9)
        assert float(words[words.index("most") + 1]) < 1e-6
        assert when == case["time_s"]


def test_replay_uses_the_solver_of_the_campaign(
    violated: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = next(violated.parent.glob("*.npz"))
    assert from_toml(str(np.load(path)["config"]), "it").train.qp_solver == "piqp"
    used = []
    monkeypatch.setattr(build, "make_solver", lambda name: used.append(name) or make_solver(name))
    assert call(["verify", "--replay", str(path)], capsys)[0] == 0
    assert used == ["piqp"]


@pytest.mark.parametrize("factor", [1 + 1e-6, np.nan, np.inf])
def test_a_replay_that_comes_out_otherwise_fails(
    factor: float, violated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = dict(np.load(next(violated.parent.glob("*.npz"))))
    path = tmp_path / "example.npz"
    np.savez(path, **(example | {"value": factor * example["value"]}))
    code, out, err = call(["verify", "--replay", str(path)], capsys)
    assert (code, out) == (1, "") and err.count("\n") == 1
    assert "not what was recorded" in err and str(path) in err


def test_replay_does_not_depend_on_the_solvers_last_digits() -> None:
    """At 10 s the closed loop can multiply any rounding by some 20 per call."""
    first, second = (SafetyFilter(C, R, 10.0, make_solver(name)) for name in ("batched", "piqp"))
    env, other = (
        InspectionEnv(count, C, [torch.Generator()], safety.safety())
        for count, safety in ((200, first), (1, second))
    )
    x, priority, _ = verification.initial_states(200, 3, BARRIERS_10_S)
    flight = verification.fly(env, verification.adversarial(first), x, priority, 200, 10)
    constraint = CONSTRAINTS.index("dynamic_speed")
    campaign = verification.Campaign("adversarial", 10.0, 200, 0, 200)
    example = verification.counter_example(flight, constraint, campaign, Config())
    value, when, difference = verification.replay(other, example)
    assert example["value"] < 0
    assert value == pytest.approx(float(example["value"]), abs=1e-9)
    assert when == len(example["control_desired"])
    assert difference < 1e-6


def test_a_damaged_counter_example_is_refused(
    violated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example = dict(np.load(next(violated.parent.glob("*.npz"))))
    for change in (
        {"state": np.zeros(3)},
        {"control_desired": np.zeros((5, 2))},
        {"control_desired": np.zeros(5)},
        {"control_applied": np.zeros((5, 2))},
        {"constraint": np.array("colour")},
        {"period": np.array([1.0, 2.0])},
        {"period": np.array(0.0)},
        {"config": np.array("[")},
    ):
        path = tmp_path / "example.npz"
        np.savez(path, **(example | change))
        assert_refused(["verify", "--replay", str(path)], [str(path)], capsys)

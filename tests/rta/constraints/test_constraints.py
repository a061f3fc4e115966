"""The 13 constraints against plain numpy re-computations from the paper's final forms, and what is enforced of them.

`paper` and what it calls are the reference of the other filter tests too. They are written from the paper's equations
with the paper's numbers, and most of it also takes complex states, for derivatives by complex steps.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from numpy import ndarray

from inspection.model.parameters import InspectionParameters
from rta.constraints import thrust as thrust_constraints
from rta.constraints import torque as torque_constraints
from rta.constraints.constraint import Constraint
from rta.constraints.thrust import chord
from rta.constraints.torque import angle_to, arccos, side
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters

C = InspectionParameters()
R = RtaParameters()
MEAN_MOTION = 0.001027  # rad/s
# thrust less the tide at 800 m less Coriolis at 5 m/s, below the dynamic speed limit there (spec, decision 6)
A_MAX = 1 / 12 - 3 * MEAN_MOTION**2 * 800 - 2 * MEAN_MOTION * 5
TABLE_3 = (
    "collision",
    "dynamic_speed",
    "keep_in_zone",
    "passive_safety",
    "velocity_x",
    "velocity_y",
    "velocity_z",
    "attitude_exclusion",
    "temperature",
    "battery",
    "angular_velocity_x",
    "angular_velocity_y",
    "angular_velocity_z",
)
PSM_TOLERANCE = 1e-4  # m; measured: at most 1e-5


def hamilton(a: ndarray, b: ndarray) -> ndarray:
    """The Hamilton product of quaternions (4, B), scalar last."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3], axis=0)
    return np.concatenate((vector, (a[3] * b[3] - (a[:3] * b[:3]).sum(0))[None]))


def body_axis(q: ndarray, axis: int) -> ndarray:
    """Hill-frame components (3, B) of a principal axis, H(H(q, n), q*)."""
    n = np.zeros_like(q)
    n[axis] = 1.0
    return hamilton(hamilton(q, n), np.concatenate((-q[:3], q[3:])))[:3]


def length(a: ndarray) -> ndarray:
    return np.sqrt((a * a).sum(0))


def positive(a: ndarray) -> ndarray:
    return np.where(a.real > 0, a, 0.0)


def root(z: ndarray, floor: float = 0.0) -> ndarray:
    """sqrt(2 a_max z), continued oddly to negative distances; nearer to 0 than a floor its chord."""
    straight = z / math.sqrt(floor or 1.0)
    return math.sqrt(2 * A_MAX) * np.where(np.abs(z) < floor, straight, np.sign(z) * np.sqrt(np.abs(z)))


def cosines(x: ndarray, panel: float = -1.0) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Of boresight and Sun, panel and Sun, the -n_y side and Sun, the -n_y side and Earth."""
    n_x, n_y = body_axis(x[6:10], 0), body_axis(x[6:10], 1)
    boresight = n_x[0] * np.cos(x[15]) + n_x[1] * np.sin(x[15])
    side = -n_y[0] * np.cos(x[15]) - n_y[1] * np.sin(x[15])
    return boresight, panel * boresight, side, n_y[0]


def orientation(x: ndarray, panel: float = -1.0) -> ndarray:
    """Attitude exclusion in rad, temperature in deg C and battery in kJ, (3, B)."""
    boresight, on_panel, side_sun, side_earth = cosines(x, panel)
    exclusion = np.arccos(boresight) - np.pi / 6 - np.pi / 18
    sun, earth = (positive(np.pi / 2 - np.arccos(cosine)) for cosine in (side_sun, side_earth))
    return np.stack(
        (exclusion, 10 - x[13] - 0.05 * sun - 0.01 * earth, x[14] - 1 - 0.05 * np.arccos(on_panel))
    )


def coast(x: ndarray, t: ndarray) -> ndarray:
    """The paper's free-flight trajectory, (3, ...)."""
    n, s, c = MEAN_MOTION, np.sin(MEAN_MOTION * t), np.cos(MEAN_MOTION * t)
    return np.stack(
        (
            (4 - 3 * c) * x[0] + s / n * x[3] + 2 / n * (1 - c) * x[4],
            6 * (s - n * t) * x[0] + x[1] - 2 / n * (1 - c) * x[3] + (4 * s - 3 * n * t) / n * x[4],
            x[2] * c + x[5] / n * s,
        )
    )


def speed_limit(x: ndarray) -> ndarray:
    return 0.2 + 7.5 * MEAN_MOTION * length(x[:3])


def keep_in_curve(x: ndarray, floor: float = 0.0) -> ndarray:
    """sqrt(2 (a_max - v_t^2 / |p|) (800 - |p|)) - v_pr, at least a tenth of a_max left to brake, all of it outside.

    Nearer to 800 m than a floor the root is its chord, outside its tangent.
    """
    distance = length(x[:3])
    radial = (x[:3] * x[3:6]).sum(0) / distance
    across = np.cross(x[:3], x[3:6], axis=0) / distance
    braking = np.maximum(A_MAX - (across**2).sum(0) / distance, A_MAX / 10)
    inside = np.sqrt(braking / A_MAX) * root(800 - distance, floor)
    tangent = (distance - 800 + floor) / (2 * math.sqrt(floor or 1.0))
    beyond = math.sqrt(2 * A_MAX) * np.where(distance - 800 < floor, tangent, np.sqrt(np.abs(800 - distance)))
    return np.where(distance > 800, -beyond, inside) - radial


def passive_safety(x: ndarray, start: float = 0.0, end: float = 500.0) -> ndarray:
    """inf |p(t)| - 15 m over [start, end] s, (B,): dense samples, then ever denser ones about the best."""
    low, high = np.full(x.shape[1], start), np.full(x.shape[1], end)
    for count in (501, 41, 41, 41, 41, 41):
        t = np.linspace(low, high, count)
        distance = length(coast(x, t))
        best = distance.argmin(0)
        low, high = (
            t[best + i, range(x.shape[1])]
            for i in (np.where(best > 0, -1, 0), np.where(best < count - 1, 1, 0))
        )
    return distance.min(0) - 15


def paper(x: ndarray) -> ndarray:
    """All 13 in the order of Table 3, (13, B)."""
    distance, speed = length(x[:3]), length(x[3:6])
    radial = (x[:3] * x[3:6]).sum(0) / distance
    return np.stack(
        (
            root(distance - 15) + radial,
            speed_limit(x) - speed,
            root(800 - distance) - radial,
            passive_safety(x),
            *(25 - x[3:6] ** 2),
            *orientation(x),
            *(np.radians(2) ** 2 - x[10:13] ** 2),
        )
    )


def states(count: int, seed: int = 0) -> ndarray:
    """(16, count) with every constraint on both sides of its limit."""
    rng = np.random.default_rng(seed)
    p, v = rng.standard_normal((2, 3, count))
    p *= rng.choice((5.0, 20.0, 100.0, 750.0), count) * rng.uniform(1, 1.2, count) / length(p)
    v *= rng.choice((0.0, 0.05, 0.5, 6.0), count) / length(v)
    q = rng.standard_normal((4, count))
    rest = rng.uniform(-0.05, 0.05, (3, count)), rng.uniform(9, 11, count), rng.uniform(0, 2, count)
    return np.vstack((p, v, q / length(q), *rest, rng.uniform(0, 2 * np.pi, count)))


def tensor(x: ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(x))


def approaching(speed: float, miss: float) -> ndarray:
    """300 states 30 to 700 m away that fly straight past the centre at up to a miss distance."""
    x, rng = states(300, seed=3), np.random.default_rng(4)
    away = x[:3] / length(x[:3])
    side = np.cross(away, rng.standard_normal((3, 300)), axis=0)
    x[:3] = away * rng.uniform(30, 700, 300)
    path = -x[:3] + side / length(side) * rng.uniform(0, miss, 300)
    x[3:6] = speed * path / length(path)
    return x


def clearance(x: ndarray, segments: tuple[float, ...] = R.passive_safety_segments) -> ndarray:
    """The constraint's own closest clearance in m per segment."""
    times = thrust_constraints.closest_passes(tensor(x), segments, C)
    return thrust_constraints.clearance_at(tensor(x), times, C).numpy()


def entries(c: InspectionParameters = C, r: RtaParameters = R) -> dict[str, Constraint]:
    """The 13 by name."""
    thrust, torque = thrust_constraints.thrust_constraints(c, r), torque_constraints.torque_constraints(c, r)
    return {each.name: each for each in (*thrust, *torque)}


def enforced(each: Constraint, x: ndarray) -> ndarray:
    """The barrier, (rows, B)."""
    return each.barrier_at(tensor(x))(tensor(x)).numpy()


def at_the_edge(count: int, distance: float, within: float) -> ndarray:
    """(16, count) states no further from a distance from the chief than `within`."""
    x = states(count, seed=8)
    x[:3] *= (distance + np.linspace(-within, within, count)) / length(x[:3])
    return x


@pytest.mark.parametrize("period", PERIODS)
def test_keep_in_curve_equals_numpy(period: float) -> None:
    """Which is exact but for a chord inside the edge and a tangent outside."""
    r = RtaParameters(period=period)
    floor, zone = chord(C, r), entries(C, r)["keep_in_zone"]
    assert floor == max(0.05, 2 * A_MAX * period**2)
    for x in (states(1000), at_the_edge(101, 800.0, 1.5 * floor)):
        np.testing.assert_allclose(enforced(zone, x)[0], keep_in_curve(x, floor), rtol=0, atol=2e-12)
    far = np.abs(800 - length(states(1000)[:3])) > floor
    assert far.mean() > 0.9
    x = states(1000)[:, far]
    np.testing.assert_allclose(enforced(zone, x)[0], keep_in_curve(x), rtol=0, atol=2e-12)


@pytest.mark.parametrize("period", PERIODS)
def test_collision_barrier_equals_numpy(period: float) -> None:
    r = RtaParameters(period=period)
    floor = chord(C, r)
    for x in (states(1000), at_the_edge(101, 15.0, min(1.5 * floor, 14.0))):
        radial = (x[:3] * x[3:6]).sum(0) / length(x[:3])
        expected = root(length(x[:3]) - 15, floor) + radial
        np.testing.assert_allclose(enforced(entries(C, r)["collision"], x)[0], expected, rtol=0, atol=2e-12)


def test_entries_are_in_the_order_of_table_3() -> None:
    assert tuple(entries()) == TABLE_3
    assert [each.held_by for each in entries().values()] == ["thrust"] * 7 + ["torque"] * 6


@pytest.mark.parametrize("name", [name for name in TABLE_3 if name != "passive_safety"])
def test_constraint_equals_the_paper(name: str) -> None:
    x = states(1000)
    value = entries()[name].h(tensor(x))
    expected = paper(x)[TABLE_3.index(name)]
    np.testing.assert_allclose(value, expected, rtol=0, atol=2e-12)  # 1e-12 m/s floors |v| at rest


@pytest.mark.parametrize("row", range(13), ids=TABLE_3)
def test_values_are_in_the_order_of_table_3(row: int) -> None:
    x = states(1000, seed=1)
    values = SafetyFilter(C, R).values(tensor(x))
    np.testing.assert_allclose(values[row], paper(x)[row], rtol=0, atol=PSM_TOLERANCE)


def test_every_constraint_is_tested_on_both_sides() -> None:
    share = (paper(states(1000)) < 0).mean(1)
    assert ((share > 0.01) & (share < 0.99)).all()


def test_panels_on_the_other_side_see_the_opposite_angle() -> None:
    x = states(100)
    flipped = [
        each.h(tensor(x))
        for each in torque_constraints.torque_constraints(InspectionParameters(solar_panel_axis="+x"), R)[:3]
    ]
    np.testing.assert_allclose(flipped, orientation(x, panel=1.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("miss", [0.0, 20.0, 300.0])
@pytest.mark.parametrize("speed", [0.0, 0.01, 0.1, 0.5, 2.0, 6.0])
def test_infimum_equals_brute_force_when_approaching(speed: float, miss: float) -> None:
    x = approaching(speed, miss)
    np.testing.assert_allclose(clearance(x).min(0), passive_safety(x), rtol=0, atol=PSM_TOLERANCE)


def test_infimum_of_each_segment_equals_brute_force() -> None:
    x = states(1000, seed=2)
    spans = itertools.pairwise(R.passive_safety_segments)
    expected = [passive_safety(x, start, end) for start, end in spans]
    np.testing.assert_allclose(clearance(x), expected, rtol=0, atol=PSM_TOLERANCE)


@pytest.mark.parametrize("pole", [-1.0, 1.0])
def test_smooth_arccos_is_the_tangent_inside_its_zone(pole: float) -> None:
    cosine = pole * np.linspace(math.cos(R.pole_angle), 1.0, 1001)
    edge = math.acos(pole * math.cos(R.pole_angle))
    tangent = edge - (cosine - math.cos(edge)) / math.sin(edge)
    np.testing.assert_allclose(arccos(tensor(cosine), R.pole_angle), tangent, rtol=0, atol=1e-12)


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("axis", ["+x", "-x", "-y"])
def test_the_side_on_which_a_direction_leaves_a_pole_has_its_angle(axis: str, far: bool) -> None:
    """The enforced angle is that of the direction itself, from the axis, also next to its other end."""
    index, sign = "xyz".index(axis[1]), -1.0 if axis[0] == "-" else 1.0
    off = tensor(np.linspace(1e-6, 0.9 * R.pole_angle, 50))
    around = tensor(np.linspace(0.0, 2 * np.pi, 50))
    parts = [off.sin() * around.cos(), off.sin() * around.sin()]
    parts.insert(index, sign * (-off.cos() if far else off.cos()))
    body = torch.stack(parts)
    leaving = side(axis, body, torch.ones(50, dtype=torch.bool), R.pole_angle, far)
    assert leaving.near.all()
    found = angle_to(axis, body, R.pole_angle, leaving)
    torch.testing.assert_close(found, math.pi - off if far else off, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("row", "margin"), [(8, R.temperature_margin), (9, R.battery_margin)])
def test_smoothing_of_a_resource_is_covered_by_its_margin(row: int, margin: float) -> None:
    x = states(1, seed=7).repeat(2001, 1)
    half = np.linspace(0, np.pi / 2, 2001)  # turn about z: boresight and -n_y sweep from the Sun away
    x[6:10], x[15] = np.stack((0 * half, 0 * half, np.sin(half), np.cos(half))), 0.0
    x[13], x[14] = 5.0, 6.0  # within the limits; beyond, no angle is smoothed where it is worst
    smooth = enforced(entries(C, RtaParameters(incidence_rounding=0.0))[TABLE_3[row]], x)[0]
    assert 1e-4 < (smooth - paper(x)[row]).max() < margin

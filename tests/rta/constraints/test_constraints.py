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
from rta.constraints import torque as torque_constraints
from rta.constraints.thrust import sqrt_floor
from rta.constraints.torque import angle_to, arccos, side
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters
from tests.oracles import (
    A_MAX,
    PSM_TOLERANCE,
    C,
    R,
    at_the_edge,
    clearance,
    enforced,
    entries,
    keep_in_curve,
    length,
    orientation,
    paper,
    passive_safety,
    root,
    states,
    tensor,
)

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


def approaching(speed: float, miss: float) -> ndarray:
    """300 states 30 to 700 m away that fly straight past the centre at up to a miss distance."""
    x, rng = states(300, seed=3), np.random.default_rng(4)
    away = x[:3] / length(x[:3])
    side = np.cross(away, rng.standard_normal((3, 300)), axis=0)
    x[:3] = away * rng.uniform(30, 700, 300)
    path = -x[:3] + side / length(side) * rng.uniform(0, miss, 300)
    x[3:6] = speed * path / length(path)
    return x


@pytest.mark.parametrize("period", PERIODS)
def test_keep_in_curve_equals_numpy(period: float) -> None:
    """Which is exact but for a chord inside the edge and a tangent outside."""
    r = RtaParameters(period=period)
    floor, zone = sqrt_floor(C, r), entries(C, r)["keep_in_zone"]
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
    floor = sqrt_floor(C, r)
    for x in (states(1000), at_the_edge(101, 15.0, min(1.5 * floor, 14.0))):
        radial = (x[:3] * x[3:6]).sum(0) / length(x[:3])
        expected = root(length(x[:3]) - 15, floor) + radial
        np.testing.assert_allclose(enforced(entries(C, r)["collision"], x)[0], expected, rtol=0, atol=2e-12)


def test_entries_are_in_the_order_of_table_3() -> None:
    assert tuple(entries()) == TABLE_3
    assert [each.actuator for each in entries().values()] == ["thrust"] * 7 + ["torque"] * 6


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

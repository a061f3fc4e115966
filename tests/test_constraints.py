"""The 13 constraints against plain numpy re-computations from the paper's final forms, and their smoothing.

`paper` and `Coast` are the reference of the other filter tests too. They are written from the paper's equations
with the paper's numbers, and most of it also takes complex states, for derivatives by complex steps.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import elementwise

from inspection.parameters import InspectionParameters
from rta import constraints
from rta.constraints import EXACT, Smoothing, arccos, signed_sqrt
from rta.parameters import RtaParameters

C = InspectionParameters()
R = RtaParameters()
SMOOTH = Smoothing(distance=R.distance_floor, angle=R.pole_angle)
MEAN_MOTION = 0.001027  # rad/s
# thrust less the tide at 800 m less Coriolis at the dynamic speed limit there (spec, decision 6)
A_MAX = 1 / 12 - 3 * MEAN_MOTION**2 * 800 - 2 * MEAN_MOTION * (0.2 + 7.5 * MEAN_MOTION * 800)
TABLE_3 = {
    "collision": "Safe separation",
    "dynamic_speed": "Dynamic speed",
    "keep_in_zone": "Keep in zone",
    "passive_safety": "PSM",
    "velocity_x": "x limit",
    "velocity_y": "y limit",
    "velocity_z": "z limit",
    "attitude_exclusion": "Attitude exclusion",
    "temperature": "Temperature",
    "battery": "Power",
    "angular_velocity_x": "omega_x limit",
    "angular_velocity_y": "omega_y limit",
    "angular_velocity_z": "omega_z limit",
}


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


def root(z: ndarray) -> ndarray:
    """sqrt(2 a_max z), continued oddly to negative distances."""
    return np.sign(z) * np.sqrt(2 * A_MAX * np.abs(z))


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


def passive_safety(x: ndarray, start: float = 0.0, end: float = 500.0) -> ndarray:
    """inf |p(t)| - 15 m by dense sampling (at most 0.25 s) and scipy's bracketed minimisation, (B,)."""
    t = np.linspace(start, end, 2001)
    sampled = length(coast(x[:6, :, None], t))  # (B, times)
    best = sampled.argmin(1).clip(1, len(t) - 2)

    def squared(t: ndarray, *state: ndarray) -> ndarray:
        return (coast(np.stack(state), t) ** 2).sum(0)

    refined = elementwise.find_minimum(squared, (t[best - 1], t[best], t[best + 1]), args=tuple(x[:6]))
    inside = np.where(refined.success, np.sqrt(refined.f_x), np.inf)  # no bracket: the minimum is an end
    return np.minimum(sampled.min(1), inside) - 15


def paper(x: ndarray) -> ndarray:
    """All 13 in the order of Table 3, (13, B)."""
    distance, speed = length(x[:3]), length(x[3:6])
    radial = (x[:3] * x[3:6]).sum(0) / distance
    return np.stack(
        (
            root(distance - 15) + radial,
            0.2 + 7.5 * MEAN_MOTION * distance - speed,
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
    """300 states 30 to 700 m away, heading past the centre at up to a miss distance."""
    x = states(300, seed=3)
    rng = np.random.default_rng(4)
    toward = -x[:3] / length(x[:3])
    side = np.cross(toward, rng.standard_normal((3, 300)), axis=0)
    aim = -x[:3] * rng.uniform(30, 700, 300) / length(x[:3])
    x[:3] = -aim
    heading = aim + side / length(side) * rng.uniform(0, miss, 300)
    x[3:6] = speed * heading / length(heading)
    return x


def test_names_follow_table_3() -> None:
    assert tuple(TABLE_3) == constraints.CONSTRAINTS


@pytest.mark.parametrize("row", range(13), ids=constraints.CONSTRAINTS)
def test_constraint_equals_the_paper(row: int) -> None:
    x = states(200)
    if row == 3:
        clearances = constraints.clearance_at(tensor(x), constraints.closest_times(tensor(x), (0.0, 500.0), C), C)
        np.testing.assert_allclose(clearances[0], paper(x)[3], atol=1e-3)
        return
    functions: dict[str, Callable] = vars(constraints)
    name = constraints.CONSTRAINTS[row]
    if name[-2:] in ("_x", "_y", "_z"):
        result = functions[name[:-2]](tensor(x), C)["xyz".index(name[-1])]
    else:
        result = functions[name](tensor(x), C)
    np.testing.assert_allclose(result, paper(x)[row], atol=1e-11)

"""The limits in NumPy, and dense flights of a law: what the lemmas of the way to rest are compared with."""

import functools
from collections.abc import Callable

import numpy as np
import torch
from numpy import ndarray
from scipy.stats import qmc
from torch import Tensor

from inspection.model.dynamics import Body, step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE
from kernels.compiled import Compiled
from study.verification.starts import states_of
from tests.rta.constraints.test_constraints import body_axis, length

AXIS = {"x": 0, "y": 1, "z": 2}
Law = Callable[[Tensor], Tensor]  # states (16, B) to controls (6, B)


def hypercube(count: int, seed: int, c: InspectionParameters) -> Tensor:
    """States (16, count) all over the limits and around them."""
    sampler = qmc.LatinHypercube(17, rng=np.random.default_rng(seed))
    return states_of(torch.from_numpy(sampler.random(count).T.copy()), c)[0]


def free_flight(p: ndarray, v: ndarray, t: ndarray, n: float) -> ndarray:
    """Clohessy and Wiltshire's closed form, (3, ...)."""
    s, co = np.sin(n * t), np.cos(n * t)
    return np.stack(
        (
            (4 - 3 * co) * p[0] + s / n * v[0] + 2 / n * (1 - co) * v[1],
            6 * (s - n * t) * p[0] + p[1] - 2 / n * (1 - co) * v[0] + (4 * s - 3 * n * t) / n * v[1],
            p[2] * co + v[2] / n * s,
        )
    )


def clearance(p: ndarray, v: ndarray, c: InspectionParameters, spacing: float = 2.0) -> ndarray:
    """m beyond the sphere in free flight, by a grid of times: never below the infimum."""
    t = np.arange(0.0, c.passive_safety_horizon + 1e-9, spacing)
    nearest = np.full(p.shape[1:], np.inf)
    for moment in t:
        nearest = np.minimum(nearest, length(free_flight(p, v, moment, c.mean_motion)))
    return nearest - c.collision_radius


def motion(p: ndarray, v: ndarray, c: InspectionParameters, spacing: float | None = 2.0) -> ndarray:
    """The seven limits of motion by the paper, of velocity v_max - |v_i|; no spacing: not passive safety."""
    n, fastest = c.mean_motion, min(c.max_speed, c.docking_speed + c.speed_slope * c.max_distance)
    a_max = c.max_thrust / c.mass - 3 * n**2 * c.max_distance - 2 * n * fastest
    distance, speed = length(p), length(v)
    radial = (p * v).sum(0) / distance

    def root(z: ndarray) -> ndarray:
        return np.sign(z) * np.sqrt(2 * a_max * np.abs(z))

    free = np.full_like(speed, np.inf) if spacing is None else clearance(p, v, c, spacing)
    return np.stack(
        (
            root(distance - c.collision_radius) + radial,
            c.docking_speed + c.speed_slope * distance - speed,
            root(c.max_distance - distance) - radial,
            free,
            *(c.max_speed - np.abs(v)),
        )
    )


def attitude(x: ndarray, c: InspectionParameters) -> ndarray:
    """Exclusion in rad, temperature in deg C, battery in kJ, and what is left of the rates in rad/s."""
    sun = np.stack((np.cos(x[15]), np.sin(x[15]), np.zeros_like(x[15])))
    earth = np.zeros_like(sun)
    earth[0] = -1.0

    def angle(axis: str, direction: ndarray) -> ndarray:
        n = body_axis(x[6:10], AXIS[axis[1]]) * (-1.0 if axis[0] == "-" else 1.0)
        return np.arccos(np.clip((n * direction).sum(0), -1.0, 1.0))

    heated, facing = (np.maximum(np.pi / 2 - angle(c.thermal_axis, r), 0.0) for r in (sun, earth))
    return np.stack(
        (
            angle("+x", sun) - c.field_of_view / 2 - c.exclusion_buffer,
            c.max_temperature - x[13] - c.temperature_sun_slope * heated - c.temperature_earth_slope * facing,
            x[14] - c.min_energy - c.energy_sun_slope * angle(c.solar_panel_axis, sun),
            c.max_rate - np.abs(x[10:13]).max(0),
        )
    )


@functools.cache
def stepping(seconds: float, c: InspectionParameters, turns: bool | None) -> Compiled:
    """`step` in C, with `turns` of bodies: mass, moments and push, (7, B); in a frame that turns, or not."""

    def stepped(x: Tensor, u: Tensor, *bodies: Tensor) -> list[Tensor]:
        if turns is None:
            return [step(x, u, seconds, c)]
        mass, inertia, push = bodies[0].split((1, 3, 3))
        return [step(x, u, seconds, c, Body(mass[0], list(inertia), list(push), turns, saturates=False))]

    sizes = SIZE, CONTROL_SIZE, *([] if turns is None else [7])
    return Compiled(stepped, *(torch.ones(size, 1, dtype=torch.float64) for size in sizes))


def moved(x: Tensor, u: Tensor, seconds: float, c: InspectionParameters, body: Body | None = None) -> Tensor:
    """The states (16, B) after controls (6, B) have acted for some s; body: one whose rates nothing saturates."""
    if body is None:
        return stepping(seconds, c, None)(x, u)[0]
    assert not body.saturates
    own = torch.stack((body.mass, *body.inertia, *body.push))
    return stepping(seconds, c, body.in_turning_frame)(x, u, own)[0]

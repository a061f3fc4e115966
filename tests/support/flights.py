"""States near limits and controls behind the filter of one second, and a second of flight by the paper's equations."""

import math
from functools import cache

import numpy as np
import pytest
from numpy import ndarray
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from kernels.build import NoCompilerError, compilers
from rta.fast.filter import batched, in_c
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from tests.oracles import drift, length, push, speed_limit, tensor, turn

C = InspectionParameters()
FILTER = batched(SafetyFilter(C, RtaParameters()))
LIMIT = np.array(C.control_limit)[:, None]


def rate(x: ndarray, u: ndarray) -> ndarray:
    """Returns f + g u, (16, B), of the paper's equations."""
    return drift(x, C) + sum(u[i] * push(x, i) + u[3 + i] * turn(x, i, C) for i in range(3))


def fly(x: ndarray, u: ndarray, steps: int = 20) -> ndarray:
    """Flies one second with u held, by RK4; the wheels hold each rate within its limit."""
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


def flights(count: int, distance: tuple[float, float], speed: tuple[float, float]) -> ndarray:
    """Returns states (16, count) at speeds in units of the limit there, many with all body rates at their limits."""
    rng = np.random.default_rng(0)
    p, v, q = rng.standard_normal((3, 4, count))
    p = p[:3] / length(p[:3]) * rng.uniform(*distance, count)
    v = v[:3] / length(v[:3]) * rng.uniform(*speed, count) * speed_limit(p)
    full = rng.choice([-1.0, 1.0], (3, count))
    omega = np.where(rng.random((3, count)) < 0.6, full, rng.uniform(-1, 1, (3, count))) * C.max_rate
    rest = rng.uniform(3, 10, count), rng.uniform(1, 5, count), rng.uniform(0, 2 * np.pi, count)
    return np.vstack((p, v, q / length(q), omega, *rest))


def near_the_limits(count: int, seed: int = 0) -> ndarray:
    """Returns states (16, count) within some limits and beyond others, at up to 1.1 times the dynamic speed limit."""
    rng = np.random.default_rng(seed)
    p, v, q = rng.standard_normal((3, 4, count))
    p = p[:3] / length(p[:3]) * rng.choice((18.0, 50.0, 200.0, 790.0), count) * rng.uniform(1, 1.01, count)
    v = v[:3] / length(v[:3]) * rng.uniform(0, 1.1, count) * speed_limit(p)
    omega = rng.uniform(-1, 1, (3, count)) * math.radians(2)
    rest = rng.uniform(3, 10, count), rng.uniform(1, 5, count), rng.uniform(0, 2 * np.pi, count)
    return np.vstack((p, v, q / length(q), omega, *rest))


def commands(count: int, seed: int = 0, largest: float = 1.0) -> Tensor:
    """Returns uniform controls (6, count) within so many times the actuators' limits."""
    return tensor(largest * np.random.default_rng(seed).uniform(-1, 1, (6, count)) * LIMIT)


@cache
def way(name: str, checked: bool = True) -> SafetyFilter:
    """Returns the filter by PIQP ("piqp"), "batched" or in "C"; not checked: the paper's, the program alone."""
    made = SafetyFilter(C, RtaParameters(filter="checked" if checked else "paper"))
    if name == "C":
        try:
            compilers()
        except NoCompilerError:
            pytest.skip("no C compiler")
        return in_c(batched(made))
    return batched(made) if name == "batched" else made

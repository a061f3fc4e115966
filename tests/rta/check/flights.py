"""Vehicles, states all over the limits, and flights of both backup laws in C: what the check is compared with."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, E, P, T, V
from kernels.compiled import Compiled
from rta.check.nominal import NominalCheck
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from settings import load
from study.config import Config
from tests.oracles import attitude, hypercube, length, motion, moved
from tests.support.filters import Unproposed

C = InspectionParameters()
# vehicle, period in s, whether the plant holds the rates; the moments of the last two are not equal
SHORT = [("paper", 10.0, True), ("espa", 10.0, False)]
LONG = [("paper", 1.0, True), ("12u", 5.0, False)]
EACH = pytest.mark.parametrize(
    ("name", "hold", "saturates"),
    [*SHORT, *(pytest.param(*case, marks=pytest.mark.campaign) for case in LONG)],
)
ROUNDED = 1e-9  # in the unit of each limit


@functools.cache
def vehicle(name: str, saturates: bool = True) -> InspectionParameters:
    """Returns a shipped vehicle's constants."""
    found = C if name == "paper" else load(f"vehicles/{name}", Config()).inspection
    return replace(found, saturate_rates=saturates)


@functools.cache
def backup(name: str, hold: float, saturates: bool = True) -> NominalCheck:
    """Returns the check of a vehicle, which must have one."""
    return NominalCheck(vehicle(name, saturates), hold)


@functools.cache
def safety(name: str, hold: float, saturates: bool = True, compiled: bool = True) -> SafetyFilter:
    """Returns the check of a vehicle as a filter without a program, so that the check decides alone."""
    own = RtaParameters() if name == "paper" else load(f"vehicles/{name}", Config()).rta
    found = Unproposed(vehicle(name, saturates), replace(own, period=hold))
    return fast(found, "cpu", 64) if compiled else found


@functools.cache
def in_c(name: str, hold: float, saturates: bool = True) -> Compiled:
    """Returns for states those after a hold of both laws, its least of each limit, the laws' control, and `at_once`."""
    b = backup(name, hold, saturates)

    def flown(x: Tensor) -> list[Tensor]:
        u = b.law(x)
        yes = torch.ones_like(x[0], dtype=torch.bool)
        return [*b.hold(x, u, yes), u, b.at_once(x), b.terminal.room(x)]

    return Compiled(flown, torch.ones(SIZE, 1, dtype=torch.float64))


def random(size: int, count: int, seed: int) -> Tensor:
    """Returns numbers (size, count) between -1 and 1."""
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(size, count, generator=generator, dtype=torch.float64) - 1


def unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=0)


def limits(c: InspectionParameters) -> Tensor:
    """Returns the limits of the controls, (6, 1)."""
    return torch.tensor(c.control_limit, dtype=torch.float64)[:, None]


def anywhere(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    return hypercube(count, seed, c)


def near_the_zone(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns states within 60 m of the zone, mostly across."""
    x, rng = hypercube(count, seed, c), np.random.default_rng(seed)
    p, v = x[P].numpy(), rng.standard_normal((3, count))
    out = p / length(p)
    v = v - rng.uniform(0.6, 1.0, count) * (v * out).sum(0) * out
    distance = c.max_distance - rng.uniform(0.5, 60.0, count)
    speed = np.minimum(c.docking_speed + c.speed_slope * distance, c.max_speed)
    x[P] = torch.from_numpy(distance * out)
    x[V] = torch.from_numpy(speed * rng.uniform(0.5, 1, count) * v / length(v))
    return x


def far_and_fast(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns states at 0.85 to 1 of the zone, almost at the limits of speed, in any direction."""
    x, draw = hypercube(count, seed, c), random(5, count, seed)
    distance = c.max_distance * (0.925 + 0.075 * draw[0])
    x[P] = distance * unit(x[P])
    v = unit(draw[2:5])
    most = torch.minimum(c.docking_speed + c.speed_slope * distance, c.max_speed / v.abs().amax(0))
    x[V] = (0.9 + 0.1 * draw[1]) * most * v
    return x


def at_the_chief(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns states that fly towards the chief, within 1 m of its centre's line."""
    x, rng = hypercube(count, seed, c), np.random.default_rng(seed)
    p = x[P].numpy()
    p = p / length(p) * rng.uniform(20, 300, count)
    aim = rng.uniform(-1, 1, (3, count)) - p
    fast = (c.docking_speed + c.speed_slope * length(p)) * rng.uniform(0.05, 1, count)
    x[P], x[V] = torch.from_numpy(p), torch.from_numpy(fast * aim / length(aim))
    return x


def hot_and_empty(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns states that turn fast, half of them next to the limits of heat and charge."""
    x, draw = hypercube(count, seed, c), random(5, count, seed)
    half = torch.arange(count) % 2 == 0
    x[T, half] = (c.max_temperature - 1.0 - draw[0])[half]
    x[E, half] = (c.min_energy + 0.6 * (1 + draw[1]) * (c.initial_energy[0] - c.min_energy))[half]
    x[OMEGA] = c.max_rate * draw[2:5].sign() * draw[2:5].abs() ** 0.3
    return x


STARTS = (anywhere, near_the_zone, far_and_fast, at_the_chief, hot_and_empty)


def everywhere(count: int, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns states (16, count) of all kinds in equal parts, one after the other."""
    each = -(-count // len(STARTS))
    parts = [start(each, seed + i, c) for i, start in enumerate(STARTS)]
    return torch.stack(parts, -1).flatten(1)[:, :count]


def opposite(u: Tensor, c: InspectionParameters) -> Tensor:
    """Returns full controls against given ones (6, B)."""
    return -limits(c) * torch.where(u == 0.0, 1.0, u.sign())


def turning(x: Tensor, hold: float, seed: int, c: InspectionParameters = C) -> Tensor:
    """Returns torque (3, B) within its limit towards rates that are almost at their limits."""
    inertia = torch.tensor(c.inertia, dtype=torch.float64)[:, None]
    wanted = 0.99 * c.max_rate * random(3, x.shape[1], seed).sign()
    return (inertia * (wanted - x[OMEGA]) / hold).clamp(-c.max_torque, c.max_torque)


def least_of(x: Tensor, c: InspectionParameters, spacing: float | None = None) -> np.ndarray:
    """Returns the eleven limits (11, B) at states (16, B) by the formulas of `tests.oracles`."""
    y = x.numpy()
    return np.concatenate((motion(y[:3], y[3:6], c, spacing), attitude(y, c)))


def least_between(
    x: Tensor,
    u: Tensor,
    hold: float,
    c: InspectionParameters,
    spacing: float | None = None,
    look: float = 0.05,
) -> np.ndarray:
    """Returns the least of the eleven limits (11, B) over a hold in the plant's steps, each sampled every `look` s.

    Args:
        spacing: s, between two looks at free flight, which is looked at where the steps end; None: it is not.
    """
    seconds = min(c.substep, hold)
    unheld = replace(c, saturate_rates=False)  # within a step nothing holds the rates
    least = least_of(x, c, spacing)
    for _ in range(round(hold / seconds)):
        for i in range(1, round(seconds / look)):
            least = np.minimum(least, least_of(moved(x, u, i * look, unheld), c))
        x = moved(x, u, seconds, c)
        least = np.minimum(least, least_of(x, c, spacing))
    if c.saturate_rates:
        least[-1] = np.inf
    return least

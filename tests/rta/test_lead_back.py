"""Beyond a limit the filter leads back: random states with one limit violated, flown behind it at 1 s.

A state is one of a Latin hypercube with one quantity put beyond its limit, if every other h, and every Psi_1, is
non-negative. All fly with zero control desired, and again: half with random controls, half with an adversary.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import body_axis, norm, unit
from inspection.model.dynamics import energy_rate, step, temperature_rate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, E, P, Q, T, V
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.result import Status
from study.verification.adversaries import adversarial, held_at_random
from tests.oracles import hypercube

C = InspectionParameters()
FREE = replace(C, saturate_rates=False)
COUNT = 24  # states of each kind
ROUNDING = 1e-9
ORIENTATION = slice(7, 10)
ONE, NONE = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)

# The longest turn, half a circle at the limit, with a stop before and a start of it.
TURN = math.pi / C.max_rate + 2 * C.max_rate / C.max_angular_acceleration  # s
DRAIN = -energy_rate(NONE, C).item()  # kJ/s in the dark
HEATING = temperature_rate(ONE, ONE, C.max_temperature * ONE, C).item()  # deg C/s at most
# A body that turns as fast as it may is stopped about each axis at once, or takes half a turn to the Sun or away.
STOP = math.sqrt(3.0) * C.max_rate * (C.max_rate / C.max_angular_acceleration + 1.0)  # rad
HEATED = HEATING * TURN + math.pi / 2 * (C.temperature_sun_slope + C.temperature_earth_slope)  # deg C
DRAINED = DRAIN * TURN + math.pi * C.energy_sun_slope  # kJ


def speed_limit(x: Tensor) -> Tensor:
    return C.docking_speed + C.speed_slope * norm(x[P])


def outside(x: Tensor, h: Tensor, share: Tensor) -> None:
    """Puts it up to 0.3 m outside the zone, slow."""
    x[V] *= 0.1
    x[P] = unit(x[P]) * (C.max_distance + 0.3 * share)


def at_the_chief(x: Tensor, h: Tensor, share: Tensor) -> None:
    """Turns its velocity to the chief."""
    x[V] = -unit(x[P]) * norm(x[V])


def too_fast(x: Tensor, h: Tensor, share: Tensor) -> None:
    x[V] = unit(x[V]) * (speed_limit(x) + 0.5)


def too_fast_along_an_axis(x: Tensor, h: Tensor, share: Tensor) -> None:
    """Puts it at 5.5 m/s along y, where the dynamic speed limit allows that."""
    x[P] = unit(x[P]) * (710.0 + 80.0 * share)
    x[V] = 0.0
    x[V.start + 1] = (C.max_speed + 0.5) * x[P][1].sign()


def in_the_cone(x: Tensor, h: Tensor, share: Tensor) -> None:
    """Turns the Sun to the camera."""
    camera = body_axis(x[Q], 0)
    x[THETA_S] = torch.atan2(camera[1], camera[0])


def too_hot(x: Tensor, h: Tensor, share: Tensor) -> None:
    x[T] += h + 0.02


def too_low(x: Tensor, h: Tensor, share: Tensor) -> None:
    x[E] -= h + 0.2


def turning_too_fast(x: Tensor, h: Tensor, share: Tensor) -> None:
    x[OMEGA.start + 1] = math.radians(3.0) * x[OMEGA.start + 1].sign()


class Kind(NamedTuple):
    """Holds how to put a state beyond a limit, and what is due then.

    Attributes:
        back: s, in which the limit is kept again (measured, and a tenth more); sinks: by how much h may fall before.
        crossing: share of the flights in which another limit is broken, in conflict with the one that is broken
            already.
    """

    put: Callable[[Tensor, Tensor, Tensor], None]
    back: int
    sinks: float = 0.0
    crossing: float = 0.0
    plant: InspectionParameters = C


KINDS = {
    "angular_velocity_y": Kind(turning_too_fast, 3, plant=FREE),
    "attitude_exclusion": Kind(in_the_cone, 24, STOP),
    "dynamic_speed": Kind(too_fast, 15, crossing=0.02),
    # next to the zone its law brakes first what leaves the zone
    "velocity_y": Kind(too_fast_along_an_axis, 12, crossing=0.1),
    "passive_safety": Kind(at_the_chief, 22, C.collision_radius),
    "battery": Kind(too_low, 140, DRAINED),
    "keep_in_zone": Kind(outside, 400, 2 * C.max_speed, crossing=0.02),
    "temperature": Kind(too_hot, 500, HEATED),
}


@pytest.mark.parametrize("name", KINDS)
def test_what_is_broken_is_kept_again(name: str) -> None:
    """It falls no deeper than momentum takes it. Other limits are kept but for conflicts, and programs are solved."""
    kind, safety, own = KINDS[name], fast(SafetyFilter(C), "cpu", 64), CONSTRAINTS.index(name)
    x = hypercube(4000, own, C)
    kind.put(x, safety.values(x)[own], torch.linspace(0.01, 1.0, 4000, dtype=torch.float64))
    _, _, psi, h = safety.program.evaluated(x)
    others = torch.cat((h, psi[ORIENTATION]))
    others[[own, *([own + 6] if own in range(*ORIENTATION.indices(13)) else [])]] = torch.inf
    x = x[:, (h[own] < 0.0) & (others >= 0.0).all(0)][:, :COUNT].repeat(1, 2)
    assert x.shape[1] == 2 * COUNT
    place = torch.arange(2 * COUNT)
    attacked = (place >= COUNT) & (place % 2 == 1)
    random = held_at_random(C, torch.Generator().manual_seed(0), 2 * COUNT)
    adversary, push = adversarial(safety), torch.zeros_like(x[:CONTROL_SIZE])
    kept = torch.zeros_like(attacked)
    lowest, first = torch.full_like(h[:, : 2 * COUNT], torch.inf), safety.values(x)
    for t in range(kind.back + 1):
        if t % 2 == 0:
            push[:, attacked] = adversary(float(t), x[:, attacked])
        pushed = torch.where(attacked, push, random(float(t), x))
        result = safety.correct(x, torch.where(place < COUNT, 0.0, pushed))
        assert (result.status < Status.UNSOLVED).all()
        kept |= result.h[own] >= 0.0
        lowest = torch.minimum(lowest, result.h)
        if kept.all():
            break
        x = step(x, result.control, 1.0, kind.plant)
    assert kept.all(), t
    assert (lowest[own] >= first[own] - kind.sinks - ROUNDING).all()
    lowest[own] = torch.inf
    assert (lowest < -ROUNDING).any(0).double().mean() <= kind.crossing

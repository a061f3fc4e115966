"""Beyond a limit the filter leads back: 100 random states of each kind, flown behind it at 1 s.

A state is one of the safe set's Latin hypercube (`safe_set`) with one quantity put beyond its limit:

    keep_in_zone        0.1 to 10 m outside, any velocity within the speed limit there whose h is negative
    passive_safety      a velocity whose free flight passes the chief 5 m inside its sphere after 15 to 500 s
    dynamic_speed       0.5 m/s above the limit, in the direction that it had
    velocity            5.5 m/s along one Hill axis, where the dynamic speed limit allows that (690 to 800 m)
    attitude_exclusion  the camera up to 0.2 rad inside the cone, on a random side
    temperature         h = -1 deg C
    battery             h = -0.5 kJ
    angular_velocity    3 deg/s about one body axis, in a plant that does not saturate rates

All else is kept, and the state is taken if every other h and Psi_1 is non-negative. All 100 fly with zero control
desired; half of them again with random controls, the other half with an adversary that decides every 2 s.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import body_axis, cross, dot, norm, unit
from inspection.model.draws import uniform
from inspection.model.dynamics import energy_rate, step, sun_direction, temperature_rate
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, E, P, Q, T, V
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.limits import PAPER
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from rta.result import Status
from study.verification.adversaries import adversarial, held_at_random
from study.verification.starts import safe_set

pytestmark = pytest.mark.usefixtures("long_flights")

C = InspectionParameters()
FILTER = SafetyFilter(C)
PROGRAMS = SafetyFilter(C, RtaParameters(filter="paper"))  # states are drawn from the programs' own safe set
FREE = dataclasses.replace(C, saturate_rates=False)
COUNT = 100
SEED = 9  # of the first kind's states, plus one for each later kind; the last kind has conflicts
COLUMNS = 2 * COUNT  # all with zero control desired, half of them with random and half with adversarial ones
ROUNDING = 1e-9
ORIENTATION = slice(7, 10)
ONE, NONE = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)

# The longest turn, half a circle at the limit, with a stop before and a start of it.
TURN = math.pi / C.max_rate + 2 * C.max_rate / C.max_angular_acceleration  # s
DRAIN = -energy_rate(NONE, C).item()  # kJ/s in the dark
HEATING = temperature_rate(ONE, ONE, C.max_temperature * ONE, C).item()  # deg C/s at most


# The states


def directions(count: int, g: torch.Generator) -> Tensor:
    """Returns unit vectors (3, count)."""
    return unit(torch.randn(3, count, generator=g, dtype=torch.float64))


def signs(count: int, g: torch.Generator) -> Tensor:
    """Returns signs (count,), 1 or -1."""
    return 2.0 * torch.randint(2, (count,), generator=g).double() - 1.0


def across(x: Tensor, axis: Tensor) -> Tensor:
    """Returns unit vectors (3, B) along the part of x that is at right angles to the unit vectors `axis`."""
    return unit(x - dot(x, axis) * axis)


def outside(x: Tensor, g: torch.Generator) -> Tensor:
    count = x.shape[1]
    x[P] = directions(count, g) * (C.max_distance + uniform(0.1, 10.0, count, g))
    x[V] = directions(count, g) * speed_limit(x, C) * uniform(0.0, 1.0, count, g)
    return x


def passing_inside(x: Tensor, g: torch.Generator) -> Tensor:
    """Aims at a point at right angles to p, at the distance from the chief that brings the pass 5 m too close."""
    count = x.shape[1]
    t, side = uniform(15.0, 500.0, count, g), across(directions(count, g), unit(x[P]))
    at_rest = torch.zeros_like(x[V])
    coast = free_flight(x[P], at_rest, t, C.mean_motion)
    units = torch.eye(3, dtype=torch.float64)[..., None].expand(-1, -1, count)
    by_speed = torch.stack([free_flight(at_rest, one, t, C.mean_motion) for one in units], 1)
    low, high = torch.zeros_like(t), torch.full_like(t, C.collision_radius)
    for _ in range(40):
        miss = (low + high) / 2
        x[V] = torch.linalg.solve(by_speed.permute(2, 0, 1), (miss * side - coast).T).T
        near = PAPER["passive_safety"].h(x, C) < -5.0
        low, high = torch.where(near, miss, low), torch.where(near, high, miss)
    return x


def too_fast(x: Tensor, g: torch.Generator) -> Tensor:
    x[V] = unit(x[V]) * (speed_limit(x, C) + 0.5)
    return x


def too_fast_along_an_axis(x: Tensor, g: torch.Generator) -> Tensor:
    count, speed = x.shape[1], C.max_speed + 0.5
    nearest = (speed - C.docking_speed) / C.speed_slope
    x[P] = unit(x[P]) * uniform(nearest, C.max_distance, count, g)
    left = (speed_limit(x, C) ** 2 - speed**2).sqrt() * uniform(0.0, 1.0, count, g).sqrt()
    angle = uniform(0.0, 2 * math.pi, count, g)
    v = torch.stack((speed * signs(count, g), left * angle.cos(), left * angle.sin()))
    axis = torch.randint(3, (count,), generator=g)
    x[V] = v.gather(0, (torch.arange(3)[:, None] - axis) % 3)
    return x


def in_the_cone(x: Tensor, g: torch.Generator) -> Tensor:
    """Makes the shortest turn that takes the camera into the cone."""
    count = x.shape[1]
    sun = sun_direction(x[THETA_S])
    angle = C.field_of_view / 2 + C.exclusion_buffer - uniform(0.0, 0.2, count, g)
    camera = angle.cos() * sun + angle.sin() * across(directions(count, g), sun)
    now = torch.stack(body_axis(x[Q], 0))
    q_v, q_4 = torch.stack(cross(now, camera)), 1.0 + dot(now, camera)
    p_v, p_4 = x[Q][:3], x[Q][3]
    vector = q_4 * p_v + p_4 * q_v + torch.stack(cross(q_v, p_v))
    x[Q] = unit(torch.cat((vector, (q_4 * p_4 - dot(q_v, p_v))[None])))
    return x


def too_hot(x: Tensor, g: torch.Generator) -> Tensor:
    x[T] += PAPER["temperature"].h(x, C) + 1.0
    return x


def too_low(x: Tensor, g: torch.Generator) -> Tensor:
    x[E] -= PAPER["battery"].h(x, C) + 0.5
    return x


def turning_too_fast(x: Tensor, g: torch.Generator) -> Tensor:
    count = x.shape[1]
    axis = torch.randint(3, (count,), generator=g)
    x[OMEGA.start + axis, torch.arange(count)] = math.radians(3.0) * signs(count, g)
    return x


def others_hold(x: Tensor, own: list[int]) -> Tensor:
    """Tells where (B,) exactly one of `own` constraints is violated, and no other one."""
    _, _, psi, h = FILTER.program.evaluated(x)
    held = torch.cat((h, psi[ORIENTATION]))
    for i in own:
        held[i] = 1.0
        if i in range(*ORIENTATION.indices(13)):
            held[len(h) + i - ORIENTATION.start] = 1.0
    return (held >= 0.0).all(0) & ((h[own] < 0.0).sum(0) == 1)


def states(put: Callable[[Tensor, torch.Generator], Tensor], own: list[int], seed: int) -> Tensor:
    """Returns states (16, COUNT) of a kind."""
    g, kept, most = torch.Generator().manual_seed(seed), [], 40
    for i in range(most):
        x = put(safe_set(2 * COUNT, most * seed + i, PROGRAMS)[0], g)
        kept.append(x[:, others_hold(x, own)])
        if sum(part.shape[1] for part in kept) >= COUNT:
            return torch.cat(kept, 1)[:, :COUNT]
    raise RuntimeError("too few states")


def speed_limit(x: Tensor, c: InspectionParameters) -> Tensor:
    return c.docking_speed + c.speed_slope * norm(x[P])


# The flights


class Kind(NamedTuple):
    """Holds how to put a state beyond limits, and what is due then.

    Attributes:
        back: s, in which the limit is kept again (measured, and a tenth more); sinks: by how much h may fall before.
        crossing: share of the flights in which another limit is broken, in conflict with the one that is broken
            already.
    """

    own: tuple[str, ...]
    put: Callable[[Tensor, torch.Generator], Tensor]
    back: int
    sinks: float = 0.0
    crossing: float = 0.0
    plant: InspectionParameters = C


def axes(name: str, letters: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{name}_{letter}" for letter in letters)


# A body that turns as fast as it may is stopped about each axis at once, or takes half a turn to the Sun or away.
STOP = math.sqrt(3.0) * C.max_rate * (C.max_rate / C.max_angular_acceleration + 1.0)  # rad
HEATED = HEATING * TURN + math.pi / 2 * (C.temperature_sun_slope + C.temperature_earth_slope)  # deg C
DRAINED = DRAIN * TURN + math.pi * C.energy_sun_slope  # kJ
KINDS = {
    "keep_in_zone": Kind(("keep_in_zone",), outside, 2750, 2 * C.max_speed, crossing=0.02),
    "angular_velocity": Kind(axes("angular_velocity"), turning_too_fast, 3, plant=FREE),
    "attitude_exclusion": Kind(("attitude_exclusion",), in_the_cone, 10, STOP),
    "dynamic_speed": Kind(("dynamic_speed",), too_fast, 31, crossing=0.02),
    # next to the zone its law brakes first what leaves the zone
    "velocity": Kind(axes("velocity"), too_fast_along_an_axis, 48, sinks=3.3, crossing=0.08),
    "passive_safety": Kind(("passive_safety",), passing_inside, 49, C.collision_radius),
    "temperature": Kind(("temperature",), too_hot, 3270, HEATED),
    "battery": Kind(("battery",), too_low, 190, DRAINED),
}


class Back(NamedTuple):
    """Holds a kind's flights: h (seconds, 13, COLUMNS), own (13, COLUMNS) bool, status (seconds, COLUMNS)."""

    h: Tensor
    own: Tensor
    status: Tensor

    @property
    def violated(self) -> Tensor:
        """Returns h of the limit that was violated at the start, (seconds, COLUMNS)."""
        return torch.where(self.own, self.h, torch.inf).amin(1)


@functools.cache
def compiled() -> SafetyFilter:
    """Returns the filter that leads back."""
    return fast(FILTER, "cpu", COLUMNS)


@functools.cache
@torch.no_grad()
def flown(name: str) -> Back:
    """Flies a kind for as long as it may take."""
    kind, safety = KINDS[name], compiled()
    own = [CONSTRAINTS.index(each) for each in kind.own]
    x = states(kind.put, own, SEED + list(KINDS).index(name)).repeat(1, 2)
    place = torch.arange(COLUMNS)
    random = held_at_random(C, torch.Generator().manual_seed(0), COLUMNS)
    adversary, push = adversarial(FILTER), torch.zeros_like(x[:CONTROL_SIZE])
    mine = torch.zeros(len(CONSTRAINTS), COLUMNS, dtype=torch.bool)
    mine[own] = safety.values(x)[own] < 0.0
    attacked = (place >= COUNT) & (place % 2 == 1)
    h, status = [], []
    for t in range(kind.back + 1):
        if t % 2 == 0:
            push[:, attacked] = adversary(float(t), x[:, attacked])
        pushed = torch.where(place % 2 == 0, random(float(t), x), push)
        result = safety.correct(x, torch.where(place < COUNT, 0.0, pushed))
        h.append(result.h)
        status.append(result.status)
        x = step(x, result.control, 1.0, kind.plant)
    return Back(torch.stack(h), mine, torch.stack(status))


EACH = pytest.mark.parametrize(
    "name",
    [
        name if name in ("angular_velocity", "attitude_exclusion", "dynamic_speed") else campaign
        for name in KINDS
        for campaign in [pytest.param(name, marks=pytest.mark.campaign)]
    ],
)


@EACH
def test_what_is_broken_is_kept_again(name: str) -> None:
    back = flown(name)
    assert (back.violated[0] < 0.0).all()
    assert (back.violated >= 0.0).any(0).all()


@EACH
def test_what_is_broken_falls_no_deeper_than_momentum_takes_it(name: str) -> None:
    violated = flown(name).violated
    assert (violated.amin(0) >= violated[0] - KINDS[name].sinks - ROUNDING).all()


@EACH
def test_other_limits_are_kept_on_the_way_but_for_conflicts(name: str) -> None:
    back = flown(name)
    crossed = torch.where(back.own, torch.inf, back.h) < -ROUNDING  # (seconds, 13, COLUMNS)
    assert crossed.any(0).any(0).double().mean() <= KINDS[name].crossing


@EACH
def test_every_program_is_solved(name: str) -> None:
    assert (flown(name).status < Status.UNSOLVED).all()

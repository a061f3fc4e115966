"""Beyond every limit the filter leads back: 200 random states of each kind, flown behind it at 1 s.

A state is one of the safe set's Latin hypercube (`safe_set`) with one quantity put beyond its limit:

    keep_in_zone        0.1 to 10 m outside, any velocity within the speed limit there whose h is negative
    passive_safety      a velocity whose free flight passes the chief 5 m inside its sphere after 15 to 500 s
    dynamic_speed       0.5 m/s above the limit, in the direction that it had
    velocity            5.5 m/s along one Hill axis, where the dynamic speed limit allows that (690 to 800 m)
    attitude_exclusion  the camera up to 0.2 rad inside the cone, on a random side
    temperature         h = -1 deg C and, to see the end of it too, -0.01 deg C
    battery             h = -0.5 kJ
    angular_velocity    3 deg/s about one body axis, in a plant that does not saturate rates

All else is kept, and the state is taken if every other h and Psi_1 is non-negative and a state inside the zone can
brake. All 200 fly with zero control desired; half of them again with random controls, the other half with an
adversary that decides every 2 s.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import body_axis, cross, dot, norm, unit
from inspection.model.draws import uniform
from inspection.model.dynamics import energy_rate, step, sun_direction, temperature_rate
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, E, P, Q, T, V
from rta.constraints.names import CONSTRAINTS
from rta.constraints.thrust import speed_limit
from rta.filter import SafetyFilter
from rta.limits import radial_speed
from rta.parameters import RtaParameters
from rta.qp.programs import Status
from study.verification.adversaries import adversarial, held_at_random
from study.verification.starts import safe_set
from tests.oracles import entries, tensor, thrust_fall, torque_fall
from tests.rta.test_barrier import FILTER
from tests.support.filters import without_check

C = InspectionParameters()
R = RtaParameters()
ENTRIES = entries(C, R)
_, TORQUE = FILTER.groups
PROGRAMS = SafetyFilter(C, R)
without_check(PROGRAMS)  # states are drawn from the programs' own safe set
FREE = dataclasses.replace(C, saturate_rates=False)
COUNT = 200
SEED = 9  # of the first kind's states, one more for each other: among the last kind's are conflicts
COLUMNS = 2 * COUNT  # all with zero control desired, half of them with random and half with adversarial ones
ROUNDING = 1e-9
ORIENTATION = slice(7, 10)
ONE, NONE = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)

# The longest turn, half a circle at the limit, with a stop before and a start of it.
TURN = math.pi / C.max_rate + 2 * C.max_rate / C.max_angular_acceleration  # s
CHARGE = energy_rate(ONE, C).item()  # kJ/s in full light
DRAIN = -energy_rate(NONE, C).item()  # kJ/s in the dark
COOLING = -temperature_rate(NONE, NONE, C.max_temperature * ONE, C).item()  # deg C/s away from Sun and Earth
HEATING = temperature_rate(ONE, ONE, C.max_temperature * ONE, C).item()  # deg C/s at most


# The states


def directions(count: int, g: torch.Generator) -> Tensor:
    """(3, count) unit vectors."""
    return unit(torch.randn(3, count, generator=g, dtype=torch.float64))


def signs(count: int, g: torch.Generator) -> Tensor:
    """(count,) of 1 and -1."""
    return 2.0 * torch.randint(2, (count,), generator=g).double() - 1.0


def across(x: Tensor, axis: Tensor) -> Tensor:
    """Unit vectors (3, B) along the part of x that is at right angles to the unit vectors `axis`."""
    return unit(x - dot(x, axis) * axis)


def outside(x: Tensor, g: torch.Generator) -> Tensor:
    count = x.shape[1]
    x[P] = directions(count, g) * (C.max_distance + uniform(0.1, 10.0, count, g))
    x[V] = directions(count, g) * speed_limit(x, C) * uniform(0.0, 1.0, count, g)
    return x


def passing_inside(x: Tensor, g: torch.Generator) -> Tensor:
    """Aimed at a point at right angles to p, as far from the chief as makes the pass exactly 5 m too close."""
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
        near = ENTRIES["passive_safety"].h(x) < -5.0
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
    """The shortest turn that takes the camera there."""
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


def too_hot(x: Tensor, g: torch.Generator, by: float = 1.0) -> Tensor:
    x[T] += ENTRIES["temperature"].h(x) + by
    return x


def too_low(x: Tensor, g: torch.Generator) -> Tensor:
    x[E] -= ENTRIES["battery"].h(x) + 0.5
    return x


def turning_too_fast(x: Tensor, g: torch.Generator) -> Tensor:
    count = x.shape[1]
    axis = torch.randint(3, (count,), generator=g)
    x[OMEGA.start + axis, torch.arange(count)] = math.radians(3.0) * signs(count, g)
    return x


def others_hold(x: Tensor, own: list[int]) -> Tensor:
    """(B,) bool: exactly one of `own` constraints is violated, and nothing else."""
    h, psi = FILTER.values(x), TORQUE.psi_at(x, TORQUE.constraints)(x)[:3]
    held = torch.cat((h, psi))
    for i in own:
        held[i] = 1.0
        if i in range(*ORIENTATION.indices(13)):
            held[len(h) + i - ORIENTATION.start] = 1.0
    braking = FILTER.can_brake(x) | (own == [CONSTRAINTS.index("keep_in_zone")])
    return (held >= 0.0).all(0) & ((h[own] < 0.0).sum(0) == 1) & braking


def states(put: Callable[[Tensor, torch.Generator], Tensor], own: list[int], seed: int) -> Tensor:
    """(16, COUNT) states of a kind."""
    g, kept, most = torch.Generator().manual_seed(seed), [], 40
    for i in range(most):
        x = put(safe_set(2 * COUNT, most * seed + i, PROGRAMS)[0], g)
        kept.append(x[:, others_hold(x, own)])
        if sum(part.shape[1] for part in kept) >= COUNT:
            return torch.cat(kept, 1)[:, :COUNT]
    raise RuntimeError("too few states")


# How long it may take, in s, and how far h may still fall, from states (16, B) with h (B,) of the violated limit


def tail(gain: float, ask: float | Tensor, last: float | Tensor) -> Tensor:
    """s in which h' = last - gain h brings h from -ask / gain to zero."""
    return torch.log1p(torch.as_tensor(ask / last)) / gain


def way_back(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """1 N inwards leaves g = a_max - v^2 / r_max and stops v_pr at most D outside, whence sqrt(2 a_max D) is enough."""
    g = C.max_acceleration - dot(x[V], x[V]) / C.max_distance
    outwards = radial_speed(x).clamp(min=0.0)
    farthest = norm(x[P]) - C.max_distance + outwards**2 / (2 * g)
    inwards = (2 * C.max_acceleration * farthest).sqrt()
    time = (outwards + inwards) / g + tail(
        R.keep_in_gain, C.max_acceleration, R.keep_in_gain * R.keep_in_margin
    )
    return time, -inwards - outwards - h


def clearing(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """h' = gain (margin - h) from -5 m: levers of up to 480 s make these 0.2 m/s cheap. The closest time errs by ms."""
    gain = R.passive_safety_gain
    return tail(gain, -gain * h, gain * R.passive_safety_margin), torch.full_like(h, -0.01)


def braking(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """1 N against v leaves a_max, of which the limit may fall by nu_1 |v|; at last h' = `fall` - gain h."""
    least = C.max_acceleration - C.speed_slope * norm(x[V])
    last = tensor(thrust_fall(x.numpy()))[1]
    return -h / least + tail(R.speed_gain, C.max_acceleration, last), torch.zeros_like(h)


def braking_along_an_axis(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """1 N against v_i leaves a_max; at last (v_max^2 - v_i^2)' = `fall` - gain h."""
    last = tensor(thrust_fall(x.numpy()))[-1]
    return 0.5 / C.max_acceleration + tail(R.velocity_gain, -R.velocity_gain * h, last), torch.zeros_like(h)


def turning_away(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """psi' = -k2 psi brakes, for |psi| / k2; then h' is half of max_rate, last k1 margin - k2 h; one call more."""
    (k1, k2), rate = R.exclusion_gains, C.max_rate / 2
    sinks = TORQUE.psi_at(x, TORQUE.constraints[:1])(x)[0].clamp(max=0.0) / k2
    return 1.0 + (-h - sinks) / rate + tail(k2, rate, k1 * R.exclusion_margin), sinks


def cooling(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Out of the light, at worst half a turn away; then half of the cooling."""
    (k1, k2), rate = R.temperature_gains, COOLING / 2
    sinks = HEATING * TURN + math.pi / 2 * (C.temperature_sun_slope + C.temperature_earth_slope)
    time = TURN + (sinks - h) / rate + tail(k2, rate, k1 * R.temperature_margin)
    return time, torch.full_like(h, -sinks)


def charging(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Into the light, at worst half a turn away; then half of full charge."""
    (k1, k2), rate = R.battery_gains, CHARGE / 2
    sinks = DRAIN * TURN + math.pi * C.energy_sun_slope
    time = TURN + (sinks - h) / rate + tail(k2, rate, k1 * R.battery_margin)
    return time, torch.full_like(h, -sinks)


def slowing(x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Full torque takes 1 s for 1 deg/s; the row asks for h' = spin - gain h, and one call more."""
    spin = tensor(torque_fall(x.numpy(), C)).amax(0)
    return 1.0 + tail(R.rate_gain, -R.rate_gain * h, spin), torch.zeros_like(h)


# The flights


class Kind(NamedTuple):
    """How to put a state beyond a limit, and what is due then; `longest` s are flown at most."""

    own: tuple[str, ...]
    put: Callable[[Tensor, torch.Generator], Tensor]
    due: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
    longest: int
    plant: InspectionParameters = C


def axes(name: str, letters: str = "xyz") -> tuple[str, ...]:
    return tuple(f"{name}_{letter}" for letter in letters)


KINDS = {
    "keep_in_zone": Kind(("keep_in_zone",), outside, way_back, 200),
    "passive_safety": Kind(("passive_safety",), passing_inside, clearing, 62),
    "dynamic_speed": Kind(("dynamic_speed",), too_fast, braking, 40),
    "velocity": Kind(axes("velocity"), too_fast_along_an_axis, braking_along_an_axis, 30),
    "attitude_exclusion": Kind(("attitude_exclusion",), in_the_cone, turning_away, 60),
    "temperature": Kind(("temperature",), too_hot, cooling, 150),
    "temperature_in_the_end": Kind(("temperature",), functools.partial(too_hot, by=0.01), cooling, 400),
    "battery": Kind(("battery",), too_low, charging, 400),
    "angular_velocity": Kind(axes("angular_velocity"), turning_too_fast, slowing, 8, FREE),
}
ALL = KINDS | {"battery_without_saturation": Kind(("battery",), too_low, charging, 60, FREE)}


class Back(NamedTuple):
    """A kind's flights from `start`: h (seconds, 13, COLUMNS), own (13, COLUMNS) bool, status (seconds, 2, COLUMNS)."""

    start: Tensor
    h: Tensor
    own: Tensor
    status: Tensor

    @property
    def violated(self) -> Tensor:
        """h of the limit that was put out, (seconds, COLUMNS)."""
        return torch.where(self.own, self.h, torch.inf).amin(1)


@functools.cache
def filters() -> tuple[SafetyFilter, SafetyFilter]:
    """That which leads back, compiled, and that whose rows the adversary looks at."""
    safety = SafetyFilter(C, R)
    without_check(safety)  # the programs lead back; once all limits are kept again the check would take over
    safety.compile("cpu", COLUMNS)
    rows = SafetyFilter(C, dataclasses.replace(R, qp_solver="piqp"))
    rows.compile("cpu", COLUMNS)  # which has rows alone compiled, of a filter in one piece they are not
    return safety, rows


@functools.cache
@torch.no_grad()
def flown(name: str) -> Back:
    """A kind for its longest time, at most until each h that can rise has risen."""
    kind, (safety, rows) = ALL[name], filters()
    own = [CONSTRAINTS.index(each) for each in kind.own]
    start = x = states(kind.put, own, SEED + list(ALL).index(name)).repeat(1, 2)
    place = torch.arange(COLUMNS)
    random = held_at_random(C, torch.Generator().manual_seed(0), COLUMNS)
    adversary, push = adversarial(rows), torch.zeros_like(x[:CONTROL_SIZE])
    mine = torch.zeros(len(CONSTRAINTS), COLUMNS, dtype=torch.bool)
    mine[own] = safety.values(x)[own] < 0.0
    attacked = (place >= COUNT) & (place % 2 == 1)
    h, status, up = [], [], torch.zeros(COLUMNS, dtype=torch.bool)
    for t in range(kind.longest + 1):
        if t % 2 == 0:
            push[:, attacked] = adversary(float(t), x[:, attacked])
        pushed = torch.where(place % 2 == 0, random(float(t), x), push)
        result = safety.correct(x, torch.where(place < COUNT, 0.0, pushed))
        h.append(result.h)
        status.append(result.program_status)
        up |= torch.where(mine, result.h, torch.inf).amin(0) >= 0.0
        if up.all():
            break
        x = step(x, result.control, 1.0, kind.plant)
    return Back(start, torch.stack(h), mine, torch.stack(status))


RISING = [name for name in KINDS if name != "temperature"]


def first_of(names: Iterable[str]) -> list[Any]:
    """The names, all but the first one for campaigns."""
    first, *others = names
    return [first, *(pytest.param(name, marks=pytest.mark.campaign) for name in others)]


@pytest.mark.parametrize("name", first_of(RISING))
def test_the_violated_h_rises_to_zero_in_the_time_that_the_actuators_need(name: str) -> None:
    back = flown(name)
    up = back.violated >= 0.0
    assert up.any(0).all()
    longest, _ = KINDS[name].due(back.start, back.violated[0])
    assert (up.double().argmax(0) <= longest.ceil()).all()


@pytest.mark.campaign
def test_too_hot_by_a_degree_cools_at_the_rate_that_is_asked_for() -> None:
    # the whole way takes an hour; its last 0.01 deg C are flown above
    h = flown("temperature").violated
    turned = math.ceil(TURN)
    rate = (h[-1] - h[turned]) / (len(h) - 1 - turned)
    assert (rate > 0.0).all()
    assert rate.median() >= COOLING / 2  # where Psi_1 just falls below zero, it is a little less for a while


@pytest.mark.parametrize("name", first_of(KINDS))
def test_the_violated_h_falls_no_deeper_than_momentum_takes_it(name: str) -> None:
    back = flown(name)
    _, sinks = KINDS[name].due(back.start, back.violated[0])
    assert (back.violated.amin(0) >= back.violated[0] + sinks - ROUNDING).all()


@pytest.mark.parametrize("name", first_of(KINDS))
def test_no_other_limit_is_crossed_on_the_way_but_by_priority(name: str) -> None:
    """Of the lowest class alone, in a flight of a hundred at most, and only after its program found a conflict."""
    back = flown(name)
    crossed = torch.where(back.own, torch.inf, back.h) < -ROUNDING  # (seconds, 13, COLUMNS)
    motion = torch.tensor([ENTRIES[each].weight == R.slack_weight_motion for each in CONSTRAINTS])
    assert not crossed[:, ~motion].any()
    for program, group in enumerate((slice(0, 7), slice(7, 13))):
        crossing = crossed[:, group].any(1)
        column = crossing.any(0)
        assert column.double().mean() <= 0.01
        conflict = back.status[:, program, column] == Status.SLACK
        assert conflict.any(0).all()
        assert (conflict.double().argmax(0) < crossing[:, column].double().argmax(0)).all()


@pytest.mark.parametrize("name", first_of(KINDS))
def test_every_program_is_solved(name: str) -> None:
    assert (flown(name).status < Status.UNSOLVED).all()


@pytest.mark.campaign
def test_without_saturation_only_rates_yield_and_only_to_another_limit_of_a_higher_class() -> None:
    """In a few flights temperature and battery ask for opposite turns; else the turn stays within the rates."""
    back = flown("battery_without_saturation")
    crossed = torch.where(back.own, torch.inf, back.h) < -ROUNDING  # (seconds, 13, COLUMNS)
    assert not crossed[:, : ORIENTATION.stop].any()
    crossing = crossed.any(1)
    assert 0.0 < crossing.any(0).double().mean() < 0.05
    first = crossing.double().argmax(0)[crossing.any(0)]
    conflict = (back.status[:, 1, crossing.any(0)] == Status.SLACK).double().argmax(0)
    assert (conflict < first).all()

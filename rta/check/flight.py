"""A hold as the plant flies it, and lower bounds of the limits in it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from columns import if_long, when
from inspection.model.attitude import norm, rotate
from inspection.model.dynamics import (
    cosine_to,
    energy_rate,
    most_gyroscopic,
    step,
    sun_and_earth_in_body,
    temperature_rate,
)
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, THRUST, TORQUE, E, Q, T, V
from rta.check.commit import MOTION
from rta.check.intersample_bounds import FreeFlight, between, strays

LOOK = 3.5  # s, longest time between two tests of motion
# Cells of passive safety's horizon, and searches in each, see `FreeFlight`. C loops over the cells, so no other axis
# may be a multiple of their number.
CELLS = (13, 1)
FLAT = 1.5  # rad; larger angles from the camera to the Sun count with the cotangent of this one


@dataclass(frozen=True)
class Flight:
    """Holds how a hold is simulated and tested.

    Attributes:
        seconds: s, of a step of the plant; looks: steps of the plant in each part of the hold; motion is tested once
            per part.
        free: bounds of free flight; drift: m/s^2, the strongest natural acceleration.
        spin: gyroscopic acceleration in rad/s^2 per (rad/s)^2.
        heating: deg C/s, the light's largest heating; charging: kJ/s, of panels in full light.
    """

    c: Limits
    seconds: float
    looks: tuple[int, ...]
    free: FreeFlight
    drift: float
    spin: float
    heating: float
    charging: float

    @property
    def gyroscopic(self) -> float:
        """Returns the largest gyroscopic acceleration in rad/s^2 of a body within the limits of its rates."""
        return self.spin * 3 * self.c.max_rate**2

    @classmethod
    def of(cls, c: Limits, hold: float, fastest: float) -> "Flight":
        seconds = min(c.substep, hold)
        steps = round(hold / seconds)
        if not math.isclose(steps * seconds, hold):
            raise ValueError(f"substep = {c.substep:g} s: must divide the period, {hold:g} s")
        most = max(1, math.floor(LOOK / seconds + 1e-9))
        looks = math.ceil(steps / most)
        counts = tuple(steps * (i + 1) // looks - steps * i // looks for i in range(looks))
        one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        cold = temperature_rate(none, none, none, c)
        # |(a w2 w3, b w1 w3, c w1 w2)| is at most the largest of a, b, c times |w|^2 / sqrt(3)
        spin = most_gyroscopic(c.inertia) / math.sqrt(3.0)
        return cls(
            c, seconds, counts, FreeFlight.of(c, *CELLS), c.largest_drift(c.max_distance, fastest), spin,
            heating=(temperature_rate(one, one, none, c) - cold).item(),
            charging=energy_rate(one, c).item() + c.power_draw / 1000.0,
        )  # fmt: skip


def angular(u: Tensor, c: Limits) -> Tensor:
    """Returns the angular acceleration in rad/s^2 (3, ...) from the torque of controls (6, ...)."""
    return torch.stack([part / moment for part, moment in zip(u[TORQUE], c.inertia, strict=True)])


def peak(x: Tensor, u: Tensor, t: float, w: Flight) -> Tensor:
    """Returns an upper bound in rad/s of the body's rate within t s, if the plant does not clamp the rates: (...)."""
    faster = angular(u, w.c)
    fast = torch.maximum(norm(x[OMEGA]), norm(x[OMEGA] + t * faster))
    return fast * (1.0 + 2.0 * w.spin * fast * t)


def path(x: Tensor, u: Tensor, w: Flight) -> list[Tensor]:
    """Returns the states (16, B) of a hold of controls (6, B): the first one, then one after each step of the plant."""
    states = [x]
    for _ in range(sum(w.looks)):
        states.append(step(states[-1], u, w.seconds, w.c))
    return states


def hold(x: Tensor, u: Tensor, asked: Tensor, w: Flight) -> tuple[Tensor, Tensor]:
    """Returns the states after a hold of controls (6, B) from x (16, B), and lower bounds of the limits in it (11, B).

    Args:
        asked: (B,) bool, where the limits of motion are needed; elsewhere they are zero.
    """
    states = path(x, u, w)
    nothing = torch.zeros_like(x[:MOTION])
    (motion,) = when(asked, motion_along, [nothing], w, u, *states, long=if_long(len(w.c.planes)) or CELLS[0])
    return states[-1], torch.cat((motion, attitude_along(states, u, w)))


def motion_along(w: Flight, u: Tensor, *states: Tensor) -> list[Tensor]:
    """Returns lower bounds of the limits of motion in a hold, (7, B)."""
    motion, first = [], 0
    for steps in w.looks:
        last = first + steps
        fast = torch.stack([peak(y, u, w.seconds, w) for y in states[first:last]]).amax(0)
        motion.append(motion_between(states[first], states[last], u, fast, steps * w.seconds, w))
        first = last
    return [torch.stack(motion).amin(0)]


def attitude_along(states: Sequence[Tensor], u: Tensor, w: Flight) -> Tensor:
    """Returns lower bounds of the limits of attitude in a hold by its states, (4, B)."""
    return torch.stack([attitude_between(y, z, u, w.seconds, w) for y, z in pairwise(states)]).amin(0)


def attitude_between(start: Tensor, end: Tensor, u: Tensor, t: float, w: Flight) -> Tensor:
    """Returns lower bounds of exclusion, temperature, battery, rates between two states of a hold, t s apart: (4, ...).

    Take the angle between the Sun and an axis that turns at w with angular acceleration a. Where the angle is convex in
    time, its second derivative is at most a + w^2 / 2 + w^2 cot(angle); the angle is at most w t / 2 off one of its
    ends. The angles of incidence are off by as much, so this times the slopes delta_0 to delta_2 is subtracted. T and E
    are off their chords by less than their change in t for an angle of incidence that is off by w t / 2.
    """
    c = w.c
    fast = peak(start, u, t, w)
    turn = fast + c.mean_motion
    faster = norm(angular(u, c)) + w.spin * fast**2 + c.mean_motion * turn
    angle, temperature, energy = [], [], []
    for x in (start, end):
        sun, earth = sun_and_earth_in_body(x)
        angle.append(incidence("+x", sun))
        lit, facing = ((math.pi / 2 - incidence(c.thermal_axis, r)).clamp(min=0.0) for r in (sun, earth))
        warm = c.temperature_sun_slope * lit + c.temperature_earth_slope * facing
        temperature.append(c.max_temperature - x[T] - warm)
        energy.append(x[E] - c.min_energy - c.energy_sun_slope * incidence(c.solar_panel_axis, sun))
    nearest, swept = torch.minimum(*angle), turn * t / 2
    curved = (faster + turn**2 * (0.5 + 1.0 / (nearest - swept).clamp(1e-3, FLAT).tan())) * t**2 / 8
    slopes = c.temperature_sun_slope + c.temperature_earth_slope + w.heating * t
    bent = w.spin * 2 * fast * faster * t**2 / 8
    room = c.max_rate - torch.maximum(start[OMEGA].abs(), end[OMEGA].abs()).amax(0) - bent
    return torch.stack(
        (
            nearest - c.field_of_view / 2 - c.exclusion_buffer - torch.minimum(curved, swept),
            torch.minimum(*temperature) - slopes * swept,
            torch.minimum(*energy) - (c.energy_sun_slope + w.charging * t) * swept,
            room,
        )
    )


def incidence(axis: str, direction: Tensor) -> Tensor:
    """Returns the angle in rad between a body axis and a direction in the body (3, ...)."""
    return cosine_to(axis, direction).clamp(-1.0, 1.0).arccos()


def motion_between(start: Tensor, end: Tensor, u: Tensor, fast: Tensor, t: float, w: Flight) -> Tensor:
    """Returns lower bounds of the limits of motion between two states of a hold, t s apart: (7, ...).

    Natural acceleration changes by at most 3 n^2 |v| + 2 n |a| per second.

    Args:
        fast: (...) rad/s, the body's largest rate.
    """
    n, push = w.c.mean_motion, u[THRUST] / w.c.mass
    mean = (rotate(start[Q], push) + rotate(end[Q], push)) / 2
    mean = mean * (norm(push) / norm(mean).clamp(min=1e-12))
    speed = torch.maximum(norm(start[V]), norm(end[V]))
    tide = (3 * n**2 * speed + 2 * n * (norm(push) + w.drift)) * t**2 / 8
    off = strays(start[:6], end[:6], t, mean, fast, tide * t, tide)
    return between(start[:6], end[:6], off, w.c, w.free)

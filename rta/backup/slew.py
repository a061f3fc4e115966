"""The way to rest of torque: turn the panels to the Sun, then follow it; the camera looks away, the surface cools.

The law is a function of the state. With d the panels' axis, away from the camera, s the direction to the Sun and e the
axis of the cooled surface, all in the body, it asks for the rate at the end of a hold

    omega = rate (d x s) + roll d - n z,        J (omega - omega_now) / T = torque less the gyroscopic one.

The first term turns d along the great circle to s, as fast as the body rates allow until kappa sin(delta) is less, with
delta the angle between them. So the camera, at pi - delta, recedes from the Sun all the way. The second rolls about d
until e is along Hill's z or against it, whichever is nearer once d is at the Sun; it begins when delta is below a right
angle. The last follows the Sun. At rest the panels face it, and neither Sun nor Earth shine on the surface.

The way is looked at in two parts: the first holds, in which the body comes to the law's rates, are simulated; the rest
is a turn of known speed, in which each limit has a bound (`turning`).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.model.attitude import cross, dot, norm, rotation_matrix
from inspection.model.dynamics import (
    cosine_to,
    energy_rate,
    euler,
    step,
    sun_and_earth_in_body,
    temperature_rate,
)
from inspection.model.parameters import AXES, Limits
from inspection.model.state import OMEGA, THRUST, TORQUE, E, Q, T
from rta.backup.chords import lowest

NODES, ROUGH_NODES = 8, 3  # of the turn to the Sun
SLOWER = 0.99  # of the law's rate, at which it turns at least: what sampling and the Sun's own motion take
FARTHEST = 0.175  # rad, that the law turns in a hold: a fast turn leads thrust that is held astray
ROUNDED = 1e-12  # rad/s, by which a rate at its limit may be beyond
FLAT = 1.5  # rad, whose cotangent counts where the camera is farther from the Sun


@dataclass(frozen=True)
class Slewing:
    """What the law and its check depend on.

    Attributes:
        hold: T in s; steps: in which the simulation of a hold is looked at; first: holds that are simulated.
        rate, roll: rad/s at most; kappa: 1/s.
        astray: rad, by which the turn strays from the great circle; gyroscopic: rad/s^2 at most.
        heating: deg C/s, that light makes at most; charging: kJ/s, of panels in full light.
    """

    c: Limits
    hold: float
    steps: int
    first: int
    rate: float
    roll: float
    kappa: float
    astray: float
    gyroscopic: float
    heating: float
    charging: float

    @classmethod
    def of(cls, c: Limits, hold: float, steps: int) -> "Slewing":
        gyroscopic = math.hypot(*euler((c.max_rate,) * 3, c.inertia))
        alpha = c.max_torque / max(c.inertia) - gyroscopic
        rate = c.max_rate - 1.05 * c.fastest_orbit_rate - gyroscopic * hold / 8
        rate = min(rate, FARTHEST / hold)
        roll = min(rate, 0.12 / hold)
        one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        cold = temperature_rate(none, none, none, c)
        return cls(
            c, hold, steps, math.ceil((c.max_rate + rate) / (alpha * hold) - 1e-9), rate, roll,
            kappa=min(alpha / (2 * rate), 0.75 / hold),
            # of the axis that rolls, of the Sun, and of what one hold leaves to the next
            astray=(rate * roll / 8 + c.mean_motion * rate / 4) * hold**2 + 1e-3,
            gyroscopic=gyroscopic,
            heating=(temperature_rate(one, one, none, c) - cold).item(),
            charging=energy_rate(one, c).item() + c.power_draw / 1000.0,
        )  # fmt: skip

    @property
    def fastest(self) -> float:
        """rad/s, at which the law has a body turn at most, two axes pointing it and one rolling."""
        return math.hypot(self.rate, self.rate, self.roll) + self.c.fastest_orbit_rate


def has_rest(c: Limits) -> bool:
    """Whether there is an attitude of rest: panels away from the camera, the cooled surface across them."""
    return c.solar_panel_axis == "-x" and c.thermal_axis[1] != "x"


def vector(axis: str, x: Tensor) -> Tensor:
    """(3, ...) of a body axis such as "-y", for states (16, ...)."""
    index, sign = AXES[axis]
    parts = [torch.zeros_like(x[0])] * 3
    parts[index] = torch.full_like(x[0], sign)
    return torch.stack(parts)


def across(a: Tensor, b: Tensor) -> Tensor:
    """a x b, (3, ...)."""
    return torch.stack(cross(a, b))


def upright(x: Tensor, d: Tensor, s: Tensor) -> Tensor:
    """Hill's z in the body (3, ...), turned along with s until that is at d: across d."""
    z = rotation_matrix(x[Q])[2]
    return z - dot(d, z) / (1.0 + dot(d, s)).clamp(min=1e-9) * (s + d)


def wanted(x: Tensor, w: Slewing) -> Tensor:
    """The law: omega (3, ...) in rad/s at the end of a hold, for states (16, ...)."""
    d, e = vector(w.c.solar_panel_axis, x), vector(w.c.thermal_axis, x)
    s, _ = sun_and_earth_in_body(x)
    z = upright(x, d, s)
    axis, cosine = across(d, s), dot(d, s)
    sine = norm(axis)
    off = dot(d, across(e, z))
    roll = w.kappa * torch.where(dot(e, z) < 0.0, -off, off)
    roll = roll.clamp(-w.roll, w.roll) * (4.0 * cosine).clamp(0.0, 1.0)
    middle = axis - (roll * w.hold / 2) * across(d, axis)  # as the body has rolled in the middle of the hold
    middle = middle * (sine / norm(middle).clamp(min=1e-12))
    rate = w.rate / middle.abs().amax(0).clamp(min=1e-12)
    rate = torch.where(cosine > 0.0, rate.clamp(max=w.kappa), rate)
    return rate * middle + roll * d - w.c.mean_motion * rotation_matrix(x[Q])[2]


def slew(x: Tensor, w: Slewing) -> Tensor:
    """The law as torque (3, B) in N m at states (16, B)."""
    inertia = x.new_tensor(w.c.inertia)[:, None]
    faster = (wanted(x, w) - x[OMEGA]) / w.hold - torch.stack(euler(x[OMEGA], w.c.inertia))
    return (inertia * faster).clamp(-w.c.max_torque, w.c.max_torque)


def between(start: Tensor, end: Tensor, seconds: float, w: Slewing) -> Tensor:
    """The least of exclusion, temperature, battery and rates between two states (16, ...) of a hold, (4, ...).

    The angle to the Sun of an axis that turns at w, with angular acceleration a, has a second derivative of at most
    a + w^2 / 2 + w^2 cot(angle) in size where it is concave up; it changes by w t / 2 to either end at most. So do the
    angles of incidence, whose slopes delta_0 to delta_2 take that off. T and E are off their chords by less than what
    light that changes by w t / 2 does in t.
    """
    c = w.c
    turn = torch.maximum(norm(start[OMEGA]), norm(end[OMEGA])) + w.gyroscopic * seconds + c.fastest_orbit_rate
    faster = norm(end[OMEGA] - start[OMEGA]) / seconds + 2 * w.gyroscopic
    angle, temperature, energy = [], [], []
    for x in (start, end):
        sun, earth = sun_and_earth_in_body(x)
        angle.append(incidence("+x", sun))
        lit, facing = ((math.pi / 2 - incidence(c.thermal_axis, r)).clamp(min=0.0) for r in (sun, earth))
        warm = c.temperature_sun_slope * lit + c.temperature_earth_slope * facing
        temperature.append(c.max_temperature - x[T] - warm)
        energy.append(x[E] - c.min_energy - c.energy_sun_slope * incidence(c.solar_panel_axis, sun))
    nearest, astray = torch.minimum(*angle), turn * seconds / 2
    curved = (faster + turn**2 * (0.5 + 1.0 / (nearest - astray).clamp(1e-3, FLAT).tan())) * seconds**2 / 8
    slopes = c.temperature_sun_slope + c.temperature_earth_slope + w.heating * seconds
    room = torch.full_like(nearest, math.inf)  # of the rates, where the plant does not hold them
    if not c.saturate_rates:
        room = c.max_rate - end[OMEGA].abs().amax(0) - w.gyroscopic * seconds / 8 + ROUNDED
    return torch.stack(
        (
            nearest - c.field_of_view / 2 - c.exclusion_buffer - torch.minimum(curved, astray),
            torch.minimum(*temperature) - slopes * astray,
            torch.minimum(*energy) - (c.energy_sun_slope + w.charging * seconds) * astray,
            room,
        )
    )


def incidence(axis: str, direction: Tensor) -> Tensor:
    """The angle in rad between a body axis and a direction in the body (3, ...)."""
    return cosine_to(axis, direction).clamp(-1.0, 1.0).arccos()


def held(x: Tensor, u: Tensor, w: Slewing) -> tuple[Tensor, Tensor]:
    """A hold of controls (6, B) at states (16, B): the least of the attitude's limits (B,), and the states after it."""
    seconds, y, parts = w.hold / w.steps, x, []
    for _ in range(w.steps):
        z = step(y, u, seconds, w.c)
        parts.append(between(y, z, seconds, w))
        y = z
    return lowest(torch.cat(parts)), y


def verified(x: Tensor, u: Tensor, w: Slewing, nodes: int = NODES) -> Tensor:
    """A lower bound of the least of the limits in a hold of controls (6, B) and on the way after it: (B,)."""
    least, end = held(x, u, w)
    return torch.minimum(least, way(end, w, nodes))


def at_a_glance(x: Tensor, u: Tensor, w: Slewing) -> Tensor:
    """`verified`, with fewer looks."""
    return verified(x, u, w, ROUGH_NODES)


def at_first_sight(x: Tensor, u: Tensor, w: Slewing) -> Tensor:
    """A lower bound of the least of the limits in a hold and on the way after it that asks for no look at either: (B,).

    Until the body has the law's rates the camera may come nearer to the Sun as fast as the body turns, in the hold at
    |omega| and what torque adds, after it at the largest rates. All the while nothing is charged and all light heats.
    """
    c = w.c
    stopping = w.first * w.hold
    faster = w.gyroscopic + norm(u[TORQUE]) / min(c.inertia)
    swept = (norm(x[OMEGA]) + faster * w.hold) * w.hold + math.sqrt(3.0) * c.max_rate * stopping
    turned = w.hold + stopping + math.pi / (SLOWER * w.rate)
    sun, _ = sun_and_earth_in_body(x)
    warm = (c.temperature_sun_slope + c.temperature_earth_slope) * math.pi / 2
    full = torch.ones_like(x[T])
    heat = temperature_rate(full, full, x[T], c).clamp(min=0.0) * (turned + 3.0 / w.kappa)
    parts = [
        incidence("+x", sun) - swept - w.astray - c.field_of_view / 2 - c.exclusion_buffer,
        c.max_temperature - x[T] - heat - warm,
        x[E] - c.min_energy - turned * c.power_draw / 1000.0 - c.energy_sun_slope * math.pi,
    ]
    if not c.saturate_rates:
        faster = u[TORQUE].abs() / x.new_tensor(c.inertia)[:, None] + w.gyroscopic
        parts.append(c.max_rate - (x[OMEGA].abs() + w.hold * faster).amax(0))
    return lowest(torch.stack(parts))


def way(x: Tensor, w: Slewing, nodes: int = NODES) -> Tensor:
    """A lower bound of the least of the attitude's limits on the way to rest from states (16, B): (B,)."""
    parts = []
    for _ in range(w.first):
        least, x = held(x, torch.cat((torch.zeros_like(x[THRUST]), slew(x, w))), w)
        parts.append(least)
    return lowest(torch.stack((*parts, turning(x, w, nodes))))


def turning(x: Tensor, w: Slewing, nodes: int) -> Tensor:
    """The same from where the body has the law's rates, in closed form.

    delta falls at `SLOWER` of the law's rate or faster. The camera recedes from the Sun. The battery is at its lowest
    where what the panels give, and delta_2 times the rate at which delta falls, make up for what is drawn; until then
    it gives

        integral of (draw - charging cos delta) d delta / rate.

    The surface is heated, between each two of a number of angles delta, as by the most light that it has there, with
    the roll anywhere between the earliest and the latest that it may be.
    """
    c = w.c
    d, e = vector(c.solar_panel_axis, x), vector(c.thermal_axis, x)
    sun, earth = sun_and_earth_in_body(x)
    cosine = dot(d, sun).clamp(-1.0, 1.0)
    astray = w.astray + norm(wanted(x, w) - x[OMEGA]) * w.hold / 2  # the rates are the law's a hold later
    delta = cosine.arccos() + astray
    g = sun - cosine * d
    g = g / norm(g).clamp(min=1e-12)
    axis = across(d, g)
    slow = SLOWER * w.rate
    fast = slow / axis.abs().amax(0)  # while the body does not roll, the axis is fixed
    exclusion = math.pi - delta - c.field_of_view / 2 - c.exclusion_buffer

    draw = c.power_draw / 1000.0
    lowest_at = torch.full_like(delta, math.acos((draw - c.energy_sun_slope * slow) / w.charging))
    right = torch.full_like(delta, math.pi / 2)

    def spent(first: Tensor, last: Tensor, rate: Tensor | float) -> Tensor:
        """kJ while delta falls from a first to a last angle."""
        first = torch.maximum(first, last)
        light = first.clamp(max=math.pi / 2).sin() - last.clamp(max=math.pi / 2).sin()
        return (draw * (first - last) - w.charging * light.clamp(min=0.0)) / rate

    used = spent(delta, right, fast) + spent(delta.minimum(right), lowest_at, slow)
    battery = x[E] - c.min_energy - used - c.energy_sun_slope * torch.minimum(delta, lowest_at)

    z = upright(x, d, sun)
    roll = torch.atan2(dot(d, across(e, z)), dot(e, z))
    roll = torch.where(
        roll > math.pi / 2, roll - math.pi, torch.where(roll < -math.pi / 2, roll + math.pi, roll)
    )
    below = delta.minimum(right)
    hot = x[T]
    warmest = torch.full_like(hot, -math.inf)
    latest, start = torch.zeros_like(delta), delta
    for j in range(1, nodes + 1):
        end = delta * (1.0 - j / nodes)
        since = (below - end).clamp(min=0.0) / slow
        seconds = (start - torch.maximum(end, right)).clamp(min=0.0) / fast
        seconds = seconds + (start.minimum(right) - end.minimum(right)) / slow
        earliest = torch.minimum(roll.abs(), since * w.roll * 1.5)
        corners = [(start, latest), (end, latest), (start, earliest), (end, earliest)]
        light = [shone(e, at, roll.sign() * psi, delta, (d, g, axis), earth) for at, psi in corners]
        sag = (start - end + earliest - latest) ** 2 / 8 + astray
        lit, facing = (
            (part[0].maximum(part[1]).maximum(part[2].maximum(part[3])) + sag).clamp(0.0, 1.0)
            for part in zip(*light, strict=True)
        )
        tail = 3.0 / w.kappa + roll.abs() / w.roll if j == nodes else 0.0
        hot = hot + temperature_rate(lit, facing, x[T], c).clamp(min=0.0) * (seconds + tail)
        warm = c.temperature_sun_slope * lit.arcsin() + c.temperature_earth_slope * facing.arcsin()
        warmest = torch.maximum(warmest, hot + warm)
        start, latest = end, torch.minimum(roll.abs(), (since - 7.0 - w.hold).clamp(min=0.0) * w.roll)
    return lowest(torch.stack((exclusion, c.max_temperature - warmest, battery)))


def shone(
    e: Tensor, at: Tensor, psi: Tensor, delta: Tensor, frame: tuple[Tensor, Tensor, Tensor], earth: Tensor
) -> tuple[Tensor, Tensor]:
    """Cosines of the surface's axis to Sun and Earth, delta having fallen to `at` and the body rolled by psi, in rad.

    Args:
        frame: d, g and d x g in the body, as it was; the Sun was at cos(delta) d + sin(delta) g. earth: as it was.
    """
    d, g, axis = frame
    along, aside = dot(e, g), dot(e, axis)
    e_g, e_axis = psi.cos() * along - psi.sin() * aside, psi.sin() * along + psi.cos() * aside
    fallen = delta - at
    earth_g = dot(g, earth) * fallen.cos() - dot(d, earth) * fallen.sin()
    return at.sin() * e_g, e_g * earth_g + e_axis * dot(axis, earth)

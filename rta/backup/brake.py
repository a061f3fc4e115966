"""The way to rest of thrust: brake, then hover. In every attitude thrust can push into any direction with max_thrust.

The law is a function of the state. In the mean over each hold of T s the spacecraft is to be accelerated by A. Natural
acceleration f is cancelled, at the middle of the hold, so thrust gives G = A - f in m/s^2, |G| at most max_thrust / m.

    straight            A = -v / |v| min(a, |v| / T), a being what is left of thrust where f is strongest. The path is
                        straight, v falls by a T in each hold, and is zero after the last.
    along the zone      where a straight way would end beyond it: inwards as much as keeps r below r_max,
                        N = v_t^2 / r + v_r^2 / (2 (r_max - r)), what is left of |G| against v_t. N does not rise on the
                        way: with r'' = v_t^2 / r - N the second term stays as it is, and the first falls with v_t.

The body turns while thrust is held, so commands are of the mean attitude of the hold (`thrust_along`).
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from inspection.model.attitude import dot, norm, rotate, rotation_matrix
from inspection.model.dynamics import step
from inspection.model.orbit import natural_acceleration, sun_angle_after
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, THETA_S, THRUST, P, Q, V
from rta.backup.chords import FreeFlight, Strays, between, lowest, strays

AT_REST = 1e-9  # m/s
SLEW = 100.0  # s, that a body takes to its attitude of rest
# Cells of passive safety's horizon, and searches in each, see `FreeFlight`. In C they are looped over, so that no other
# axis may be a multiple of them: primes.
CLOSELY, ROUGHLY = (29, 1), (11, 1)
INSIDE = 1.0  # m, of the zone, where a straight way ends at the farthest
SPARE = 0.997  # of thrust, used along the zone: what f changes by on the way, 2 n a T / 2, may need the rest
SURPLUS = 1.02  # of N, for what a hold and rounding leave out of it


@dataclass(frozen=True)
class Braking:
    """What the law and its check depend on.

    Attributes:
        free, rough: of free flight, looked at closely and at a glance.
        hold: T in s; steps: in which the simulation of a hold is looked at.
        thrust: the largest |G|; straight: a, both in m/s^2.
        turn: rad/s, that the body turns at most once it has the slew's rates, with the direction of f.
        astray: share of |G| by which the mean over a hold differs from the one wanted.
        buffer: m, of the zone, for how far a path strays in a hold; creep: m, that it may move while it hovers
            for an orbit; holds: after which it must be at rest.
    """

    c: Limits
    free: FreeFlight
    rough: FreeFlight
    hold: float
    steps: int
    thrust: float
    straight: float
    turn: float
    astray: float
    buffer: float
    creep: float
    holds: int

    @classmethod
    def of(cls, c: Limits, hold: float, steps: int, slewing: float) -> "Braking":
        rate = math.sqrt(3.0) * c.max_rate
        half = rate * hold / 2
        quickening = math.sqrt(3.0) * min(c.max_torque / min(c.inertia), 2 * c.max_rate / hold)
        off_mean = half**2 / 6 + quickening * hold**2 / 24  # |1 - M R_m'|, see `thrust_along`
        astray = off_mean**2 + (c.mean_motion * hold) ** 2
        fastest = min(c.docking_speed + c.speed_slope * c.max_distance, math.sqrt(3.0) * c.max_speed)
        thrust = c.max_thrust / c.mass / (1 + off_mean)
        straight = thrust - c.largest_drift(c.max_distance, fastest)
        turn = slewing + 4 * c.mean_motion
        orbit = 2 * math.pi / c.mean_motion
        creep = c.largest_drift(c.max_distance, 0.0) * (rate * SLEW + c.mean_motion * orbit) * hold**2 / 12
        buffer = straight * hold**2 / 4 + fastest * turn * hold**2 / 12 + creep
        holds = math.ceil(1.5 * fastest / (straight * hold)) + 3
        free = FreeFlight.of(c, *CLOSELY)
        rough = replace(free, cells=ROUGHLY[0], searches=ROUGHLY[1])
        return cls(c, free, rough, hold, steps, thrust, straight, turn, astray, buffer, creep, holds)


def planned(p: Tensor, v: Tensor, theta_s: Tensor, w: Braking) -> tuple[Tensor, Tensor]:
    """The law: A and G (3, ...) in m/s^2 in Hill's frame, at positions and velocities (3, ...) and the Sun's angle."""
    c, t = w.c, w.hold
    speed = norm(v)
    direction = v / speed.clamp(min=1e-30)
    straight = -direction * (speed / t).clamp(max=w.straight)
    middle = p + t / 2 * v
    theta = sun_angle_after(theta_s, t / 2, c)

    def natural(acceleration: Tensor) -> Tensor:
        p_m, v_m = middle + t**2 / 8 * acceleration, v + t / 2 * acceleration
        return torch.stack(natural_acceleration(p_m.unbind(), v_m.unbind(), theta, c))

    distance = norm(middle)
    outwards = middle / distance.clamp(min=1e-30)
    radial = dot(v, outwards)
    across = v - radial * outwards
    tangential = norm(across)
    ahead = across / tangential.clamp(min=1e-30)
    room = (c.max_distance - w.buffer - distance).clamp(min=0.1 * w.buffer)
    needed = SURPLUS * (tangential**2 / distance + radial.clamp(min=0.0) ** 2 / (2 * room))
    needed = torch.maximum(needed, w.straight * radial / speed.clamp(min=1e-30))
    f = natural(straight)
    f_r, f_t = dot(f, outwards), dot(f, ahead)
    across_both = f - f_r * outwards - f_t * ahead
    most = ((SPARE * w.thrust) ** 2 - dot(across_both, across_both)).sqrt()  # f is another along another way
    inwards = torch.minimum(needed + f_r, most)
    left = (most**2 - inwards**2).clamp(min=0.0).sqrt()
    back = torch.minimum(tangential / t + f_t, left)
    along = (f_r - inwards) * outwards + (f_t - back) * ahead

    end = norm(p + direction * speed * (speed / (2 * w.straight) + t / 2))
    needs_zone = (end > c.max_distance - INSIDE - w.buffer) & (speed > w.straight * t)
    wanted = torch.where(needs_zone, along, straight)
    return wanted, wanted - natural(wanted)


def brake(x: Tensor, torque: Tensor, w: Braking) -> Tensor:
    """The law as thrust (3, B) in N, in the body, at states (16, B) while torque (3, B) is held."""
    _, given = planned(x[P], x[V], x[THETA_S], w)
    return thrust_along(given, x, torque, w)


def thrust_along(given: Tensor, x: Tensor, torque: Tensor, w: Braking) -> Tensor:
    """The thrust (3, B) in N whose mean over a hold is G (3, B) in m/s^2, while torque (3, B) is held.

    Of a body that turns over the hold by R(s), with the mean M of Simpson's rule and R_m in the middle, M R_m' is 1 to
    second order. So u = m R_m' (2 - M R_m') G leaves the fourth.
    """
    u = torch.cat((torch.zeros_like(torque), torque))
    middle = step(x, u, w.hold / 2, w.c)
    end = step(middle, u, w.hold / 2, w.c)
    first, second, third = (rotation_matrix(y[Q]) for y in (x, middle, end))
    mean = (first + 4.0 * second + third) / 6.0
    body = (second * given[:, None]).sum(0)
    left = 2.0 * given - (mean * body).sum(1)
    limit = w.c.max_thrust
    return (w.c.mass * (second * left[:, None]).sum(0)).clamp(-limit, limit)


def held(x: Tensor, u: Tensor, w: Braking, free: FreeFlight) -> tuple[Tensor, Tensor]:
    """A hold of controls (6, B) at states (16, B): the least of the limits of motion (B,), and the states after it."""
    parts = []
    for _ in range(w.steps):
        x, least = look(x, u, w, free)
        parts.append(least)
    return lowest(torch.stack(parts)), x


def look(x: Tensor, u: Tensor, w: Braking, free: FreeFlight) -> tuple[Tensor, Tensor]:
    """The states after one step of a hold, and the least of the limits in it, see `held`.

    Natural acceleration changes by 2 n |a| + 3 n^2 |v| a second at most, the first as if the body turned by 2 n more.
    """
    seconds, push = w.hold / w.steps, u[THRUST] / w.c.mass
    end = step(x, u, seconds, w.c)
    mean = (rotate(x[Q], push) + rotate(end[Q], push)) / 2
    mean = mean * (norm(push) / norm(mean).clamp(min=1e-12))
    turn = torch.maximum(norm(x[OMEGA]), norm(end[OMEGA])) + 2 * w.c.mean_motion
    tide = 3 * w.c.mean_motion**2 * torch.maximum(norm(x[V]), norm(end[V])) * seconds**2 / 8
    off = strays(x[:6], end[:6], seconds, mean, turn, tide * seconds, tide)
    return end, lowest(between(x[:6], end[:6], off, w.c, free))


def beginning(x: Tensor, w: Braking) -> Tensor:
    """Where the way from states (16, B) begins, (10, B).

    Position, velocity, the Sun's angle, the body's largest rate from there on, and by how much the way strays from what
    is planned, in m and m/s.

    Of each hold, an error of astray |G| T of velocity is left to the next, which takes it away. In all a way from a
    speed v has |v| / (a T) holds.
    """
    speed = norm(x[V])
    off_v = w.astray * (speed + w.thrust * w.hold)
    off_p = w.astray * speed * (speed / (2 * w.straight) + w.hold) + w.creep
    return torch.cat((x[:6], torch.stack((x[THETA_S], norm(x[OMEGA]).clamp(min=w.turn), off_p, off_v))))


def aside(push: Tensor, turn: Tensor, w: Braking) -> Tensor:
    """m by which a hold of thrust of so many m/s^2 leads past where it is planned to: a w T^3 / 12, see `strays`."""
    return push * turn * w.hold**3 / 12


def braked(at: Tensor, w: Braking) -> tuple[Tensor, Tensor]:
    """One hold of the way, from (10, B) as of `beginning`: where it ends, the same, and the least of the limits."""
    start, theta_s, turn, off_p, off_v = at[:6], at[6], at[7], at[8], at[9]
    p, v, t = start[P], start[V], w.hold
    wanted, given = planned(p, v, theta_s, w)
    end = torch.cat((p + t * v + t**2 / 2 * wanted, v + t * wanted))
    off_p = off_p + aside(norm(given), turn, w)
    least = lowest(between(start, end, strays(start, end, t, given, turn, off_p, off_v), w.c, w.free))
    rest = torch.stack((sun_angle_after(theta_s, t, w.c), turn, off_p, off_v))
    return torch.cat((end, rest)), least


def at_a_glance(x: Tensor, u: Tensor, w: Braking) -> Tensor:
    """A lower bound of the least of the limits in a hold of controls (6, B) and on the way after it: (B,).

    That is straight; all holds but the last are one parabola, the last is another.
    """
    least, end = held(x, u, w, w.rough)
    return torch.minimum(least, at_once(beginning(end, w), w))


def at_once(at: Tensor, w: Braking) -> Tensor:
    """The same of the way alone, from (10, B) as of `beginning`, in a single chord from there to its end.

    Place and speed lie on one parabola until the last hold, and on another in it. From the chord they are at most as
    far as the parabolas are from theirs, (v - s)^2 / (8 a) and s T / 8, and as the point where they meet.
    """
    start, turn, off_p, off_v = at[:6], at[7], at[8], at[9]
    p, v, t = start[P], start[V], w.hold
    speed = norm(v)
    direction = v / speed.clamp(min=1e-30)
    full = (-(1.0 - speed / (w.straight * t)).floor()).clamp(min=0.0)  # holds but the last
    slow = speed - full * w.straight * t
    fallen = (speed**2 - slow**2) / (2 * w.straight)
    length = fallen + slow * t / 2
    rest = torch.cat((p + length * direction, torch.zeros_like(p)))
    meet = (fallen - length * (1.0 - slow / speed.clamp(min=1e-30))).abs()
    sag = meet + torch.maximum((speed - slow) ** 2 / (8 * w.straight), slow * t / 8)
    drift = w.thrust - w.straight  # of natural acceleration, at most and in any direction
    push = torch.minimum(speed / t, torch.full_like(speed, w.straight)) + drift
    off_p = off_p + (full + 1.0) * aside(push, turn, w)
    off = strays(start, start, t, push * direction, turn, off_p, off_v)
    off = Strays(off.position + sag, off.velocity, off.speed + off.velocity * drift / w.straight)
    # where the law takes the way to end, at first and at last: on the way the point moves from the one to the other
    ends = [norm(p + direction * speed * (speed / (2 * w.straight) + late)) for late in (0.0, t / 2)]
    room = w.c.max_distance - INSIDE - w.buffer - torch.maximum(*ends)
    return lowest(torch.cat((between(start, rest, off, w.c, w.rough), room[None])))

"""The backup law of thrust: brake, then hover. In every attitude thrust can push in any direction with max_thrust.

The law is a function of the state. The spacecraft's mean acceleration over each hold of T s is to be A. Thrust cancels
the natural acceleration f in the middle of the hold. So it gives G = A - f in m/s^2, with |G| at most max_thrust / m.
Let w = v - v_ref(p). The field of velocities v_ref is zero, except beside the chief (outwards) and at the edge of the
zone (inwards).

    straight            A = -w / |w| min(a, |w| / T), with a the thrust that is left where f is strongest. The path is
                        straight, |w| falls by a T in each hold, and is zero after the last.
    along the zone      where a straight path would end beyond the zone: inwards as much as keeps r below r_max,
                        N = v_t^2 / r + v_r^2 / (2 (r_max - r)); the rest of |G| brakes v_t. N does not rise on this
                        path: with r'' = v_t^2 / r - N the second term is constant, and the first falls with v_t.

The body turns while thrust is held, so commands are for the mean attitude of the hold (`thrust_along`).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.model.attitude import dot, norm, quaternion_rate, rotation_matrix, unit
from inspection.model.dynamics import euler
from inspection.model.orbit import clohessy_wiltshire
from inspection.model.parameters import Limits
from inspection.model.rk4 import rk4_step
from inspection.model.state import OMEGA, P, Q, V

INSIDE = 1.0  # m, smallest distance inside the zone's edge at which a straight path ends
SPARE = 0.997  # share of thrust along the zone; the rest is for the change of f on the path, 2 n a T / 2
SURPLUS = 1.02  # factor of N, for errors of a hold and rounding
DRIFT = 0.02  # m/s, the field's speed beside the chief and at the edge of the zone
STEEP = 5e-4  # 1/s, slope by which the field falls off with distance, and rises beyond either limit
BACK = 0.1  # m/s, the field's largest additional speed beyond a limit
BESIDE = 4.0 / 3.0  # distance up to which the field leads outwards, in collision radii


@dataclass(frozen=True)
class Braking:
    """Holds the constants of the law.

    Attributes:
        hold: T in s; thrust: the largest |G|; straight: a, both in m/s^2.
        mean_error: share of |G| by which the mean over a hold differs from the wanted one.
        buffer: m, kept from the zone's edge because a path strays in a hold.
        fastest: m/s, the largest speed within the limits.
    """

    c: Limits
    hold: float
    thrust: float
    straight: float
    mean_error: float
    buffer: float
    fastest: float

    @classmethod
    def of(cls, c: Limits, hold: float, slewing: float) -> "Braking":
        """Computes the constants.

        Args:
            slewing: rad/s, the largest rate of a body under the law of torque.
        """
        half = math.sqrt(3.0) * c.max_rate * hold / 2
        quickening = math.sqrt(3.0) * min(c.max_torque / min(c.inertia), 2 * c.max_rate / hold)
        off_mean = half**2 / 6 + quickening * hold**2 / 24  # |1 - M R_m'|, see `thrust_along`
        mean_error = off_mean**2 + (c.mean_motion * hold) ** 2
        fastest = min(c.docking_speed + c.speed_slope * c.max_distance, math.sqrt(3.0) * c.max_speed)
        thrust = c.max_thrust / c.mass / (1 + off_mean)
        straight = thrust - c.largest_drift(c.max_distance, fastest)
        turn = slewing + 4 * c.mean_motion
        buffer = straight * hold**2 / 4 + fastest * turn * hold**2 / 12
        return cls(c, hold, thrust, straight, mean_error, buffer, fastest)


def field(p: Tensor, c: Limits) -> Tensor:
    """Returns v_ref (3, ...) in m/s at positions (3, ...) in m."""
    r = norm(p).clamp(min=1e-3)
    beside, edge = BESIDE * c.collision_radius, c.max_distance - INSIDE
    out = (DRIFT - STEEP * (r - beside)).clamp(0.0, DRIFT)
    back = (DRIFT + STEEP * (r - edge)).clamp(0.0, DRIFT)
    deep = (STEEP * (c.collision_radius - r)).clamp(0.0, BACK)
    far = (STEEP * (r - c.max_distance)).clamp(0.0, BACK)
    return (out + deep - back - far) / r * p


def planned(p: Tensor, v: Tensor, w: Braking) -> Tensor:
    """Returns the law: G (3, ...) in m/s^2 in Hill's frame, at positions and velocities (3, ...)."""
    c, t = w.c, w.hold
    off = v - field(p, c)
    speed_error = norm(off)
    straight = -off / speed_error.clamp(min=1e-30) * (speed_error / t).clamp(max=w.straight)
    middle = p + t / 2 * v

    def natural(acceleration: Tensor) -> Tensor:
        p_m, v_m = middle + t**2 / 8 * acceleration, v + t / 2 * acceleration
        return torch.stack(clohessy_wiltshire(p_m.unbind(), v_m.unbind(), c.mean_motion))

    speed, distance = norm(v), norm(middle)
    direction = v / speed.clamp(min=1e-30)
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
    most = ((SPARE * w.thrust) ** 2 - dot(across_both, across_both)).sqrt()  # SPARE: f depends on the path
    inwards = torch.minimum(needed + f_r, most)
    left = (most**2 - inwards**2).clamp(min=0.0).sqrt()
    back = torch.minimum(tangential / t + f_t, left)
    along = (f_r - inwards) * outwards + (f_t - back) * ahead

    end = norm(p + direction * speed * (speed / (2 * w.straight) + t / 2))
    needs_zone = (end > c.max_distance - INSIDE - w.buffer) & (speed > w.straight * t)
    wanted = torch.where(needs_zone, along, straight)
    return wanted - natural(wanted)


def brake(x: Tensor, torque: Tensor, w: Braking) -> Tensor:
    """Returns the law as thrust (3, B) in N, in the body, at states (16, B) while torque (3, B) is held."""
    return thrust_along(planned(x[P], x[V], w), x, torque, w)


def thrust_along(acceleration: Tensor, x: Tensor, torque: Tensor, w: Braking) -> Tensor:
    """Returns thrust (3, B) in N whose mean over a hold of torque (3, B) is an acceleration G (3, B) in m/s^2.

    The body turns over the hold by R(s), with the mean M by Simpson's rule and R_m in the middle. M R_m' is 1 to second
    order. So u = m R_m' (2 - M R_m') G has an error of fourth order.
    """
    middle = attitude_after(x, torque, w.hold / 2, w.c)
    end = attitude_after(x, torque, w.hold, w.c)
    first, second, third = (rotation_matrix(q) for q in (x[Q], middle, end))
    mean = (first + 4.0 * second + third) / 6.0
    body = (second * acceleration[:, None]).sum(0)
    left = 2.0 * acceleration - (mean * body).sum(1)
    limit = w.c.max_thrust
    return (w.c.mass * (second * left[:, None]).sum(0)).clamp(-limit, limit)


def attitude_after(x: Tensor, torque: Tensor, seconds: float, c: Limits) -> Tensor:
    """Returns the quaternion (4, B) after torque (3, B) has acted for some s, by one step with rates within limits."""
    limit = c.max_rate

    def rate(y: list[Tensor]) -> list[Tensor]:
        omega = [each.clamp(-limit, limit) for each in y[4:]]
        faster = [e + t / j for e, t, j in zip(euler(omega, c.inertia), torque, c.inertia, strict=True)]
        return [*quaternion_rate(y[:4], omega), *faster]

    return unit(torch.stack(rk4_step(rate, [*x[Q], *x[OMEGA]], seconds)[:4]))

"""The backup law of torque: turn the panels to the Sun, then follow it; the camera looks away, the surface cools.

The law is a function of the state. With d the panels' axis, away from the camera, s the direction to the Sun and e the
axis of the cooled surface, all in the body, it asks for the rate at the end of a hold

    omega = rate (d x s) + roll d - n z,        J (omega - omega_now) / T = torque less the gyroscopic one.

The first term turns d along the great circle to s, as fast as the body rates allow until kappa sin(delta) is less, with
delta the angle between them. So the camera, at pi - delta, recedes from the Sun all the way. The second rolls about d
until e is along Hill's z or against it, whichever is nearer once d is at the Sun; it begins when delta is below a right
angle. The last follows the Sun. At rest the panels face it, and neither Sun nor Earth shine on the surface.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.model.attitude import cross, dot, norm, rotation_matrix
from inspection.model.dynamics import euler, most_gyroscopic, sun_and_earth_in_body
from inspection.model.parameters import AXES, Limits
from inspection.model.state import OMEGA, Q
from rta.check.commit import NoCheckError

FARTHEST = 0.175  # rad, that the law turns in a hold: a fast turn misdirects thrust that is held
PER_HOLD = 0.75  # of an angle that is left, that a hold takes away at most


@dataclass(frozen=True)
class Pointing:
    """What the law depends on.

    Attributes:
        hold: T in s; rate, roll: rad/s at most; kappa: 1/s; overshoot: rad/s, see `overshoot`.
    """

    c: Limits
    hold: float
    rate: float
    roll: float
    kappa: float
    overshoot: float

    @classmethod
    def of(cls, c: Limits, hold: float) -> "Pointing":
        gyroscopic = math.hypot(*euler((c.max_rate,) * 3, c.inertia))
        alpha = c.max_torque / max(c.inertia) - gyroscopic
        over = overshoot(c, hold)
        rate = min(c.max_rate - 1.05 * c.mean_motion - over, FARTHEST / hold)
        return cls(c, hold, rate, min(rate, 0.12 / hold), min(alpha / (2 * rate), PER_HOLD / hold), over)

    @property
    def fastest(self) -> float:
        """rad/s, at which the law has a body turn at most, two axes pointing it and one rolling."""
        return math.hypot(self.rate, self.rate, self.roll) + self.c.mean_motion


def overshoot(c: Limits, hold: float) -> float:
    """Returns rad/s by which a rate in a hold of the law exceeds those at its ends as the law counts with them.

    The law takes the gyroscopic acceleration a_i w_j w_k, G = a max_rate^2 at most, for that of the beginning. On the
    straight line between two rates within the limits its mean differs from that by G at most (the mean is linear in
    each rate at either end: the corners decide). Rates that stray by D from the line change it by 2 a max_rate D more,
    half of it in the mean. So D = G T / (1 - a max_rate T). Between two steps of the plant `attitude_between` takes
    off sqrt(3) / 2 G t^2 / T more, but for terms of higher order.

    Raises:
        NoCheckError: these are too large.
    """
    gyroscopic = most_gyroscopic(c.inertia) * c.max_rate
    seconds, turned = min(c.substep, hold), gyroscopic * hold
    if gyroscopic * seconds > 0.1 or turned > 0.5:
        raise NoCheckError("gyroscopic torque turns the body as fast as the law does")
    higher = (1.0 + 3.5 * gyroscopic * seconds) * (1.0 + turned)
    return turned * c.max_rate * (1.0 / (1.0 - turned) + math.sqrt(0.75) * (seconds / hold) ** 2 * higher)


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


def rest_deviation(x: Tensor, c: Limits) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the deviation of states (16, ...) from the attitude of rest.

    Returns:
        d x s (3, ...); the sine of the roll that is left about d, to the nearer of z and -z, and cos(delta), (...).
    """
    d, e = vector(c.solar_panel_axis, x), vector(c.thermal_axis, x)
    s, _ = sun_and_earth_in_body(x)
    z = upright(x, d, s)
    off = dot(d, across(e, z))
    return across(d, s), torch.where(dot(e, z) < 0.0, -off, off), dot(d, s)


def wanted(x: Tensor, w: Pointing) -> Tensor:
    """The law: omega (3, ...) in rad/s at the end of a hold, for states (16, ...)."""
    d = vector(w.c.solar_panel_axis, x)
    axis, off, cosine = rest_deviation(x, w.c)
    sine = norm(axis)
    roll = (w.kappa * off).clamp(-w.roll, w.roll) * (4.0 * cosine).clamp(0.0, 1.0)
    middle = axis - (roll * w.hold / 2) * across(d, axis)  # as the body has rolled in the middle of the hold
    middle = middle * (sine / norm(middle).clamp(min=1e-12))
    rate = w.rate / middle.abs().amax(0).clamp(min=1e-12)
    rate = torch.where(cosine > 0.0, rate.clamp(max=w.kappa), rate)
    return rate * middle + roll * d - w.c.mean_motion * rotation_matrix(x[Q])[2]


def slew(x: Tensor, w: Pointing) -> Tensor:
    """The law as torque (3, B) in N m at states (16, B)."""
    inertia = x.new_tensor(w.c.inertia)[:, None]
    faster = (wanted(x, w) - x[OMEGA]) / w.hold - torch.stack(euler(x[OMEGA], w.c.inertia))
    return (inertia * faster).clamp(-w.c.max_torque, w.c.max_torque)

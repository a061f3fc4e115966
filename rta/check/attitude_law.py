"""The backup law of torque: turn the panels to the Sun, then follow it; the camera looks away, the surface cools.

The law is a function of the state. Let d be the panels' axis, away from the camera, s the direction to the Sun and e
the axis of the cooled surface, all in the body. The law commands the body rate at the end of a hold

    omega = rate (d x s) + roll d - n z,        J (omega - omega_now) / T = torque less the gyroscopic one.

The first term turns d along the great circle to s. It turns as fast as the body rates allow, until kappa sin(delta) is
slower, with delta the angle between d and s. So the camera, at pi - delta, recedes from the Sun all the way. The second
term rolls about d until e is along Hill's z or against it, whichever is closer once d is at the Sun; it begins when
delta is below a right angle. The third term follows the Sun. At rest the panels face the Sun, and neither Sun nor Earth
shine on the surface.
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

FARTHEST = 0.175  # rad, largest turn in a hold: a faster turn misdirects thrust that is held
PER_HOLD = 0.75  # largest share of the remaining angle that a hold removes


@dataclass(frozen=True)
class Pointing:
    """Holds the constants of the law.

    Attributes:
        hold: T in s; rate, roll: largest rad/s; kappa: 1/s; overshoot: rad/s, see `overshoot`.
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
        """Returns the largest rate in rad/s that the law commands: two axes point the body and one rolls it."""
        return math.hypot(self.rate, self.rate, self.roll) + self.c.mean_motion


def overshoot(c: Limits, hold: float) -> float:
    """Returns by how much in rad/s a rate within a hold exceeds the rates that the law counts with at its ends.

    The law takes the gyroscopic acceleration a_i w_j w_k, at most G = a max_rate^2, as constant from the hold's
    beginning. On the straight line between two rates within the limits, its mean differs from the beginning by at most
    G (the mean is linear in each rate at either end, so the corners decide). Rates that are off the line by D change it
    by at most 2 a max_rate D more, and half of that in the mean. So D = G T / (1 - a max_rate T). Between two steps of
    the plant `attitude_between` subtracts sqrt(3) / 2 G t^2 / T more, except for terms of higher order.

    Raises:
        NoCheckError: the gyroscopic terms are too large.
    """
    gyroscopic = most_gyroscopic(c.inertia) * c.max_rate
    seconds, turned = min(c.substep, hold), gyroscopic * hold
    if gyroscopic * seconds > 0.1 or turned > 0.5:
        raise NoCheckError("gyroscopic torque turns the body as fast as the law does")
    higher = (1.0 + 3.5 * gyroscopic * seconds) * (1.0 + turned)
    return turned * c.max_rate * (1.0 / (1.0 - turned) + math.sqrt(0.75) * (seconds / hold) ** 2 * higher)


def check_rest(c: Limits) -> None:
    """Raises NoCheckError without an attitude of rest: panels away from the camera, the cooled surface across them."""
    if c.solar_panel_axis != "-x" or c.thermal_axis[1] == "x":
        raise NoCheckError("there is no attitude of rest: panels must be on -x, the thermal side across them")


def vector(axis: str, x: Tensor) -> Tensor:
    """Returns a body axis such as "-y" as a vector (3, ...), for states (16, ...)."""
    index, sign = AXES[axis]
    parts = [torch.zeros_like(x[0])] * 3
    parts[index] = torch.full_like(x[0], sign)
    return torch.stack(parts)


def upright(x: Tensor, d: Tensor, s: Tensor) -> Tensor:
    """Returns Hill's z in the body (3, ...), turned along with s until s is at d: a vector across d."""
    z = rotation_matrix(x[Q])[2]
    return z - dot(d, z) / (1.0 + dot(d, s)).clamp(min=1e-9) * (s + d)


def rest_deviation(x: Tensor, c: Limits) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the deviation of states (16, ...) from the attitude of rest.

    Returns:
        d x s (3, ...); the sine of the remaining roll about d, to the closer of z and -z, and cos(delta), both (...).
    """
    d, e = vector(c.solar_panel_axis, x), vector(c.thermal_axis, x)
    s, _ = sun_and_earth_in_body(x)
    z = upright(x, d, s)
    off = dot(d, torch.stack(cross(e, z)))
    return torch.stack(cross(d, s)), torch.where(dot(e, z) < 0.0, -off, off), dot(d, s)


def wanted(x: Tensor, w: Pointing) -> Tensor:
    """Returns the law: omega (3, ...) in rad/s at the end of a hold, for states (16, ...)."""
    d = vector(w.c.solar_panel_axis, x)
    axis, off, cosine = rest_deviation(x, w.c)
    sine = norm(axis)
    roll = (w.kappa * off).clamp(-w.roll, w.roll) * (4.0 * cosine).clamp(0.0, 1.0)
    middle = axis - (roll * w.hold / 2) * torch.stack(cross(d, axis))  # by the roll in the middle of the hold
    middle = middle * (sine / norm(middle).clamp(min=1e-12))
    rate = w.rate / middle.abs().amax(0).clamp(min=1e-12)
    rate = torch.where(cosine > 0.0, rate.clamp(max=w.kappa), rate)
    return rate * middle + roll * d - w.c.mean_motion * rotation_matrix(x[Q])[2]


def slew(x: Tensor, w: Pointing) -> Tensor:
    """Returns the law as torque (3, B) in N m at states (16, B)."""
    inertia = x.new_tensor(w.c.inertia)[:, None]
    faster = (wanted(x, w) - x[OMEGA]) / w.hold - torch.stack(euler(x[OMEGA], w.c.inertia))
    return (inertia * faster).clamp(-w.c.max_torque, w.c.max_torque)

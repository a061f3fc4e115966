"""The six constraints that torque enforces, each with all that the filter knows of it.

As in `rta.constraints.thrust`, each is a function of constants and parameters to its entry. The first three are of
relative degree two. Their h is that of `rta.limits`, which is exact; in what is enforced, slopes that would be infinite
are continued as constants, and the slope of a broken limit does not vanish at the pole where it is worst (`Side`).
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import cosine_to, energy_rate, sun_and_earth_in_body, temperature_rate
from inspection.model.parameters import AXES, Limits
from inspection.model.state import OMEGA, E, T
from rta import limits
from rta.bounds.uncertainty import NO_UNCERTAINTY, Uncertainty
from rta.constraints.constraint import Constraint
from rta.lie_derivatives import Function
from rta.parameters import RtaParameters

ON_POLE = 1e-9  # rad, from a pole where no side is nearer

Entry = partial(Constraint, actuator="torque", coupled=False)  # which no other actuator changes


def torque_constraints(
    c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY
) -> tuple[Constraint, ...]:
    """All six in the order of Table 3."""
    return (
        attitude_exclusion(c, r),
        temperature(c, r),
        battery(c, r),
        *(angular_velocity(i, c, r, uncertainty) for i in range(3)),
    )


def arccos(cosine: Tensor, pole: float) -> Tensor:
    """arccos, nearer than `pole` in rad to 0 or pi the tangent that starts there."""
    edge = math.cos(pole)
    inside = cosine.clamp(-edge, edge)
    if pole == 0.0:
        return inside.arccos()
    return inside.arccos() - (cosine - inside) / math.sin(pole)


class Side(NamedTuple):
    """To which side a direction in the body frame is to leave a pole, where a broken limit is worst.

    The angle to the pole has no slope at the pole, and hardly one near it as a function of the cosine: no torque seems
    to help. Along a fixed direction e across the pole, arcsin(r . e) has the slope 1; it is the angle of r where r is
    on the side of e, and less elsewhere. So e is the side on which r is, at the pole itself the next body axis.

    Attributes:
        near: (B,) bool, the limit is broken, and the direction within the least angle to the pole.
        across: (3, B) e, a unit vector in the body frame.
        far: the pole is the axis' other end.
    """

    near: Tensor
    across: Tensor
    far: bool


def side(axis: str, body: Tensor, broken: Tensor, pole: float, far: bool = False) -> Side:
    """Of directions (3, B) near a body axis or, `far`, its other end, where the limit (B,) is broken."""
    index, _ = AXES[axis]
    one = torch.eye(3, dtype=body.dtype, device=body.device)[..., None]
    across = (1.0 - one[index]) * body
    length = norm(across)
    unit = torch.where(length > ON_POLE, across / length.clamp(min=ON_POLE), one[(index + 1) % 3])
    cosine = cosine_to(axis, body)
    return Side(broken & ((-cosine if far else cosine) > math.cos(pole)), unit, far)


def angle_to(axis: str, body: Tensor, pole: float, leaving: Side) -> Tensor:
    """The angle of directions (3, ...) to a body axis in rad: `arccos`, or along the side to which it is left."""
    angle = arccos(cosine_to(axis, body), pole)
    x, y, z = leaving.across  # of states; body may have an axis of directions before theirs
    along = x * body[0] + y * body[1] + z * body[2]
    aside = math.pi / 2 - along.clamp(-0.5, 0.5).arccos()  # arcsin
    return torch.where(leaving.near, math.pi - aside if leaving.far else aside, angle)


def positive_part(angle: Tensor, width: float) -> Tensor:
    """max(angle, 0), within w = `width` of zero the parabola (angle + w)^2 / (4 w), which continues its slopes."""
    if width == 0.0:
        return angle.clamp(min=0.0)
    # inside, the square of a clamped number; beyond, what is left over
    return (angle + width).clamp(0.0, 2 * width) ** 2 / (4 * width) + (angle - width).clamp(min=0.0)


def attitude_exclusion(c: Limits, r: RtaParameters) -> Constraint:
    """The camera's boresight +x and the Sun."""

    def enforced(x: Tensor, leaving: Side) -> Tensor:
        sun, _ = sun_and_earth_in_body(x)
        return angle_to("+x", sun, r.pole_angle, leaving) - c.field_of_view / 2 - c.exclusion_buffer

    def barrier(x: Tensor) -> Function:
        sun, _ = sun_and_earth_in_body(x)
        leaving = side("+x", sun, h(x) < 0.0, r.pole_angle)
        return lambda y: enforced(y, leaving)[None]

    h = partial(limits.attitude_exclusion, c=c)

    return Entry(
        "attitude_exclusion",
        h,
        gains=r.exclusion_gains,
        margin=r.exclusion_margin,
        weight=r.slack_weight_critical,
        barrier=barrier,
        recovery=0.5 * c.max_rate,  # of a turn at full rate
    )


def temperature(c: Limits, r: RtaParameters) -> Constraint:
    """The warmth of the thermal side, which Sun and Earth heat."""

    def enforced(x: Tensor, leaving: Sequence[Side]) -> Tensor:
        both = zip(sun_and_earth_in_body(x), leaving, strict=True)
        angles = torch.stack([angle_to(c.thermal_axis, body, r.pole_angle, to) for body, to in both])
        sun, earth = positive_part(math.pi / 2 - angles, r.incidence_rounding)
        return c.max_temperature - x[T] - c.temperature_sun_slope * sun - c.temperature_earth_slope * earth

    def barrier(x: Tensor) -> Function:
        hot = h(x) < 0.0
        leaving = [side(c.thermal_axis, body, hot, r.pole_angle) for body in sun_and_earth_in_body(x)]
        return lambda y: enforced(y, leaving)[None]

    h = partial(limits.temperature, c=c)
    none, hot = torch.tensor((0.0, c.max_temperature), dtype=torch.float64)
    cooling = -temperature_rate(none, none, hot, c).item()  # in the dark

    return Entry(
        "temperature",
        h,
        gains=r.temperature_gains,
        margin=r.temperature_margin,
        weight=r.slack_weight_resource,
        barrier=barrier,
        recovery=0.5 * cooling,
    )


def battery(c: Limits, r: RtaParameters) -> Constraint:
    """The charge of the battery, which panels in the Sun keep up."""

    def enforced(x: Tensor, leaving: Side) -> Tensor:
        sun, _ = sun_and_earth_in_body(x)
        angle = angle_to(c.solar_panel_axis, sun, r.pole_angle, leaving)
        return x[E] - c.min_energy - c.energy_sun_slope * angle

    def barrier(x: Tensor) -> Function:
        sun, _ = sun_and_earth_in_body(x)
        leaving = side(c.solar_panel_axis, sun, h(x) < 0.0, r.pole_angle, far=True)
        return lambda y: enforced(y, leaving)[None]

    h = partial(limits.battery, c=c)
    charging = energy_rate(torch.ones((), dtype=torch.float64), c).item()  # in full light

    return Entry(
        "battery",
        h,
        gains=r.battery_gains,
        margin=r.battery_margin,
        weight=r.slack_weight_resource,
        barrier=barrier,
        recovery=max(0.5 * charging, 0.0),
    )


def angular_velocity(
    axis: int, c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY
) -> Constraint:
    """The limit of the rate about a body axis.

    Where a control is held for longer than a body needs to stop, or the plant does not saturate, the filter holds the
    rates itself: by omega_max -+ omega_i, which are linear, less what a rate may be measured wrong and turn otherwise
    in a hold. Braking a turn is always possible and raises them, so they have no slack; what can yield to them are the
    resources.
    """

    def both(x: Tensor) -> Tensor:
        rate = x[OMEGA.start + axis]
        return torch.stack((limit - rate, limit + rate))

    h = partial(limits.angular_velocity, c=c, axis=axis)
    unknown = math.radians(uncertainty.rate) + uncertainty.angular_acceleration(c) * uncertainty.hold(r)
    limit = c.max_rate - uncertainty.rate_offset(c) - unknown
    if uncertainty.needs_sampled_rows(r):
        return Entry(
            f"angular_velocity_{'xyz'[axis]}",
            h,
            gains=(r.rate_gain,),
            weight=math.inf,
            barrier=lambda x: both,
            rows=2,
            axis=axis,
        )
    # in a period T an angular acceleration changes omega_i^2 by at most its square T^2 beyond linear
    spin = (c.max_torque / min(c.inertia)) ** 2 * r.period
    spin = min(spin, 0.5 * r.gain(r.rate_gain) * c.max_rate**2)
    return Entry(
        f"angular_velocity_{'xyz'[axis]}",
        h,
        gains=(r.rate_gain,),
        margin=r.rate_margin,
        weight=r.slack_weight_motion,
        intersample_drop=lambda x: spin * (h(x) < 0.0).to(x.dtype),  # within it the plant saturates
        axis=axis,
    )

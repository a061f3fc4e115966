"""The six constraints that torque holds, each with all that the filter knows of it (Sec. Safety Constraints).

As in `rta.constraints.thrust`, each is a function of constants and parameters to its entry. The first three are of
relative degree two. Reported values are exact; in what is enforced, slopes that would be infinite are continued as
constants.
"""

import math
from functools import partial

import torch
from torch import Tensor

from inspection.model.dynamics import cosine_to, energy_rate, sun_and_earth_in_body, temperature_rate
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, E, T
from rta.bounds.uncertainty import NOTHING, Uncertainty
from rta.constraints.constraint import Constraint
from rta.parameters import RtaParameters

Entry = partial(Constraint, held_by="torque", coupled=False)  # which no other actuator changes


def torque_constraints(c: Limits, r: RtaParameters, known: Uncertainty = NOTHING) -> tuple[Constraint, ...]:
    """All six in the order of Table 3."""
    return (
        attitude_exclusion(c, r),
        temperature(c, r),
        battery(c, r),
        *(angular_velocity(i, c, r, known) for i in range(3)),
    )


def arccos(cosine: Tensor, pole: float = 0.0) -> Tensor:
    """arccos, nearer than `pole` in rad to 0 or pi the tangent that starts there."""
    edge = math.cos(pole)
    inside = cosine.clamp(-edge, edge)
    if pole == 0.0:
        return inside.arccos()
    return inside.arccos() - (cosine - inside) / math.sin(pole)


def positive_part(angle: Tensor, width: float = 0.0) -> Tensor:
    """max(angle, 0), within w = `width` of zero the parabola (angle + w)^2 / (4 w), which continues its slopes."""
    if width == 0.0:
        return angle.clamp(min=0.0)
    # inside, the square of a clamped number; beyond, what is left over
    return (angle + width).clamp(0.0, 2 * width) ** 2 / (4 * width) + (angle - width).clamp(min=0.0)


def attitude_exclusion(c: Limits, r: RtaParameters) -> Constraint:
    """theta_EZ - alpha_FOV / 2 - beta in rad: the camera's boresight +n_x and the Sun."""

    def h(x: Tensor, pole: float = 0.0) -> Tensor:
        sun, _ = sun_and_earth_in_body(x)
        return arccos(sun[0], pole) - c.field_of_view / 2 - c.exclusion_buffer

    return Entry(
        "attitude_exclusion",
        h,
        gains=r.exclusion_gains,
        margin=r.exclusion_margin,
        weight=r.slack_weight_critical,
        barrier=lambda x: lambda y: h(y, r.pole_angle)[None],
        recovery=0.5 * c.max_rate,  # of a turn at full rate
    )


def temperature(c: Limits, r: RtaParameters) -> Constraint:
    """T_max - T - delta_0 (pi/2 - theta_SI)^+ - delta_1 (pi/2 - theta_EI)^+ in deg C.

    Incidence angles are defined on [0, pi/2], hence the positive parts.
    """

    def h(x: Tensor, pole: float = 0.0, width: float = 0.0) -> Tensor:
        directions = torch.stack([cosine_to(c.thermal_axis, body) for body in sun_and_earth_in_body(x)])
        sun, earth = positive_part(math.pi / 2 - arccos(directions, pole), width)
        return c.max_temperature - x[T] - c.temperature_sun_slope * sun - c.temperature_earth_slope * earth

    none, hot = torch.tensor((0.0, c.max_temperature), dtype=torch.float64)
    cooling = -temperature_rate(none, none, hot, c).item()  # in the dark

    return Entry(
        "temperature",
        h,
        gains=r.temperature_gains,
        margin=r.temperature_margin,
        weight=r.slack_weight_resource,
        barrier=lambda x: lambda y: h(y, r.pole_angle, r.incidence_rounding)[None],
        recovery=0.5 * cooling,
    )


def battery(c: Limits, r: RtaParameters) -> Constraint:
    """E - E_min - delta_2 theta_SI in kJ: the solar panels and the Sun."""

    def h(x: Tensor, pole: float = 0.0) -> Tensor:
        sun, _ = sun_and_earth_in_body(x)
        angle = arccos(cosine_to(c.solar_panel_axis, sun), pole)
        return x[E] - c.min_energy - c.energy_sun_slope * angle

    charging = energy_rate(torch.ones(()).double(), c).item()  # in full light

    return Entry(
        "battery",
        h,
        gains=r.battery_gains,
        margin=r.battery_margin,
        weight=r.slack_weight_resource,
        barrier=lambda x: lambda y: h(y, r.pole_angle)[None],
        recovery=max(0.5 * charging, 0.0),
    )


def angular_velocity(axis: int, c: Limits, r: RtaParameters, known: Uncertainty = NOTHING) -> Constraint:
    """omega_max^2 - omega_i^2 for a body axis, in rad^2/s^2.

    Where a control is held for longer than a body needs to stop, or the plant does not saturate, the filter holds the
    rates itself: by omega_max -+ omega_i, which are linear. Braking a turn is always possible and raises them, so they
    have no slack; what can yield to them are the resources.
    """

    def h(x: Tensor) -> Tensor:
        return c.max_rate**2 - x[OMEGA.start + axis] ** 2

    def both(x: Tensor) -> Tensor:
        rate = x[OMEGA.start + axis]
        return torch.stack((limit - rate, limit + rate))

    limit = c.max_rate - known.rate_offset(c)
    if known.holds(r):
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
        loss=lambda x: spin * (h(x) < 0.0).to(x.dtype),  # within it the plant saturates
        axis=axis,
    )

"""The distance to a limit in one unit for all constraints: filter calls."""

import math

from inspection.model.parameters import Limits
from rta.names import CONSTRAINTS


def scales(c: Limits, period: float) -> list[float]:
    """Returns for each constraint how far its h can fall from one filter call to the next, in h's unit.

    h over this scale is the least number of calls, `period` s each, between a state and the limit. Each scale is the
    largest |dh/dt| near the limit times the period:

    - v and its radial part change by at most a T, with a from thrust along all axes and the natural acceleration. Where
      h is zero, sqrt(2 a_max d) changes by a_max T. The speed limit changes by nu_1 |v| T.
    - The end of the free flight moves by T_f a T.
    - The directions to Sun and Earth turn by |omega| T. In addition the surface heats up and the battery discharges.
    - omega_i^2 changes by 2 omega_max alpha_max T, and by at most omega_max^2, from its limit to zero.
    """
    natural = c.max_thrust / c.mass - c.max_acceleration
    pushed = (math.sqrt(3.0) * c.max_thrust / c.mass + natural) * period  # m/s
    radial = pushed + c.max_acceleration * period
    fastest = c.docking_speed + c.speed_slope * c.max_distance  # m/s
    turned = math.sqrt(3.0) * c.max_rate * period  # rad
    absorbed = (
        c.absorptivity * c.surface_area * c.solar_constant * (1 + c.albedo)
    )  # W, without the Earth's infrared radiation
    heated = absorbed / (c.node_mass * c.specific_heat) * period  # deg C
    spun = 2 * c.max_rate * c.max_torque / min(c.inertia) * period  # rad^2/s^2
    found = {
        "collision": radial,
        "dynamic_speed": pushed + c.speed_slope * fastest * period,
        "keep_in_zone": radial,
        "passive_safety": c.passive_safety_horizon * pushed,
        **dict.fromkeys(("velocity_x", "velocity_y", "velocity_z"), 2 * c.max_speed * pushed),
        "attitude_exclusion": turned,
        "temperature": (c.temperature_sun_slope + c.temperature_earth_slope) * turned + heated,
        "battery": c.energy_sun_slope * turned + 1e-3 * c.power_draw * period,
        **dict.fromkeys(
            ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z"), min(spun, c.max_rate**2)
        ),
    }
    return [found.get(name, 1.0) for name in CONSTRAINTS]  # h of a limit of your own is left in its unit

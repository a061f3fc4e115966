"""How near a limit is, in the same unit for every constraint: filter calls."""

import math

from inspection.model.parameters import Limits
from rta.names import CONSTRAINTS


def scales(c: Limits, period: float) -> list[float]:
    """By constraint, how far its h can fall from one filter call to the next, in its unit.

    h over it is the least number of calls, `period` s each, that lie between a state and the limit. Each is
    what |dh/dt| reaches near the limit, times the period:

    - v changes by a T at most, with a of thrust along all axes and of the natural acceleration, and so does its radial
      part; where h is zero, sqrt(2 a_max d) changes by a_max T. The limit of speed moves by nu_1 |v| T.
    - The far end of the free flight is moved by T_f a T.
    - The Sun's and the Earth's directions turn by |omega| T. The surface heats and the battery empties on top.
    - omega_i^2 changes by 2 omega_max alpha_max T, and by omega_max^2 from its limit to zero.
    """
    natural = c.max_thrust / c.mass - c.max_acceleration
    pushed = (math.sqrt(3.0) * c.max_thrust / c.mass + natural) * period  # m/s
    radial = pushed + c.max_acceleration * period
    fastest = c.docking_speed + c.speed_slope * c.max_distance  # m/s
    turned = math.sqrt(3.0) * c.max_rate * period  # rad
    absorbed = (
        c.absorptivity * c.surface_area * c.solar_constant * (1 + c.albedo)
    )  # W, without the Earth's warmth
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
    return [found.get(name, 1.0) for name in CONSTRAINTS]  # a limit of your own: its unit

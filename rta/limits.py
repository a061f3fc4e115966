"""The paper's 13 safety constraints, each h(x) >= 0 in its final form (Sec. Safety Constraints).

Every h is exact: it has no margin, no floor and no smoothing; where it has no slope, the slope is 0. Each h is written
for one spacecraft, the component axis first; trailing axes are the batch: states (16, ...) to (...), with the task's
constants c. Reports, campaigns and both filters use these h.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from torch import Tensor

from inspection.model.attitude import dot, norm
from inspection.model.dynamics import cosine_to, sun_and_earth_in_body
from inspection.model.orbit import closest_times, free_flight
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, E, P, T, V

TINY = 1e-300  # below this a root has the slope 0
POLE = 1.0 - 2.0**-53  # beyond this cosine an angle has the slope 0, within 1.5e-8 rad of its axis
PARTS = 5  # parts of the free flight; the closest time is found in each


class Limit(NamedTuple):
    """Describes a constraint as the filter enforces it.

    Attributes:
        h: maps states (16, ...) and the task's constants to (...); not negative where the limit is satisfied.
        gains: of the class-K functions alpha_j(z) = k_j z, 1/s; one for each relative degree.
        weight: of its slack squared; None or 0: it has no slack and must hold.
    """

    h: Callable[[Tensor, Limits], Tensor]
    gains: tuple[float, ...]
    weight: float | None


def root(z: Tensor) -> Tensor:
    """Returns sqrt(z), continued to z < 0, where a limit is violated already, as -sqrt(-z)."""
    return z.sign() * z.abs().clamp(min=TINY).sqrt()


def radial_speed(x: Tensor) -> Tensor:
    """Returns v_pr = <v, p> / |p|, m/s."""
    return dot(x[V], x[P]) / norm(x[P])


def angle(axis: str, direction: Tensor) -> Tensor:
    """Returns theta between a body axis such as "-y" and a unit vector (3, ...) in the body frame, rad."""
    return cosine_to(axis, direction).clamp(-POLE, POLE).arccos()


def safe_separation(x: Tensor, c: Limits) -> Tensor:
    """Returns sqrt(2 a_max (|p| - (r_d + r_c))) + v_pr, m/s (Sec. Safe Separation)."""
    return root(2 * c.max_acceleration * (norm(x[P]) - c.collision_radius)) + radial_speed(x)


def dynamic_speed(x: Tensor, c: Limits) -> Tensor:
    """Returns nu_0 + nu_1 |p| - |v|, m/s (Sec. Dynamic Speed Constraint)."""
    return c.docking_speed + c.speed_slope * norm(x[P]) - root(dot(x[V], x[V]))


def keep_in_zone(x: Tensor, c: Limits) -> Tensor:
    """Returns sqrt(2 a_max (r_max - |p|)) - v_pr, m/s (Sec. Keep In Zone)."""
    return root(2 * c.max_acceleration * (c.max_distance - norm(x[P]))) - radial_speed(x)


def passive_safety(x: Tensor, c: Limits) -> Tensor:
    """Returns inf of |p(t)| over free flight for the next T_f, less r_d + r_c, m (Sec. Passively Safe Maneuvers)."""
    edges = tuple(c.passive_safety_horizon * i / PARTS for i in range(PARTS + 1))
    # exact to 1e-5 m; the slope of an infimum is that of |p(t)| at its t
    t = closest_times(x.detach(), edges, c)
    return norm(free_flight(x[P], x[V], t, c.mean_motion)).amin(0) - c.collision_radius


def axial_velocity(x: Tensor, c: Limits, axis: int) -> Tensor:
    """Returns v_max^2 - v_i^2, m^2/s^2, of an axis of Hill's frame (Sec. Axial Velocity Limits)."""
    return c.max_speed**2 - x[V.start + axis] ** 2


def attitude_exclusion(x: Tensor, c: Limits) -> Tensor:
    """Returns theta_EZ - alpha_FOV / 2 - beta, rad, of the camera +x and the Sun (Sec. Attitude Exclusion Zone)."""
    sun, _ = sun_and_earth_in_body(x)
    return angle("+x", sun) - c.field_of_view / 2 - c.exclusion_buffer


def temperature(x: Tensor, c: Limits) -> Tensor:
    """Returns T_max - T - delta_0 (pi/2 - theta_SI) - delta_1 (pi/2 - theta_EI), deg C.

    An incidence angle counts up to pi/2, where the light leaves the surface (Sec. Maintain Acceptable Temperature).
    """
    sun, earth = (
        (math.pi / 2 - angle(c.thermal_axis, body)).clamp(min=0.0) for body in sun_and_earth_in_body(x)
    )
    return c.max_temperature - x[T] - c.temperature_sun_slope * sun - c.temperature_earth_slope * earth


def battery(x: Tensor, c: Limits) -> Tensor:
    """Returns E - E_min - delta_2 theta_SI, kJ, of the solar panels and the Sun (Sec. Maintain Battery Charge)."""
    sun, _ = sun_and_earth_in_body(x)
    return x[E] - c.min_energy - c.energy_sun_slope * angle(c.solar_panel_axis, sun)


def angular_velocity(x: Tensor, c: Limits, axis: int) -> Tensor:
    """Returns omega_max^2 - omega_i^2, rad^2/s^2, of a body axis (Sec. Angular Velocity Limits)."""
    return c.max_rate**2 - x[OMEGA.start + axis] ** 2


WEIGHT = 1e12  # weight of all slack (Sec. RL Control Loop with RTA)

# In the order of Table 3. The gains are not published for six degrees of freedom.
PAPER: dict[str, Limit] = {
    "collision": Limit(safe_separation, (0.1,), None),
    "dynamic_speed": Limit(dynamic_speed, (0.5,), WEIGHT),
    "keep_in_zone": Limit(keep_in_zone, (0.1,), WEIGHT),
    "passive_safety": Limit(passive_safety, (0.03,), WEIGHT),
    "velocity_x": Limit(partial(axial_velocity, axis=0), (0.2,), WEIGHT),
    "velocity_y": Limit(partial(axial_velocity, axis=1), (0.2,), WEIGHT),
    "velocity_z": Limit(partial(axial_velocity, axis=2), (0.2,), WEIGHT),
    "attitude_exclusion": Limit(attitude_exclusion, (0.05, 0.2), WEIGHT),
    "temperature": Limit(temperature, (0.0015, 0.2), WEIGHT),
    "battery": Limit(battery, (0.004, 0.1), WEIGHT),
    "angular_velocity_x": Limit(partial(angular_velocity, axis=0), (0.5,), WEIGHT),
    "angular_velocity_y": Limit(partial(angular_velocity, axis=1), (0.5,), WEIGHT),
    "angular_velocity_z": Limit(partial(angular_velocity, axis=2), (0.5,), WEIGHT),
}

"""The 13 safety constraints, each a short function h(x) >= 0 of one spacecraft (Sec. Safety Constraints).

States have the component axis first; trailing axes are independent spacecraft. Where the paper transforms
a constraint to lower its relative degree, the function is the transformed, final form.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.attitude import dot, norm
from inspection.dynamics import cosine_to, free_flight, sun_and_earth_in_body
from inspection.parameters import InspectionParameters
from inspection.state import OMEGA, E, P, T, V

# In the order of the paper's Table 3: seven that only thrust can influence, six that only torque can.
TRANSLATIONAL = (
    "collision",
    "dynamic_speed",
    "keep_in_zone",
    "passive_safety",
    "velocity_x",
    "velocity_y",
    "velocity_z",
)
ATTITUDE = (
    "attitude_exclusion",
    "temperature",
    "battery",
    "angular_velocity_x",
    "angular_velocity_y",
    "angular_velocity_z",
)
CONSTRAINTS = TRANSLATIONAL + ATTITUDE
PASSES = 13  # grid points per segment of the free flight: at most 12 s apart in the default segments


@dataclass(frozen=True)
class Smoothing:
    """Where a slope would be infinite, it is continued as a constant; zero means exact.

    Attributes:
        distance: m; below it sqrt(2 a z) becomes its chord through 0.
        angle: rad; nearer than this to 0 or pi, arccos becomes its tangent.
        incidence: rad; nearer than this to 0, the positive part of an angle becomes the parabola above it that
            continues its slopes, 0 and 1.
    """

    distance: float = 0.0
    angle: float = 0.0
    incidence: float = 0.0


EXACT = Smoothing()


class Angles(NamedTuple):
    """Angles in rad: camera to Sun (theta_EZ), tracked surface to Sun and Earth, solar panels to Sun."""

    boresight_sun: Tensor
    surface_sun: Tensor
    surface_earth: Tensor
    panel_sun: Tensor


def arccos(cosine: Tensor, smoothing: Smoothing) -> Tensor:
    """arccos, within `smoothing.angle` of its poles the tangent that starts there."""
    edge = math.cos(smoothing.angle)
    inside = cosine.clamp(-edge, edge)
    if smoothing.angle == 0.0:
        return inside.arccos()
    return inside.arccos() - (cosine - inside) / math.sin(smoothing.angle)


def positive_part(angle: Tensor, smoothing: Smoothing) -> Tensor:
    """max(angle, 0), within `smoothing.incidence` of zero the parabola (angle + w)^2 / (4 w)."""
    w = smoothing.incidence
    if w == 0.0:
        return angle.clamp(min=0.0)
    # inside, the square of a clamped number; beyond, what is left over
    return (angle + w).clamp(0.0, 2 * w) ** 2 / (4 * w) + (angle - w).clamp(min=0.0)


def signed_sqrt(z: Tensor, smoothing: Smoothing) -> Tensor:
    """sign(z) sqrt(|z|), linear where |z| is below smoothing.distance (also for negative distances)."""
    floor = max(smoothing.distance, 1e-300)
    return torch.where(z.abs() < floor, z / math.sqrt(floor), z.sign() * z.abs().clamp(min=floor).sqrt())


def radial_speed(x: Tensor) -> Tensor:
    """v_pr = <v, p> / |p| in m/s."""
    return dot(x[V], x[P]) / norm(x[P])


def collision(x: Tensor, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Tensor:
    """sqrt(2 a_max (|p| - r_d - r_c)) + v_pr, in m/s: the speed from which braking still suffices."""
    distance = norm(x[P]) - c.collision_radius
    return math.sqrt(2 * c.max_acceleration) * signed_sqrt(distance, smoothing) + radial_speed(x)


def speed_limit(x: Tensor, c: InspectionParameters) -> Tensor:
    """nu_0 + nu_1 |p|, in m/s."""
    return c.docking_speed + c.speed_slope * norm(x[P])


def dynamic_speed(x: Tensor, c: InspectionParameters) -> Tensor:
    """nu_0 + nu_1 |p| - |v|, in m/s."""
    # The floor keeps the slope of |v| finite at rest, far below any speed that matters.
    speed = (dot(x[V], x[V]) + 1e-24).sqrt()
    return speed_limit(x, c) - speed


def keep_in_zone(x: Tensor, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Tensor:
    """sqrt(2 a_max (r_max - |p|)) - v_pr, in m/s."""
    distance = c.max_distance - norm(x[P])
    return math.sqrt(2 * c.max_acceleration) * signed_sqrt(distance, smoothing) - radial_speed(x)


def keep_in_curve(x: Tensor, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Tensor:
    """The keep-in zone as thrust can hold it, never above `keep_in_zone`, in m/s: with a_max - v_t^2 / |p|.

    d v_pr / dt holds the centrifugal v_t^2 / |p|, v_t the speed across p, which a_max leaves out: up to
    0.051 m/s^2 at the speed limit of 800 m, of a_max's 0.0705. Flying fast across where h is zero, 1 N does not
    keep h there; where this barrier is zero, 1 N inwards does, which every attitude can give.
    """
    across = dot(x[V], x[V]) - radial_speed(x) ** 2
    braking = (c.max_acceleration - across / norm(x[P])).clamp(min=0.1 * c.max_acceleration)
    distance = c.max_distance - norm(x[P])
    return (2 * braking).sqrt() * signed_sqrt(distance, smoothing) - radial_speed(x)


def closest_times(x: Tensor, segments: tuple[float, ...], c: InspectionParameters) -> Tensor:
    """When the free flight is nearest to the chief within each time segment: (16, ...) to (segments, ...) s.

    The best of a grid, refined by the parabola of |p(t)|^2 through it and its neighbours (exact for a
    straight path, which the path is over two grid steps to a few centimetres).
    """
    edges = x.new_tensor(segments)
    start, spacing = edges[:-1], edges.diff() / (PASSES - 1)
    shape = (-1, *(1,) * (x.dim() - 1))
    grid = start[:, None] + spacing[:, None] * torch.arange(PASSES, dtype=x.dtype, device=x.device)
    path = free_flight(x[P], x[V], grid.reshape(*grid.shape, *shape[1:]), c.mean_motion)
    squared = dot(path, path)  # (segments, PASSES, ...)
    best = squared.argmin(1, keepdim=True)
    centre = best.clamp(1, PASSES - 2)
    before, middle, after = (squared.gather(1, centre + i)[:, 0] for i in (-1, 0, 1))
    bend = before - 2 * middle + after
    offset = torch.where(bend > 0, 0.5 * (before - after) / bend, (best - centre)[:, 0].to(x.dtype))
    return start.reshape(shape) + spacing.reshape(shape) * (centre[:, 0] + offset.clamp(-1.0, 1.0))


def clearance_at(x: Tensor, times: Tensor, c: InspectionParameters) -> Tensor:
    """|p(t)| - r_d - r_c in m after coasting for each of times (k, ...), (16, ...) to (k, ...).

    With times = `closest_times` its gradient is that of the infimum (envelope theorem).
    """
    return norm(free_flight(x[P], x[V], times, c.mean_motion)) - c.collision_radius


def velocity(x: Tensor, c: InspectionParameters) -> Tensor:
    """v_max^2 - v_i^2 for the three Hill axes, (3, ...) in m^2/s^2."""
    return c.max_speed**2 - x[V] ** 2


def incidence_angles(x: Tensor, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Angles:
    """The angles that the attitude constraints are made of, each on [0, pi], from states (16, ...)."""
    sun, earth = sun_and_earth_in_body(x)
    cosines = (
        sun[0],
        cosine_to(c.thermal_axis, sun),
        cosine_to(c.thermal_axis, earth),
        cosine_to(c.solar_panel_axis, sun),
    )
    return Angles(*arccos(torch.stack(cosines), smoothing))


def attitude_exclusion(angles: Angles, c: InspectionParameters) -> Tensor:
    """theta_EZ - alpha_FOV / 2 - beta in rad."""
    return angles.boresight_sun - c.field_of_view / 2 - c.exclusion_buffer


def temperature(x: Tensor, angles: Angles, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Tensor:
    """T_max - T - delta_0 (pi/2 - theta_SI)^+ - delta_1 (pi/2 - theta_EI)^+ in deg C.

    Incidence angles are defined on [0, pi/2], hence the positive parts.
    """
    sun = positive_part(math.pi / 2 - angles.surface_sun, smoothing)
    earth = positive_part(math.pi / 2 - angles.surface_earth, smoothing)
    return c.max_temperature - x[T] - c.temperature_sun_slope * sun - c.temperature_earth_slope * earth


def battery(x: Tensor, angles: Angles, c: InspectionParameters) -> Tensor:
    """E - E_min - delta_2 theta_SI in kJ."""
    return x[E] - c.min_energy - c.energy_sun_slope * angles.panel_sun


def orientation(x: Tensor, c: InspectionParameters, smoothing: Smoothing = EXACT) -> Tensor:
    """Attitude exclusion, temperature and battery, all of relative degree two: (16, ...) to (3, ...)."""
    angles = incidence_angles(x, c, smoothing)
    return torch.stack(
        (attitude_exclusion(angles, c), temperature(x, angles, c, smoothing), battery(x, angles, c))
    )


def angular_velocity(x: Tensor, c: InspectionParameters) -> Tensor:
    """omega_max^2 - omega_i^2 for the three body axes, (3, ...) in rad^2/s^2."""
    return c.max_rate**2 - x[OMEGA] ** 2


def values(x: Tensor, c: InspectionParameters) -> Tensor:
    """All 13 constraints exactly as in the paper, in the order of CONSTRAINTS: (16, ...) to (13, ...)."""
    segments = tuple(c.passive_safety_horizon * i / 5 for i in range(6))
    clearance = clearance_at(x, closest_times(x, segments, c), c).amin(0)
    return torch.cat(
        (
            torch.stack((collision(x, c), dynamic_speed(x, c), keep_in_zone(x, c), clearance)),
            velocity(x, c),
            orientation(x, c),
            angular_velocity(x, c),
        )
    )

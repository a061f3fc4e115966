"""Classical controllers for comparison with agents, within the actuators' limits."""

import math
from collections.abc import Callable

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from inspection.closed_loop import Controller
from inspection.model.attitude import conjugate, cross, dot, norm, rotate, unit
from inspection.model.dynamics import sun_and_earth_in_body, sun_direction
from inspection.model.parameters import AXES, Limits
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, E, P, Q, T, V
from inspection.orbits import Orbit

POINTING_FREQUENCY = 0.1  # rad/s, frequency of the critically damped pointing law
ABOVE = 6  # power of sin(elevation) by which the phase counts less towards the pole, where it is undefined
HELD = 0.3  # largest product of a law's frequency and the time for which its control is held
# The camera's largest angle off the chief; the chief stays in view from 50 m on: 30 deg less asin(10 / 50)
TILT = math.radians(18)
RATE_SHARE = 0.9  # the law's largest body rate, as a share of the limit
LOW = 3.0, 1.0  # energy above its limit, in half turns' energies, between which the battery comes to be low
GLARE = math.radians(30), math.radians(10)  # camera's angle above its Sun limit between which glare rises
ALONG = 8.0  # gain of the roll that aligns thrust with a body axis; `roll` gives its stable range
MUCH = 0.01  # N, thrust across the camera from which on the alignment counts in full
WARM = 3.0, 2.0  # deg C below the temperature limit between which the roll turns from thrust to shade
# angles of the deputy off the Sun between which the chief's visible side turns dark
DUSK = math.radians(90), math.radians(110)

# A tour of every boundary in 2,000 s: start in s and position (m, Hill's frame) of each set point of the LQR. The tour
# has long chords because axis velocities reach their limit only beyond 623 m, where the dynamic speed limit is higher.
SET_POINTS = (
    (0.0, (750.0, -440.0, 0.0)),  # outside the keep-in zone
    (400.0, (720.0, 640.0, 0.0)),  # along y
    (650.0, (350.0, 150.0, 900.0)),  # along z
    (850.0, (-700.0, 240.0, 500.0)),  # along x
    (1100.0, (0.0, 0.0, 0.0)),  # into the chief
)


def limited(thrust_hill: Tensor, torque: Tensor, x: Tensor, c: Limits) -> Tensor:
    """Returns thrust (3, B), turned into the body frame, and torque (3, B), clipped to the actuators' limits."""
    limit = x.new_tensor(c.control_limit)[:, None]
    u = torch.cat((rotate(conjugate(x[Q]), thrust_hill), torque))
    return torch.maximum(torch.minimum(u, limit), -limit)


def point(
    x: Tensor,
    axis: str,
    direction: Tensor,
    c: Limits,
    frequency: float = POINTING_FREQUENCY,
) -> Tensor:
    """Returns the PD torque (3, B) that turns a body axis such as "-y" towards a unit vector (3, B) in Hill's frame."""
    target = rotate(conjugate(x[Q]), direction)
    index, sign = AXES[axis]
    pointed = torch.zeros_like(target)
    pointed[index] = sign
    error = torch.stack(cross(pointed, target))
    inertia = x.new_tensor(c.inertia)[:, None]
    return inertia * (frequency**2 * error - 2.0 * frequency * x[OMEGA])


def lqr_gain(c: Limits) -> np.ndarray:
    """Returns the gain K (3, 6) of the LQR u = -K [p, v].

    It minimises the integral of |p|^2 / (100 m)^2 + |v|^2 / (1 m/s)^2 + |F|^2 / F_max^2.
    """
    n = c.mean_motion
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    a[3, 0], a[3, 4], a[4, 3], a[5, 2] = 3 * n**2, 2 * n, -2 * n, -(n**2)
    b = np.vstack((np.zeros((3, 3)), np.eye(3) / c.mass))
    r = np.eye(3) / c.max_thrust**2
    riccati = scipy.linalg.solve_continuous_are(a, b, np.diag([1e-4] * 3 + [1.0] * 3), r)
    return np.linalg.solve(r, b.T @ riccati)


def lqr_pd(c: Limits) -> Controller:
    """Flies an LQR from set point to set point; a PD law turns side after side into the Sun, past every boundary.

    It stands for the primary controller of the paper's RTA demonstration, about which no more is published.
    """
    gain = torch.from_numpy(lqr_gain(c))
    # turns over, blinds the camera, heats the thermal side; all three leave the panels in the dark
    sunward = ((0.0, "+z"), (40.0, "+x"), (150.0, c.thermal_axis))

    def control(t: float, x: Tensor) -> Tensor:
        target = x.new_tensor([position for start, position in SET_POINTS if start <= t][-1])[:, None]
        axis = [axis for start, axis in sunward if start <= t][-1]
        thrust = -gain.to(x) @ torch.cat((x[P] - target, x[V]))
        torque = point(x, axis, sun_direction(x[THETA_S]), c)
        return limited(thrust, torque, x, c)

    return control


def camera_direction(x: Tensor, outward: Tensor, sun: Tensor, c: Limits) -> Tensor:
    """Returns the camera's target direction (3, B): to the chief as far as power allows, and never to the Sun.

    From the chief the camera is turned away from the Sun until the panels on its back make the power drawn, at most by
    TILT, with the chief in view. It is turned further, up to straight away from the Sun, on the dark side, while the
    battery is low, and where the Sun is near the camera.

    Args:
        outward, sun: unit vectors (3, B) from the chief and to the Sun.
    """
    # kJ that half a turn in the dark takes at most
    half_a_turn = math.pi * (c.power_draw / 1000.0 / c.max_rate + c.energy_sun_slope)
    low = (LOW[0] - (x[E] - c.min_energy) / half_a_turn) / (LOW[0] - LOW[1])
    angle = dot(outward, sun).clamp(-1.0, 1.0).arccos()
    dark = (angle - DUSK[0]) / (DUSK[1] - DUSK[0])
    off_sun = sun_and_earth_in_body(x)[0][0].clamp(-1.0, 1.0).arccos()
    off_limit = off_sun - c.field_of_view / 2 - c.exclusion_buffer
    glare = (GLARE[0] - off_limit) / (GLARE[0] - GLARE[1])
    need = torch.stack((low, dark, glare)).amax(0).clamp(0.0, 1.0)
    # the panels' angle to the Sun at which they make the power drawn; 0 if they never make more
    balanced = math.acos(min(1.0, c.power_draw / brightest(c)))
    tilt = torch.minimum((angle - (1.0 - need) * balanced).clamp(min=0.0), TILT + need * math.pi)
    across = unit(sun - dot(outward, sun) * outward)
    return -(outward * tilt.cos() + across * tilt.sin())


def roll(x: Tensor, light: Tensor, thrust: Tensor, c: Limits) -> Tensor:
    """Returns the roll error (B,) about the camera: a body axis to the thrust, or the thermal side away from the Sun.

    Fuel is the sum of |F| over the body's axes. So the part of the thrust across the camera, of size F at the angle phi
    from y to z, costs least along one of these axes. A roll by psi turns phi into phi - psi. So an error of g sin(4
    phi) / 4 brings the nearest axis to the thrust: it is zero at each axis, with slope g, and half way between two.
    With this error, the held law of `natural_motion` multiplies angle and rate T by [[1 - g h^2 / 2, 1 - h], [-g h^2, 1
    - 2 h]]. That is stable for h < 1 and g h < 4 (Jury); here ALONG HELD = 2.4.

    Where little thrust is wanted, or the temperature is near its limit, the roll turns the thermal side away from the
    Sun instead. The two errors are mixed by shares whose sum is 1, so that no slope exceeds g.

    Args:
        light: unit vector (3, B) to the Sun; thrust: (3, B) in N, both in the body frame.
    """
    cold = torch.zeros_like(light)
    index, sign = AXES[c.thermal_axis]
    cold[index] = -sign
    size = dot(thrust[1:], thrust[1:]).clamp(min=1e-18).sqrt()  # clamped for a finite slope at zero
    y, z = thrust[1:] / size
    warm = (WARM[0] - (c.max_temperature - x[T])) / (WARM[0] - WARM[1])
    share = (size / MUCH).clamp(max=1.0) * (1.0 - warm.clamp(0.0, 1.0))
    quarter_sine = y * z * (y * y - z * z)  # sin(4 phi) / 4
    return share * ALONG * quarter_sine + (1.0 - share) * cross(cold, light)[0]


def pointing_torque(
    x: Tensor, direction: Tensor, sun: Tensor, c: Limits, frequency: float, thrust: Tensor | None = None
) -> Tensor:
    """Returns the PD torque (3, B) that turns the camera to a unit vector (3, B), and rolls about the camera.

    Its error is 2 sin(angle / 2), which, unlike the error of `point`, does not vanish where the camera looks the other
    way. The desired rates stay within the limit: the rate of the roll, and the camera's rate, which no roll delays.

    Args:
        direction, sun: unit vectors (3, B) in Hill's frame, where to look and to the Sun.
        thrust: (3, B) in N in Hill's frame, along which to `roll` a body axis; None: no thrust.
    """
    thrust = torch.zeros_like(direction) if thrust is None else thrust
    target, light, wanted = (rotate(conjugate(x[Q]), each) for each in (direction, sun, thrust))
    camera = torch.zeros_like(target)
    camera[0] = 1.0
    error = torch.stack(cross(camera, target)) / ((1.0 + target[0]) / 2.0).clamp(min=1e-6).sqrt()
    most = 2.0 * RATE_SHARE * c.max_rate / frequency
    error = error * (most / norm(error).clamp(min=1e-9)).clamp(max=1.0)
    error[0] = roll(x, light, wanted, c).clamp(-most, most)
    inertia = x.new_tensor(c.inertia)[:, None]
    return inertia * (frequency**2 * error - 2.0 * frequency * x[OMEGA])


def pointing_frequency(every: float) -> float:
    """Returns the frequency in rad/s of a pointing law whose control is held for `every` s, see `natural_motion`."""
    return min(POINTING_FREQUENCY, HELD / every)


def brightest(c: Limits) -> float:
    """Returns the power in W of panels that face the Sun."""
    return c.panel_performance * c.panel_degradation * c.surface_area


def target_along_ellipse(p: Tensor, wanted: Tensor, orbit: Orbit, n: float) -> tuple[Tensor, Tensor]:
    """Returns the ellipse's point at most `look_ahead` of phase from p (3, B) towards the wanted phase (B,).

    Returns:
        the point and its velocity in free motion, each (3, B). Above or below the chief a position has no phase, and
        nothing is in the way: there the point is the one of the wanted phase.
    """
    a, b = orbit.out_of_plane, orbit.semi_minor
    phase = torch.atan2(p[1] / 2, p[0])
    lag = torch.remainder(wanted - phase + math.pi, 2 * math.pi) - math.pi
    ahead = orbit.look_ahead + (math.pi - orbit.look_ahead) * unit(p)[2] ** ABOVE
    phase = phase + torch.maximum(torch.minimum(lag, ahead), -ahead)
    cos, sin = phase.cos(), phase.sin()
    position = torch.stack((b * cos, 2 * b * sin, a * sin))
    return position, n * torch.stack((b * sin, -2 * b * cos, -a * cos))


def target_on_great_circle(p: Tensor, wanted: Tensor, orbit: Orbit, n: float) -> tuple[Tensor, Tensor]:
    """Returns a point at most `look_ahead` from p (3, B), on the great circle to the wanted phase (B,) of the ellipse.

    The circle is around the chief in coordinates whose along-track axis is shrunk by half, where the ellipse is a
    circle, too. So the path leads over a pole where that is shorter. It depends continuously on its beginning, except
    opposite to its end; a network can learn that. `target_along_ellipse` instead turns back where the phase is half a
    turn from the wanted one.

    Returns:
        the point and its velocity in a free motion of the ellipse's tilt, each (3, B).
    """
    a, b = orbit.out_of_plane, orbit.semi_minor
    goal = torch.stack((wanted.cos(), wanted.sin(), a / b * wanted.sin()))
    here, there = unit(torch.stack((p[0], p[1] / 2, p[2]))), unit(goal)
    across = there - dot(here, there) * here
    angle = torch.atan2(norm(across), dot(here, there))
    ahead = torch.minimum(angle, orbit.look_ahead * torch.ones_like(angle))
    x, y, z = b * norm(goal) * (here * ahead.cos() + unit(across) * ahead.sin())
    return torch.stack((x, 2 * y, z)), n * torch.stack((y, -2 * x, -a / b * x))


def natural_motion(
    c: Limits,
    every: float = 1.0,
    orbit: Orbit | None = None,
    score: Callable[[], Tensor] | None = None,
    rolls: bool = True,
) -> Controller:
    """Flies a PD law to the relative ellipse x = b cos(phi), y = 2 b sin(phi), z = a sin(phi) at phi = theta_S - lead.

    The ellipse is a free motion of the Clohessy-Wiltshire equations that turns with the Sun, so staying on it costs
    almost no fuel. With a > 0 it stays at least min(a, b) from the whole line along the track through the chief, so
    that no drift along this line ends in a collision (D'Amico and Montenbruck 2006: eccentricity and inclination
    vectors apart). Away from the wanted phase the target is a point a little ahead, so that the path leads around the
    chief: without a lead along the ellipse (`target_along_ellipse`), with a lead on a great circle
    (`target_on_great_circle`).

    Without a lead the camera looks at the chief where the panels on its back then make the power drawn. Elsewhere it
    looks away from the Sun, which charges the battery. With a lead, `camera_direction` gives the direction, and
    `pointing_torque` the torque.

    Args:
        every: s for which a control is held, T. The critically damped law, of frequency w, then multiplies angle and
            rate T by [[1 - h^2 / 2, 1 - h], [-h^2, 1 - 2 h]] with h = w T, which is stable for h < 1 (Jury): h <= HELD.
        orbit: None: the default one.
        score: the inspected weight (B,) so far, which a lead needs, such as `Sight.score`.
        rolls: with a lead, a body axis rolls to the thrust, which saves fuel; else only to the shade.

    Raises:
        ValueError: the orbit leads, and no score is given.
    """
    orbit = orbit or Orbit()
    lead = orbit.lead
    if lead and score is None:
        raise ValueError("a lead needs the inspected score")
    n, w = c.mean_motion, orbit.tracking
    pointing = pointing_frequency(every)

    def control(t: float, x: Tensor) -> Tensor:
        sun, outward = sun_direction(x[THETA_S]), unit(x[P])
        wanted = x[THETA_S] - lead.at(score()) if lead and score else x[THETA_S]
        target = target_on_great_circle if lead else target_along_ellipse
        position, velocity = target(x[P], wanted, orbit, n)
        error = position - x[P]
        limit = orbit.approach * (c.docking_speed + c.speed_slope * norm(x[P]))
        nearing = error * torch.minimum(limit / norm(error).clamp(min=1e-9), torch.ones_like(limit) * (w / 2))
        # the law w^2 error + 2 w error', with the approach speed limited
        thrust = 2 * w * c.mass * (nearing + velocity - x[V])
        if lead:
            camera = camera_direction(x, outward, sun, c)
            torque = pointing_torque(x, camera, sun, c, pointing, thrust if rolls else None)
        else:
            away = torch.where(brightest(c) * dot(outward, sun) > c.power_draw, outward, sun)
            torque = point(x, "+x", -away, c, pointing)
        return limited(thrust, torque, x, c)

    return control


def recorded(actions: np.ndarray, step: float) -> Controller:
    """Replays controls (N, 6) in N and N m, one per `step` s; the last one is held."""
    controls = torch.from_numpy(np.ascontiguousarray(actions, dtype=np.float64))

    def control(t: float, x: Tensor) -> Tensor:
        row = min(round(t / step), len(controls) - 1)
        return controls[row].to(x)[:, None].expand(-1, x.shape[1])

    return control


def zero() -> Controller:
    """Applies no control."""
    return lambda t, x: x.new_zeros(CONTROL_SIZE, x.shape[1])


def random(c: Limits, generator: torch.Generator) -> Controller:
    """Draws uniformly random controls anew at every call."""

    def control(t: float, x: Tensor) -> Tensor:
        draw = torch.rand(CONTROL_SIZE, x.shape[1], generator=generator, dtype=x.dtype)
        return (2.0 * draw - 1.0).to(x) * x.new_tensor(c.control_limit)[:, None]

    return control

"""The chief's orbit: how Hill's frame turns, what gravity does in it, and where free flight leads (Sec. Dynamics, PSM).

`orbit = "clohessy-wiltshire"` is the paper's: a circle, and gravity linear in the deputy's position.
`orbit = "two-body"` is exact: both fly on Kepler's orbits about a point mass, the chief's with an eccentricity. Where
the chief is on it follows from the state: the Sun stands still, so its angle theta_S from the radial direction is
`sun_from_perigee` - f with the true anomaly f.

Every function is written for one spacecraft with the component axis first; batch axes trail and broadcast.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import Components, Vector, dot, norm
from inspection.model.parameters import Model
from inspection.model.rk4 import rk4_step
from inspection.model.state import THETA_S, P, V


class Chief(NamedTuple):
    """Where the chief is and how Hill's frame turns, each (...).

    Attributes:
        radius: m from the Earth's centre; climb: m/s, its rate.
        rate: rad/s about z, of Hill's frame; quickening: rad/s^2, its rate.
    """

    radius: Tensor
    climb: Tensor
    rate: Tensor
    quickening: Tensor


def chief_at(theta_s: Tensor, c: Model) -> Chief:
    """The chief on its Kepler orbit, from the Sun's angle (...) in rad (Curtis 2020, Sec. 2.5)."""
    e, f = c.eccentricity, c.sun_from_perigee - theta_s
    parameter = c.semi_major_axis * (1 - e**2)  # m
    speed = math.sqrt(c.gravitational_parameter / parameter)  # m/s
    radius = parameter / (1 + e * f.cos())
    climb = speed * e * f.sin()
    rate = parameter * speed / radius**2
    return Chief(radius, climb, rate, -2 * rate * climb / radius)


def orbit_rate(theta_s: Tensor, c: Model) -> Tensor:
    """rad/s about z, of Hill's frame, from the Sun's angle (...) in rad."""
    return torch.full_like(theta_s, c.mean_motion) if c.is_circular else chief_at(theta_s, c).rate


def sun_angle_after(theta_s: Tensor, seconds: Tensor | float, c: Model) -> Tensor:
    """The Sun's angle (...) in rad so many s later; by one RK4 step where the orbit is none of a circle."""
    if c.is_circular:
        return theta_s - c.mean_motion * seconds
    (after,) = rk4_step(lambda theta: [-orbit_rate(theta[0], c)], [theta_s], seconds)
    return after


def natural_acceleration(p: Components, v: Components, theta_s: Tensor, c: Model) -> Vector:
    """Components in Hill's frame in m/s^2, of a deputy that nothing pushes."""
    if c.orbit == "two-body":
        return two_body(p, v, chief_at(theta_s, c), c.gravitational_parameter)
    return clohessy_wiltshire(p, v, c.mean_motion)


def clohessy_wiltshire(p: Components, v: Components, n: float) -> Vector:
    """Components of the natural acceleration in Hill's frame in m/s^2."""
    return 3 * n**2 * p[0] + 2 * n * v[1], -2 * n * v[0], -(n**2) * p[2]


def two_body(p: Components, v: Components, chief: Chief, mu: float) -> Vector:
    """Components of the natural acceleration in Hill's frame in m/s^2, exact (Alfriend et al. 2010, Eq. 4.14 to 4.16).

    The difference of two nearly equal attractions, mu r_c / r^3 - mu (r_c + p) / |r_c + p|^3, is in Battin's form:
    with 1 + q = |r_c + p|^2 / r^2 it is mu / r^3 ((r_c + p) (1 - (1 + q)^(-3/2)) - p).
    """
    (x, y, z), r, w = p, chief.radius, chief.rate
    q = (2 * r * x + x**2 + y**2 + z**2) / r**2
    weaker = -(-1.5 * q.log1p()).expm1()
    k = mu / r**3
    return (
        2 * w * v[1] + chief.quickening * y + w**2 * x + k * ((r + x) * weaker - x),
        -2 * w * v[0] - chief.quickening * x + w**2 * y + k * (y * weaker - y),
        k * (z * weaker - z),
    )


def coast(x: Tensor, t: Tensor, c: Model) -> Tensor:
    """Position in m after coasting for t s: states (16, ...) and (k, ...) or any shape that broadcasts to (3, *...)."""
    if c.orbit == "two-body":
        return kepler_flight(x[P], x[V], chief_at(x[THETA_S], c), t, c.gravitational_parameter)
    return free_flight(x[P], x[V], t, c.mean_motion)


def free_flight(p: Tensor, v: Tensor, t: Tensor, n: float) -> Tensor:
    """Position after coasting for t s, the closed-form Clohessy-Wiltshire solution (Sec. PSM).

    Args:
        p, v: (3, ...) position in m and velocity in m/s at t = 0.
        t: (k, ...) or any shape that broadcasts against (...), in s.

    Returns:
        (3, *broadcast) in m.
    """
    (x, y, z), (dx, dy, dz) = p, v
    s, co = (n * t).sin(), (n * t).cos()
    return torch.stack(
        (
            (4 - 3 * co) * x + s / n * dx + 2 / n * (1 - co) * dy,
            6 * (s - n * t) * x + y - 2 / n * (1 - co) * dx + (4 * s - 3 * n * t) / n * dy,
            z * co + dz / n * s,
        )
    )


def kepler_flight(p: Tensor, v: Tensor, chief: Chief, t: Tensor, mu: float) -> Tensor:
    """Position after coasting for t s, exact: both on Kepler's orbits, and Hill's frame of then.

    Args, returns: as `free_flight`; the difference of positions of 7,000 km leaves 1e-9 m of rounding.
    """
    zero = torch.zeros_like(chief.radius)
    chief_r = torch.stack((chief.radius, zero, zero))
    chief_v = torch.stack((chief.climb, chief.radius * chief.rate, zero))
    across = torch.stack((-chief.rate * p[1], chief.rate * p[0], torch.zeros_like(p[0])))  # w x p
    chief_then = kepler(chief_r, chief_v, t, mu)
    x, y, z = kepler(chief_r + p, chief_v + v + across, t, mu) - chief_then
    radius = torch.hypot(chief_then[0], chief_then[1])
    cos, sin = chief_then[0] / radius, chief_then[1] / radius
    return torch.stack((cos * x + sin * y, cos * y - sin * x, z))


NEWTON = 8  # steps, in which Kepler's equation converges to rounding below the largest eccentricity allowed


def kepler(r: Tensor, v: Tensor, t: Tensor, mu: float) -> Tensor:
    """Position after t s on a Kepler orbit from r, v (3, ...), by the change of the eccentric anomaly.

    Lagrange's coefficients f and g (Battin 1999, Sec. 4.3); t as in `free_flight`.
    """
    distance = norm(r)
    a = 1 / (2 / distance - dot(v, v) / mu)
    n = (mu / a**3).sqrt()
    s, k = dot(r, v) / (mu * a).sqrt(), 1 - distance / a
    e = passed = n * t  # at first, of the mean anomaly
    for _ in range(NEWTON):
        sin, cos = e.sin(), e.cos()
        e = e - (e + s * (1 - cos) - k * sin - passed) / (1 + s * sin - k * cos)
    f, g = 1 - a / distance * (1 - e.cos()), t - (e - e.sin()) / n
    return torch.stack([f * r_i + g * v_i for r_i, v_i in zip(r, v, strict=True)])


def closest_pass(x: Tensor, horizon: float, c: Model, spacing: float = 10.0) -> Tensor:
    """The position in m next to the chief's centre while coasting for `horizon` s: states (16, k) to (3, k).

    The path is sampled every `spacing` s at most and joined by straight chords, so that a fast pass between two
    samples is not missed; a chord strays from the arc by at most |a| spacing^2 / 8 (0.1 m at 0.01 m/s^2), and the last
    one ends up to `spacing` s after the horizon.

    By Clohessy and Wiltshire one orbit is enough: every later one is the same, moved along the track by
    -6 pi (2 x + v_y / n), and each chord is looked at in the orbit in which its point next to the line along the track
    through the chief is next to the chief.
    """
    orbit = 2.0 * math.pi / c.mean_motion
    repeats = c.orbit == "clohessy-wiltshire" and horizon > orbit
    span = orbit if repeats else horizon
    t = torch.linspace(0.0, span, math.ceil(span / spacing) + 1, dtype=x.dtype, device=x.device)
    path = coast(x[:, None], t[:, None], c)  # (3, times, k)
    start, chord = path[:, :-1], path[:, 1:] - path[:, :-1]
    if repeats:
        drift = -6.0 * math.pi * (2.0 * x[P][0] + x[V][1] / c.mean_motion)  # m an orbit
        orbits = ((horizon - t[:-1, None]) / orbit).floor()
        across = torch.stack((start[0], start[2])), torch.stack((chord[0], chord[2]))
        y = start[1] + share(*across) * chord[1]
        passed = (-y / torch.where(drift == 0.0, torch.inf, drift)).round()
        start = torch.stack((start[0], start[1] + passed.clamp(min=0.0).minimum(orbits) * drift, start[2]))
    closest = start + share(start, chord) * chord
    first = dot(closest, closest).argmin(0)
    return closest.gather(1, first.expand(3, 1, -1))[:, 0]


PASSES = 13  # grid points per segment, in the default ones at most 12 s apart


def closest_times(x: Tensor, segments: tuple[float, ...], c: Model) -> Tensor:
    """When the free flight is nearest to the chief's centre within each segment: (16, ...) to (segments, ...) s.

    The best of a grid, refined by the parabola of |p(t)|^2 through it and its neighbours (exact for a
    straight path, which the path is over two grid steps to a few centimetres).
    """
    edges = x.new_tensor(segments)
    start, spacing = edges[:-1], edges.diff() / (PASSES - 1)
    shape = (-1, *(1,) * (x.dim() - 1))
    grid = start[:, None] + spacing[:, None] * torch.arange(PASSES, dtype=x.dtype, device=x.device)
    times = grid.reshape(*grid.shape, *shape[1:])
    path = coast(x, times, c)
    squared = dot(path, path)  # (segments, PASSES, ...)
    best = squared.argmin(1, keepdim=True)
    centre = best.clamp(1, PASSES - 2)
    before, middle, after = (squared.gather(1, centre + i)[:, 0] for i in (-1, 0, 1))
    bend = before - 2 * middle + after
    offset = torch.where(bend > 0, 0.5 * (before - after) / bend, (best - centre)[:, 0].to(x.dtype))
    return start.reshape(shape) + spacing.reshape(shape) * (centre[:, 0] + offset.clamp(-1.0, 1.0))


def share(start: Tensor, chord: Tensor) -> Tensor:
    """How far along a chord, 0 to 1, it is nearest to the origin."""
    return (-dot(start, chord) / dot(chord, chord).clamp(min=1e-30)).clamp(0.0, 1.0)

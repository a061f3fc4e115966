"""Gravity in Hill's frame, and the path of free flight (Sec. Dynamics, Passively Safe Maneuvers).

The chief's orbit is a circle. Gravity is linear in the deputy's position (Clohessy and Wiltshire).

Every function is written for one spacecraft with the component axis first; batch axes trail and broadcast.
"""

import math

import torch
from torch import Tensor

from inspection.model.attitude import Components, Vector, dot
from inspection.model.parameters import Model
from inspection.model.state import P, V


def clohessy_wiltshire(p: Components, v: Components, n: float) -> Vector:
    """Returns the components of the natural acceleration in Hill's frame in m/s^2 (Sec. Translational Motion)."""
    return 3 * n**2 * p[0] + 2 * n * v[1], -2 * n * v[0], -(n**2) * p[2]


def free_flight(p: Tensor, v: Tensor, t: Tensor, n: float) -> Tensor:
    """Returns the position after t s of coasting, by Clohessy and Wiltshire (Sec. Passively Safe Maneuvers).

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


def closest_pass(x: Tensor, horizon: float, c: Model, spacing: float = 10.0) -> Tensor:
    """Returns the position in m closest to the chief's centre while coasting for `horizon` s: states (16, k) to (3, k).

    The path is sampled at least every `spacing` s and joined by straight chords, so that a fast pass between two
    samples is not missed. A chord is off the arc by at most |a| spacing^2 / 8 (0.1 m at 0.01 m/s^2). The last chord
    ends up to `spacing` s after the horizon.

    One orbit is enough: every later orbit is the same path, moved along the track by -6 pi (2 x + v_y / n). For each
    chord take its point closest to the line along the track through the chief; the chord counts in the orbit in which
    this point is closest to the chief.
    """
    orbit = 2.0 * math.pi / c.mean_motion
    repeats = horizon > orbit
    span = orbit if repeats else horizon
    t = torch.linspace(0.0, span, math.ceil(span / spacing) + 1, dtype=x.dtype, device=x.device)
    path = free_flight(x[P, None], x[V, None], t[:, None], c.mean_motion)  # (3, times, k)
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


PASSES = 13  # grid points per segment, at most 12 s apart in the default segments


def closest_times(x: Tensor, segments: tuple[float, ...], c: Model) -> Tensor:
    """Returns when free flight is closest to the chief's centre within each segment: (16, ...) to (segments, ...) s.

    The best grid point is refined by the parabola of |p(t)|^2 through it and its neighbours. The parabola is exact for
    a straight path; over two grid steps the path is straight to a few centimetres.
    """
    edges = x.new_tensor(segments)
    start, spacing = edges[:-1], edges.diff() / (PASSES - 1)
    shape = (-1, *(1,) * (x.dim() - 1))
    grid = start[:, None] + spacing[:, None] * torch.arange(PASSES, dtype=x.dtype, device=x.device)
    times = grid.reshape(*grid.shape, *shape[1:])
    path = free_flight(x[P], x[V], times, c.mean_motion)
    squared = dot(path, path)  # (segments, PASSES, ...)
    best = squared.argmin(1, keepdim=True)
    centre = best.clamp(1, PASSES - 2)
    before, middle, after = (squared.gather(1, centre + i)[:, 0] for i in (-1, 0, 1))
    bend = before - 2 * middle + after
    offset = torch.where(bend > 0, 0.5 * (before - after) / bend, (best - centre)[:, 0].to(x.dtype))
    return start.reshape(shape) + spacing.reshape(shape) * (centre[:, 0] + offset.clamp(-1.0, 1.0))


def share(start: Tensor, chord: Tensor) -> Tensor:
    """Returns how far along a chord, 0 to 1, it is closest to the origin."""
    return (-dot(start, chord) / dot(chord, chord).clamp(min=1e-30)).clamp(0.0, 1.0)

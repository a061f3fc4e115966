"""Lower bounds of the limits of motion between two tests of a path, from the tested states alone.

A path of position and velocity is known at its nodes. The chord between two nodes is (p, v) linear in a share s of the
way. The path is off the chord by at most e_p in position and e_v in velocity. Each limit has a lower bound on the whole
chord:

    |v(s)|              is convex: at most its chord;  |v_i| likewise
    |p(s)|              is convex: at most its chord, and at least n . p(s), linear, for any direction n
    sqrt(2 a z)         is concave and rises with z, so with z from above it is at least the chord of its ends
    v_r = v . p / |p|   is off its chord by at most (2 |dv| eta + 3 |v| eta^2) / 8 with eta = |dp| / min |p|: its second
                        derivative is 2 dv . u' + v . u'' for the direction u, |u'| <= eta, |u''| <= sqrt(5) eta^2
    p(t) in free flight is linear in (p, v). Between two times it is off its chord by at most (dt)^2 / 8 times the
                        largest |p''(t)|. So all paths from all of a chord within dt lie in the hull of four points,
                        which is beyond the sphere if m . p > R at each of them for one direction m

Beside a hull the collision's z and v_r are the height above a plane and the speed away from it. Both are linear, and m
is the plane's normal. The best of all planes counts.

The distance from the chord is added to each bound: e_p and e_v, and in free flight |Phi_rr| e_p + |Phi_rv| e_v.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.chief.hull import planes_of
from inspection.model.attitude import dot, norm, unit
from inspection.model.orbit import free_flight, share
from inspection.model.parameters import Limits
from inspection.model.state import SIZE, P, V

NEAREST = 1.0  # m, smallest distance to the chief's centre that is used as a divisor
NEVER = 1e3  # m/s; -NEVER stands for a root without a real value


@dataclass(frozen=True)
class FreeFlight:
    """Holds bounds of how free flight over the horizon depends on its initial state (Clohessy and Wiltshire).

    Attributes:
        position: the largest |Phi_rr|; velocity: the largest |Phi_rv| / t.
        bend_position, bend_velocity: the largest |Phi_rr''| in 1/s^2 and |Phi_rv''| in 1/s.
        cells: parts of the horizon; searches: for the direction m in each, by Gilbert's method (1966).
    """

    position: float
    velocity: float
    bend_position: float
    bend_velocity: float
    cells: int
    searches: int

    def times(self, y: Tensor, c: Limits) -> tuple[float, list[Tensor]]:
        """Returns a cell's length in s, and begin and end of each in s: (cells, 1, ...), as many axes as y (6, ...)."""
        cell = c.passive_safety_horizon / self.cells
        first = torch.arange(self.cells, dtype=y.dtype, device=y.device)
        return cell, [(cell * each).reshape(-1, *(1,) * (y.dim() - 1)) for each in (first, first + 1)]

    @classmethod
    def of(cls, c: Limits, cells: int, searches: int) -> "FreeFlight":
        """Computes the bounds on a grid of 1 s, raised by 0.1 %: the entries turn by n t, 0.06 deg per second."""
        n, horizon = c.mean_motion, c.passive_safety_horizon
        t = torch.linspace(horizon / 500, horizon, 500, dtype=torch.float64)
        columns = []
        for i in range(6):
            x = torch.zeros(SIZE, 1, dtype=torch.float64)
            x[i] = 1.0
            columns.append(free_flight(x[P], x[V], t[:, None], n)[..., 0].T)  # (times, 3)
        of_p, of_v = torch.stack(columns[:3], -1), torch.stack(columns[3:], -1)
        s, co, zero = (n * t).sin(), (n * t).cos(), torch.zeros_like(t)

        def matrix(*rows: tuple[Tensor, Tensor, Tensor]) -> Tensor:
            return torch.stack([torch.stack(row, -1) for row in rows], -2)

        bend_p = n**2 * matrix((3 * co, zero, zero), (-6 * s, zero, zero), (zero, zero, -co))
        bend_v = n * matrix((-s, 2 * co, zero), (-2 * co, -4 * s, zero), (zero, zero, -s))
        largest = [torch.linalg.matrix_norm(part, ord=2) for part in (of_p, of_v, bend_p, bend_v)]
        largest[1] = largest[1] / t
        position, velocity, bend_position, bend_velocity = (1.001 * part.max().item() for part in largest)
        return cls(position, velocity, bend_position, bend_velocity, cells, searches)


def least_stretch(slope: Tensor, times: Tensor, n: float) -> Tensor:
    """Returns the least singular value of Phi_rr + slope Phi_rv by times (m,) in s and slopes (k,) in 1/s: (m, k).

    Free flight from p with the velocity slope p stretches p at least by this factor, for any direction of p. Both
    matrices act on x and y together, and on z alone.
    """
    eye = torch.eye(3, dtype=times.dtype)[:, :, None]
    none = torch.zeros_like(eye[0])
    of_p = [free_flight(e, none, times, n) for e in eye]  # (3, times) by initial position
    of_v = [free_flight(none, e, times, n) for e in eye]
    (xx, yx, _), (xy, yy, _), (_, _, zz) = (
        p[:, :, None] + v[:, :, None] * slope for p, v in zip(of_p, of_v, strict=True)
    )
    squares, determinant = xx**2 + xy**2 + yx**2 + yy**2, xx * yy - xy * yx
    flat = ((squares - (squares**2 - 4 * determinant**2).clamp(min=0.0).sqrt()) / 2).sqrt()
    return torch.minimum(flat, zz.abs())


class Strays(NamedTuple):
    """Holds how far a path is off the chord between two nodes, (...).

    Attributes:
        position: m; velocity, speed: m/s, of v in any direction and of |v|.
    """

    position: Tensor
    velocity: Tensor
    speed: Tensor


def between(start: Tensor, end: Tensor, off: Strays, c: Limits, free: FreeFlight) -> Tensor:
    """Returns lower bounds of the limits of motion between two nodes (6, ...) of a path: (7, ...), see the module.

    They have the order and units of `TRANSLATIONAL`, except for velocity: v_max - |v_i| in m/s. Where a root has no
    real value, -NEVER takes its place, so that the result is far below zero.

    Args:
        off: how far the path is off the chord.
    """
    e_p, e_v, e_speed = off
    ends = start, end
    distance, speed = [norm(y[P]) for y in ends], [norm(y[V]) for y in ends]
    n = unit(start[P] + end[P])
    along = [dot(n, y[P]) for y in ends]  # at most the distance
    radial = [dot(y[V], y[P]) / d for y, d in zip(ends, distance, strict=True)]
    nearest, fastest = (torch.minimum(*along) - e_p).clamp(min=NEAREST), torch.maximum(*speed)
    eta = norm(end[P] - start[P]) / nearest
    sag = (2 * norm(end[V] - start[V]) * eta + 3 * fastest * eta**2) / 8 + e_v + fastest * e_p / nearest
    collision, zone, limit = [], [], []
    for d, a, r, v in zip(distance, along, radial, speed, strict=True):
        collision.append(braking(a - e_p - c.collision_radius, c) + r)
        zone.append(braking(c.max_distance - d - e_p, c) - r)
        limit.append(c.docking_speed + c.speed_slope * (a - e_p) - v)
    separation = torch.minimum(*collision) - sag
    if c.planes:  # of the plane whose smaller value of both ends is largest
        planes = planes_of(c, start)
        each = [braking(planes.above(y[P][:, None]) - e_p, c) + planes.along(y[V][:, None]) for y in ends]
        separation = torch.minimum(*each).amax(0) - e_v
    axes = c.max_speed - torch.maximum(start[V].abs(), end[V].abs()) - e_v
    return torch.stack(
        (
            separation,
            torch.minimum(*limit) - e_speed,
            torch.minimum(*zone) - sag,
            clearance(start, end, e_p, e_v, torch.maximum(*distance), fastest, c, free),
            *axes,
        )
    )


def braking(z: Tensor, c: Limits) -> Tensor:
    """Returns sqrt(2 a_max z) in m/s, from which a spacecraft stops within z m."""
    return torch.where(z > 0.0, (2 * c.max_acceleration * z.clamp(min=0.0)).sqrt(), -NEVER)


def clearance(
    start: Tensor,
    end: Tensor,
    e_p: Tensor,
    e_v: Tensor,
    farthest: Tensor,
    fastest: Tensor,
    c: Limits,
    free: FreeFlight,
) -> Tensor:
    """Returns a lower bound in m of the clearance of all free flights that begin between two nodes: (...)."""
    cell, times = free.times(start, c)
    corners = [free_flight(y[P], y[V], t, c.mean_motion) for y in (start, end) for t in times]
    nearest = nearer(corners[0] + corners[2], corners[1] + corners[3]) / 2
    beyond, radius = torch.full_like(nearest[0], -math.inf), c.collision_radius
    if c.planes:
        planes, radius = planes_of(c, start), 0.0
        beyond = torch.stack([planes.above(corner[:, None]) for corner in corners]).amin(0).amax(0)
    for _ in () if c.planes else range(1 + free.searches):
        m = unit(nearest)
        corner, along = least_along(m, corners)
        beyond, nearest = torch.maximum(beyond, along), nearer(nearest, corner)
    beyond = beyond - free.velocity * times[1] * e_v
    bend = (free.bend_position * (farthest + e_p) + free.bend_velocity * (fastest + e_v)) * cell**2 / 8
    return beyond.amin(0) - radius - free.position * e_p - bend


def nearer(first: Tensor, last: Tensor) -> Tensor:
    """Returns the point closest to the origin between two points (3, ...)."""
    chord = last - first
    return first + share(first, chord) * chord


def least_along(direction: Tensor, points: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Returns the point (3, ...) that is least far along a direction (3, ...), and how far it is (...)."""
    best, least = points[0], dot(direction, points[0])
    for point in points[1:]:
        along = dot(direction, point)
        best, least = torch.where(along < least, point, best), torch.minimum(along, least)
    return best, least


def strays(
    start: Tensor,
    end: Tensor,
    seconds: float,
    thrust: Tensor,
    turn: Tensor,
    position: Tensor | float = 0.0,
    velocity: Tensor | float = 0.0,
) -> Strays:
    """Returns the strays of a hold from its nodes (6, ...).

    Thrust is fixed in the body. If the body turns at w at most, a thrust of a m/s^2 deviates from its mean over t by a
    w |s - t/2| across the mean, and by a w^2 (s - t/2)^2 / 2 along it. So the velocity is off its chord by at most e =
    a w t^2 / 8 across thrust and a w^2 t^3 / 60 along it, also where the plant clamps the rates on the way. |v| is off
    by (e |v across thrust| + e^2 / 2) / |v|, plus the part along thrust. A position under a steady acceleration is off
    its chord by |dv| t / 8.

    Args:
        seconds: between the nodes; thrust: its mean in m/s^2, (3, ...); turn: rad/s, (...).
        position, velocity: m and m/s, how far the nodes themselves may be off.
    """
    push = norm(thrust)
    direction = thrust / push.clamp(min=1e-12)
    e_v, along = push * turn * seconds**2 / 8, push * turn**2 * seconds**3 / 60
    e_v = e_v + along
    faster = torch.zeros_like(push)
    for y in (start, end):
        v = y[V]
        across = norm(v - dot(v, direction) * direction)
        faster = torch.maximum(faster, (across + e_v / 2) / norm(v).clamp(min=1e-12))
    e_p = norm(end[V] - start[V]) * seconds / 8 + e_v * seconds
    return Strays(e_p + position, e_v + velocity, e_v * faster.clamp(max=1.0) + along + velocity)


def lowest(parts: Tensor) -> Tensor:
    """Returns the smallest entry, (k, ...) to (...), in operations that fuse; NaN is below everything."""
    least = parts.amin(0)
    return torch.where(least.isnan(), -math.inf, least)

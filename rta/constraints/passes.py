"""Where the free flight is nearest to the chief, and how clear of it, for passive safety (Sec. PSM)."""

from typing import NamedTuple

import torch
from torch import Tensor

from inspection.chief.hull import Planes, planes_of
from inspection.model.attitude import norm
from inspection.model.orbit import closest_times, coast
from inspection.model.parameters import Limits

GRID, HALVINGS = 5, 10  # beside a hull: points per segment, and by how much they are refined, to 0.1 s


class Passes(NamedTuple):
    """Where the free flight is nearest to the chief within each time segment.

    Attributes:
        times: (segments, ...) s; planes: beside a hull one of each segment, (3, segments, ...); None: beside a sphere.
    """

    times: Tensor
    planes: Planes | None = None


def closest_passes(x: Tensor, segments: tuple[float, ...], c: Limits) -> Passes:
    """Of states (16, ...)."""
    return passes_of_hull(x, segments, c) if c.planes else Passes(closest_times(x, segments, c))


def passes_of_hull(x: Tensor, segments: tuple[float, ...], c: Limits) -> Passes:
    """Of states (16, ...) beside a hull: where the highest of the heights above all planes is lowest.

    That is convex in time along a straight path. The least of a grid, then halving by the slope of the plane that is
    the highest, i that falls before and j that rises after. Where they meet, the plane between them that does not rise
    along the path, l n_i + (1 - l) n_j, bounds all of a straight path, as the plane that touches both would.
    """
    edges, every = x.new_tensor(segments), planes_of(c, x)
    shape = (-1, *(1,) * (x.dim() - 1))
    start, spacing = (each.reshape(shape) for each in (edges[:-1], edges.diff() / (GRID - 1)))

    def highest(t: Tensor) -> tuple[Tensor, Tensor]:
        """Height at times (segments, ...) above the highest plane, and which that is."""
        return every.above(coast(x, t, c)[:, None]).max(0)

    def rise(t: Tensor, planes: Planes) -> Tensor:
        """m, of each segment's plane within a tenth of a second."""
        return planes.along(coast(x, t + 0.1, c) - coast(x, t, c))

    grid = torch.stack([highest((start + i * spacing).expand(-1, *x.shape[1:]))[0] for i in range(GRID)])
    best = grid.argmin(0)
    low, high = (start + spacing * (best + i).clamp(0, GRID - 1) for i in (-1, 1))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        rises = rise(middle, every.those(highest(middle)[1])) > 0.0
        low, high = torch.where(rises, low, middle), torch.where(rises, middle, high)
    before, after = (every.those(highest(t)[1]) for t in (low, high))
    falls, rises = -rise(low, before), rise(high, after)
    share = torch.where(falls + rises > 0.0, rises / (falls + rises), 0.5)  # of the plane before
    share = torch.where(falls <= 0.0, 1.0, torch.where(rises <= 0.0, 0.0, share))
    between = Planes(*(share * one + (1.0 - share) * other for one, other in zip(before, after, strict=True)))
    return Passes(share * low + (1.0 - share) * high, between)


def clearance_at(x: Tensor, passes: Passes, c: Limits) -> Tensor:
    """|p(t)| - r_d - r_c, or n . p(t) - b - r_d, in m after coasting to each of k passes: (16, ...) to (k, ...).

    With `closest_passes` its gradient is that of the infimum (envelope theorem).
    """
    times, planes = passes
    directions = (1,) * (x.dim() - times.dim())  # that x has before the batch
    p = coast(x, times.reshape(len(times), *directions, *times.shape[1:]), c)
    return planes.above(p) if planes else norm(p) - c.collision_radius

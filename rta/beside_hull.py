"""Safe separation and passive safety beside the chief's convex hull, in place of the sphere around it.

Outside a convex body one separating plane is enough. So each h is the largest over the planes n . p = b that touch the
body (`inspection.chief.hull`). The slope of h is that of its best plane (envelope theorem).
"""

import torch
from torch import Tensor

from inspection.chief.hull import Planes, planes_of
from inspection.model.orbit import free_flight
from inspection.model.parameters import Limits
from inspection.model.state import P, V
from rta.limits import PAPER, PARTS, Limit, root

GRID, HALVINGS = 5, 10  # points in each part of the free flight, then halvings that refine them to 0.1 s


def safe_separation(x: Tensor, c: Limits) -> Tensor:
    """Returns max over planes of sqrt(2 a_max (n . p - b - r_d)) + n . v, m/s: states (16, ...) to (...)."""
    every = planes_of(c, x)

    def speed_left(y: Tensor, planes: Planes) -> Tensor:
        height, speed = planes.above(y[P][:, None]), planes.along(y[V][:, None])
        return root(2 * c.max_acceleration * height) + speed

    best = speed_left(x.detach(), every).argmax(0, keepdim=True)
    return speed_left(x, every.those(best))[0]


def passive_safety(x: Tensor, c: Limits) -> Tensor:
    """Returns inf over the free flight of the next T_f of the height above the planes, less r_d, in m: (...)."""
    times, planes = passes(x.detach(), c)
    return planes.above(free_flight(x[P], x[V], times, c.mean_motion)).amin(0)


def passes(x: Tensor, c: Limits) -> tuple[Tensor, Planes]:
    """Returns times (PARTS, ...) in s and planes where free flight from states (16, ...) is closest in each of PARTS.

    The largest height above all planes is convex in time along a straight path. Its minimum is found on a grid, then by
    halving, with the slope of the highest plane: plane i, which falls, before it, and plane j, which rises, after it.
    Where the two meet, the plane between them that does not rise along the path, l n_i + (1 - l) n_j, bounds all of a
    straight path, as the plane that touches both would.
    """
    every = planes_of(c, x)
    edges = x.new_tensor([c.passive_safety_horizon * i / PARTS for i in range(PARTS + 1)])
    shape = (-1, *(1,) * (x.dim() - 1))
    start, spacing = (each.reshape(shape) for each in (edges[:-1], edges.diff() / (GRID - 1)))

    def path(t: Tensor) -> Tensor:
        return free_flight(x[P], x[V], t, c.mean_motion)

    def highest(t: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the height at times (PARTS, ...) above the highest plane, and the index of this plane."""
        return every.above(path(t)[:, None]).max(0)

    def rise(t: Tensor, planes: Planes) -> Tensor:
        """Returns in m by how much each part's plane rises along the path within 0.1 s."""
        return planes.along(path(t + 0.1) - path(t))

    grid = torch.stack([highest((start + i * spacing).expand(-1, *x.shape[1:]))[0] for i in range(GRID)])
    best = grid.argmin(0)
    low, high = (start + spacing * (best + i).clamp(0, GRID - 1) for i in (-1, 1))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        rises = rise(middle, every.those(highest(middle)[1])) > 0.0
        low, high = torch.where(rises, low, middle), torch.where(rises, middle, high)
    before, after = (every.those(highest(t)[1]) for t in (low, high))
    falls, rises = -rise(low, before), rise(high, after)
    share = torch.where(falls + rises > 0.0, rises / (falls + rises), 0.5)  # of the plane that falls
    share = torch.where(falls <= 0.0, 1.0, torch.where(rises <= 0.0, 0.0, share))
    between = Planes(*(share * one + (1.0 - share) * other for one, other in zip(before, after, strict=True)))
    return share * low + (1.0 - share) * high, between


BESIDE_HULL: dict[str, Limit] = {
    "collision": PAPER["collision"]._replace(h=safe_separation),
    "passive_safety": PAPER["passive_safety"]._replace(h=passive_safety),
}

"""The chief's inspection points: weights, visibility, illumination and the nearest uninspected cluster.

The points are unit normals n (3, N) on a sphere of radius r_c. Masks per point are (N, B) (Sec. RL Environment).
"""

import math
from collections.abc import Callable
from functools import partial, reduce

import torch
from torch import Tensor

from inspection.model.attitude import body_axis, dot, norm, unit
from inspection.model.dynamics import sun_direction
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, P, Q

LLOYD_ITERATIONS = 5
CHUNK = 256  # columns whose per-point values fit into the caches of a CPU


def fibonacci_sphere(count: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    """Returns `count` nearly equidistant unit vectors, (3, count), along the golden-angle spiral."""
    i = torch.arange(count, dtype=dtype, device=device)
    z = 1 - (2 * i + 1) / count
    azimuth = i * math.pi * (3 - math.sqrt(5.0))
    radius = (1 - z**2).sqrt()
    return torch.stack((radius * azimuth.cos(), radius * azimuth.sin(), z))


def point_weights(normals: Tensor, priority: Tensor, areas: Tensor | None = None) -> Tensor:
    """Returns weights (N, B) that sum to 1 over the points.

    A weight is proportional to the angle between the normal and the opposite of priority (3, B), and to the area (N,).
    """
    angle = (-(normals.T @ priority)).clamp(-1.0, 1.0).arccos()
    if areas is not None:
        angle = angle * areas[:, None]
    return angle / angle.sum(0)


def in_view(normals: Tensor, x: Tensor, c: InspectionParameters) -> Tensor:
    """Checks from states x (16, B) which points are lit, and which of these are in view, (2, N, B) bool.

    A point is in view within the camera's cone about +n_x and above the near-side horizon.
    """
    p, r = x[P], c.chief_radius
    boresight = torch.stack(body_axis(x[Q], 0))
    height = normals.T @ p  # p . n
    to_point = (r**2 + dot(p, p) - 2 * r * height).sqrt()
    along_boresight = r * (normals.T @ boresight) - dot(p, boresight)
    in_cone = along_boresight - math.cos(c.field_of_view / 2) * to_point
    lit = normals.T @ sun_direction(x[THETA_S])
    return torch.stack((lit, reduce(torch.minimum, (lit, in_cone, height - r)))) > 0.0


def max_clusters(normals: Tensor, c: InspectionParameters, turns: bool = False) -> int:
    """Returns the largest k = ceil(n / points_per_cluster) for any lit hemisphere on the Sun's circle.

    With `turns` the Sun may be in any direction, as for a chief that turns. Only some directions are tested, so one
    cluster is added as a margin.
    """
    if turns:
        suns = fibonacci_sphere(3600, normals.dtype, str(normals.device))
    else:
        suns = sun_direction(
            torch.linspace(0.0, 2 * math.pi, 3600, dtype=normals.dtype, device=normals.device)
        )
    most = int((normals.T @ suns > 0.0).sum(0).max()) + turns * c.points_per_cluster
    return -(-min(most + 1, normals.shape[1]) // c.points_per_cluster)


def seed_clusters(
    points: Tensor, wanted: Tensor, centres: Tensor, alive: Tensor, count: Tensor
) -> tuple[Tensor, Tensor]:
    """Puts every missing one of the first `count` centres on the wanted point farthest from the other centres.

    Args and returns are as in `cluster`. The result is deterministic: ties go to the lowest point index.
    """
    slots = torch.arange(alive.shape[0], device=alive.device)[:, None]
    missing = (slots < count) & ~alive
    gap = distance_squared(points, centres).masked_fill(~alive, math.inf).amin(1)  # (N, B)
    for j in torch.nonzero(missing.any(1)).flatten().tolist():
        farthest = gap.masked_fill(~wanted, -1.0).argmax(0)
        seed = points[:, farthest]
        centres = torch.where(missing[j] & (slots == j), seed[:, None], centres)
        gap = torch.where(missing[j], torch.minimum(gap, distance_squared(points, seed[:, None])[:, 0]), gap)
    return centres, (alive | missing) & (slots < count)


def distance_squared(points: Tensor, centres: Tensor) -> Tensor:
    """Returns |point - centre|^2, (N, k, B), for points (3, N) and centres (3, k, B)."""
    k, batch = centres.shape[1:]
    inner = (points.T @ centres.reshape(3, -1)).reshape(-1, k, batch)
    return dot(points, points)[:, None, None] + dot(centres, centres) - 2 * inner


def lloyd(points: Tensor, centres: Tensor, wanted: Tensor, alive: Tensor) -> list[Tensor]:
    """Runs one iteration of Lloyd: every living centre moves to the mean of the wanted points nearest to it.

    A point with several equally near centres counts for each of them. Args are as in `cluster`. Returns the centres
    (3, K, B) and how many points each has (K, B). Matrix products in homogeneous coordinates [p, 1] find the nearest
    centres and add up their points, one slot after the other.
    """
    homogeneous = torch.cat((points, torch.ones_like(points[:1])))
    offset = torch.where(alive, dot(centres, centres), math.inf)
    # |p - m|^2 - |p|^2 = [p, 1] . [-2 m, |m|^2], (N, B) per slot
    gaps = [homogeneous.T @ slot for slot in torch.cat((-2.0 * centres, offset[None])).unbind(1)]
    least = torch.where(wanted, reduce(torch.minimum, gaps), -math.inf)
    total = torch.stack([homogeneous @ (gap == least).to(points.dtype) for gap in gaps], 1)
    size = total[3]
    return [torch.where(size > 0, total[:3] / size.clamp(min=1.0), centres), size]


def settled(points: Tensor, centres: Tensor, wanted: Tensor, alive: Tensor) -> list[Tensor]:
    """Returns what `lloyd` returns after LLOYD_ITERATIONS."""
    new, size = lloyd(points, centres, wanted, alive)
    moving = torch.nonzero((new != centres).any(0).any(0)).flatten()
    for _ in range(LLOYD_ITERATIONS - 1):
        if not moving.numel():
            break
        # once an iteration leaves a column unchanged, every further iteration would, too
        before = new[..., moving]
        after, size[:, moving] = lloyd(points, before, wanted[:, moving], alive[:, moving])
        new[..., moving] = after
        moving = moving[(after != before).any(0).any(0)]
    return [new, size]


def cluster(
    points: Tensor,
    wanted: Tensor,
    centres: Tensor,
    alive: Tensor,
    per_cluster: int,
    settle: Callable[[Tensor, Tensor, Tensor], list[Tensor]] | None = None,
) -> tuple[Tensor, Tensor]:
    """Runs batched k-means (Lloyd) on the wanted points, warm-started from the previous step's centres.

    Args:
        points: (3, N) positions.
        wanted: (N, B) bool, the points to cluster; k = ceil(wanted / per_cluster) per column.
        centres, alive: (3, K, B) and (K, B) bool, the previous centres and which of them hold a cluster.
        settle: computes `settled` of these points; None: `settled` itself.

    Returns:
        The new centres (3, K, B) and alive (K, B).
    """
    settle = settle or partial(by_chunks, partial(settled, points))
    count = -(-wanted.sum(0) // per_cluster)
    slots = torch.arange(alive.shape[0], device=alive.device)[:, None]
    alive = alive & (slots < count)
    short = torch.nonzero(alive.sum(0) < count).flatten()
    if short.numel():
        centres, alive = centres.clone(), alive.clone()
        centres[..., short], alive[:, short] = seed_clusters(
            points, wanted[:, short], centres[..., short], alive[:, short], count[short]
        )
    new, size = settle(centres, wanted, alive)
    return new, alive & (size > 0)


def by_chunks(function: Callable[..., list[Tensor]], *tensors: Tensor) -> list[Tensor]:
    """Returns function(*tensors), computed a few columns at once on a CPU; the tensors' last axis is the batch."""
    if tensors[0].device.type != "cpu":
        return function(*tensors)
    chunks = zip(*(tensor.split(CHUNK, -1) for tensor in tensors), strict=True)
    found = [function(*(part.contiguous() for part in chunk)) for chunk in chunks]
    return [torch.cat(parts, -1) for parts in zip(*found, strict=True)]


def nearest_cluster(centres: Tensor, alive: Tensor, p: Tensor) -> Tensor:
    """Returns r_UPS: unit vectors (3, B) from the chief to the living centre nearest to p (3, B); zeros if none."""
    gap = norm(centres - p[:, None]).masked_fill(~alive, math.inf)
    nearest = gap.argmin(0)
    centre = centres.gather(1, nearest.expand(3, 1, -1))[:, 0]
    return torch.where(alive.any(0), unit(centre), 0.0)

"""The chief's convex hull as what to stay clear of, in place of the sphere of `chief_radius` around it.

Beside a convex body there is a plane that separates: n . p - b > 0 with the body's support b = max n . corner. `PLANES`
are tried, and the body's own faces. Each is a lower bound of the distance, so that a plane may be chosen at will.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from torch import Tensor

from inspection.chief.mesh import path_of, read
from inspection.chief.points import fibonacci_sphere
from inspection.model.attitude import dot, norm, rotate, unit
from inspection.model.parameters import ChiefParameters, InspectionParameters, Limits

PLANES = 100  # in directions spread over the sphere, about 0.35 rad apart
MOST_FACES = 100  # of the hull, the largest ones: each takes time at every call


@dataclass(frozen=True)
class TaskWithHull(InspectionParameters):
    """The task where the chief is what `planes` enclose; made by `with_hull`, not read from a file."""

    planes: tuple[tuple[float, ...], ...] = ()  # n and b: n . p <= b in m for all of the chief

    @property
    def least_distance(self) -> float:
        """m from the chief's centre at which the deputy touches it, at the nearest."""
        return self.deputy_radius + min(b for *_, b in self.planes)


def with_hull(c: InspectionParameters, chief: ChiefParameters) -> InspectionParameters:
    """The task with what `chief.collision` says to stay clear of.

    Raises:
        ValueError: the mesh has no volume, or its origin is outside of it.
    """
    if chief.collision == "sphere":
        return c
    arrays = read(chief.mesh)
    corners = arrays["triangles"].reshape(-1, 3) if arrays["triangles"].size else arrays["points"]
    try:
        faces = faces_of(ConvexHull(corners))
    except (QhullError, ValueError):  # the latter of too few
        raise ValueError(
            f"mesh = {path_of(chief.mesh)!r}: has no convex hull: its corners are all in a plane"
        ) from None
    directions = unit(torch.cat((fibonacci_sphere(PLANES), torch.from_numpy(faces).T), 1))
    support = (torch.from_numpy(corners) @ directions).amax(0)
    if not support.min() > 0.0:
        raise ValueError(f"mesh = {path_of(chief.mesh)!r}: its origin must lie within its hull")
    attitude = unit(torch.tensor(chief.attitude, dtype=torch.float64))[:, None].expand(4, support.numel())
    planes = torch.cat((rotate(attitude, directions), support[None])).T
    return TaskWithHull(**vars(c), planes=tuple(map(tuple, planes.tolist())))


def faces_of(hull: ConvexHull) -> np.ndarray:
    """Normals (k, 3) of its MOST_FACES largest faces."""
    normals, which = np.unique(hull.equations[:, :3].round(6), axis=0, return_inverse=True)
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.bincount(which.ravel(), np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return normals[np.sort(np.argsort(-areas, kind="stable")[:MOST_FACES])]


class Planes(NamedTuple):
    """Some planes around the chief, moved out by the deputy's radius: n . p <= b is on the chief's side.

    Attributes:
        normals: (3, k, ...), unit; offsets: (k, ...) in m; trailing axes as those of the states that they belong to.
    """

    normals: Tensor
    offsets: Tensor

    def above(self, p: Tensor) -> Tensor:
        """n . p - b in m of positions (3, k or 1, ...): (k, ...)."""
        return self.along(p) - widened(self.offsets, p.dim() - 1, 1)

    def along(self, v: Tensor) -> Tensor:
        """n . v of vectors (3, k or 1, ...): (k, ...)."""
        return dot(widened(self.normals, v.dim(), 2), v)

    def those(self, which: Tensor) -> "Planes":
        """Of planes without trailing axes, those of indices (k, ...)."""
        return Planes(self.normals[:, which], self.offsets[which])


def widened(tensor: Tensor, dimensions: int, ahead: int) -> Tensor:
    """With axes of one entry after the first `ahead`."""
    shape = tensor.shape
    return tensor.reshape(*shape[:ahead], *(1,) * (dimensions - tensor.dim()), *shape[ahead:])


def planes_of(c: Limits, like: Tensor) -> Planes:
    """All of a task's, (3, planes) and (planes,)."""
    *normals, offsets = like.new_tensor(c.planes).T
    return Planes(torch.stack(normals), offsets + c.deputy_radius)


def clearance(p: Tensor, c: Limits) -> Tensor:
    """What is left between deputy and chief at p (3, ...) in m: exact beside a sphere, a lower bound beside a hull."""
    return planes_of(c, p).above(p[:, None]).amax(0) if c.planes else norm(p) - c.collision_radius


def farthest(c: Limits) -> float:
    """m from the chief's centre, beyond which `clearance` is positive."""
    if not c.planes:
        return c.collision_radius
    planes = planes_of(c, torch.zeros(3, dtype=torch.float64))
    sides = torch.cat((planes.normals, -planes.offsets[None])).T.numpy()
    return float(np.linalg.norm(HalfspaceIntersection(sides, np.zeros(3)).intersections, axis=1).max())


def reach(direction: Tensor, c: Limits) -> Tensor:
    """The distance from the chief's centre in m at which `clearance` is zero, in unit directions (3, B)."""
    if not c.planes:
        return torch.full_like(direction[0], c.collision_radius)
    planes = planes_of(c, direction)
    rise = planes.along(direction[:, None])
    return torch.where(rise > 0.0, planes.offsets[:, None] / rise, torch.inf).amin(0)

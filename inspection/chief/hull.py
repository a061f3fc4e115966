"""The chief's convex hull as its collision geometry, in place of the sphere of `chief_radius` around it.

Outside a convex body some plane separates a position p from the body: n . p - b > 0, with the body's support
b = max n . corner. The code tries `PLANES` directions and the body's own faces. Each plane gives a lower bound of the
distance, so any plane may be chosen.
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

PLANES = 100  # their directions are spread over the sphere, about 0.35 rad apart
MOST_FACES = 100  # only the hull's largest faces: each face takes time at every call


@dataclass(frozen=True)
class TaskWithHull(InspectionParameters):
    """Describes the task whose chief is enclosed by `planes`; `with_hull` makes it, it is not read from a file."""

    planes: tuple[tuple[float, ...], ...] = ()  # n, b: n . p <= b in m for the chief's points p

    @property
    def least_distance(self) -> float:
        """Returns the smallest distance in m from the chief's centre at which the deputy touches the chief."""
        return self.deputy_radius + min(b for *_, b in self.planes)


def with_hull(c: InspectionParameters, chief: ChiefParameters) -> InspectionParameters:
    """Returns the task with the collision geometry that `chief.collision` names.

    Raises:
        ValueError: the mesh has no volume, or its origin is outside of it.
    """
    if chief.collision == "sphere":
        return c
    arrays = read(chief.mesh)
    corners = arrays["triangles"].reshape(-1, 3) if arrays["triangles"].size else arrays["points"]
    try:
        faces = faces_of(ConvexHull(corners))
    except (QhullError, ValueError):  # ValueError: too few corners
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
    """Returns the normals (k, 3) of the hull's MOST_FACES largest faces."""
    normals, which = np.unique(hull.equations[:, :3].round(6), axis=0, return_inverse=True)
    a, b, c = hull.points[hull.simplices].transpose(1, 0, 2)
    areas = np.bincount(which.ravel(), np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return normals[np.sort(np.argsort(-areas, kind="stable")[:MOST_FACES])]


class Planes(NamedTuple):
    """Holds some planes around the chief, moved out by the deputy's radius: n . p <= b is the chief's side.

    Attributes:
        normals: (3, k, ...) unit vectors; offsets: (k, ...) in m. The trailing axes are those of the states.
    """

    normals: Tensor
    offsets: Tensor

    def above(self, p: Tensor) -> Tensor:
        """Returns n . p - b in m, (k, ...), for positions (3, k or 1, ...)."""
        return self.along(p) - widened(self.offsets, p.dim() - 1, 1)

    def along(self, v: Tensor) -> Tensor:
        """Returns n . v, (k, ...), for vectors (3, k or 1, ...)."""
        return dot(widened(self.normals, v.dim(), 2), v)

    def those(self, which: Tensor) -> "Planes":
        """Returns the planes of indices (k, ...); these planes must not have trailing axes."""
        return Planes(self.normals[:, which], self.offsets[which])


def widened(tensor: Tensor, dimensions: int, ahead: int) -> Tensor:
    """Returns the tensor with axes of length one inserted after its first `ahead` axes."""
    shape = tensor.shape
    return tensor.reshape(*shape[:ahead], *(1,) * (dimensions - tensor.dim()), *shape[ahead:])


def planes_of(c: Limits, like: Tensor) -> Planes:
    """Returns all planes of a task, normals (3, planes) and offsets (planes,)."""
    *normals, offsets = like.new_tensor(c.planes).T
    return Planes(torch.stack(normals), offsets + c.deputy_radius)


def clearance(p: Tensor, c: Limits) -> Tensor:
    """Returns the distance from deputy to chief at p (3, ...) in m: exact for a sphere, a lower bound for a hull."""
    return planes_of(c, p).above(p[:, None]).amax(0) if c.planes else norm(p) - c.collision_radius


def farthest(c: Limits) -> float:
    """Returns the distance in m from the chief's centre beyond which `clearance` is positive."""
    if not c.planes:
        return c.collision_radius
    planes = planes_of(c, torch.zeros(3, dtype=torch.float64))
    sides = torch.cat((planes.normals, -planes.offsets[None])).T.numpy()
    return float(np.linalg.norm(HalfspaceIntersection(sides, np.zeros(3)).intersections, axis=1).max())


def reach(direction: Tensor, c: Limits) -> Tensor:
    """Returns the distance in m from the chief's centre at which `clearance` is zero, along unit directions (3, B)."""
    if not c.planes:
        return torch.full_like(direction[0], c.collision_radius)
    planes = planes_of(c, direction)
    rise = planes.along(direction[:, None])
    return torch.where(rise > 0.0, planes.offsets[:, None] / rise, torch.inf).amin(0)

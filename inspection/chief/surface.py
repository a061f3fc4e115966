"""The chief's surface: points with normals and areas, on the paper's sphere or a mesh, and which points are hidden.

A mesh may hide its own points from the camera and from the Sun. Seen from a point, a face with three or four corners
covers a cone of directions. The planes through the point and two neighbouring corners bound this cone. The planes are
computed once. A point is hidden from a spacecraft or the Sun that lies inside one of the point's cones.
"""

import math
from functools import lru_cache, reduce
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.chief.mesh import (
    AT_ONCE,
    EXACT,
    check_winding,
    enclosed,
    faces,
    is_closed,
    path_of,
    read,
    sampled,
    with_digest,
)
from inspection.chief.points import fibonacci_sphere
from inspection.model.attitude import body_axis, conjugate, dot, norm, rotate, unit
from inspection.model.dynamics import sun_direction
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import THETA_S, P, Q

FLAT = 1e-9  # m^3, volume below which a cone counts as empty
DIRECTIONS = 512, 20_000  # tried per point of a mesh, to leave out points that are never seen
GROUPS = 6  # groups of points with similar numbers of cones, so that few computed cones are only padding


class Surface(NamedTuple):
    """Holds the surface to inspect, in the chief's frame.

    Attributes:
        points: (3, N) in m; normals: (3, N); areas: (N,) in m^2.
        triangles: (F, 3, 3) m, corner by corner; a sphere has none.
        cones: one tensor (n, K, k, 4) float32 per group of points, groups with few cones first. For k points with K
            cones each, it holds the n planes m . p + b = 0 around each cone as [m, b]; m points inwards.
    """

    points: Tensor
    normals: Tensor
    areas: Tensor
    triangles: Tensor
    cones: tuple[Tensor, ...] = ()

    def part(self, which: Tensor | list[int], cones: tuple[Tensor, ...] = ()) -> "Surface":
        """Returns the surface of some points, by their indices or a mask (N,), with the cones of these points."""
        return Surface(
            self.points[:, which], self.normals[:, which], self.areas[which], self.triangles, cones
        )


def surface(chief: ChiefParameters, c: InspectionParameters, device: torch.device | str = "cpu") -> Surface:
    """Returns the chief's surface; raises ValueError if its file holds none, or reaches beyond `chief_radius`."""
    if not chief.mesh:
        normals = fibonacci_sphere(c.num_points, device=str(device))
        areas = torch.ones_like(normals[0])
        none = normals.new_zeros(0, 3, 3)
        return Surface(c.chief_radius * normals, normals, areas, none)
    *parts, cones = of_mesh(with_digest(chief.mesh), c.num_points, c.chief_radius)
    points, normals, areas, triangles = (part.to(device) for part in parts)
    return Surface(points, normals, areas, triangles, tuple(group.to(device) for group in cones))


@lru_cache(maxsize=4)  # a large mesh takes minutes; the key contains the file's digest
def of_mesh(mesh: str, count: int, largest: float) -> Surface:
    """Returns the surface of a file (`with_digest`) within the radius `largest` in m; raises ValueError as `surface`.

    If the file has no points, `count` points are sampled on its triangles.
    """
    arrays = {name: torch.from_numpy(array) for name, array in read(mesh).items()}
    triangles = arrays["triangles"]
    if "points" in arrays:
        points, normals, areas = arrays["points"].T, arrays["normals"].T, arrays["areas"]
        if not ((areas >= 0.0).all() and 0.0 < areas.sum() < math.inf and (norm(normals) > 0.0).all()):
            raise ValueError(f"{path_of(mesh)}: areas must not be negative or all zero, normals not zero")
    else:
        check_winding(triangles, path_of(mesh))
        points, normals, areas = sampled(triangles, count)
    reach = max(float(norm(each).max()) for each in (points, triangles.flatten(0, 1).T) if each.numel())
    if not reach <= largest:
        raise ValueError(
            f"{path_of(mesh)}: reaches {reach:,.4g} m from its origin: must lie within chief_radius, {largest:g} m"
            + (" (is it in mm?)" if reach > 100.0 * largest else "")
        )
    return ever_seen(Surface(points, unit(normals), areas, triangles), mesh)


def hiding(whole: Surface) -> list[Tensor]:
    """Returns for each point the planes (n, K, 3) around the cones of the K faces, of n corners, that can hide it.

    Only faces that rise above the point's horizon can hide it. For a closed mesh only the faces that face the point
    count: a ray that leaves the mesh through another face enters it again through one of them.
    """
    points, normals, all_faces = whole.points.T, whole.normals.T, faces(whole.triangles)
    diagonals = all_faces[:, 2] - all_faces[:, 0], all_faces[:, -1] - all_faces[:, 1]
    outwards = unit(torch.linalg.cross(*diagonals).T).T
    closed = is_closed(whole.triangles)
    found: list[Tensor] = []
    for some in torch.arange(len(points)).split(max(1, AT_ONCE // max(1, len(all_faces)))):
        # corners as seen from the points, (n corners, k points, F, 3)
        corners = all_faces.transpose(0, 1)[:, None] - points[some, None]
        hides = ((corners * normals[some, None]).sum(-1) > EXACT).any(0)
        if closed:
            hides &= (corners[0] * outwards).sum(-1) < -FLAT
        planes = torch.linalg.cross(corners, corners.roll(-1, 0))
        volume = (planes[0] * corners[2] + planes[2] * corners[0]).sum(-1)
        hides &= volume.abs() > FLAT
        planes = torch.nn.functional.normalize(planes * volume.sign()[..., None], dim=-1)
        of_a_repeated_corner = (planes == 0.0).all(-1, keepdim=True)
        planes = torch.where(of_a_repeated_corner, planes[:1], planes)
        found += [planes[:, i, hides[i]] for i in range(len(some))]
    return found


def hidden(planes: Tensor, directions: Tensor) -> Tensor:
    """Checks which directions (3, k) from a point lie in one of its cones, (k,) bool; the planes are (n, K, 3)."""
    return (planes @ directions > 0.0).all(0).any(0)


def cuts(counts: list[int]) -> list[int]:
    """Returns where to cut ascending counts into GROUPS, one cut after the other, each where it saves the most."""
    found = [0, len(counts)]
    rises = [i for i, (before, after) in enumerate(pairwise(counts), 1) if before < after]
    for _ in range(GROUPS - 1):
        found = min(
            (sorted({*found, i}) for i in rises),
            key=lambda ends: sum((end - begin) * counts[end - 1] for begin, end in pairwise(ends)),
            default=found,
        )
    return found


def grouped(whole: Surface, planes: list[Tensor], keep: Tensor) -> Surface:
    """Returns the surface of the points to keep (N,) bool in GROUPS, points with few cones first."""
    order = sorted(keep.nonzero().flatten().tolist(), key=lambda i: planes[i].shape[1])
    cones = []
    for begin, end in pairwise(cuts([planes[i].shape[1] for i in order])):
        group = order[begin:end]
        most = planes[group[-1]].shape[1]
        points, normals = whole.points[:, group].T, whole.normals[:, group].T
        # padding cones hide nothing above the horizon
        some = -normals[None, None].repeat(len(planes[0]), most, 1, 1)
        for k, i in enumerate(group):
            some[:, : planes[i].shape[1], k] = planes[i]
        offsets = -(some * points).sum(-1, keepdim=True)  # a plane goes through its point
        cones.append(torch.cat((some, offsets), -1).float())
    return whole.part(order, tuple(cones))


def ever_seen(whole: Surface, name: str) -> Surface:
    """Returns the surface with its cones, without the points that are hidden from every direction.

    Points inside a closed mesh or a part of it are left out first: seen from inside, its triangles hide nothing. Raises
    ValueError if no point is left; `name` is the mesh for the message.
    """
    if is_closed(whole.triangles):
        outside = ~enclosed(whole.points + 1e-4 * whole.normals, whole.triangles)
        whole = whole.part(outside)
    unseen = f"mesh = {path_of(name)!r}: none of its points can be seen: do its normals point outwards?"
    if not len(whole.areas):
        raise ValueError(unseen)
    planes = hiding(whole)
    seen = torch.zeros_like(whole.areas, dtype=torch.bool)
    for count in DIRECTIONS:  # try more directions for points not seen yet, such as those inside a tube
        far = fibonacci_sphere(count)
        for i in (~seen).nonzero().flatten().tolist():
            seen[i] = (far.T @ whole.normals[:, i] > 0.0)[~hidden(planes[i], far)].any()
    if not seen.any():
        raise ValueError(unseen)
    return grouped(whole, planes, seen)


def groups(whole: Surface, least: int) -> list[tuple[Surface, int]]:
    """Returns the parts of a surface whose points have equally many cones, and how many points each part has.

    The points of a part are repeated to at least `least` points. A surface without cones is one part.
    """
    sizes = [group.shape[2] for group in whole.cones] or [len(whole.areas)]
    found = []
    indices = torch.arange(sum(sizes)).split(sizes)
    for own, cones in zip(indices, whole.cones or (torch.empty(0),), strict=True):
        many = torch.arange(max(least, len(own))) % len(own)
        part = whole.part(own[many], (cones[:, :, many],) if cones.numel() else ())
        found.append((part, len(own)))
    return found


def covered(whole: Surface, place: Tensor) -> Tensor:
    """Returns (N, B), positive where a cone of the point contains a position [p, 1] (4, B) or a direction (3, B).

    The result is zero elsewhere. A product is positive where the place is inside all planes. Minima would be slower:
    their compiled code must pass NaN on.
    """
    found = []
    for group in whole.cones:
        # one plane after the other, to save memory
        inside = ((plane[..., : len(place)] @ place).relu() for plane in group)
        found.append(reduce(torch.mul, inside).sum(0))
    return torch.cat(found)


def light(whole: Surface, sun: Tensor) -> Tensor:
    """Returns (N, B) float32, positive where a point sees the Sun in directions (3, B) of the chief's frame."""
    facing = whole.normals.float().T @ sun
    return torch.where(covered(whole, sun) > 0.0, -1.0, facing) if whole.cones else facing


def directions(x: Tensor, attitude: Tensor) -> Tensor:
    """Returns (9, B) float32 in the chief's frame: the deputy's position in m, its camera's axis, the Sun's direction.

    Args:
        x: states (16, B); attitude: (4, B) of the chief, from its frame to Hill's.
    """
    to_chief = conjugate(attitude)
    boresight = torch.stack(body_axis(x[Q], 0))
    parts = x[P], boresight, sun_direction(x[THETA_S])
    return torch.cat([rotate(to_chief, each).float() for each in parts])


def seen_from(whole: Surface, where: Tensor, c: InspectionParameters) -> Tensor:
    """Checks which points are lit, and which of these are in view, (2, N, B) bool, from `directions` (9, B).

    A point is in view within the camera's cone about +n_x and above the point's own horizon, if no face hides it.
    """
    p, boresight, sun = where.split(3)
    points, normals = whole.points.float(), whole.normals.float()
    height = normals.T @ p - dot(points, normals)[:, None]
    to_point = (dot(points, points)[:, None] + dot(p, p) - 2.0 * (points.T @ p)).sqrt()
    in_cone = points.T @ boresight - dot(p, boresight) - math.cos(c.field_of_view / 2) * to_point
    lit, seen = light(whole, sun), in_cone.minimum(height)
    if whole.cones:
        seen = torch.where(covered(whole, torch.cat((p, torch.ones_like(p[:1])))) > 0.0, -1.0, seen)
    return torch.stack((lit, lit.minimum(seen))) > 0.0


def in_view(whole: Surface, x: Tensor, attitude: Tensor, c: InspectionParameters) -> Tensor:
    """Returns `seen_from` for states x (16, B) and the chief's attitude (4, B)."""
    return seen_from(whole, directions(x, attitude), c)

"""The chief's surface: points with normals and areas, of the paper's sphere or of a mesh, and which of them is hidden.

A mesh may hide its own points from the camera and from the Sun. Seen from a point, a face, of three or four corners,
covers a cone of directions, bounded by the planes through the point and two corners each. The planes are computed once;
where a spacecraft or the Sun is, a point is hidden if they lie inside one of its cones.
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

FLAT = 1e-9  # m^3, below which a cone holds nothing
DIRECTIONS = 512, 20_000  # from which a point of a mesh is looked at, to leave out those that are never seen
GROUPS = 6  # of points with about as many cones each, so that few of those that are computed fill up


class Surface(NamedTuple):
    """What is inspected, in the chief's frame.

    Attributes:
        points (3, N) in m, normals (3, N), areas (N,) in m^2.
        triangles: (F, 3, 3) m, corner by corner; none of a sphere.
        cones: of groups of points one after the other, those with few cones first: (n, K, k, 4) float32, the n planes
            m . p + b = 0 around each of K cones of k points as [m, b]; m points inwards.
    """

    points: Tensor
    normals: Tensor
    areas: Tensor
    triangles: Tensor
    cones: tuple[Tensor, ...] = ()


def surface(chief: ChiefParameters, c: InspectionParameters, device: torch.device | str = "cpu") -> Surface:
    """The chief's; raises ValueError where its file holds none, or one that reaches beyond `chief_radius`."""
    if not chief.mesh:
        normals = fibonacci_sphere(c.num_points, device=str(device))
        areas = torch.ones_like(normals[0])
        none = normals.new_zeros(0, 3, 3)
        return Surface(c.chief_radius * normals, normals, areas, none)
    *parts, cones = of_mesh(with_digest(chief.mesh), c.num_points, c.chief_radius)
    points, normals, areas, triangles = (part.to(device) for part in parts)
    return Surface(points, normals, areas, triangles, tuple(group.to(device) for group in cones))


@lru_cache(maxsize=4)  # a large mesh takes minutes; the file's digest is part of the key
def of_mesh(mesh: str, count: int, largest: float) -> Surface:
    """Of a file (`with_digest`), with so many points if it has none, within a radius in m; ValueError as `surface`."""
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
    """Of each point, the planes (n, K, 3) around the cones of the faces that can hide it, of n corners each.

    These are the faces that rise above the point's horizon; of a closed mesh only those that face it, since what
    leaves it enters the mesh again through such a one.
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
    """(k,) bool: directions (3, k) from a point are in one of its cones, their planes (n, K, 3)."""
    return (planes @ directions > 0.0).all(0).any(0)


def cuts(counts: list[int]) -> list[int]:
    """Where to cut what has ascending counts into GROUPS: one after the other, each where it saves the most."""
    found = [0, len(counts)]
    rises = [i for i, (before, after) in enumerate(pairwise(counts), 1) if before < after]

    def filled(ends: list[int]) -> int:
        return sum((end - begin) * counts[end - 1] for begin, end in pairwise(ends))

    for _ in range(GROUPS - 1):
        found = min((sorted({*found, i}) for i in rises), key=filled, default=found)
    return found


def grouped(whole: Surface, planes: list[Tensor], keep: Tensor) -> Surface:
    """The surface of the points (N,) bool to keep, in GROUPS, those with few cones first."""
    order = sorted(keep.nonzero().flatten().tolist(), key=lambda i: planes[i].shape[1])
    cones = []
    for begin, end in pairwise(cuts([planes[i].shape[1] for i in order])):
        group = order[begin:end]
        most = planes[group[-1]].shape[1]
        points, normals = whole.points[:, group].T, whole.normals[:, group].T
        # those that fill up hide nothing above the horizon
        some = -normals[None, None].repeat(len(planes[0]), most, 1, 1)
        for k, i in enumerate(group):
            some[:, : planes[i].shape[1], k] = planes[i]
        offsets = -(some * points).sum(-1, keepdim=True)  # a plane goes through its point
        cones.append(torch.cat((some, offsets), -1).float())
    return Surface(
        whole.points[:, order], whole.normals[:, order], whole.areas[order], whole.triangles, tuple(cones)
    )


def ever_seen(whole: Surface, name: str) -> Surface:
    """The surface with its cones, without the points that are hidden from everywhere, as those within it are.

    Those within a part of a closed mesh are left out first: its triangles, looked at from within, hide nothing.
    """
    if is_closed(whole.triangles):
        outside = ~enclosed(whole.points + 1e-4 * whole.normals, whole.triangles)
        whole = whole._replace(
            points=whole.points[:, outside], normals=whole.normals[:, outside], areas=whole.areas[outside]
        )
    unseen = f"mesh = {path_of(name)!r}: none of its points can be seen: do its normals point outwards?"
    if not len(whole.areas):
        raise ValueError(unseen)
    planes = hiding(whole)
    seen = torch.zeros_like(whole.areas, dtype=torch.bool)
    for count in DIRECTIONS:  # more for those that so many leave out, as the inside of a tube
        far = fibonacci_sphere(count)
        for i in (~seen).nonzero().flatten().tolist():
            seen[i] = (far.T @ whole.normals[:, i] > 0.0)[~hidden(planes[i], far)].any()
    if not seen.any():
        raise ValueError(unseen)
    return grouped(whole, planes, seen)


def groups(whole: Surface, least: int) -> list[tuple[Surface, int]]:
    """The parts of a surface whose points have equally many cones, each repeated to at least so many; how many it has.

    Without any cones it is all of it.
    """
    sizes = [group.shape[2] for group in whole.cones] or [len(whole.areas)]
    found = []
    for own, cones in zip(
        torch.arange(sum(sizes)).split(sizes), whole.cones or (torch.empty(0),), strict=True
    ):
        many = torch.arange(max(least, len(own))) % len(own)
        points, normals, areas = (
            whole.points[:, own[many]],
            whole.normals[:, own[many]],
            whole.areas[own[many]],
        )
        part = Surface(points, normals, areas, whole.triangles, (cones[:, :, many],) if cones.numel() else ())
        found.append((part, len(own)))
    return found


def covered(whole: Surface, place: Tensor) -> Tensor:
    """(N, B), positive where a cone of a point holds the place, a position [p, 1] (4, B) or a direction (3, B).

    It is zero elsewhere. A product is positive where all planes say inside; the compiled code of minima, which must
    pass NaN on, takes longer.
    """
    found = []
    for group in whole.cones:
        # one after the other in memory
        inside = ((plane[..., : len(place)] @ place).relu() for plane in group)
        found.append(reduce(torch.mul, inside).sum(0))
    return torch.cat(found)


def light(whole: Surface, sun: Tensor) -> Tensor:
    """(N, B) float32, positive where a point sees the Sun in directions (3, B) of the chief's frame."""
    facing = whole.normals.float().T @ sun
    return torch.where(covered(whole, sun) > 0.0, -1.0, facing) if whole.cones else facing


def directions(x: Tensor, attitude: Tensor) -> Tensor:
    """(9, B) float32 in the chief's frame: where the deputy is in m, whither its camera looks, and where the Sun is.

    Args:
        x: states (16, B); attitude: of the chief (4, B), from its frame to Hill's.
    """
    to_chief = conjugate(attitude)
    boresight = torch.stack(body_axis(x[Q], 0))
    parts = x[P], boresight, sun_direction(x[THETA_S])
    return torch.cat([rotate(to_chief, each).float() for each in parts])


def seen_from(whole: Surface, where: Tensor, c: InspectionParameters) -> Tensor:
    """(2, N, B) bool, whether a point is lit, and whether it is also in view, from `directions` (9, B).

    In view is what lies within the camera's cone about +n_x, above its point's own horizon, and is not hidden.
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
    """`seen_from` states x (16, B), where the chief has an attitude (4, B)."""
    return seen_from(whole, directions(x, attitude), c)

"""The chief's surface: points with normals and areas, of the paper's sphere or of a mesh, and which of them is hidden.

A mesh may hide its own points from the camera and from the Sun. Seen from a point, a face, of three or four corners,
covers a cone of directions, bounded by the planes through the point and two corners each. The planes are computed once;
where a spacecraft or the Sun is, a point is hidden if they lie inside one of its cones.
"""

import hashlib
import io
import math
import re
from functools import lru_cache, reduce
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from inspection.attitude import body_axis, conjugate, dot, norm, rotate, unit
from inspection.chief import fibonacci_sphere
from inspection.dynamics import sun_direction
from inspection.parameters import ChiefParameters, InspectionParameters
from inspection.state import THETA_S, P, Q

ROOT = Path(__file__).parents[1]
RISE = 1e-5  # m, by which a corner must rise above a point's horizon to hide anything; float32 files are as exact
FLAT = 1e-9  # m^3, below which a cone holds nothing
DIRECTIONS = 512, 20_000  # from which a point of a mesh is looked at, to leave out those that are never seen
MOST = 20_000  # triangles, or points that a file gives
DIGEST = re.compile(r"#([0-9a-f]{12})$")  # behind a mesh's path: how the sha256 of its file begins
SHAPES = {"triangles": (3, 3), "points": (3,), "normals": (3,), "areas": ()}  # of one of what a file holds
GROUPS = 6  # of points with about as many cones each, so that few of those that are computed fill up
AT_ONCE = 2_000_000  # pairs of a point and a triangle whose cones are computed together
GOLDEN = 0.7548776662466927, 0.5698402909980532  # Roberts' additive sequence, which fills a square evenly


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
    *parts, cones = of_mesh(pinned(chief.mesh), c.num_points, c.chief_radius)
    return Surface(*(part.to(device) for part in parts), tuple(group.to(device) for group in cones))


@lru_cache(maxsize=4)  # a large mesh takes minutes; the file's digest is part of the key
def of_mesh(mesh: str, count: int, largest: float) -> Surface:
    """Of a file, `pinned`, with so many points where it gives none, within a radius in m; ValueError as `surface`."""
    arrays = {name: torch.from_numpy(array) for name, array in read(mesh).items()}
    triangles = arrays["triangles"]
    if "points" in arrays:
        points, normals, areas = arrays["points"].T, arrays["normals"].T, arrays["areas"]
        if not ((areas >= 0.0).all() and 0.0 < areas.sum() < math.inf and (norm(normals) > 0.0).all()):
            raise ValueError(f"{mesh}: areas must not be negative or all zero, normals not zero")
    else:
        points, normals, areas = spread(triangles, count)
    reach = max(float(norm(each).max()) for each in (points, triangles.flatten(0, 1).T) if each.numel())
    if not reach <= largest:
        raise ValueError(
            f"{mesh}: reaches {reach:.3g} m from its origin: must lie within chief_radius, {largest:g} m"
        )
    return ever_seen(Surface(points, unit(normals), areas, triangles), mesh)


def arrays_of_npz(content: bytes) -> dict[str, np.ndarray]:
    """All arrays of a file."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def triangles_of_stl(content: bytes) -> np.ndarray:
    """(F, 3, 3), corner by corner."""
    import trimesh  # half a second that who has no such file need not wait

    try:
        return np.array(trimesh.load(io.BytesIO(content), file_type="stl", force="mesh").triangles)
    except ImportError as error:  # of what reads text, when it is none
        raise ValueError(error) from None


def file_of(mesh: str) -> tuple[str, bytes]:
    """Its path as it was given, and what the file holds; ValueError where that is not what its digest says.

    A path that is not below the working directory is looked for in this project's folder.
    """
    path = DIGEST.sub("", mesh)
    file = next((each for each in (Path(path), ROOT / path) if each.is_file()), None)
    if file is None:
        raise ValueError(f"mesh = {path!r}: there is no such file")
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ValueError(f"mesh = {path!r}: cannot be read: {error.strerror or error}") from None
    wanted, found = DIGEST.search(mesh), hashlib.sha256(content).hexdigest()[:12]
    if wanted and wanted[1] != found:
        raise ValueError(f"mesh = {mesh!r}: is another file by now, whose sha256 begins with {found}")
    return path, content


def pinned(mesh: str) -> str:
    """A mesh's path and digest, as `DIGEST`."""
    if DIGEST.search(mesh):
        return mesh
    path, content = file_of(mesh)
    return f"{path}#{hashlib.sha256(content).hexdigest()[:12]}"


def read(mesh: str) -> dict[str, np.ndarray]:
    """The float64 arrays of a mesh's file: `triangles`, none or more, and all or none of the others in SHAPES.

    ValueError where it holds anything else.
    """
    path, content = file_of(mesh)
    suffix = Path(path).suffix
    if suffix not in (".npz", ".stl"):
        raise ValueError(f"mesh = {path!r}: must end in .npz or .stl")
    try:
        arrays = arrays_of_npz(content) if suffix == ".npz" else {"triangles": triangles_of_stl(content)}
    except ImportError:
        raise ValueError(f"mesh = {path!r}: needs trimesh: pip install trimesh") from None
    except Exception:  # both libraries report damage through many exception types
        raise ValueError(f"mesh = {path!r}: cannot be read: is damaged, or no {suffix} file") from None
    arrays.setdefault("triangles", np.zeros((0, 3, 3)))
    known = {name: arrays[name] for name in SHAPES if name in arrays}
    for name, array in known.items():
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise ValueError(f"mesh = {path!r}: {name} must hold finite numbers only")
        known[name] = array.astype(np.float64)
    has = [name for name in ("points", "normals", "areas") if name in known]
    if len(has) not in (0, 3) or not (has or known["triangles"].size):
        raise ValueError(f"mesh = {path!r}: needs triangles, or points, normals and areas")
    for name, array in known.items():
        if array.ndim < 1 or array.shape[1:] != SHAPES[name] or len(array) > MOST:
            letter = "F" if name == "triangles" else "N"
            shape = f"({', '.join((letter, *map(str, SHAPES[name])))})".replace("(N)", "(N,)")
            raise ValueError(f"mesh = {path!r}: {name} must be {shape}, at most {MOST:,}")
    if len({len(known[name]) for name in has}) > 1:
        raise ValueError(f"mesh = {path!r}: points and normals must be (N, 3) and areas (N,)")
    return known


def spread(triangles: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """`count` points (3, N) evenly over the triangles (F, 3, 3), with normals (3, N) and equal areas (N,)."""
    origin, *edges = triangles[:, 0].T, *((triangles[:, k] - triangles[:, 0]).T for k in (1, 2))
    normals = torch.linalg.cross(*edges, dim=0)
    areas = 0.5 * norm(normals)
    if not float(areas.sum()) > 0.0:
        raise ValueError("the mesh has no area")
    at = (torch.arange(count, dtype=areas.dtype) + 0.5) / count * areas.sum()
    which = torch.searchsorted(areas.cumsum(0), at).clamp(max=len(areas) - 1)
    steps = torch.arange(1, count + 1, dtype=areas.dtype)
    u, v = ((step * steps).frac() for step in GOLDEN)
    u, v = torch.where(u + v > 1.0, 1.0 - u, u), torch.where(u + v > 1.0, 1.0 - v, v)
    points = origin[:, which] + u * edges[0][:, which] + v * edges[1][:, which]
    return points, unit(normals)[:, which], (areas.sum() / count).expand(count).clone()


def numbered(triangles: Tensor) -> Tensor:
    """(F, 3) which corner each is: those at the same place, to a micrometre, are one."""
    places = (triangles * 1e6).round().long().reshape(-1, 3)
    return torch.unique(places, dim=0, return_inverse=True)[1].reshape(-1, 3)


def is_closed(triangles: Tensor) -> bool:
    """Whether every edge of the triangles (F, 3, 3) is one of another, the other way round."""
    corners = numbered(triangles)
    edges = torch.cat([torch.stack((corners[:, k], corners[:, (k + 1) % 3]), 1) for k in range(3)])
    count = int(corners.max()) + 1 if len(corners) else 0
    ways = torch.stack((edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]))
    there, back = (way.sort().values for way in ways)
    return bool((there == back).all())


def faces(triangles: Tensor) -> Tensor:
    """The triangles (F, 3, 3), or (k, 4, 3) where many pairs of them are one flat and convex quadrangle.

    That has four planes around its cone, two triangles have six. What is left repeats its last corner.
    """
    by_edge = {
        (first, second): (i, k)
        for i, (a, b, c) in enumerate(numbered(triangles).tolist())
        for k, (first, second) in enumerate(((a, b), (b, c), (c, a)))
    }
    partner: dict[int, int] = {}
    found = []
    for (first, second), (i, k) in by_edge.items():
        j, m = by_edge.get((second, first), (i, k))
        if i in partner or j in partner or i == j:
            continue
        a, b, c = triangles[i].roll(-k, 0)
        quadrangle = torch.stack((a, triangles[j, (m + 2) % 3], b, c))
        if is_flat_and_convex(quadrangle):
            partner[i], partner[j] = j, i
            found.append(quadrangle)
    alone = triangles[[i not in partner for i in range(len(triangles))]]
    if 4 * (len(found) + len(alone)) >= 3 * len(triangles):
        return triangles
    return torch.cat((torch.stack(found), torch.cat((alone, alone[:, 2:]), 1)))


def is_flat_and_convex(corners: Tensor) -> bool:
    """Of a quadrangle's corners (4, 3): whether it turns the same way at each, about one axis."""
    edges = corners.roll(-1, 0) - corners
    turns = torch.linalg.cross(edges.roll(1, 0), edges)
    axis = torch.nn.functional.normalize(turns.sum(0), dim=0)
    return bool((turns @ axis >= -(RISE**2)).all()) and bool(
        ((corners - corners[0]) @ axis).abs().max() < RISE
    )


def enclosed(points: Tensor, triangles: Tensor) -> Tensor:
    """(N,) bool: points (3, N) are within a closed mesh or a part of it (Van Oosterom and Strackee 1983).

    The solid angles of its triangles, signed, add up to 4 pi there and to nothing outside.
    """
    found = []
    for some in points.T.split(max(1, AT_ONCE // max(1, len(triangles)))):
        a, b, c = (triangles[None, :, k] - some[:, None] for k in range(3))
        la, lb, lc = (each.norm(dim=-1) for each in (a, b, c))
        volume = (torch.linalg.cross(a, b) * c).sum(-1)
        below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        found.append(2.0 * torch.atan2(volume, below).sum(-1).abs() > 2.0 * math.pi)
    return torch.cat(found)


def hiding(whole: Surface) -> list[Tensor]:
    """Of each point, the planes (n, K, 3) around the cones of the faces that can hide it, of n corners each.

    These are the faces that rise above the point's horizon; of a closed mesh only those that face it, since what
    leaves it enters the mesh again through such a one.
    """
    points, normals, all_faces = whole.points.T, whole.normals.T, faces(whole.triangles)
    one, two, three = all_faces[:, :3].unbind(1)
    outwards = unit(torch.linalg.cross(two - one, three - one).T).T
    closed = is_closed(whole.triangles)
    found: list[Tensor] = []
    for some in torch.arange(len(points)).split(max(1, AT_ONCE // max(1, len(all_faces)))):
        # corners as seen from the points, (n corners, k points, F, 3)
        corners = all_faces.transpose(0, 1)[:, None] - points[some, None]
        hides = ((corners * normals[some, None]).sum(-1) > RISE).any(0)
        if closed:
            hides &= (corners[0] * outwards).sum(-1) < -FLAT
        planes = torch.linalg.cross(corners, corners.roll(-1, 0))
        volume = (planes[0] * corners[2]).sum(-1)
        hides &= volume.abs() > FLAT
        planes = torch.nn.functional.normalize(planes * volume.sign()[..., None], dim=-1)
        planes = torch.where(
            (planes == 0.0).all(-1, keepdim=True), planes[:1], planes
        )  # of a repeated corner
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
        some = -normals[None, None].repeat(
            len(planes[0]), most, 1, 1
        )  # those that fill up hide nothing above the horizon
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
    unseen = (
        f"mesh = {DIGEST.sub('', name)!r}: none of its points can be seen: do its normals point outwards?"
    )
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


def covered(whole: Surface, place: Tensor) -> Tensor:
    """(N, B), positive where a cone of a point holds the place, a position [p, 1] (4, B) or a direction (3, B).

    It is zero elsewhere. A product is positive where all planes say inside; the compiled code of minima, which must
    pass NaN on, takes longer.
    """
    found = []
    for group in whole.cones:
        inside = ((plane[..., : len(place)] @ place).relu() for plane in group)  # one after the other in memory
        found.append(reduce(torch.mul, inside).sum(0))
    return torch.cat(found)


def light(whole: Surface, sun: Tensor) -> Tensor:
    """(N, B) float32, positive where a point sees the Sun in directions (3, B) of the chief's frame."""
    facing = whole.normals.float().T @ sun
    return torch.where(covered(whole, sun) > 0.0, -1.0, facing) if whole.cones else facing


def margins(whole: Surface, x: Tensor, attitude: Tensor, c: InspectionParameters) -> Tensor:
    """(2, N, B) float32, positive where a point is lit, and where it is also in view from x (16, B).

    In view is what lies within the camera's cone about +n_x, above its point's own horizon, and is not hidden.

    Args:
        attitude: of the chief (4, B), from its frame to Hill's.
    """
    to_chief = conjugate(attitude)
    boresight = rotate(to_chief, torch.stack(body_axis(x[Q], 0))).float()
    p, sun = (rotate(to_chief, each).float() for each in (x[P], sun_direction(x[THETA_S])))
    points, normals = whole.points.float(), whole.normals.float()
    height = normals.T @ p - dot(points, normals)[:, None]
    to_point = (dot(points, points)[:, None] + dot(p, p) - 2.0 * (points.T @ p)).sqrt()
    in_cone = points.T @ boresight - dot(p, boresight) - math.cos(c.field_of_view / 2) * to_point
    lit, seen = light(whole, sun), in_cone.minimum(height)
    if whole.cones:
        seen = torch.where(covered(whole, torch.cat((p, torch.ones_like(p[:1])))) > 0.0, -1.0, seen)
    return torch.stack((lit, lit.minimum(seen)))

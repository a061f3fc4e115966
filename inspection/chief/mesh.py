"""A chief's mesh: its file, and geometry of its triangles."""

import hashlib
import io
import math
import re
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.model.attitude import norm, unit

ROOT = Path(__file__).parents[2]
DIGEST = re.compile(r"#([0-9a-f]{12})$")  # the end of a mesh's path: the first digits of its file's sha256
MOST = 20_000  # the most triangles or points in a file
SHAPES = {  # of the arrays in a file: the shape of an entry, and the array's shape for messages
    "triangles": ((3, 3), "(F, 3, 3)"),
    "points": ((3,), "(N, 3)"),
    "normals": ((3,), "(N, 3)"),
    "areas": ((), "(N,)"),
}
TEXTS = "stl", "obj", "off", "ply"  # kinds of files that are text, may be text or begin with text
EXACT = 1e-5  # m, the accuracy of float32 files
AT_ONCE = 2_000_000  # pairs of a point and a triangle in one operation, to bound the memory
GOLDEN = 0.7548776662466927, 0.5698402909980532  # Roberts' additive sequence fills a square evenly


def triangles_of(content: bytes, kind: str) -> np.ndarray:
    """Returns the triangles (F, 3, 3) of a file of a kind ("stl"); raises KeyError if trimesh cannot read the kind."""
    import trimesh  # takes half a second, so import it only for such a file

    if kind not in (kinds := trimesh.exchange.load.mesh_formats()):
        raise KeyError(", ".join(f".{each}" for each in sorted(kinds)))
    try:
        return np.array(trimesh.load_mesh(io.BytesIO(content), file_type=kind).triangles)
    except Exception:  # trimesh guesses the encoding of text with a package that may fail
        text, mark, numbers = content.removeprefix(BOM_UTF8).partition(
            b"end_header"
        )  # ends the text of .ply; other files are all text
        if kind not in TEXTS or b"\0" in text or content.isascii():
            raise
        # other characters than ASCII can only be in names and comments
        plain = text.translate(bytes(range(128)) + b"?" * 128) + mark + numbers
        return np.array(trimesh.load_mesh(io.BytesIO(plain), file_type=kind).triangles)


def path_of(mesh: str) -> str:
    """Returns the path without its digest."""
    return DIGEST.sub("", mesh)


def file_of(mesh: str) -> tuple[str, bytes, str]:
    """Returns a file's path as given, its content and its digest; raises ValueError if no file has `mesh`'s digest.

    The path is looked up below the working directory, then below this project's folder.
    """
    path, wanted, found = path_of(mesh), DIGEST.search(mesh), ""
    for file in (Path(path), ROOT / path):
        if not file.is_file():
            continue
        try:
            content = file.read_bytes()
        except OSError as error:
            raise ValueError(f"mesh = {path!r}: cannot be read: {error.strerror or error}") from None
        digest = hashlib.sha256(content).hexdigest()[:12]
        if not wanted or wanted[1] == digest:
            return path, content, digest
        found = found or digest
    if found:
        raise ValueError(f"mesh = {mesh!r}: is another file by now, whose sha256 begins with {found}")
    if Path(path).is_dir() or (ROOT / path).is_dir():
        raise ValueError(f"mesh = {path!r}: is a directory; name a file, such as .npz or .stl")
    raise ValueError(f"mesh = {path!r}: there is no such file, here or below the project's folder")


def with_digest(mesh: str) -> str:
    """Returns a mesh's path with its digest appended, as `DIGEST` describes."""
    if DIGEST.search(mesh):
        return mesh
    path, _, digest = file_of(mesh)
    return f"{path}#{digest}"


def read(mesh: str) -> dict[str, np.ndarray]:
    """Returns the float64 arrays of a mesh's file: `triangles` (perhaps none), and all or none of the others in SHAPES.

    Raises:
        ValueError: the file holds anything else.
    """
    path, content, _ = file_of(mesh)
    suffix = Path(path).suffix.lower()
    try:
        if suffix == ".npz":
            arrays = {**np.load(io.BytesIO(content), allow_pickle=False)}
        else:
            arrays = {"triangles": triangles_of(content, suffix[1:])}
    except KeyError as error:
        raise ValueError(
            f"mesh = {path!r}: must end in .npz, or in what trimesh reads: {error.args[0]}"
        ) from None
    except ImportError as error:
        if error.name not in ("trimesh", None):  # the package that reads this kind of file is missing
            raise ValueError(f"mesh = {path!r}: cannot be read: needs {error.name}") from None
        raise ValueError(f"mesh = {path!r}: needs trimesh: pip install trimesh") from None
    except Exception:  # both libraries report damage through many exception types
        raise ValueError(
            f"mesh = {path!r}: cannot be read: is damaged, no {suffix} file, or needs another file beside it"
        ) from None
    arrays.setdefault("triangles", np.zeros((0, 3, 3)))
    known = {name: arrays[name] for name in SHAPES if name in arrays}
    for name, array in known.items():
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise ValueError(f"mesh = {path!r}: {name} must hold finite numbers only")
        known[name] = array.astype(np.float64)
    has = [name for name in ("points", "normals", "areas") if name in known]
    if suffix != ".npz" and not known["triangles"].size:
        raise ValueError(f"mesh = {path!r}: holds no triangles")
    if len(has) not in (0, 3) or not (has or known["triangles"].size):
        raise ValueError(f"mesh = {path!r}: needs triangles, or points, normals and areas")
    for name, array in known.items():
        each, shape = SHAPES[name]
        if array.ndim < 1 or array.shape[1:] != each or len(array) > MOST:
            raise ValueError(f"mesh = {path!r}: {name} must be {shape}, at most {MOST:,}")
    if len({len(known[name]) for name in has}) > 1:
        raise ValueError(f"mesh = {path!r}: points and normals must be (N, 3) and areas (N,)")
    return known


def sampled(triangles: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns `count` points (3, N) spread evenly over triangles (F, 3, 3), normals (3, N) and equal areas (N,)."""
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


def body_of(triangles: Tensor) -> Any:
    """Returns triangles (F, 3, 3) as a trimesh body, in which corners at the same place are one corner."""
    import trimesh

    return trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles.numpy()))


def is_closed(triangles: Tensor) -> bool:
    """Checks whether every edge of the triangles (F, 3, 3) is also an edge of another one, in the other direction."""
    if not len(triangles):
        return True
    body = body_of(triangles)
    return bool(body.is_watertight and body.is_winding_consistent)


def check_winding(triangles: Tensor, path: str) -> None:
    """Raises ValueError if neighbours are not counterclockwise from the same side.

    Otherwise the points of one neighbour would face inwards.
    """
    if not body_of(triangles).is_winding_consistent:
        raise ValueError(
            f"mesh = {path!r}: some neighbours are not counterclockwise from the same side: mend the order of their "
            "corners (trimesh.repair.fix_normals)"
        )


def faces(triangles: Tensor) -> Tensor:
    """Returns the triangles (F, 3, 3), or (k, 4, 3) where many pairs of triangles form a flat, convex quadrangle.

    A quadrangle has four planes around its cone, two triangles have six. A single triangle repeats its last corner.
    """
    places = (triangles * 1e6).round().long().reshape(-1, 3)  # corners within a micrometre are one
    corners = torch.unique(places, dim=0, return_inverse=True)[1].reshape(-1, 3).tolist()
    edges = [edge for a, b, c in corners for edge in ((a, b), (b, c), (c, a))]
    by_edge = {edge: divmod(n, 3) for n, edge in enumerate(edges)}
    paired: set[int] = set()
    found = []
    for (first, second), (i, k) in by_edge.items():
        j, m = by_edge.get((second, first), (i, k))
        if i == j or paired & {i, j}:
            continue
        a, b, c = triangles[i].roll(-k, 0)
        quadrangle = torch.stack((a, triangles[j, (m + 2) % 3], b, c))
        if is_flat_and_convex(quadrangle):
            paired |= {i, j}
            found.append(quadrangle)
    alone = triangles[[i not in paired for i in range(len(triangles))]]
    if 4 * (len(found) + len(alone)) >= 3 * len(triangles):
        return triangles
    return torch.cat((torch.stack(found), torch.cat((alone, alone[:, 2:]), 1)))


def is_flat_and_convex(corners: Tensor) -> bool:
    """Checks whether a quadrangle (4, 3) is flat and turns the same way, by more than zero, at every corner."""
    edges = corners.roll(-1, 0) - corners
    turns = torch.linalg.cross(edges.roll(1, 0), edges)
    axis = torch.nn.functional.normalize(turns.sum(0), dim=0)
    is_flat = ((corners - corners[0]) @ axis).abs().max() < EXACT
    return bool(is_flat and (turns @ axis > EXACT**2).all())


def enclosed(points: Tensor, triangles: Tensor) -> Tensor:
    """Checks which points (3, N) are within a closed mesh or a part of it, (N,) bool (Van Oosterom and Strackee 1983).

    Inside, the signed solid angles of the triangles sum to 4 pi; outside they sum to zero.
    """
    found = []
    for some in points.T.split(max(1, AT_ONCE // max(1, len(triangles)))):
        a, b, c = (triangles[None, :, k] - some[:, None] for k in range(3))
        la, lb, lc = (each.norm(dim=-1) for each in (a, b, c))
        volume = (torch.linalg.cross(a, b) * c).sum(-1)
        below = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        found.append(2.0 * torch.atan2(volume, below).sum(-1).abs() > 2.0 * math.pi)
    return torch.cat(found)

"""Meshes: where their points are, and what hides them, against rays cast one by one."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from inspection.chief import points as chief
from inspection.chief.mesh import faces, read
from inspection.chief.surface import covered, in_view, light, surface
from inspection.environment import InspectionEnv
from inspection.model.attitude import rotate
from inspection.model.draws import random_quaternion
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import SIZE, THETA_S, P, Q

ROOT = Path(__file__).parents[3]
MESHES = ("configs/chiefs/box.npz", "configs/chiefs/satellite.stl")
C = InspectionParameters(num_points=150)


def hit(origin: np.ndarray, towards: np.ndarray, triangles: np.ndarray, longest: float = np.inf) -> bool:
    """Tells whether a ray meets one of the triangles (Moeller and Trumbore 1997)."""
    edges = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(towards, edges[1])
    det = (edges[0] * across).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_corner = origin - triangles[:, 0]
        u = (from_corner * across).sum(1) / det
        aside = np.cross(from_corner, edges[0])
        v = (aside @ towards) / det
        t = (edges[1] * aside).sum(1) / det
    return bool(((np.abs(det) > 1e-12) & (u > 0) & (v > 0) & (u + v < 1) & (t > 1e-6) & (t < longest)).any())


@pytest.fixture(scope="module", params=MESHES)
def whole(request):
    return surface(ChiefParameters(mesh=request.param), C)


def some_states(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns states that look at the chief's centre from 12 to 40 m, and attitudes of the chief."""
    generator = torch.Generator().manual_seed(3)
    x = torch.zeros(SIZE, count, dtype=torch.float64)
    direction = torch.nn.functional.normalize(torch.randn(3, count, generator=generator).double(), dim=0)
    x[P] = direction * (12.0 + 28.0 * torch.rand(count, generator=generator).double())
    axis = torch.linalg.cross(
        torch.tensor([1.0, 0.0, 0.0]).double()[:, None].expand_as(direction), -direction, dim=0
    )
    x[Q] = torch.nn.functional.normalize(torch.cat((axis, 1.0 - direction[:1])), dim=0)
    x[THETA_S] = 6.3 * torch.rand(count, generator=generator).double()
    return x, random_quaternion(count, generator, torch.float64)


def test_points_are_lit_and_seen_where_no_ray_is_stopped(whole) -> None:
    x, attitude = some_states(25)
    assert torch.allclose(rotate(x[Q], torch.eye(3).double()[:, :1].expand(3, 25)), -x[P] / x[P].norm(dim=0))
    lit, seen = in_view(whole, x, attitude, C).numpy()
    triangles, half = whole.triangles.numpy(), C.field_of_view / 2
    wrong = hidden = 0
    for b in range(x.shape[1]):
        inverse = torch.cat((-attitude[:3, b], attitude[3:, b]))
        theta = float(x[THETA_S, b])
        sun = rotate(inverse, torch.tensor([np.cos(theta), np.sin(theta), 0.0]).double()).numpy()
        p = rotate(inverse, x[P, b]).numpy()
        for i in range(whole.points.shape[1]):
            point, normal = whole.points[:, i].numpy(), whole.normals[:, i].numpy()
            faces_sun, before_it = normal @ sun > 0.0, normal @ (p - point) > 0.0
            to_point = (point - p) / np.linalg.norm(point - p)
            before_it &= to_point @ (-p / np.linalg.norm(p)) > np.cos(half)
            free = [not hit(point, towards, triangles) for towards in (sun, (p - point))]
            hidden += (faces_sun and not free[0]) + (before_it and not free[1])
            in_light = faces_sun and free[0]
            wrong += (in_light != lit[i, b]) + ((in_light and before_it and free[1]) != seen[i, b])
    assert hidden > 100  # the mesh hides enough for the check to mean something
    assert wrong <= 2  # on an edge, to single precision


def test_flat_pairs_of_triangles_become_one_face(whole) -> None:
    """Half as many, of the same area."""
    corners = faces(whole.triangles)
    assert corners.shape == (len(whole.triangles) // 2, 4, 3)
    halves = corners[:, [[0, 1, 2], [2, 3, 0]]].flatten(0, 1)
    areas = [
        torch.linalg.cross(each[:, 1] - each[:, 0], each[:, 2] - each[:, 0]).norm(dim=1).sum()
        for each in (halves, whole.triangles)
    ]
    assert torch.allclose(*areas)


def test_the_sphere_is_seen_as_the_papers(random_states) -> None:
    x = random_states(300)
    ball = surface(ChiefParameters(), C)
    fixed = torch.zeros(4, 300, dtype=torch.float64)
    fixed[3] = 1.0
    ours, papers = in_view(ball, x, fixed, C), chief.in_view(ball.normals, x, C)
    assert (ours != papers).float().mean() < 1e-4 and papers[1].any()


def test_points_are_spread_evenly(whole) -> None:
    edges = whole.triangles[:, 1:] - whole.triangles[:, :1]
    area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).sum()
    assert torch.allclose(whole.areas.sum() * 150 / whole.points.shape[1], area)
    gaps = (whole.points[:, :, None] - whole.points[:, None]).norm(dim=0).fill_diagonal_(99.0)
    assert gaps.amin(1).median() > 0.4 * float(area / 150) ** 0.5


def test_an_open_mesh_hides_from_both_sides(tmp_path) -> None:
    plate = np.array([[[-2.0, -2.0, 3.0], [2.0, -2.0, 3.0], [0.0, 2.0, 3.0]]])
    for name, corners in (("up", plate), ("down", plate[:, ::-1])):
        np.savez(
            tmp_path / f"{name}.npz",
            triangles=corners,
            points=[[0.0, 0.0, 0.0]],
            normals=[[0.0, 0.0, 1.0]],
            areas=[1.0],
        )
        whole = surface(ChiefParameters(mesh=str(tmp_path / f"{name}.npz")), C)
        # from straight above it is hidden and in shade, from aside it is not
        place = torch.tensor([[0.0, 20.0], [0.0, 0.0], [20.0, 6.0]])
        assert (covered(whole, torch.cat((place, torch.ones_like(place[:1]))))[0] > 0.0).tolist() == [
            True,
            False,
        ]
        assert (light(whole, torch.nn.functional.normalize(place, dim=0))[0] > 0.0).tolist() == [False, True]


def box(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Triangles (12, 3, 3), counterclockwise from outside."""
    mesh = trimesh.creation.box(bounds=[low, high])
    return np.array(mesh.triangles)


def test_points_within_another_part_are_left_out(tmp_path) -> None:
    """A bus with a panel that is stuck into it: parts that overlap are each closed."""
    bus, panel = box((-2, -2, -2), (2, 2, 2)), box((-0.15, 1, -1.5), (0.15, 7, 1.5))
    np.savez(tmp_path / "parts.npz", triangles=np.concatenate((bus, panel)))
    c = InspectionParameters(num_points=400)
    points = surface(ChiefParameters(mesh=str(tmp_path / "parts.npz")), c).points
    assert not (points.abs() < 2.0 - 1e-9).all(0).any()
    aside, along, up = points.abs()
    assert not (
        (aside < 0.15 - 1e-9) & (points[1] > 1.0 + 1e-9) & (along < 7.0 - 1e-9) & (up < 1.5 - 1e-9)
    ).any()
    assert 360 < points.shape[1] < 395


def test_a_mesh_of_triangles_that_are_not_wound_alike_is_refused(tmp_path) -> None:
    """As the export of many a CAD program; points on those would face inwards and be left out."""
    mesh = box((-2, -2, -2), (2, 2, 2))
    mesh[3] = mesh[3, ::-1]
    np.savez(tmp_path / "mixed.npz", triangles=mesh)
    with pytest.raises(ValueError, match="neighbours are not counterclockwise"):
        surface(ChiefParameters(mesh=str(tmp_path / "mixed.npz")), C)


def test_points_weigh_by_their_areas_and_their_angle_to_the_priority(tmp_path) -> None:
    normals = Rotation.random(60, random_state=1).apply([0.0, 0.0, 1.0])
    areas = np.random.default_rng(0).uniform(0.1, 3.0, 60)
    np.savez(tmp_path / "own.npz", points=5.0 * normals, normals=normals, areas=areas)
    target = ChiefParameters(mesh=str(tmp_path / "own.npz"))
    env = InspectionEnv(3, C, [torch.Generator().manual_seed(0)], target=target)
    env.reset()
    for i in range(3):
        weights = areas * np.arccos(-normals @ env.sight.priority[:, i].numpy())
        expected = weights[env.sight.inspected[:, i].numpy()].sum() / weights.sum()
        np.testing.assert_allclose(env.sight.weights[:, i], weights / weights.sum(), rtol=1e-9)
        np.testing.assert_allclose(env.sight.score()[i], expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"triangles": np.ones((4, 3))}, "must be (F, 3, 3)"),
        ({"triangles": 30.0 * np.eye(3)[None]}, "must lie within chief_radius, 10 m"),
        ({"triangles": 3e3 * np.eye(3)[None]}, "(is it in mm?)"),
        ({"points": np.eye(3), "normals": np.eye(3)}, "needs triangles, or points, normals and areas"),
        (
            {"points": np.eye(3), "normals": np.eye(3), "areas": np.arange(-1.0, 4.0, 2.0)},
            "areas must not be",
        ),
        ({"points": np.eye(3), "normals": 0 * np.eye(3), "areas": np.ones(3)}, "normals not zero"),
        ({"triangles": np.full((1, 3, 3), np.nan)}, "finite numbers only"),
        ({"points": np.ones(3), "normals": np.ones(3), "areas": np.array(1.0)}, "points must be (N, 3)"),
        ({"points": np.eye(3), "normals": np.eye(3), "areas": np.eye(3)}, "areas must be (N,)"),
        ({"points": np.eye(3), "normals": np.eye(3), "areas": np.full(3, 1e308)}, "areas must not be"),
        ({"triangles": np.zeros((20_001, 3, 3))}, "at most 20,000"),
        ({"triangles": np.ones((1, 3, 3))}, "has no area"),
    ],
)
def test_what_is_no_mesh_is_refused(content, words, tmp_path) -> None:
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(ValueError, match=re.escape(words)):
        surface(ChiefParameters(mesh=str(tmp_path / "bad.npz")), C)


def stl_text(name: str = "box", end: str = "\n") -> str:
    """Returns the box as STL text with a name, which may hold any text."""
    lines = [f"solid {name}"]
    for triangle in BOX.tolist():
        corners = [f"vertex {x!r} {y!r} {z!r}" for x, y, z in triangle]
        lines += ["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"]
    return end.join([*lines, f"endsolid {name}", ""])


def stl_binary(head: bytes = b"") -> bytes:
    record = np.zeros(len(BOX), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    record["corners"] = BOX
    return head.ljust(80, b" ") + np.uint32(len(BOX)).tobytes() + record.tobytes()


def exported(kind: str, **options: str) -> bytes:
    """Returns the box as trimesh writes it."""
    mesh = trimesh.Trimesh(BOX.reshape(-1, 3), np.arange(3 * len(BOX)).reshape(-1, 3))
    content = mesh.export(file_type=kind, **options)
    return content.encode() if isinstance(content, str) else content


BOX = np.array(trimesh.creation.box((4.0, 3.0, 2.0)).triangles)
SPELLINGS: dict[str, tuple[str, bytes]] = {
    "binary": ("a.stl", stl_binary()),
    "upper case": ("A.STL", stl_binary()),
    "binary that begins like text": ("a.stl", stl_binary(b"solid facet")),
    "text": ("a.Stl", stl_text().encode()),
    "text in upper case": ("a.stl", stl_text().upper().encode()),
    "text of Windows": ("a.stl", stl_text(end="\r\n").encode()),
    "a name in UTF-8": ("a.stl", stl_text("Raumfähre 宇宙").encode()),
    "with a mark": ("a.stl", stl_text("Raumfähre").encode("utf-8-sig")),
    "two solids": ("a.stl", (stl_text().split("facet", 1)[0] + "endsolid\n" + stl_text()).encode()),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_an_stl_file_is_read_however_it_is_spelt(spelling: str, tmp_path: Path) -> None:
    name, content = SPELLINGS[spelling]
    (tmp_path / name).write_bytes(content)
    np.testing.assert_allclose(read(str(tmp_path / name))["triangles"], BOX, atol=1e-6)


@pytest.mark.parametrize("kind", ["off", "glb", "stl_ascii", "OBJ", "Ply"])
def test_what_trimesh_reads_is_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    path.write_bytes(exported(kind.lower()))
    triangles = read(str(path))["triangles"]
    volume = np.linalg.det(triangles).sum() / 6.0
    assert len(triangles) == len(BOX) and abs(volume - np.linalg.det(BOX).sum() / 6.0) < 1e-5


def with_comment(kind: str, **options: str) -> tuple[bytes, bytes]:
    """Returns the box as trimesh writes it, in two parts between which a comment may stand."""
    lines = exported(kind, **options).split(b"\n", {"obj": 0, "off": 1, "ply": 2}[kind])
    return b"".join(line + b"\n" for line in lines[:-1]), lines[-1]


FOREIGN = {
    "stl": ((b"solid ", stl_text().removeprefix("solid box").encode()), ""),
    "obj": (with_comment("obj"), "# "),
    "off": (with_comment("off"), "# "),
    "ply": (with_comment("ply", encoding="ascii"), "comment "),
    "PLY": (with_comment("ply"), "comment "),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_names_and_comments_may_be_in_any_encoding(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)  # which trimesh asks, and we do not require
    (head, rest), mark = FOREIGN[kind]
    path = tmp_path / f"a.{kind}"
    path.write_bytes(head + f"{mark}Gehäuse\n".encode("latin-1") + rest)
    np.testing.assert_allclose(read(str(path))["triangles"], BOX, atol=1e-6)


def test_a_mark_of_utf_8_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_bytes(b"".join((b"\xef\xbb\xbf", *with_comment("obj"))))
    np.testing.assert_allclose(read(str(path))["triangles"], BOX, atol=1e-6)

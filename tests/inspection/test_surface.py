"""Meshes: where their points are, and what hides them, against rays cast one by one."""

from pathlib import Path

import numpy as np
import pytest
import torch

from inspection import chief
from inspection.attitude import random_quaternion, rotate
from inspection.parameters import ChiefParameters, InspectionParameters
from inspection.state import SIZE, THETA_S, P, Q
from inspection.surface import is_closed, margins, surface

ROOT = Path(__file__).parents[2]
MESHES = ("configs/chiefs/box.npz", "configs/chiefs/satellite.stl")
C = InspectionParameters(num_points=150)


def hit(origin: np.ndarray, towards: np.ndarray, triangles: np.ndarray, longest: float = np.inf) -> bool:
    """Whether a ray meets one of the triangles (Moeller and Trumbore 1997)."""
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
    """States that look at the chief's centre from 12 to 40 m, and attitudes of the chief."""
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
    lit, seen = (each.numpy() > 0.0 for each in margins(whole, x, attitude, C))
    triangles, half = whole.triangles.numpy(), C.field_of_view / 2
    wrong = hidden = 0
    for b in range(x.shape[1]):
        inverse = torch.cat((-attitude[:3, b], attitude[3:, b]))
        theta = float(x[THETA_S, b])
        sun = rotate(inverse, torch.tensor([np.cos(theta), np.sin(theta), 0.0]).double()).numpy()
        p = rotate(inverse, x[P, b]).numpy()
        for i in range(whole.points.shape[1]):
            point, normal = whole.points[:, i].numpy(), whole.normals[:, i].numpy()
            faces_sun, in_view = normal @ sun > 0.0, normal @ (p - point) > 0.0
            to_point = (point - p) / np.linalg.norm(point - p)
            in_view &= to_point @ (-p / np.linalg.norm(p)) > np.cos(half)
            free = [not hit(point, towards, triangles) for towards in (sun, (p - point))]
            hidden += (faces_sun and not free[0]) + (in_view and not free[1])
            in_light = faces_sun and free[0]
            wrong += (in_light != lit[i, b]) + ((in_light and in_view and free[1]) != seen[i, b])
    assert hidden > 100  # the mesh hides enough for the check to mean something
    assert wrong <= 2  # on an edge, to single precision


def test_a_surface_that_forgets_a_cone_is_caught(whole) -> None:
    x, attitude = some_states(25)
    blind = whole._replace(cones=tuple(group[:, :0] for group in whole.cones))
    assert (margins(blind, x, attitude, C) > 0.0).sum() > (margins(whole, x, attitude, C) > 0.0).sum() + 50


def test_the_sphere_is_seen_as_the_papers(random_states) -> None:
    x = random_states(300)
    ball = surface(ChiefParameters(), C)
    fixed = torch.zeros(4, 300, dtype=torch.float64)
    fixed[3] = 1.0
    ours, papers = margins(ball, x, fixed, C) > 0.0, chief.margins(ball.normals, x, C) > 0.0
    assert (ours != papers).float().mean() < 1e-4 and papers[1].any()


def test_points_are_spread_evenly(whole) -> None:
    edges = whole.triangles[:, 1:] - whole.triangles[:, :1]
    area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).sum()
    assert torch.allclose(whole.areas.sum() * 150 / whole.points.shape[1], area)
    gaps = (whole.points[:, :, None] - whole.points[:, None]).norm(dim=0).fill_diagonal_(99.0)
    assert gaps.amin(1).median() > 0.4 * float(area / 150) ** 0.5


def test_closed_meshes_are_told_from_open_ones(whole) -> None:
    assert is_closed(whole.triangles)
    assert not is_closed(whole.triangles[1:])
    assert not is_closed(whole.triangles.flip(1)[:1])


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
        x, fixed = some_states(2)[0], torch.tensor([[0.0], [0.0], [0.0], [1.0]]).double().expand(4, 2)
        # from straight above it is hidden, from aside it is not
        x[P] = torch.tensor([[0.0, 20.0], [0.0, 0.0], [20.0, 6.0]]).double()
        sun_up = torch.tensor([[0.0], [-(0.5**0.5)], [0.0], [0.5**0.5]]).double().expand(4, 2)
        assert (margins(whole, x, fixed, C)[0] <= 0.0).all()  # the Sun is in its plane
        from inspection.surface import clear

        assert (clear(whole, x[P].float(), 1.0)[0] > 0.0).tolist() == [False, True]
        assert sun_up.shape == fixed.shape


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"triangles": np.ones((4, 3))}, "must be (F, 3, 3)"),
        ({"triangles": 30.0 * np.eye(3)[None]}, "must lie within chief_radius, 10 m"),
        ({"points": np.eye(3), "normals": np.eye(3)}, "needs triangles, or points, normals and areas"),
        ({"points": np.eye(3), "normals": np.eye(3), "areas": np.ones(2)}, "areas (N,)"),
        ({"triangles": np.full((1, 3, 3), np.nan)}, "finite numbers only"),
        ({"triangles": np.ones((1, 3, 3))}, "has no area"),
    ],
)
def test_what_is_no_mesh_is_refused(content, words, tmp_path) -> None:
    np.savez(tmp_path / "bad.npz", **content)
    with pytest.raises(ValueError, match=words.replace("(", r"\(").replace(")", r"\)")):
        surface(ChiefParameters(mesh=str(tmp_path / "bad.npz")), C)


@pytest.mark.parametrize(
    ("name", "words"), [("no.npz", "no such file"), ("a.txt", "must end in"), ("b.stl", "needs triangles")]
)
def test_a_file_that_is_none_is_refused(name, words, tmp_path) -> None:
    if name != "no.npz":
        (tmp_path / name).write_text("nothing", encoding="utf-8")
    with pytest.raises(ValueError, match=words):
        surface(ChiefParameters(mesh=str(tmp_path / name)), C)

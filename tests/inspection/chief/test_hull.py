"""What to stay clear of where it is a mesh's convex hull: planes against distances by non-negative least squares."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from inspection.chief.hull import clearance, reach, with_hull
from inspection.chief.mesh import read
from inspection.model.attitude import rotate
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.termination import failures

MESHES = ("configs/chiefs/box.npz", "configs/chiefs/satellite.stl")
ATTITUDE = (0.25, -0.5, 0.1, 0.8)
C = InspectionParameters()


def hull_of(mesh: str) -> ChiefParameters:
    return ChiefParameters(mesh=mesh, attitude=ATTITUDE, collision="hull")


def corners(mesh: str) -> np.ndarray:
    """Returns corners (n, 3) in Hill's frame."""
    own = torch.as_tensor(read(mesh)["triangles"], dtype=torch.float64).reshape(-1, 3).T
    q = torch.tensor(ATTITUDE, dtype=torch.float64)
    return rotate((q / q.norm())[:, None].expand(4, own.shape[1]), own).T.numpy()


def distance(p: np.ndarray, body: np.ndarray) -> float:
    """Returns the distance from corners' convex hull: the least |sum w_i corner_i - p| with w >= 0 that sum to 1."""
    heavy = 1e4  # of the sum
    matrix = np.vstack((body.T, np.full(len(body), heavy)))
    weights = nnls(matrix, np.append(p, heavy))[0]
    return float(np.linalg.norm(weights @ body / weights.sum() - p))


def some_positions(count: int, low: float, high: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    p = torch.randn(3, count, generator=generator, dtype=torch.float64)
    return p / p.norm(dim=0) * (low + (high - low) * torch.rand(count, generator=generator))


@pytest.mark.parametrize("mesh", MESHES)
def test_clearance_is_never_above_the_distance_and_hardly_below(mesh: str) -> None:
    c, body = with_hull(C, hull_of(mesh)), corners(mesh)
    p = some_positions(200, 10.0, 60.0)
    true = np.array([distance(each, body) for each in p.T.numpy()]) - C.deputy_radius
    off = true - clearance(p, c).numpy()
    assert off.min() > -1e-6
    assert off.max() < 1.5 and np.median(off) < 0.3, "most beyond long edges, between the planes' directions"


@pytest.mark.parametrize("mesh", MESHES)
def test_the_chief_is_behind_every_plane_and_touches_it(mesh: str) -> None:
    body, planes = corners(mesh), np.array(with_hull(C, hull_of(mesh)).planes)
    np.testing.assert_allclose((body @ planes[:, :3].T).max(0), planes[:, 3], rtol=0, atol=1e-5)


@pytest.mark.parametrize("mesh", MESHES)
def test_reach_is_where_clearance_is_zero(mesh: str) -> None:
    c, u = with_hull(C, hull_of(mesh)), some_positions(100, 1.0, 1.0)
    there = reach(u, c)
    assert clearance(there * u, c).abs().max() < 1e-9
    assert there.max() <= C.collision_radius / np.cos(0.2) and there.min() < 10.0
    x = torch.ones(16, u.shape[1], dtype=torch.float64)
    ends = []
    for f in (0.999, 1.001):
        x[:3] = f * there * u
        ends.append(failures(x, c)["crash"])
    just_inside, just_outside = ends
    assert just_inside.all() and not just_outside.any()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, ["needs a mesh"]),
        ({"mesh": MESHES[0], "rate": (0.1, 0.0, 0.0)}, ["without rate"]),
        ({"mesh": MESHES[0], "random_attitude": True}, ["random_attitude"]),
    ],
)
def test_a_hull_is_of_a_mesh_that_does_not_turn(settings: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as refused:
        ChiefParameters(collision="hull", **settings)
    assert all(word in str(refused.value) for word in words)
    with pytest.raises(ValueError, match="sphere or hull"):
        ChiefParameters(collision="cube")

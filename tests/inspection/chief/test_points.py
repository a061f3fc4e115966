"""Inspection points against ray tracing one point at a time and a loop-based k-means."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from inspection.chief import points as chief
from inspection.model.state import THETA_S, P, Q

RADIUS, POINTS, PER_CLUSTER = 10.0, 100, 10


@pytest.fixture(scope="module")
def normals():
    return chief.fibonacci_sphere(POINTS)


@pytest.fixture
def looking(random_states):
    """Returns eight states (16, 8) whose boresight is within about 20 degrees of the chief, at 15.5 to 150 m."""
    x = random_states(8)
    x[P] *= torch.tensor([15.5, 16.0, 18.0, 25.0, 40.0, 60.0, 90.0, 150.0]) / x[P].norm(dim=0)
    for i in range(8):
        boresight = -x[P, i] / x[P, i].norm() + 0.2 * torch.sin(torch.tensor([1.0, 2.0, 3.0]) * (i + 1))
        rotation, _ = Rotation.align_vectors(boresight[None].numpy(), [[1.0, 0.0, 0.0]])
        x[Q, i] = torch.tensor(rotation.as_quat())
    return x


def ray_hits(start, direction):
    """Returns real parameters t at which start + t direction meets the chief's sphere, in ascending order."""
    a, b, k = direction @ direction, 2 * start @ direction, start @ start - RADIUS**2
    discriminant = b * b - 4 * a * k
    if discriminant < 0:
        return []
    return sorted((-b + sign * math.sqrt(discriminant)) / (2 * a) for sign in (-1, 1))


def lloyd(points, wanted, centres, per_cluster, iterations=5):
    """K-means of points[wanted] by loops; centres is a list with None where there is no cluster."""
    wanted = np.flatnonzero(wanted)
    count = math.ceil(len(wanted) / per_cluster)
    centres = [centre if j < count else None for j, centre in enumerate(centres)]
    for j in range(count):
        if centres[j] is None:
            living = [centre for centre in centres if centre is not None]
            gaps = [min((np.linalg.norm(points[i] - m) for m in living), default=math.inf) for i in wanted]
            centres[j] = points[wanted[int(np.argmax(gaps))]]
    for _ in range(iterations):
        members = [[] for _ in range(count)]
        for i in wanted:
            members[int(np.argmin([np.linalg.norm(points[i] - m) for m in centres[:count]]))].append(
                points[i]
            )
        for j in range(count):
            if members[j]:
                centres[j] = np.mean(members[j], axis=0)
    return [centre if j < count and members[j] else None for j, centre in enumerate(centres)]


def choose(counts, generator):
    """Returns random subsets of the given sizes, (N, len(counts)) bool."""
    wanted = torch.zeros(POINTS, len(counts), dtype=torch.bool)
    for column, count in enumerate(counts):
        wanted[torch.randperm(POINTS, generator=generator)[:count], column] = True
    return wanted


def check_against_lloyd(points, wanted, old, centres, alive):
    """Returns the reference's centres, one list per column, after comparing."""
    new = []
    for column in range(wanted.shape[1]):
        expected = lloyd(points.T.numpy(), wanted[:, column].numpy(), old[column], PER_CLUSTER)
        assert alive[:, column].tolist() == [centre is not None for centre in expected]
        for j, centre in enumerate(expected):
            if centre is not None:
                np.testing.assert_allclose(centres[:, j, column], centre, rtol=0, atol=1e-10)
        new.append(expected)
    return new


def test_fibonacci_points_are_nearly_equidistant(normals):
    n = normals.T.numpy()
    gap = np.linalg.norm(n[:, None] - n, axis=-1) + 9.0 * np.eye(POINTS)
    nearest = gap.min(0)
    assert nearest.min() > 0.9 * nearest.mean() and nearest.max() < 1.1 * nearest.mean()
    assert np.linalg.norm(n.mean(0)) < 1e-3


def test_weights_are_the_angles_to_the_opposite_of_priority(normals, generator):
    priority = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    priority /= priority.norm(dim=0)
    angle = np.array([[math.acos(-(n @ r)) for r in priority.T] for n in normals.T])
    weights = chief.point_weights(normals, priority)
    np.testing.assert_allclose(weights, angle / angle.sum(0), rtol=1e-12)
    np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-14)


def test_visible_points_are_those_a_free_ray_reaches_in_the_cone(normals, looking, c):
    lit, seen = chief.in_view(normals, looking, c)
    for i, x in enumerate(looking.T.numpy()):
        p, sun = x[P], np.array([math.cos(x[THETA_S]), math.sin(x[THETA_S]), 0.0])
        boresight = Rotation.from_quat(x[Q]).apply([1.0, 0.0, 0.0])
        for k, point in enumerate(RADIUS * normals.T.numpy()):
            ray = point - p
            in_cone = math.acos(ray @ boresight / np.linalg.norm(ray)) <= math.radians(30.0)
            in_light = all(t < 1e-6 for t in ray_hits(point, sun))
            assert lit[k, i] == in_light
            assert seen[k, i] == (in_cone and in_light and ray_hits(p, ray)[0] > 1 - 1e-6)
    assert (seen.sum(0) > 0).sum() > 3 and seen.sum(0).max() < POINTS / 2


def test_warm_started_clusters_match_loop_based_lloyd(normals, generator):
    """Sets that shrink, grow and vanish; each call starts where the last one ended."""
    points = RADIUS * normals
    alive, centres = torch.zeros(5, 6, dtype=torch.bool), torch.zeros(3, 5, 6, dtype=torch.float64)
    old = [[None] * 5] * 6
    for counts in (
        [0, 1, 9, 10, 11, 50],
        [50, 10, 30, 0, 12, 45],
        [45, 25, 0, 3, 50, 50],
        [11, 49, 41, 28, 1, 3],
    ):
        wanted = choose(counts, generator)
        centres, alive = chief.cluster(points, wanted, centres, alive, PER_CLUSTER)
        old = check_against_lloyd(points, wanted, old, centres, alive)


def test_a_cluster_that_lost_its_points_dies_and_is_seeded_anew(normals):
    points, wanted = RADIUS * normals, (normals[0] > 0.7)[:, None]
    assert PER_CLUSTER < wanted.sum() <= 2 * PER_CLUSTER
    centres = torch.tensor([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]]).double().T[..., None]
    old = [list(centres[..., 0].T.numpy().copy())]
    centres, alive = chief.cluster(points, wanted, centres, torch.ones(2, 1, dtype=torch.bool), PER_CLUSTER)
    old = check_against_lloyd(points, wanted, old, centres, alive)
    assert alive[:, 0].tolist() == [True, False]  # all points were nearer to the first centre
    centres, alive = chief.cluster(points, wanted, centres, alive, PER_CLUSTER)
    check_against_lloyd(points, wanted, old, centres, alive)
    assert alive.all()


def test_nearest_cluster_is_the_direction_of_the_living_centre_nearest_to_the_deputy():
    centres = torch.tensor([[9.0, 0.0, 0.0], [0.0, 4.0, 3.0], [-5.0, 0.0, 0.0]]).double().T[..., None]
    alive = torch.tensor([[True], [True], [False]])
    cases = {(50.0, 0, 0): (1.0, 0, 0), (0, 50.0, 0): (0, 0.8, 0.6), (-50.0, 9.0, 0): (0, 0.8, 0.6)}
    for p, expected in cases.items():
        found = chief.nearest_cluster(centres, alive, torch.tensor(p, dtype=torch.float64)[:, None])
        np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("batch", [1, chief.CHUNK, 2 * chief.CHUNK + 3])
def test_chunks_join_to_the_whole(batch):
    x, y, sizes = torch.randn(3, 2, batch), torch.randn(2, batch), []

    def function(x, y):
        sizes.append(x.shape[-1])
        return [(x * y).sum(0)]

    assert torch.equal(chief.by_chunks(function, x, y)[0], (x * y).sum(0))
    assert sum(sizes) == batch and max(sizes) <= chief.CHUNK

"""The check beside a convex hull, against dense paths, planes in NumPy and distances by non-negative least squares."""

import functools

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.chief.hull import farthest, reach, with_hull
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, P, V
from rta.check.flight import CELLS
from rta.check.intersample_bounds import FreeFlight, Strays, between
from rta.fast.filter import fast
from rta.parameters import RtaParameters
from tests.inspection.chief.test_hull import MESHES, corners, distance, hull_of, some_positions
from tests.oracles import hypercube, length, motion, moved, tensor
from tests.rta.check.flights import ROUNDED, least_of, limits, opposite, random, unit
from tests.support.filters import Unproposed

C = InspectionParameters()
EACH = pytest.mark.parametrize("mesh", MESHES)


@functools.cache
def task(mesh: str) -> InspectionParameters:
    return with_hull(C, hull_of(mesh))


def nearby(count: int, seed: int, c: InspectionParameters, within: float = 40.0) -> Tensor:
    """Returns states (16, count) within a distance of the hull, mostly off its planes, at speeds up to the limit."""
    x, draw = hypercube(count, seed, c), (random(2, count, seed) + 1) / 2
    out = unit(x[P])
    x[P] = out * (reach(out, c) + within * draw[0] ** 2)
    x[V] = unit(x[V]) * draw[1] * (c.docking_speed + c.speed_slope * x[P].norm(dim=0))
    return x


@EACH
@pytest.mark.parametrize(
    ("step", "faster", "e_p", "e_v"), [(0, 0, 0, 0), (3, 0.3, 0, 0), (8, 0.5, 1, 0.05), (0.1, 0.1, 0.3, 0.2)]
)
def test_no_path_within_the_strays_is_below_the_bound(
    mesh: str, step: float, faster: float, e_p: float, e_v: float
) -> None:
    c, count, rng = task(mesh), 300, np.random.default_rng(0)
    start = nearby(count, 1, c)[:6].numpy()
    aside = rng.standard_normal((2, 3, count))
    aside = aside / np.linalg.norm(aside, axis=1, keepdims=True) * rng.uniform(0, 1, count)
    end = start + np.concatenate((step * aside[0], faster * aside[1]))
    off = Strays(*(torch.full((count,), e, dtype=torch.float64) for e in (e_p, e_v, e_v)))
    bound = between(tensor(start), tensor(end), off, c, FreeFlight.of(c, *CELLS)).numpy()
    least, normals = np.full_like(bound, np.inf), np.array(c.planes)[:, :3]
    for share in np.linspace(0, 1, 7):
        middle = start + share * (end - start)
        best = normals[(normals @ middle[:3] - np.array(c.planes)[:, 3:]).argmax(0)].T
        for inwards in (-best, best) if e_p or e_v else (best,):
            for swifter in (inwards, middle[3:] / length(middle[3:])):
                path = motion(middle[:3] + e_p * inwards, middle[3:] + e_v * swifter, c, 10.0)
                least = np.minimum(least, path)
    assert (bound <= least + ROUNDED).all(), (bound - least).max(1)
    assert (bound[[0, 3]] > 0.0).any(1).all() and (bound[[0, 3]] < 0.0).any(1).all()
    if not step:  # and hardly less than there is
        lost = (least - bound)[0][bound[0] > 0.0] - e_v
        assert np.median(lost) < 0.01 + 0.5 * e_p


@EACH
def test_what_lies_beyond_all_of_it_is_above_a_plane(mesh: str) -> None:
    c = task(mesh)
    touching = reach(some_positions(50_000, 1.0, 1.0), c).max()
    assert touching <= farthest(c) < touching + 0.1
    assert farthest(C) == C.collision_radius


def test_pushed_at_the_hull_it_stays_clear_whatever_the_body_does() -> None:
    """The compiled filter, without a program, so that the check has to find all; by the least distance there is."""
    c, body = task(MESHES[0]), corners(MESHES[0])
    plain = Unproposed(c, RtaParameters(period=10.0))
    safety = fast(plain, "cpu", 64)
    x = nearby(200, 8, c)
    x = x[:, safety.is_safe(x)][:, :64]
    few, wish = x[:, :8], limits(c) * random(CONTROL_SIZE, 8, 9)
    one, other = (f.correct(few, wish) for f in (safety, plain))
    torch.testing.assert_close(one.control, other.control, rtol=0, atol=ROUNDED)
    assert torch.equal(one.verified, other.verified) and one.verified.all()
    nearest, backup = np.inf, plain.check
    assert backup
    for call in range(12):
        desired = opposite(backup.law(x), c)
        if call % 2:
            desired[:3] = -c.max_thrust * unit(x[P])
        answer = safety.correct(x, desired)
        assert answer.verified.all()
        for step in range(10):
            x = moved(x, answer.control, 1.0, c)
            least = least_of(x, c, 10.0 if step == call % 4 == 0 else None)
            assert (least > -ROUNDED).all(), (call, least.min(1))
        close = x[P].norm(dim=0).topk(4, largest=False).indices
        nearest = min(nearest, *(distance(p, body) for p in x[P, close].T.numpy()))
    assert c.deputy_radius <= nearest < c.deputy_radius + 3.0

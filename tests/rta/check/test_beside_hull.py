"""The check beside a convex hull, against dense paths, planes in NumPy and distances by non-negative least squares."""

import functools

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.chief.hull import farthest, reach, with_hull
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, P, V
from kernels.compiled import Compiled
from rta.check.flight import CELLS
from rta.check.intersample_bounds import FreeFlight, Strays, between
from rta.check.nominal import KEPT, LIMITS, NominalCheck
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from tests.inspection.chief.test_hull import MESHES, corners, distance, hull_of, some_positions
from tests.oracles import attitude, free_flight, hypercube, length, moved, tensor
from tests.oracles import motion as beside_sphere
from tests.rta.check.flights import limits, opposite, random, unit
from tests.support.filters import Unproposed

C = InspectionParameters()
HOLDS = pytest.mark.parametrize("hold", [1.0, 10.0])
EACH = pytest.mark.parametrize("mesh", MESHES)
ROUNDING = 1e-9


@functools.cache
def task(mesh: str) -> InspectionParameters:
    return with_hull(C, hull_of(mesh))


def motion(p: ndarray, v: ndarray, c: InspectionParameters, spacing: float | None) -> ndarray:
    """Returns `oracles.motion` with planes in place of the sphere; p, v (3, B)."""
    *normals, b = np.array(c.planes).T
    n, b = np.array(normals).T, b[:, None] + c.deputy_radius
    least = beside_sphere(p, v, c, None)
    z, most = n @ p - b, (c.max_speed, c.docking_speed + c.speed_slope * c.max_distance)
    a_max = c.max_thrust / c.mass - 3 * c.mean_motion**2 * c.max_distance - 2 * c.mean_motion * min(most)
    least[0] = (np.sign(z) * np.sqrt(2 * a_max * np.abs(z)) + n @ v).max(0)
    for t in np.arange(0.0, c.passive_safety_horizon + 1e-9, spacing) if spacing else ():
        least[3] = np.minimum(least[3], (n @ free_flight(p, v, t, c.mean_motion) - b).max(0))
    return least


def nearby(count: int, seed: int, c: InspectionParameters, within: float = 40.0) -> Tensor:
    """Returns states (16, count) within a distance of the hull, mostly off its planes, at speeds up to the limit."""
    x, draw = hypercube(count, seed, c), (random(2, count, seed) + 1) / 2
    out = unit(x[P])
    x[P] = out * (reach(out, c) + within * draw[0] ** 2)
    x[V] = unit(x[V]) * draw[1] * (c.docking_speed + c.speed_slope * x[P].norm(dim=0))
    return x


def inside(x: Tensor, c: InspectionParameters, spacing: float = 5.0) -> ndarray:
    """Tells where (B,) all limits are satisfied."""
    y = x.numpy()
    return np.concatenate((motion(y[:3], y[3:6], c, spacing), attitude(y, c))).min(0) >= 0.0


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
    assert (bound <= least + ROUNDING).all(), (bound - least).max(1)
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


def flown(safety: SafetyFilter, x: Tensor) -> Tensor:
    """Returns `NominalCheck.fly` in C, of all limits."""
    none = torch.zeros(LIMITS, x.shape[1], dtype=torch.bool)
    return in_c(safety)(x, none, ~none[:2])[0]


@functools.cache
def in_c(safety: SafetyFilter) -> Compiled:
    """Returns `NominalCheck.fly`."""
    check = safety.check
    assert isinstance(check, NominalCheck)
    given = torch.ones(SIZE, 1, dtype=torch.float64), torch.zeros(LIMITS, 1, dtype=torch.bool)
    return Compiled(lambda *parts: [check.fly(*parts)], *given, ~given[1][:2], long=len(safety.c.planes))


@pytest.mark.campaign
@HOLDS
@EACH
def test_flights_that_are_accepted_keep_every_limit_and_end(mesh: str, hold: float) -> None:
    """Also where one look accepts them. Each step of the plant is looked into, free flight every few minutes."""
    c = task(mesh)
    safety = SafetyFilter(c, RtaParameters(period=hold))
    b, x = safety.check, nearby(700, 6, c)
    assert isinstance(b, NominalCheck)
    x = x[:, torch.from_numpy(inside(x, c))]
    found = flown(safety, x).all(0)
    assert found.double().mean() > 0.85
    law = Compiled(
        lambda x: [b.law(x), b.at_once(x)], torch.ones(SIZE, 1, dtype=torch.float64), long=len(c.planes)
    )
    assert (law(x)[1].amin(0) >= KEPT).any()
    x = x[:, found]
    for call in range(round(700 / hold)):
        u = law(x)[0]
        spacing = 10.0 if call % round(50 / hold) == 0 else None
        for i in range(round(hold)):
            y = x.numpy()
            least = np.concatenate((motion(y[:3], y[3:6], c, None if i else spacing), attitude(y, c)))
            assert (least > -ROUNDING).all(), (call, i, least.min(1))
            x = moved(x, u, 1.0, c)
    assert (b.terminal.room(x) >= 0.0).all()
    assert flown(safety, x).all()


@pytest.mark.parametrize("calls", [4, pytest.param(30, marks=pytest.mark.campaign)])
def test_pushed_at_the_hull_it_stays_clear_whatever_the_body_does(calls: int) -> None:
    """The compiled filter, without a program, so that the check has to find all; by the least distance there is."""
    c, body = task(MESHES[0]), corners(MESHES[0])
    plain = Unproposed(c, RtaParameters(period=10.0))
    safety = fast(plain, "cpu", 64)
    x = nearby(200, 8, c)
    x = x[:, safety.is_safe(x)][:, :64]
    one, other = (f(x, limits(c) * random(CONTROL_SIZE, 64, 9)) for f in (safety.correct, plain.correct))
    torch.testing.assert_close(one.control, other.control, rtol=0, atol=1e-9)
    assert torch.equal(one.verified, other.verified) and one.verified.all()
    nearest, backup = np.inf, plain.check
    assert backup
    for call in range(calls):
        desired = opposite(backup.law(x), c)
        if call % 2:
            desired[:3] = -c.max_thrust * unit(x[P])
        answer = safety.correct(x, desired)
        assert answer.verified.all()
        for _ in range(10):
            x = moved(x, answer.control, 1.0, c)
            y = x.numpy()
            least = np.concatenate((motion(y[:3], y[3:6], c, None), attitude(y, c)))
            assert (least > -ROUNDING).all(), (call, least.min(1))
        close = x[P].norm(dim=0).topk(4, largest=False).indices
        nearest = min(nearest, *(distance(p, body) for p in x[P, close].T.numpy()))
    assert c.deputy_radius <= nearest < c.deputy_radius + 3.0

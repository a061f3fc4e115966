"""The lower bound: its half-spaces on flights, its program against enumeration, and no known flight below it."""

import itertools
import json
import math

import numpy as np
import pytest
import torch
from scipy.optimize import linprog
from torch import Tensor

from experiments import optimum_bound
from experiments.optimum_bound import NODES, Bound, Horizons, Task, climbed, horizons, lower_bound
from inspection.chief.points import fibonacci_sphere
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from study.files import ROOT

C = InspectionParameters()
N = C.mean_motion


def task(points: int, wanted: float, look: float = 10.0) -> Task:
    """Equally weighed points, seen from rest at 60 m in the sunlight."""
    start = torch.tensor([45.0, 40.0, 5.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    weights = torch.full((points,), 1.0 / points, dtype=torch.float64)
    return Task(start, 0.6, fibonacci_sphere(points), weights, wanted, C.chief_radius, N, look)


def flight(own: Task, times: Tensor, when: Tensor, impulses: Tensor) -> Tensor:
    """Positions (3, times) after impulses (k, 3) in m/s at some times (k,), by free flight alone."""
    path = free_flight(own.start[:3, None], own.start[3:, None], times, N)
    for moment, impulse in zip(when, impulses, strict=True):
        after = (times - moment).clamp(min=0.0)
        path = path + free_flight(torch.zeros(3, 1, dtype=torch.float64), impulse[:, None], after, N)
    return path


def unmet(found: Horizons, own: Task, duration: float, windows: int, draws: torch.Generator) -> int:
    """How many looks of a random flight see a point that the half-spaces of neither end of their window allow."""
    window = duration / windows
    when = duration * torch.rand(3, generator=draws, dtype=torch.float64)
    impulses = 0.3 * torch.randn(3, 3, generator=draws, dtype=torch.float64)
    looks = torch.arange(round(duration / own.look) + 1, dtype=torch.float64) * own.look
    height = own.normals.T @ flight(own, looks, when, impulses) - own.radius
    node = window / NODES
    nodes = torch.arange(NODES * windows + 1, dtype=torch.float64) * node
    hat = (1.0 - (when[:, None] - nodes).abs() / node).clamp(min=0.0)
    u, g = hat.T @ impulses, hat.T @ impulses.norm(dim=1)
    met = torch.einsum("pjq,jq->p", found.height, u) + found.error @ g >= found.lowest
    # the pairs of a time follow one another, its points in their order
    end = torch.cumsum(torch.cat((torch.zeros(1), (found.point[1:] <= found.point[:-1]).float())), 0).long()
    allowed = {
        (i, k) for i, k, ok in zip(found.point.tolist(), end.tolist(), met.tolist(), strict=True) if ok
    }
    bad = 0
    for i, look in torch.nonzero((height > 0.0) & own.lit(looks)).tolist():
        first = int(looks[look] // window)
        ends = {first, math.ceil(looks[look] / window), first + (look * own.look % window > 0)}
        bad += not any((i, k) in allowed for k in ends)
    return bad


def test_whatever_is_seen_is_above_a_horizon_of_its_window() -> None:
    """Which would be too high without its errors."""
    own, duration, windows = task(40, 0.95), 1800.0, 6
    found = horizons(own, duration, duration / windows, duration / windows / NODES)
    for horizon, least, most in ((found, 0, 0), (found._replace(error=0.0 * found.error), 11, math.inf)):
        draws = torch.Generator().manual_seed(1)
        assert least <= sum(unmet(horizon, own, duration, windows, draws) for _ in range(40)) <= most


def enumerated(own: Task, duration: float) -> float:
    """The least fuel in m/s of impulses at looks, over all ways to see enough points at looks: a program each."""
    looks = torch.arange(round(duration / own.look) + 1, dtype=torch.float64) * own.look
    count, directions = len(looks), fibonacci_sphere(32).numpy()
    lit = own.lit(looks)
    free = own.normals.T @ free_flight(own.start[:3, None], own.start[3:, None], looks, N)
    reply = torch.zeros(count, count, 3, 3, dtype=torch.float64)  # of a look to an impulse
    for k, j in itertools.product(range(count), range(count)):
        for axis in range(3) if k > j else ():
            velocity = torch.zeros(3, dtype=torch.float64)
            velocity[axis] = 1.0
            reply[k, j, :, axis] = free_flight(
                torch.zeros(3, dtype=torch.float64), velocity, looks[k] - looks[j], N
            )
    enough = math.ceil(own.wanted * own.weights.numel() - 1e-9)
    long = np.hstack((np.kron(np.eye(count), directions.T), -np.kron(np.eye(count), np.ones((32, 1)))))
    best = math.inf
    for points in itertools.combinations(range(own.weights.numel()), enough):
        for when in itertools.product(range(count), repeat=enough):
            if not all(lit[i, k] for i, k in zip(points, when, strict=True)):
                continue
            rows = [
                -torch.einsum("i,jiq->jq", own.normals[:, i], reply[k]).flatten().numpy()
                for i, k in zip(points, when, strict=True)
            ]
            seen = np.hstack((np.array(rows), np.zeros((enough, count))))
            right = [(free[i, k] - own.radius).item() for i, k in zip(points, when, strict=True)]
            found = linprog(
                np.concatenate((np.zeros(3 * count), np.ones(count))),
                A_ub=np.vstack((seen, long)),
                b_ub=np.concatenate((right, np.zeros(len(long)))),
                bounds=[(None, None)] * 3 * count + [(0.0, None)] * count,
            )
            if found.status == 0:
                impulses = found.x[: 3 * count].reshape(count, 3)
                best = min(best, float(np.linalg.norm(impulses, axis=1).sum()))
    return best


@pytest.fixture(scope="module")
def tiny() -> tuple[Task, float, float]:
    """Four points of which three are wanted within 600 s, with looks every 120 s; and what that takes."""
    own = task(4, 0.75, look=120.0)
    return own, 600.0, enumerated(own, 600.0)


def test_the_bound_is_below_what_enumeration_finds_and_near(tiny: tuple[Task, float, float]) -> None:
    own, duration, least = tiny
    found = lower_bound(own, duration, most=5.0, seconds=20.0, windows=5)
    assert found.finished and found.fuel == pytest.approx(found.solution, rel=1e-3)
    assert 0.6 * least < found.fuel <= least
    half = 0.5 * found.fuel
    assert lower_bound(own, duration, half, 20.0, windows=5) == Bound(half, math.inf, True)
    more_looks = own._replace(look=60.0)  # more flights
    assert 0.0 < climbed(more_looks, duration, 0.0, 20.0, 5.0) <= least


def test_a_horizon_that_is_too_high_is_caught(
    tiny: tuple[Task, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    own, duration, least = tiny
    monkeypatch.setattr(optimum_bound, "TOLERANCE", -0.5 * least * duration)  # m, planted
    assert lower_bound(own, duration, most=5.0, seconds=20.0, windows=5).fuel > least


def test_slopes_and_bends_of_the_kernel_are_below_their_bounds() -> None:
    t = torch.linspace(0.0, 7000.0, 1401, dtype=torch.float64)
    near = optimum_bound.kernel(t[:, None] + torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64), N)
    slope = torch.linalg.matrix_norm(near[:, 2] - near[:, 0], 2)
    curve = torch.linalg.matrix_norm(near[:, 2] - 2 * near[:, 1] + near[:, 0], 2) / 0.25
    assert all(slope[i] <= optimum_bound.steepest(t[i].item() + 1.5, N) for i in range(len(t)))
    assert 0.99 * optimum_bound.bend(N) < curve.max() <= optimum_bound.bend(N) * (1 + 1e-6)


def test_no_known_flight_is_below_the_bound() -> None:
    found = json.loads((ROOT / "runs/reference/optimum/optimum.json").read_text(encoding="utf-8"))
    compared = 0
    for flights in found["times"]:
        for case, least in enumerate(flights["bound_m_s"]):
            best = flights["length_m_s"][case]
            assert best is None or least <= best <= flights["delta_v_m_s"][case]
            for way in found["guidance"].values():
                if way["time_s"][case] <= flights["allowed_s"]:
                    compared += 1
                    assert least <= way["delta_v_m_s"][case]
    assert compared > 10

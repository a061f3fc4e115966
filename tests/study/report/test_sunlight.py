"""The earliest success that the Sun allows, against a loop over points and by hand."""

import math
from dataclasses import replace

import numpy as np
import torch

from inspection.chief import points as chief
from inspection.model.parameters import ChiefParameters, InspectionParameters
from study.report.sunlight import earliest_success


def by_loop(theta: float, priority: np.ndarray, c: InspectionParameters) -> float:
    """Returns each point's moment of first light from its angle to the Sun's circle, then points in that order."""
    normals = chief.fibonacci_sphere(c.num_points).T.numpy()
    angles = [math.acos(max(-1.0, min(1.0, -float(n @ priority)))) for n in normals]
    lit_at = []
    for n in normals:
        # n . s(t) = |n_xy| cos(azimuth - theta + n t) is first positive when the Sun is 90 deg before the azimuth
        # the Sun's angle falls by this to reach the point
        ahead = (theta - math.atan2(n[1], n[0])) % (2 * math.pi)
        dark = math.pi / 2 < ahead < 3 * math.pi / 2
        lit_at.append((ahead - math.pi / 2) / c.mean_motion if dark else 0.0)
    total = 0.0
    for time, angle in sorted(zip(lit_at, angles, strict=True)):
        total += angle / sum(angles)
        if total >= c.success_score:
            return time
    return math.inf


def test_it_is_the_moment_at_which_enough_points_have_been_lit():
    c = InspectionParameters()
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.0, 2 * math.pi, 20)
    priority = rng.normal(size=(3, 20))
    priority /= np.linalg.norm(priority, axis=0)
    found = earliest_success(torch.tensor(theta), torch.tensor(priority), c, ChiefParameters()).numpy()
    expected = np.array([by_loop(theta[i], priority[:, i], c) for i in range(20)])
    assert (found >= expected - 1e-6).all() and (found <= expected + c.action_period).all()


def test_a_box_that_stands_straight_is_never_lit_enough_and_one_that_is_tilted_or_turns_is():
    c = InspectionParameters(num_points=120)
    theta = torch.linspace(0.0, 6.0, 8).double()
    priority = torch.nn.functional.normalize(
        torch.randn(3, 8, generator=torch.Generator().manual_seed(0)).double(), dim=0
    )
    straight = ChiefParameters(mesh="configs/chiefs/box.npz")
    tilted = replace(straight, attitude=(0.25, 0.25, 0.0, 0.935))
    turning = replace(straight, rate=(0.3, 0.2, 0.0))
    assert earliest_success(theta, priority, c, straight).isinf().all()
    slow, quick = (earliest_success(theta, priority, c, chief) for chief in (tilted, turning))
    assert slow.isfinite().all() and quick.mean() < 0.7 * slow.mean()

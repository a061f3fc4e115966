"""Random numbers, directions and rotations: uniform, and independent of what they should not depend on."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from inspection.model.draws import (
    counter_based_uniform,
    isotropic,
    random_quaternion,
    shoemake,
    spherical,
    uniform,
)
from tests.support.states import seeded

COUNT = 100_000


def numbers(rows: int) -> Tensor:
    return uniform(0.0, 1.0, rows * COUNT, seeded(rows)).reshape(rows, COUNT)


def test_draws_fill_their_range() -> None:
    draws = uniform(-2.0, 3.0, COUNT, seeded(0))
    assert draws.dtype == torch.float64
    assert stats.kstest(draws.numpy(), "uniform", (-2.0, 5.0)).pvalue > 1e-3


def test_azimuth_and_elevation_are_the_papers() -> None:
    one = torch.ones(1, dtype=torch.float64)
    p = spherical(80.0 * one, math.radians(30) * one, math.radians(60) * one)[:, 0]
    np.testing.assert_allclose(p, [80 * math.sqrt(3) / 4, 20.0, 40 * math.sqrt(3)], rtol=1e-14)


def test_directions_are_unit_and_uniform() -> None:
    directions = isotropic(numbers(2))
    np.testing.assert_allclose(directions.norm(dim=0), 1.0, rtol=1e-14)
    for component in directions.numpy():  # as Archimedes found
        assert stats.kstest(component, "uniform", (-1.0, 2.0)).pvalue > 1e-3


@pytest.mark.parametrize(
    "q",
    [random_quaternion(COUNT, seeded(1), torch.float64), shoemake(numbers(3))],
    ids=["Gaussian", "Shoemake"],
)
def test_rotations_are_unit_and_uniform(q: Tensor) -> None:
    np.testing.assert_allclose(q.norm(dim=0), 1.0, rtol=1e-12)
    # uniform on the 3-sphere: mean 0, second moments 1/4, E[q1^4] = 3/24
    assert q.mean(1).abs().max() < 0.01
    np.testing.assert_allclose(q @ q.T / q.shape[1], np.eye(4) / 4, atol=0.005)
    np.testing.assert_allclose((q**4).mean(1), 0.125, atol=0.003)


def test_hashed_numbers_are_uniform_and_independent_of_key_time_and_row() -> None:
    key = (torch.rand(300, generator=seeded(0), dtype=torch.float64) * 2**53).long()
    found = torch.stack(
        [counter_based_uniform(key, torch.full_like(key, 1000 * t), 13) for t in range(60)]
    )  # time, row, key
    assert stats.kstest(found.flatten().numpy(), "uniform").pvalue > 1e-3
    for axis in range(3):
        by_axis = found.movedim(axis, 0).flatten(1).numpy()
        n = by_axis.shape[1]
        correlation = np.corrcoef(by_axis) - np.eye(len(by_axis))
        assert np.abs(correlation).max() < 5.5 / math.sqrt(n)

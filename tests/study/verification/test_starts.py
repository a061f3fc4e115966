"""Initial states of a verification: in the safe set, all over it, reproducible."""

import math

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.stats import kstest
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.verification.starts import safe_set
from tests.oracles import PSM_TOLERANCE, last_psi, length, paper, speed_limit
from tests.support.filters import without_check
from tests.support.flights import FILTER

C = InspectionParameters()
R = RtaParameters()
COUNT = 1500


class Programs(SafetyFilter):
    """Acts as a filter without a backup trajectory: it accepts starts with every h and every Psi_1 non-negative."""

    def __init__(self) -> None:
        super().__init__(C, R)
        without_check(self)


class Everything(Programs):
    """Acts as a filter that accepts every state, to see the drawn ones."""

    def is_safe(self, x: Tensor) -> Tensor:
        return torch.ones(x.shape[1], dtype=torch.bool)


@pytest.fixture(scope="module")
def start() -> tuple[ndarray, ndarray]:
    x, priority, _ = safe_set(COUNT, 0, Programs())
    return x.numpy(), priority.numpy()


@pytest.fixture(scope="module")
def drawn() -> tuple[ndarray, ndarray]:
    x, priority, _ = safe_set(COUNT, 0, Everything())
    return x.numpy(), priority.numpy()


def test_every_start_satisfies_every_constraint(start: tuple[ndarray, ndarray]) -> None:
    x = start[0]
    assert x.shape == (16, COUNT)
    assert paper(x).min() >= -PSM_TOLERANCE
    assert np.delete(paper(x), 3, 0).min() >= 0.0
    np.testing.assert_allclose(length(x[6:10]), 1.0, atol=1e-12)


def test_states_that_only_psi_rejects_are_counted_up_to_the_last_one_taken() -> None:
    drawn = []

    class Recording(Programs):
        def is_safe(self, x: Tensor) -> Tensor:
            drawn.append(x.numpy())
            return super().is_safe(x)

    x, _, rejected = safe_set(500, 3, Recording())
    every = np.hstack(drawn)
    last = np.flatnonzero((every == x[:, -1:].numpy()).all(0))[0]
    every = every[:, : last + 1]
    kept = (paper(every) >= 0).all(0)
    assert (kept & (last_psi(every) >= 0).all(0)).sum() == 500
    assert rejected == kept.sum() - 500 > 0


def test_starts_fill_their_ranges_before_rejection(drawn: tuple[ndarray, ndarray]) -> None:
    x, priority = drawn
    sides = np.concatenate((x[:3] / length(x[:3]), x[3:6] / length(x[3:6]), priority))
    shares = {
        "distance": (length(x[:3]) - 15) / (795 - 15),
        "speed": length(x[3:6]) / speed_limit(x),
        "temperature": (x[13] - 3) / 7,
        "energy": (x[14] - 1) / 6,
        "sun": x[15] / (2 * np.pi),
        **{f"rate {i}": x[10 + i] / C.max_rate / 2 + 0.5 for i in range(3)},
        **{f"direction {i}": side / 2 + 0.5 for i, side in enumerate(sides)},  # Archimedes
    }
    for name, share in shares.items():
        assert kstest(share, "uniform").pvalue > 1e-4, name


def test_all_drawn_quantities_are_independent(drawn: tuple[ndarray, ndarray]) -> None:
    """Rank correlations of uniform shares, also of their distance from the middle."""
    x, priority = drawn
    p, v = x[:3] / length(x[:3]), x[3:6] / length(x[3:6])
    azimuths = [np.arctan2(side[1], side[0]) for side in (p, v, priority)]
    attitude = [np.arctan2(x[6], x[7]), np.arctan2(x[8], x[9]), np.hypot(x[6], x[7])]
    columns = [length(x[:3]), length(x[3:6]) / speed_limit(x), p[2], v[2], priority[2]]
    columns = np.stack([*columns, *azimuths, *attitude, *x[10:16]])
    assert columns.shape[0] == 17
    rank = columns.argsort(1).argsort(1) / COUNT - 0.5
    folded = np.abs(rank) - 0.25
    correlation = np.corrcoef(np.vstack((rank, folded))) - np.eye(34)
    assert np.abs(correlation).max() < 5 / math.sqrt(COUNT)


def test_rejection_leaves_starts_near_every_limit(start: tuple[ndarray, ndarray]) -> None:
    x = start[0]
    assert length(x[:3]).min() < 60 and length(x[:3]).max() > 780
    assert (length(x[3:6]) / speed_limit(x)).max() > 0.97
    assert x[13].max() > 9.8 and x[14].min() < 1.3
    assert (np.abs(x[10:13]).max(1) > 0.99 * C.max_rate).all()


def test_starts_of_a_filter_that_knows_a_way_are_the_states_that_have_one() -> None:
    x, _, left_out = safe_set(300, 0, FILTER)
    assert FILTER.is_safe(x).all() and (FILTER.values(x) >= 0.0).all()
    assert 0 < left_out < 60  # states within all limits without a backup trajectory

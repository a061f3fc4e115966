"""The initial distribution: the paper's ranges, safe attitudes and determinism."""

import math

import pytest
import torch

from inspection import initial_state
from inspection.initial_state import InitialStates, sample_initial_state
from inspection.model.state import THETA_S, E, P, Q, T
from tests.support.states import seeded


@pytest.fixture(scope="module")
def sample(c):
    return sample_initial_state(20_000, seeded(1), c)


@pytest.mark.parametrize(
    ("quantity", "low", "high"),
    [
        (lambda x, r: x[P].norm(dim=0), 50.0, 100.0),
        (lambda x, r: torch.atan2(x[1], x[0]) % (2 * math.pi), 0.0, 2 * math.pi),
        (lambda x, r: (x[2] / x[P].norm(dim=0)).asin(), -math.pi / 2, math.pi / 2),
        (lambda x, r: x[E], 5.0, 7.0),
        (lambda x, r: x[T], 3.0, 7.0),
        (lambda x, r: x[THETA_S], 0.0, 2 * math.pi),
        (lambda x, r: torch.atan2(r[1], r[0]) % (2 * math.pi), 0.0, 2 * math.pi),
        (lambda x, r: r[2].asin(), -math.pi / 2, math.pi / 2),
    ],
    ids=["radius", "azimuth", "elevation", "E", "T", "theta_S", "priority_azimuth", "priority_elevation"],
)
def test_uniform_over_the_papers_range(sample, quantity, low, high):
    fraction = ((quantity(*sample) - low) / (high - low)).sort().values
    assert fraction[0] >= -1e-12 and fraction[-1] <= 1 + 1e-12
    uniform = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
    assert (fraction - uniform).abs().max() < 1.95 / math.sqrt(20_000)  # Kolmogorov-Smirnov at 0.1 %


def test_states_without_a_safe_attitude_are_redrawn_as_a_whole(c):
    def is_safe(x):
        return (x[0] > 0.0) & (x[Q][3] > 0.5)

    free, priority = sample_initial_state(200, seeded(9), c)
    x, new_priority = sample_initial_state(200, seeded(9), c, is_safe)
    cured = free[0] > 0.0
    others = [*range(6), *range(10, 16)]
    assert is_safe(x).all() and 80 < cured.sum() < 120
    assert torch.equal(x[others][:, cured], free[others][:, cured])
    assert torch.equal(new_priority[:, cured], priority[:, cured])
    again = x[:, ~cured]
    assert (again[P] != free[P][:, ~cured]).all() and (again[[*range(3, 6), *range(10, 13)]] == 0.0).all()
    assert ((again[P].norm(dim=0) >= 50.0) & (again[P].norm(dim=0) <= 100.0)).all()


def test_what_is_rare_is_not_given_up(c, monkeypatch):
    """One state in a hundred is safe; the last of 300 spacecraft needs several hundred draws."""
    monkeypatch.setattr(initial_state, "MAX_ATTITUDES", 0)
    x, _ = sample_initial_state(300, seeded(0), c, lambda x: x[T] < 3.04)
    assert x.shape == (16, 300) and (x[T] < 3.04).all()


def test_supply_does_not_depend_on_how_it_is_taken(c, monkeypatch):
    monkeypatch.setattr(initial_state, "POOL", 7)
    one, other = InitialStates(seeded(6), c), InitialStates(seeded(6), c)
    pieces = [torch.cat(one.take(count)) for count in (1, 0, 12, 7)]
    assert torch.equal(torch.cat(pieces, 1), torch.cat(other.take(20)))

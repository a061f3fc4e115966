"""The laws are flown from the edge of what the check accepts: nothing is broken, and little is given away."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from inspection.model.state import OMEGA, THETA_S, E, P, Q, T, V
from tests.rta.check.flights import (
    CASES,
    C,
    anywhere,
    backup,
    in_c,
    least_between,
    least_of,
    safety,
    vehicle,
)

pytestmark = pytest.mark.usefixtures("long_flights")

COUNT, BISECTIONS, FLIGHT, ROUNDED = 300, 16, 200.0, 1e-9  # states, halvings of what is scaled, s
EACH = pytest.mark.parametrize(
    ("name", "hold", "saturates"),
    [case if case is CASES[2] else pytest.param(*case, marks=pytest.mark.campaign) for case in CASES],
)


def edge(
    x: Tensor, row: slice | int, good: Tensor, bad: Tensor, accepts: Callable[[Tensor], Tensor]
) -> Tensor:
    """Returns states with the last value of a row between a good and a bad one that is accepted."""
    low, high = torch.zeros_like(x[0]), torch.ones_like(x[0])
    for _ in range(BISECTIONS):
        share = (low + high) / 2
        x[row] = good + share * (bad - good)
        fine = accepts(x)
        low, high = torch.where(fine, share, low), torch.where(fine, high, share)
    x[row] = good + low * (bad - good)
    return x


def least_on_the_way(x: Tensor, name: str, hold: float, saturates: bool) -> Tensor:
    """Returns the least of each limit (11, B) while both laws are flown, in the plant's steps."""
    c, flight = vehicle(name, saturates), in_c(name, hold, saturates)
    least = torch.from_numpy(least_of(x, c, 10.0))
    for _ in range(round(FLIGHT / hold)):
        after, _, u, *_ = flight(x)
        least = torch.minimum(least, torch.from_numpy(least_between(x, u, hold, c, look=1.0)))
        x = after
    return least


@EACH
@pytest.mark.parametrize(("row", "limit"), [(T, 8), (E, 9)], ids=["hot", "empty"])
def test_the_hottest_and_the_emptiest_that_are_accepted_keep_their_limits(
    name: str, hold: float, saturates: bool, row: int, limit: int
) -> None:
    c, accepts = vehicle(name, saturates), safety(name, hold, saturates).is_safe
    x = anywhere(COUNT, 3, c)
    x[T], x[E] = c.initial_temperature[0], c.initial_energy[1]
    x = x[:, accepts(x)]
    beyond = c.max_temperature if row == T else c.min_energy
    good = x[row].clone()
    least = least_on_the_way(
        edge(x, row, good, torch.full_like(good, beyond), accepts), name, hold, saturates
    )
    assert (least >= -ROUNDED).all(), least.amin(1)
    given_away = least[limit].median() / (1.0 if row == T else c.energy_sun_slope / C.energy_sun_slope)
    assert given_away < 0.1  # deg C, kJ of the paper's: little


@EACH
def test_the_fastest_that_are_accepted_keep_the_limits(name: str, hold: float, saturates: bool) -> None:
    c, accepts = vehicle(name, saturates), safety(name, hold, saturates).is_safe
    x = anywhere(COUNT, 5, c)
    x[T], x[E] = c.initial_temperature[0], c.initial_energy[1]
    fast = 1.6 * x[V]
    x[V] = 0.001 * fast
    fit = accepts(x)
    x, fast = x[:, fit], fast[:, fit]
    least = least_on_the_way(edge(x, V, 0.001 * fast, fast, accepts), name, hold, saturates)
    assert (least >= -ROUNDED).all(), least.amin(1)
    assert least[:7].amin(0).median() < 0.5


def test_a_turn_that_misses_the_laws_rates_is_not_taken_for_cool() -> None:
    """A law of before led this one 0.002 deg C beyond the limit: it is refused, or flown with nothing broken."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[P.start], x[E], x[T], x[THETA_S] = 100.0, 6.0, 9.991878, 3.956315
    x[Q, 0] = torch.tensor([-0.857427, -0.202538, 0.160551, 0.444994], dtype=torch.float64)
    x[Q] /= x[Q].norm()
    x[OMEGA, 0] = torch.tensor([0.029927, 0.019323, -0.031676], dtype=torch.float64)
    keeps = (least_on_the_way(x, "paper", 10.0, True) >= 0.0).all()
    assert keeps or not backup("paper", 10.0).has_backup_trajectory(x)

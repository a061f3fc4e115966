"""The laws are flown from the edge of what the check accepts: nothing is broken, and little is given away."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.stats import qmc
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, THRUST, TORQUE, E, P, Q, T, V
from rta import SafetyFilter
from rta.backup import brake, slew
from rta.backup.check import Backup
from study.verification.starts import NUMBERS, states_of
from tests.rta.backup.brute_force import moved

C = InspectionParameters()
VALUES = SafetyFilter(C).values
COUNT, BISECTIONS, FLIGHT = 150, 16, 200.0  # states, halvings of what is scaled, s
COOL, CHARGED = 5.0, 6.5  # deg C, kJ, that nothing breaks


def states() -> Tensor:
    """States all over the safe set, whose temperature and energy leave room."""
    numbers = qmc.LatinHypercube(NUMBERS, rng=np.random.default_rng(3)).random(COUNT).T
    x, _ = states_of(torch.from_numpy(numbers.copy()), C)
    x[T], x[E] = COOL, CHARGED
    return x


def edge(
    x: Tensor, row: slice | int, good: Tensor, bad: Tensor, accepts: Callable[[Tensor], Tensor]
) -> Tensor:
    """States with the last value of a row between a good and a bad one that is accepted."""
    low, high = torch.zeros_like(x[0]), torch.ones_like(x[0])
    for _ in range(BISECTIONS):
        share = (low + high) / 2
        x[row] = good + share * (bad - good)
        fine = accepts(x)
        low, high = torch.where(fine, share, low), torch.where(fine, high, share)
    x[row] = good + low * (bad - good)
    return x


def least_on_the_way(x: Tensor, backup: Backup, moves: bool) -> Tensor:
    """The least of every h (13, B) while both laws are flown; without `moves` the spacecraft stays where it is."""
    start, seconds = x.clone(), backup.slewing.hold / (2 * backup.slewing.steps)
    least = VALUES(x)
    for _ in range(round(FLIGHT / backup.slewing.hold)):
        u = torch.zeros(CONTROL_SIZE, x.shape[1], dtype=x.dtype)
        u[TORQUE] = slew.slew(x, backup.slewing)
        if moves:
            u[THRUST] = backup.brakes_with(x, u)
        for _ in range(2 * backup.slewing.steps):
            x = moved(x, u, seconds, backup.c)
            if not moves:
                x[P], x[V] = start[P], start[V]
            least = torch.minimum(least, VALUES(x))
    return least


@pytest.mark.parametrize("hold", [1.0, 5.0, 10.0])
@pytest.mark.parametrize(("row", "beyond", "limit"), [(T, 10.0, 8), (E, 1.0, 9)], ids=["hot", "empty"])
def test_the_hottest_and_the_emptiest_that_are_accepted_keep_their_limits(
    hold: float, row: int, beyond: float, limit: int
) -> None:
    backup = Backup(C, hold)
    x = states()
    x = x[:, slew.way(x, backup.slewing) >= 0.0]
    good = x[row].clone()
    x = edge(x, row, good, torch.full_like(good, beyond), lambda y: slew.way(y, backup.slewing) >= 0.0)
    least = least_on_the_way(x, backup, moves=False)
    assert (least[7:10] >= 0.0).all()
    assert least[limit].median() < 0.05  # deg C, kJ: little is given away


@pytest.mark.parametrize("hold", [1.0, 5.0, 10.0])
def test_the_fastest_that_are_accepted_keep_the_limits_of_motion(hold: float) -> None:
    backup = Backup(C, hold)

    def accepts(x: Tensor) -> Tensor:
        return backup.brakes(brake.beginning(x, backup.braking))

    x = states()
    fast = 1.6 * x[V]
    x[V] = 0.001 * fast
    fit = accepts(x) & (slew.way(x, backup.slewing) >= 0.0)
    x, fast = x[:, fit], fast[:, fit]
    x = edge(x, V, 0.001 * fast, fast, accepts)
    assert (least_on_the_way(x, backup, moves=True)[:7] >= 0.0).all()


def test_a_turn_that_misses_the_laws_rates_is_not_taken_for_cool() -> None:
    """The law led this one 0.002 deg C beyond the limit: the path that it does not fly yet was counted as flown."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[0], x[E], x[T], x[THETA_S] = 100.0, 6.0, 9.991878, 3.956315
    x[Q, 0] = torch.tensor([-0.857427, -0.202538, 0.160551, 0.444994], dtype=torch.float64)
    x[Q] /= x[Q].norm()
    x[OMEGA, 0] = torch.tensor([0.029927, 0.019323, -0.031676], dtype=torch.float64)
    backup = Backup(C, 10.0)
    assert least_on_the_way(x, backup, moves=False)[8] < 0.0
    assert not backup.has_way(x)

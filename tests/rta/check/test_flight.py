"""A hold as it is looked at: it ends where the plant is, and nothing between is below the least that it returns."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA
from rta.check import flight
from tests.rta.check.flights import (
    EACH,
    ROUNDED,
    backup,
    everywhere,
    least_between,
    limits,
    random,
    turning,
    vehicle,
)

COUNT = 1000


def controls(x: Tensor, period: float, c: InspectionParameters) -> Tensor:
    """Returns controls of any size with little torque, at corners, and both with torque towards the rates' limits."""
    count = x.shape[1]
    any_size, corners = random(6, count, 1), random(6, count, 2).sign()
    kind = torch.arange(count) % 4
    u = limits(c) * torch.where(kind % 2 == 0, any_size, corners)
    u[3:, kind == 0] *= 0.05
    u[3:, kind >= 2] = turning(x, period, 3, c)[:, kind >= 2]
    return u


@EACH
def test_a_hold_ends_where_the_plant_does(name: str, hold: float, saturates: bool) -> None:
    """Bit for bit, in a plant that holds the rates, too, where the least of them in the hold is not negative."""
    c, w = vehicle(name, saturates), backup(name, hold, saturates).flight
    x = everywhere(COUNT, 1, c)
    u = controls(x, hold, c)
    seconds = min(c.substep, hold)
    yes = torch.ones(COUNT, dtype=torch.bool)
    end, least = flight.hold(x, u, yes, w)
    for plant, same in ((replace(c, saturate_rates=False), yes), (c, least[10] >= 0.0)):
        expected = x
        for _ in range(round(hold / seconds)):
            expected = step(expected, u, seconds, plant)
        assert same.sum() > 50 and torch.equal(end[:, same], expected[:, same])


@EACH
def test_no_limit_is_below_its_least_in_a_hold(name: str, hold: float, saturates: bool) -> None:
    c, w = vehicle(name, False), backup(name, hold, saturates).flight
    x = everywhere(COUNT, 5, c)
    x[OMEGA, ::3] = c.max_rate * random(3, COUNT, 7).sign()[:, ::3]  # full torque may be held at the limit
    u = controls(x, hold, c)
    yes = torch.ones(COUNT, dtype=torch.bool)
    bounds, least = flight.hold(x, u, yes, w)[1].numpy(), least_between(x, u, hold, c, spacing=5.0, look=0.1)
    below = bounds - least
    assert (below <= ROUNDED).all(), below.max(1)
    lost_by = (0.05, 0.05, 0.05, 3.0, 0.02, 0.02, 0.02, 0.01, 0.01, 0.05, 1e-3)
    for row, most in enumerate(lost_by):
        inside = least[row] > (2e-3 if row == 10 else 0.05)
        assert inside.sum() > 50, row
        lost = np.median(-below[row][inside])
        assert lost < most * (2.0 if row < 7 and hold > 1.0 else 1.0), (row, lost)

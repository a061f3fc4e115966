"""What was verified once is verified for ever, whatever is proposed: the next state lies on what the check flew.

In PyTorch, in C for batches and in the exported C; at 1, 5 and 10 s, with rates that the plant holds and that it does
not; from states all over the safe set, from starts that are far out and fast, and from those next to the limits.
"""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THRUST, TORQUE
from rta.constraints.constraint import Constraint
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters
from rta.qp.batched_solver import BatchedSolver
from rta.result import FilterResult
from tests.rta.backup.brute_force import moved
from tests.rta.backup.flights import (
    CASES,
    C,
    backup,
    everywhere,
    far_and_fast,
    in_c,
    least_of,
    limits,
    opposite,
    random,
    safety,
    vehicle,
)
from tests.rta.printed.test_driver import Driver

EACH = pytest.mark.parametrize(("name", "period", "saturates"), CASES)
HOLDS = pytest.mark.parametrize("period", PERIODS)
RATES_HELD = 1e-15  # rad/s, of rounding where the plant holds them at their limit
Ask = Callable[[int, Tensor], Tensor]  # which call it is, and states, to desired controls


def proposals(name: str, period: float, saturates: bool) -> Ask:
    """A column each of what is opposite to the laws, at a random corner, held for a while, nothing, and no number."""
    c, flight = vehicle(name, saturates), in_c(name, period, saturates)

    def ask(call: int, x: Tensor) -> Tensor:
        count = x.shape[1]
        kind = torch.arange(count) % 6
        u = opposite(flight(x)[2], c)
        corner, held = random(6, count, call).sign(), random(6, count, call // round(20 / period)).sign()
        u = torch.where(kind == 1, limits(c) * corner, u)
        u = torch.where(kind == 2, 3.0 * limits(c) * held, u)
        u[THRUST, kind == 3] = 0.0
        u[TORQUE, kind == 4] = 0.0
        u[:, kind == 5] = torch.zeros_like(u).masked_fill(random(6, count, call) > 0.5, torch.nan)[
            :, kind == 5
        ]
        return u

    return ask


def assert_kept(x: Tensor, c: InspectionParameters, spacing: float | None, where: str) -> None:
    """Every limit by formulas that are not the code's own."""
    least = least_of(x, c, spacing)
    least[-1] += RATES_HELD
    assert (least >= 0.0).all(), (where, least.min(1), x[:, least.min(0).argmin()].tolist())


def fly(
    correct: Callable[[Tensor, Tensor], FilterResult], x: Tensor, ask: Ask, c: InspectionParameters, period: float,
    seconds: float,
) -> int:  # fmt: skip
    """Flies behind a filter from states that it verifies; returns in how many calls the check changed something."""
    changed = 0
    for call in range(round(seconds / period)):
        result = correct(x, ask(call, x))
        assert result.verified.all(), (call, x[:, ~result.verified][:, 0].tolist())
        changed += int(result.backup.sum())
        for _ in range(round(period / c.substep)):
            x = moved(x, result.control, c.substep, c)
            assert_kept(x, c, None, f"call {call}")
        if call % 8 == 0:
            assert_kept(x, c, 10.0, f"call {call}")
    return changed


def starts(name: str, period: float, saturates: bool, count: int, seed: int) -> Tensor:
    """States (16, count) that are accepted: half of all kinds, half far out and fast."""
    c, accepts = vehicle(name, saturates), safety(name, period, saturates).is_safe
    parts = []
    for draw in (everywhere, far_and_fast):
        x = draw(4 * count, seed, c)
        parts.append(x[:, accepts(x)][:, : count // 2])
    x = torch.cat(parts, 1)
    assert x.shape[1] == count // 2 * 2
    return x[:, torch.randperm(count // 2 * 2, generator=torch.Generator().manual_seed(seed))]


@EACH
def test_whatever_is_proposed_all_stays_verified_in_c(name: str, period: float, saturates: bool) -> None:
    c, safe = vehicle(name, saturates), safety(name, period, saturates)
    x = starts(name, period, saturates, 120, 1)
    assert fly(safe.correct, x, proposals(name, period, saturates), c, period, 120.0) > 150


@pytest.mark.parametrize(("name", "period", "saturates"), [("paper", 10.0, True), ("12u", 5.0, False)])
def test_whatever_is_proposed_all_stays_verified_in_pytorch(
    name: str, period: float, saturates: bool
) -> None:
    c, safe = vehicle(name, saturates), safety(name, period, saturates, compiled=False)
    x = starts(name, period, saturates, 6, 2)
    assert fly(safe.correct, x, proposals(name, period, saturates), c, period, 40.0) > 3


@pytest.mark.parametrize(("name", "period", "saturates"), [CASES[0], CASES[1], CASES[4]])
def test_whatever_is_proposed_all_stays_verified_in_the_exported_c(
    name: str, period: float, saturates: bool, tmp_path: Path
) -> None:
    c, own = vehicle(name, saturates), safety(name, period, saturates)
    driver = Driver(SafetyFilter(c, own.parameters, BatchedSolver()), tmp_path)
    x = starts(name, period, saturates, 24, 3)
    changed = fly(
        lambda y, u: driver(y, u, None, None), x, proposals(name, period, saturates), c, period, 120.0
    )
    assert changed > 20


@HOLDS
def test_a_limit_of_the_users_own_that_never_yields_takes_none_away(period: float) -> None:
    """It asks for 0.5 m/s along a direction, or for a turn, where the laws are about to brake."""

    def outwards(y: Tensor) -> Tensor:
        return 0.6 * y[3] + 0.64 * y[4] - 0.48 * y[5] - 2.0

    def turning(y: Tensor) -> Tensor:
        return y[10] - 0.5 * C.max_rate

    extra = [
        Constraint("outwards", outwards, held_by="thrust", gains=(0.5,), weight=math.inf),
        Constraint("turning", turning, held_by="torque", gains=(0.5,), weight=math.inf),
    ]
    safe = SafetyFilter(C, RtaParameters(period=period), extra=extra)
    safe.compile("cpu", 64)
    x = starts("paper", period, True, 12, 4)
    assert fly(safe.correct, x, lambda _, y: torch.zeros_like(y[:6]), C, period, 20.0) > 0


@EACH
def test_the_flight_from_the_next_state_is_the_rest_of_the_one_looked_at(
    name: str, period: float, saturates: bool
) -> None:
    """Bit for bit, and so is what the plant does: in PyTorch, whose columns do not know of each other."""
    c, b = vehicle(name, saturates), backup(name, period, saturates)
    x = starts(name, period, saturates, 16, 5)
    asked = torch.where(random(6, 16, 6).abs() > 2.0, torch.nan, opposite(b.law(x), c))
    u = safety(name, period, saturates).correct(x, asked).control
    y, least = b.hold(x, u)
    flight, limit = [y], [least]
    for _ in range(6):
        y, least = b.hold(y, b.law(y))
        flight.append(y)
        limit.append(least)
    plant = x
    for i, expected in enumerate(flight):
        for _ in range(round(period / c.substep)):
            plant = step(plant, u, c.substep, c)
        assert torch.equal(plant, expected), i
        again, told = b.hold(plant, b.law(plant))
        if i + 1 < len(flight):
            assert torch.equal(again, flight[i + 1]) and torch.equal(told, limit[i + 1])
        u = b.law(plant)

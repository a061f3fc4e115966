"""What was verified once is verified for ever, whatever is proposed: the next state lies on what the check flew.

In PyTorch, in C for batches and in the exported C; at 1, 5 and 10 s, with rates that the plant holds and that it does
not; from states all over the safe set, from starts that are far out and fast, and from those next to the limits.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import THRUST, TORQUE
from rta.fast.loaded import InC
from rta.result import FilterResult
from tests.oracles import moved
from tests.rta.check.flights import (
    CASES,
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
from tests.support.filters import Unproposed

SHORT = ("paper", 10.0, True)
LONG = [pytest.param(*case, marks=pytest.mark.campaign) for case in CASES]
RATES_HELD = 1e-15  # rad/s, of rounding where the plant holds them at their limit
Ask = Callable[[int, Tensor], Tensor]  # which call it is, and states, to desired controls


def proposals(name: str, period: float, saturates: bool) -> Ask:
    """Returns proposals by column: opposite to the laws or a part of it, random corners, held corners, and NaN."""
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
    """Asserts every limit by formulas that are not the code's own."""
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
    """Returns states (16, count) that are accepted: half of all kinds, half far out and fast."""
    c, accepts = vehicle(name, saturates), safety(name, period, saturates).is_safe
    parts = []
    for draw in (everywhere, far_and_fast):
        x = draw(4 * count, seed, c)
        parts.append(x[:, accepts(x)][:, : count // 2])
    x = torch.cat(parts, 1)
    assert x.shape[1] == count // 2 * 2
    return x[:, torch.randperm(count // 2 * 2, generator=torch.Generator().manual_seed(seed))]


@pytest.mark.parametrize(("name", "period", "saturates"), LONG)
def test_whatever_is_proposed_all_stays_verified_in_c(name: str, period: float, saturates: bool) -> None:
    c, safe = vehicle(name, saturates), safety(name, period, saturates)
    x = starts(name, period, saturates, 120, 1)
    assert fly(safe.correct, x, proposals(name, period, saturates), c, period, 120.0) > 150


@pytest.mark.parametrize(("name", "period", "saturates"), [SHORT, LONG[3]])
def test_whatever_is_proposed_all_stays_verified_in_pytorch(
    name: str, period: float, saturates: bool
) -> None:
    c, safe = vehicle(name, saturates), safety(name, period, saturates, compiled=False)
    x = starts(name, period, saturates, 6, 2)
    assert fly(safe.correct, x, proposals(name, period, saturates), c, period, 40.0) > 3


@pytest.mark.parametrize(("name", "period", "saturates"), [LONG[0], LONG[1], LONG[4]])
def test_whatever_is_proposed_all_stays_verified_in_the_exported_c(
    name: str, period: float, saturates: bool
) -> None:
    c, own = vehicle(name, saturates), safety(name, period, saturates)
    exported = InC(Unproposed(c, own.parameters))
    x = starts(name, period, saturates, 24, 3)
    changed = fly(exported.correct, x, proposals(name, period, saturates), c, period, 120.0)
    assert changed > 20

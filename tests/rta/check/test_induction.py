"""What was verified once is verified for ever, whatever is proposed: the next state lies on what the check flew.

In PyTorch, in C for batches and in the exported C; at 1, 5 and 10 s, with rates that the plant holds and that it does
not; from states all over the safe set, and from starts that are far out and fast.
"""

import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import THRUST, TORQUE
from rta.fast.loaded import InC
from tests.oracles import moved
from tests.rta.check.flights import (
    LONG,
    SHORT,
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

RATES_HELD = 1e-15  # rad/s, of rounding where the plant holds them at their limit
FLIGHTS = [
    ("C", *SHORT[0], 120, 120.0),
    ("PyTorch", *SHORT[0], 4, 30.0),
    *(
        pytest.param(*flight, marks=pytest.mark.campaign)
        for flight in (
            *(("C", *case, 120, 120.0) for case in (SHORT[1], *LONG, ("paper", 5.0, True))),
            *(("exported C", *case, 24, 120.0) for case in (LONG[0], SHORT[1])),
        )
    ),
]


def proposed(call: int, x: Tensor, laws: Tensor, period: float, c: InspectionParameters) -> Tensor:
    """Returns by column: opposite to the laws or a part of it, random corners, held corners, and NaN."""
    count = x.shape[1]
    kind = torch.arange(count) % 6
    corner, held = random(6, count, call).sign(), random(6, count, call // round(20 / period)).sign()
    u = torch.where(kind == 1, limits(c) * corner, opposite(laws, c))
    u = torch.where(kind == 2, 3.0 * limits(c) * held, u)
    u[THRUST, kind == 3] = 0.0
    u[TORQUE, kind == 4] = 0.0
    return torch.where(kind == 5, torch.where(random(6, count, call) > 0.5, torch.nan, 0.0), u)


@pytest.mark.parametrize(("way", "name", "period", "saturates", "count", "seconds"), FLIGHTS)
def test_whatever_is_proposed_all_stays_verified(
    way: str, name: str, period: float, saturates: bool, count: int, seconds: float
) -> None:
    """By formulas that are not the code's own; half of the starts are far out and fast."""
    c, flight = vehicle(name, saturates), in_c(name, period, saturates)
    compiled = safety(name, period, saturates)
    plain = Unproposed(c, compiled.parameters)
    correct = (InC(plain) if way == "exported C" else compiled if way == "C" else plain).correct
    parts = [draw(4 * count, 1, c) for draw in (everywhere, far_and_fast)]
    x = torch.cat([part[:, compiled.is_safe(part)][:, : count // 2] for part in parts], 1)
    x = x[:, torch.randperm(count, generator=torch.Generator().manual_seed(1))]
    changed, calls = 0, round(seconds / period)
    for call in range(calls):
        result = correct(x, proposed(call, x, flight(x)[2], period, c))
        assert result.verified.all(), (call, x[:, ~result.verified][:, 0].tolist())
        changed += int(result.backup.sum())
        for step in range(round(period / c.substep)):
            x = moved(x, result.control, c.substep, c)
            least = least_of(x, c, 10.0 if step == call % 8 == 0 else None)
            least[-1] += RATES_HELD
            assert (least >= 0.0).all(), (call, least.min(1), x[:, least.min(0).argmin()].tolist())
    assert changed > 0.1 * count * calls

"""The laws are flown from the edge of what the check accepts: nothing is broken, and little is given away."""

import pytest
import torch
from torch import Tensor

from inspection.model.state import E, T, V
from tests.rta.check.flights import (
    EACH,
    ROUNDED,
    C,
    anywhere,
    in_c,
    least_between,
    least_of,
    safety,
    vehicle,
)
from tests.support.states import last_accepted

COUNT, FLIGHT = 300, 200.0  # states, s


@EACH
@pytest.mark.parametrize("what", ["hot", "empty", "fast"])
def test_the_last_that_are_accepted_keep_the_limits(
    name: str, hold: float, saturates: bool, what: str
) -> None:
    c, accepts, flight = (
        vehicle(name, saturates),
        safety(name, hold, saturates).is_safe,
        in_c(name, hold, saturates),
    )
    x = anywhere(COUNT, 5, c)
    x[T], x[E] = c.initial_temperature[0], c.initial_energy[1]
    row, good, bad = {
        "hot": (T, x[T].clone(), torch.full_like(x[T], c.max_temperature)),
        "empty": (E, x[E].clone(), torch.full_like(x[E], c.min_energy)),
        "fast": (V, 0.0016 * x[V], 1.6 * x[V]),
    }[what]
    x[row] = good
    fit = accepts(x)
    x, good, bad = x[:, fit], good[..., fit], bad[..., fit]

    def towards_bad(share: Tensor) -> Tensor:
        x[row] = good + share * (bad - good)
        return x

    x = towards_bad(last_accepted(lambda share: accepts(towards_bad(share)), x.shape[1]))
    least = torch.from_numpy(least_of(x, c, 10.0))
    for _ in range(round(FLIGHT / hold)):
        after, _, u, *_ = flight(x)
        least = torch.minimum(least, torch.from_numpy(least_between(x, u, hold, c, look=1.0)))
        x = after
    assert (least >= -ROUNDED).all(), least.amin(1)
    given_away, little = {
        "hot": (least[8], 0.1),  # deg C
        "empty": (least[9], 0.1 * c.energy_sun_slope / C.energy_sun_slope),  # kJ
        "fast": (least[:7].amin(0), 0.5),
    }[what]
    assert given_away.median() < little

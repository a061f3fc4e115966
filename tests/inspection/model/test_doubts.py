"""States that look like ones in other units or another order."""

from dataclasses import replace

import pytest
import torch

from inspection.model.doubts import doubts
from inspection.model.state import E, Q, T


@pytest.mark.parametrize(
    ("component", "value", "said"),
    [
        (T, 278.15, "is it in K"),
        (E, 6000.0, "is it in J"),
        (E, -0.1, "below zero"),
        (Q, (1.0, 0.0, 0.0, 0.0), "is its scalar first"),
    ],
)
def test_one_of_many_is_enough(component, value, said, random_states, c) -> None:
    x = random_states(100)
    assert doubts(x, c) == []
    x[component, 57] = torch.tensor(value, dtype=x.dtype)
    (found,) = doubts(x, c)
    assert said in found


def test_another_vehicle_has_other_measures(random_states, c) -> None:
    x = random_states(3)
    x[T, 0], x[E, 1] = 200.0, 6000.0
    assert doubts(x, replace(c, max_temperature=80.0, initial_energy=(500.0, 700.0))) == []

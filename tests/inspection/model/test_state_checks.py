"""Which states a spacecraft can be in."""

import pytest
import torch

from inspection.model.parameters import InspectionParameters
from inspection.model.state import Q, T
from inspection.model.state_checks import is_state
from tests.support.states import IMPOSSIBLE, at_rest, impossible

C = InspectionParameters()


def test_states_of_flights_are_possible(random_states) -> None:
    x = random_states(500)
    assert is_state(x, C).all()
    x[T] = -273.1
    x[Q] *= 1.0 + 9e-5  # as single precision may leave it
    assert is_state(x, C).all()


@pytest.mark.parametrize("kind", IMPOSSIBLE)
def test_impossible_states_are_told_apart(kind: str) -> None:
    assert is_state(torch.cat((at_rest(), impossible(kind)), 1), C).tolist() == [True, False]

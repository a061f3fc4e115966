"""What the world tells a filter: the controls held since a state was measured, and what is left of each actuator."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from inspection.closed_loop import Clocks, closed_loop
from inspection.model.state import SIZE
from inspection.world.parameters import PlantParameters
from tests.inspection.world.test_plant import begun, moments

BATCH, CALLS = 40, 12
LATE = PlantParameters(latency=(0, 3), missed_calls=0.4, missed_in_a_row=2)


class Informed:
    """Acts as a filter that counts its calls, asks for their number, and keeps its inputs."""

    def __init__(self) -> None:
        self.told: list[dict[str, Tensor]] = []

    def __call__(self, x: Tensor, desired: Tensor, **told: Tensor) -> SimpleNamespace:
        self.told.append({name: value.clone() for name, value in told.items()})
        return SimpleNamespace(control=torch.full_like(desired, float(len(self.told))))


def fly(plant, period: float = 1.0):
    """Returns the filter, and the held controls from each call on, (calls, 6, BATCH)."""
    plant.every, correct = period, Informed()
    batch = plant.key.numel()
    x = torch.zeros(SIZE, batch, dtype=torch.float64)
    x[9] = 1.0
    clocks = Clocks(period, period, period, period)
    holds = closed_loop(
        x,
        lambda t, seen: torch.zeros_like(seen[:6]),
        correct,
        lambda x, u, seconds: x,
        clocks,
        CALLS * period,
        plant,
        moments(batch),
        True,
    )
    return correct, torch.stack([hold.applied for hold in holds])


def by_hand(held: Tensor, latency: Tensor, call: int) -> Tensor:
    """Returns (3, 6, BATCH), the oldest first: controls of as many calls as the state is old, at most of all calls."""
    sent = torch.full((3, *held.shape[1:]), math.nan, dtype=torch.float64)
    for column, age in enumerate(latency.tolist()):
        for back in range(1, min(age, call) + 1):
            sent[3 - back, :, column] = held[call - back, :, column]
    return sent


@pytest.mark.parametrize("period", [1.0, 5.0])
def test_what_was_held_since_the_state_is_told_though_calls_were_missed(period: float) -> None:
    plant = begun(LATE, BATCH)
    correct, held = fly(plant, period=period)
    latency = plant.drawn.latency
    assert latency.unique().tolist() == [0, 1, 2, 3]
    missed = held[:, 0] != torch.arange(1.0, CALLS + 1)[:, None]
    assert 0.2 < missed.double().mean() < 0.5
    for call, told in enumerate(correct.told):
        torch.testing.assert_close(told["sent"], by_hand(held, latency, call), rtol=0, atol=0, equal_nan=True)
    # the desired controls in place of the held ones would give other numbers
    asked = torch.arange(1.0, CALLS + 1, dtype=torch.float64)[:, None, None].expand_as(held)
    assert not torch.equal(
        correct.told[-1]["sent"].nan_to_num(), by_hand(asked, latency, CALLS - 1).nan_to_num()
    )


def test_episodes_that_begin_anew_know_of_no_earlier_control() -> None:
    plant = begun(LATE, BATCH)
    fly(plant)
    anew = torch.arange(0, BATCH, 2)
    plant.begin(anew, torch.zeros(16, len(anew)), torch.linspace(0.0, 0.9, len(anew), dtype=torch.float64))
    time = moments(BATCH, float(CALLS))
    time[anew] = 0.0
    sent = plant.filter_inputs(time)["sent"]
    assert sent[..., anew].isnan().all()
    others = torch.arange(1, BATCH, 2)
    counts = (~sent[:, 0, others].isnan()).sum(0)
    assert torch.equal(counts, plant.drawn.latency[others])

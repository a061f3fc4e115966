"""What is accepted by one look is accepted by the flight, too, which takes no more holds than are allowed."""

import pytest
import torch
from torch import Tensor

from rta.backup.check import ENDS, KEPT, MOTION
from tests.rta.backup.flights import CASES, backup, everywhere, in_c, least_of, opposite, safety, vehicle

COUNT = 24_000  # states of each case


def flights(name: str, hold: float, saturates: bool, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whether flights from states (16, B) end, of thrust and torque, (2, B); by how much; the hold in which they do.

    The least of each limit counts up to where its group has arrived.
    """
    flight, terminal = in_c(name, hold, saturates), backup(name, hold, saturates).terminal
    least = torch.full((11, x.shape[1]), torch.inf, dtype=torch.float64)
    ended = torch.full((2, x.shape[1]), -1)
    room = terminal.room(x)
    for call in range(2 * backup(name, hold, saturates).holds):
        there = torch.stack([(room[list(ENDS[group])] >= 0.0).all(0) for group in range(2)])
        ended = torch.where((ended < 0) & there, call, ended)
        if (ended >= 0).all():
            break
        x, told, _, _, room = flight(x)
        for group, own in ((0, slice(0, MOTION)), (1, slice(MOTION, 11))):
            least[own] = torch.where(ended[group] >= 0, least[own], torch.minimum(least[own], told[own]))
    return ended >= 0, torch.stack((least[:MOTION].amin(0), least[MOTION:].amin(0))), ended


@pytest.mark.parametrize(("name", "hold", "saturates"), CASES)
def test_what_one_look_accepts_the_flight_accepts(name: str, hold: float, saturates: bool) -> None:
    c, b = vehicle(name, saturates), backup(name, hold, saturates)
    x = everywhere(COUNT, 21, c)
    x = x[:, torch.from_numpy((least_of(x, c) >= 0.0).all(0))]
    once = in_c(name, hold, saturates)(x)[3]
    accepted = torch.stack((once[:MOTION].amin(0), once[MOTION:].amin(0))) >= KEPT
    assert (accepted.double().mean(1) > 0.1).all(), accepted.double().mean(1)
    ended, least, holds = flights(name, hold, saturates, x)
    for group in range(2):
        own = accepted[group]
        assert ended[group][own].all()
        assert (least[group][own] >= KEPT).all(), (group, least[group][own].min(), x[:, own][:, least[group][own].argmin()].tolist())
        assert holds[group][own].max() <= 0.9 * b.holds, (holds[group][own].max(), b.holds)


@pytest.mark.parametrize(("name", "hold", "saturates"), CASES)
def test_no_flight_that_keeps_the_limits_takes_more_holds_than_are_allowed(
    name: str, hold: float, saturates: bool
) -> None:
    c, b = vehicle(name, saturates), backup(name, hold, saturates)
    x = everywhere(COUNT // 2, 22, c)
    _, least, holds = flights(name, hold, saturates, x)
    fine = least >= KEPT
    assert (holds[fine] >= 0).all()
    assert holds[fine].max() <= 0.9 * b.holds, (holds[fine].max(), b.holds)


@pytest.mark.parametrize(("name", "hold", "saturates"), CASES)
def test_it_decides_after_a_hold_opposite_to_the_law_as_the_flight_does(
    name: str, hold: float, saturates: bool
) -> None:
    """Where the filter asks it: behind one hold of any control."""
    c, filtered = vehicle(name, saturates), safety(name, hold, saturates)
    x = everywhere(COUNT // 3, 23, c)
    x = x[:, filtered.is_safe(x)]
    after = filtered.correct(x, opposite(in_c(name, hold, saturates)(x)[2], c))
    y = backup(name, hold, saturates).hold(x, after.control)[0]
    once = in_c(name, hold, saturates)(y)[3]
    accepted = torch.stack((once[:MOTION].amin(0), once[MOTION:].amin(0))) >= KEPT
    ended, least, _ = flights(name, hold, saturates, y)
    assert accepted.any(1).all()
    assert ((ended & (least >= KEPT)) | ~accepted).all()

"""What is accepted by one look is accepted by the flight, too, which takes no more holds than are allowed."""

import numpy as np
import torch
from torch import Tensor

from rta.check.commit import MOTION
from rta.check.nominal import ENDS, KEPT
from tests.oracles import moved
from tests.rta.check.flights import EACH, ROUNDED, backup, everywhere, in_c, least_of, vehicle

COUNT = 10_000  # states of each case


def of_groups(least: Tensor) -> Tensor:
    """Returns the least of the limits of thrust and of torque, (2, B)."""
    return torch.stack((least[:MOTION].amin(0), least[MOTION:].amin(0)))


def flights(name: str, hold: float, saturates: bool, x: Tensor) -> tuple[Tensor, Tensor]:
    """Tells whether flights from states (16, B) keep limits of thrust, of torque, and end; and their holds, (2, B)."""
    flight, terminal = in_c(name, hold, saturates), backup(name, hold, saturates).terminal
    kept = torch.zeros(2, x.shape[1], dtype=torch.bool)
    holds = torch.zeros(2, x.shape[1], dtype=torch.long)
    flying, alive, room = torch.arange(x.shape[1]), torch.ones_like(kept), terminal.room(x)
    for call in range(2 * backup(name, hold, saturates).max_periods):
        there = torch.stack([(room[list(ENDS[group])] >= 0.0).all(0) for group in range(2)])
        kept[:, flying] |= alive & there
        holds[:, flying] = torch.where(alive, call, holds[:, flying])
        x, bounds, _, _, room = flight(x)
        alive = alive & ~there & (of_groups(bounds) >= KEPT)
        on = alive.any(0)
        if not on.any():
            break
        flying, x, room, alive = flying[on], x[:, on], room[:, on], alive[:, on]
    return kept, holds


@EACH
def test_what_one_look_accepts_the_flight_accepts(name: str, hold: float, saturates: bool) -> None:
    c, b = vehicle(name, saturates), backup(name, hold, saturates)
    x = everywhere(COUNT, 21, c)
    x = x[:, torch.from_numpy((least_of(x, c) >= 0.0).all(0))]
    accepted = of_groups(in_c(name, hold, saturates)(x)[3]) >= KEPT
    assert (accepted.double().mean(1) > 0.1).all(), accepted.double().mean(1)
    kept, holds = flights(name, hold, saturates, x)
    missed = accepted & ~kept
    assert not missed.any(), x[:, missed.any(0)][:, 0].tolist()
    assert (kept & ~accepted).any(1).all()  # it is a bound of the flight, not the flight
    longest = holds[kept].max()
    assert 0.3 * b.max_periods < longest <= 0.95 * b.max_periods, (longest, b.max_periods)


def test_no_limit_is_below_what_one_look_says_on_the_flight() -> None:
    """Each limit at the plant's steps of a flight, by formulas of its own: at a path's nodes a chord says too much."""
    c, hold = vehicle("paper"), 10.0
    flight, b = in_c("paper", hold), backup("paper", hold)
    x = everywhere(1000, 25, c)
    bounds = flight(x)[3]
    accepted = (of_groups(bounds) >= KEPT).numpy()
    least = least_of(x, c)
    for call in range(round(b.early_accept.arrives / hold)):
        u = flight(x)[2]
        for _ in range(round(hold)):
            x = moved(x, u, 1.0, c)
            least = np.minimum(least, least_of(x, c))
        if call == round(100 / hold):  # by then all rest that brake on a straight line
            motion = least[:MOTION].copy()
    above = bounds.numpy()[:10] - np.concatenate((motion, least[MOTION:10]))
    assert (above[:MOTION, accepted[0]] <= ROUNDED).all() and (above[MOTION:, accepted[1]] <= ROUNDED).all()
    assert (accepted.mean(1) > 0.1).all()

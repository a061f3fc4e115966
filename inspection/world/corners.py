"""Vertices of the error box: who says, call by call, at which end of its bounds each error is.

A corner is a vertex of the box of all errors, (19, B) bool: which of the sensors' errors along the 12 axes of position,
velocity, attitude and rate are positive, which gains of the six actuators are at their upper end, and last, whether the
call is missed.
"""

from typing import Protocol

import torch
from torch import Tensor

from inspection.model.attitude import rotated_by
from inspection.model.draws import counter_based_uniform
from inspection.model.state import OMEGA, SIZE, P, Q, V

CORNER, ERRORS, GAINS, MISSED = 19, slice(0, 12), slice(12, 18), 18
ENDS = GAINS.stop
LONGEST_END = 60.0  # s that chance leaves an error at one end; as long as the random policy holds an action
BEFORE = -1  # the time in ms of numbers that an episode draws at its beginning
FIRST = 48  # of these numbers for corners; those before are of `inspection.world.plant.sample_plant`
FIRST_NOW = 13  # of the numbers of a moment; those before are of noise and missed calls


class Adversary(Protocol):
    """Who chooses the corners of a world whose errors are worst, and knows the truth.

    Times (B,) are those of the episodes, in s; states x (16, B) are true.
    """

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """(12, B) bool: which errors are positive in the measurement of x."""
        ...

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """(7, B) bool: the gains, and whether the call is missed, once u (6, B) is the answer.

        Args:
            held: (6, B) what acts if it is missed: the last control, and u where the world cannot miss the call.
        """
        ...


class Recorded:
    """An `Adversary` that repeats corners (calls, 19, B), the first of them at `start` s, one every so many s."""

    def __init__(self, corners: Tensor, every: float, start: float = 0.0) -> None:
        self.corners, self.every, self.start = corners, every, start

    def _now(self, time: Tensor) -> Tensor:
        # the one that has begun: calls may come between
        return self.corners[int((time[0].item() - self.start) / self.every + 1e-6)]

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """See `Adversary`."""
        return self._now(time)[ERRORS]

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """See `Adversary`."""
        return self._now(time)[GAINS.start :]


def held_ends(key: Tensor) -> Tensor:
    """(18, k) bool: a corner for the whole episode, by the episodes' keys (k,)."""
    return counter_based_uniform(key, torch.full_like(key, BEFORE), ENDS, FIRST) < 0.5


def wandering_ends(key: Tensor, time: Tensor) -> Tensor:
    """(18, k) bool: a corner at times (k,) in s, each end drawn anew after a time of its own of up to LONGEST_END."""
    lasting, phase = counter_based_uniform(key, torch.full_like(key, BEFORE), 2 * ENDS, FIRST).chunk(2)
    turn = (time / (LONGEST_END * lasting) + phase).floor().long()
    return counter_based_uniform(key, turn, ENDS, FIRST_NOW) < 0.5


def displaced(x: Tensor, error: Tensor) -> Tensor:
    """States (16, ...) that are off by errors (12, ...): m, m/s, a rotation vector in the body frame in rad, rad/s."""
    return torch.cat(
        (
            x[P] + error[0:3],
            x[V] + error[3:6],
            rotated_by(x[Q], error[6:9]),
            x[OMEGA] + error[9:12],
            x[OMEGA.stop : SIZE],
        )
    )

"""Corners of the error box: who decides, call by call, at which end of its bounds each error is.

A corner is a vertex of the box of all errors, (19, B) bool. In this order it says which of the sensors' errors along
the 12 axes of position, velocity, attitude and rate are positive, which gains of the six actuators are at their upper
end, and whether the call is missed.
"""

from typing import Protocol

import torch
from torch import Tensor

from inspection.model.attitude import rotated_by
from inspection.model.draws import counter_based_uniform
from inspection.model.state import OMEGA, SIZE, P, Q, V

CORNER, ERRORS, GAINS, MISSED = 19, slice(0, 12), slice(12, 18), 18
ENDS = GAINS.stop
LONGEST_END = 60.0  # s, the longest that a drawn error stays at one end; as an action of the random policy
BEFORE = -1  # the time in ms that stands for the numbers an episode draws at its beginning
FIRST = 48  # first of these numbers for corners; `inspection.world.plant.sample_plant` uses those before
FIRST_NOW = 13  # first number of a moment for corners; noise and missed calls use those before


class Adversary(Protocol):
    """Chooses the corners of a plant whose errors are "worst", and knows the true state.

    Times (B,) are those of the episodes, in s; states x (16, B) are true.
    """

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns which errors are positive in the measurement of x, (12, B) bool."""
        ...

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """Returns the gains and whether the call is missed, (7, B) bool, once the answer u (6, B) is known.

        Args:
            held: (6, B) acts if the call is missed: the last control, or u if the call cannot be missed.
        """
        ...


class Recorded:
    """Repeats corners (calls, 19, B) as an `Adversary`: the first at `start` s, then one every `every` s."""

    def __init__(self, corners: Tensor, every: float, start: float = 0.0) -> None:
        self.corners, self.every, self.start = corners, every, start

    def _now(self, time: Tensor) -> Tensor:
        # the corner that has begun, since calls may come between two corners
        return self.corners[int((time[0].item() - self.start) / self.every + 1e-6)]

    def errors(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns which errors are positive, see `Adversary`."""
        return self._now(time)[ERRORS]

    def response(self, time: Tensor, x: Tensor, u: Tensor, held: Tensor) -> Tensor:
        """Returns the gains and whether the call is missed, see `Adversary`."""
        return self._now(time)[GAINS.start :]


def wandering_ends(key: Tensor, time: Tensor) -> Tensor:
    """Returns a corner (18, k) bool at times (k,) in s.

    Each end is drawn anew after a time of its own of up to LONGEST_END.
    """
    lasting, phase = counter_based_uniform(key, torch.full_like(key, BEFORE), 2 * ENDS, FIRST).chunk(2)
    turn = (time / (LONGEST_END * lasting) + phase).floor().long()
    return counter_based_uniform(key, turn, ENDS, FIRST_NOW) < 0.5


def displaced(x: Tensor, error: Tensor) -> Tensor:
    """Returns states (16, ...) off by errors (12, ...): m, m/s, a rotation vector in the body frame in rad, rad/s."""
    return torch.cat(
        (
            x[P] + error[0:3],
            x[V] + error[3:6],
            rotated_by(x[Q], error[6:9]),
            x[OMEGA] + error[9:12],
            x[OMEGA.stop : SIZE],
        )
    )

"""Data that a campaign keeps of a flight besides its record: the controls of every call."""

import itertools
import math

import torch
from torch import Tensor

from inspection.closed_loop import Hold
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from inspection.world.corners import CORNER
from study.flight.fly import Limits, Observer

CHECK_EVERY = 1.0  # s between two checks, the default


class Tape(Observer):
    """Keeps the controls of every call of the filter; last axis the episodes.

    Args:
        duration: s of flight; first: the number of the first column.

    Attributes:
        desired, applied: (calls, 6, B); corners: (calls, 19, B) bool, of the plants' errors at each call, or
            (calls, 0, B) if the plants have no corners.
        column: (B,) the episode's number.
    """

    def __init__(self, duration: float, first: int = 0) -> None:
        self.duration, self.first = duration, first

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.env, x = env, env.x
        calls, batch = math.ceil(self.duration / env.safety.period), x.shape[1]
        corner = CORNER if env.plant and env.plant.is_worst else 0
        self.desired, self.applied = (x.new_zeros(calls, CONTROL_SIZE, batch) for _ in range(2))
        self.corners = torch.zeros(calls, corner, batch, dtype=torch.bool, device=x.device)
        self.column = torch.arange(self.first, self.first + batch, device=x.device)
        self.call = itertools.count()

    def hold(self, hold: Hold, running: Tensor) -> None:
        if hold.correction is None:
            return
        i = next(self.call)
        self.desired[i], self.applied[i] = hold.desired, hold.applied
        if self.env.plant and self.env.plant.is_worst:
            self.corners[i] = self.env.plant.corner

"""What a campaign keeps of a flight beside its record: every call's controls, and the calls with slack in full."""

import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from inspection.closed_loop import Hold
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from inspection.world.corners import CORNER
from study.flight.fly import ROUNDING, Limits, Observer

CHECK_EVERY = 1.0  # s between two checks, where nothing else is wanted


class Conflicts(NamedTuple):
    """Filter calls with slack, in the order of time; last axis the calls.

    Attributes:
        column: (N,) the episode's number; time: (N,) s; state: (16, N) as seen; desired: (6, N).
        slack: (constraints, N); h: (constraints, N) of the true state.
    """

    column: Tensor
    time: Tensor
    state: Tensor
    desired: Tensor
    slack: Tensor
    h: Tensor

    def of(self, columns: Tensor) -> "Conflicts":
        """Returns the calls of the episodes with these numbers."""
        theirs = torch.isin(self.column, columns)
        return Conflicts(*(part[..., theirs] for part in self))


class Tape(Observer):
    """The controls of every call of the filter, and its calls with slack; last axis the episodes.

    Args:
        duration: s that is flown; first: the number of the first column.

    Attributes:
        desired, applied: (calls, 6, B); corners: (calls, 19, B) bool, of the worlds at each call; of those that have
            none, (calls, 0, B).
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
        self.limits, h = limits, limits.h
        self.with_slack = [
            Conflicts(self.column[:0], x[0, :0], x[:, :0], x[:CONTROL_SIZE, :0], h[:, :0], h[:, :0])
        ]
        self.call = itertools.count()

    def hold(self, hold: Hold, running: Tensor) -> None:
        if hold.correction is None:
            return
        i, answer = next(self.call), hold.correction
        self.desired[i], self.applied[i] = hold.desired, hold.applied
        if self.env.plant and self.env.plant.is_worst:
            self.corners[i] = self.env.plant.corner
        slack: Any = answer.slack  # type: ignore[attr-defined]  # of the project's own filter
        yielded = (slack > ROUNDING).any(0)
        if hold.missed is not None:  # then nothing was asked
            yielded = yielded & ~hold.missed
        if yielded.any():
            time = torch.full_like(slack[0], hold.time)
            parts = self.column, time, hold.seen, hold.desired, slack, self.limits.before
            self.with_slack.append(Conflicts(*(part[..., yielded] for part in parts)))

    @property
    def conflicts(self) -> Conflicts:
        """The calls with slack so far."""
        return Conflicts(*(torch.cat(parts, -1) for parts in zip(*self.with_slack, strict=True)))


class Teller(Observer):
    """Tells after every hold its end in s, and which episodes have violated a constraint so far, (B,) bool."""

    def __init__(self, tell: Callable[[float, Tensor], None]) -> None:
        self.tell = tell

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.limits = limits

    def hold(self, hold: Hold, running: Tensor) -> None:
        self.tell(hold.end, self.limits.violating[-1] > 0)

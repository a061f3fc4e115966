"""Flying a batch of episodes in closed loop, with every constraint checked at the filter's calls and between them."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.closed_loop import Controller, Smallest
from inspection.environment import InspectionEnv
from inspection.model.state import CONTROL_SIZE
from inspection.world.corners import CORNER
from rta.qp.programs import Status
from study.flight.answers import in_full

CHECK_EVERY = 1.0  # s between two checks, where nothing else is wanted
ROUNDING = 1e-10  # slack that does not count, in units of h's rate; even rows that never yield reach 1e-12


class Conflicts(NamedTuple):
    """Filter calls with slack, in the order of time; last axis the calls.

    Attributes:
        column: (N,) the episode's number; time: (N,) s; state: (16, N) as seen; desired: (6, N); slack: (13, N).
        h: (13, N) of the true state.
    """

    column: Tensor
    time: Tensor
    state: Tensor
    desired: Tensor
    slack: Tensor
    h: Tensor


@dataclasses.dataclass
class Flight:
    """What a batch of episodes did; last axis the episodes, "any" last among 13 + 1 constraints.

    Attributes:
        violating: (14, B) states checked at which the constraint was negative, out of steps: (B,).
        worst: (13, B) smallest value; when: (13, B) s.
        status: (4, B) filter calls by `Status`.
        yielded: (13, B) calls at which a row had slack; slack: (13, B) its largest.
        backup: (B,) calls at which another control was applied than the programs' solution, see `FilterResult.backup`.
        excess: (B,) largest control in units of its actuator's limit.
        start: (16 + 3, B) initial states and priority vectors; desired, applied: (calls, 6, B) controls of each filter
            call.
        corners: (calls, 19, B) bool, of the worlds at each filter call; of those that have none, (calls, 0, B).
        number: (B,) from which the episodes' plants follow.
        column: (B,) the episode's number; conflicts: calls with slack, by that number.
    """

    violating: Tensor
    steps: Tensor
    worst: Tensor
    when: Tensor
    status: Tensor
    yielded: Tensor
    slack: Tensor
    backup: Tensor
    excess: Tensor
    start: Tensor
    desired: Tensor
    applied: Tensor
    corners: Tensor
    column: Tensor
    number: Tensor
    conflicts: Conflicts

    def __getitem__(self, chosen: Tensor) -> "Flight":
        """The episodes where `chosen` (B,) bool is set."""
        parts = {name: part[..., chosen] for name, part in vars(self).items() if name != "conflicts"}
        theirs = torch.isin(self.conflicts.column, parts["column"])
        return Flight(**parts, conflicts=Conflicts(*(part[..., theirs] for part in self.conflicts)))


@torch.no_grad()
def fly(
    env: InspectionEnv,
    controller: Controller,
    x: Tensor,
    priority: Tensor,
    duration: float,
    first: int = 0,
    number: Tensor | None = None,
    tell: Callable[[float, Tensor], None] | None = None,
    looks: bool = False,
) -> Flight:
    """Flies one episode per column behind the environment's filter, checked at least as often as its clocks report.

    Args:
        x, priority: initial states (16, B) and priority vectors (3, B).
        duration: s; first: the number of the first column.
        number: (B,) in [0, 1) from which the episodes' plants follow; None: 0.
        tell: is told the time in s after every hold, and which episodes have violated a constraint, (B,) bool.
        looks: the controller observes the chief, which is looked at every action period.
    """
    number = torch.zeros_like(x[0]) if number is None else number
    env.start(x, priority, number)
    constraints, batch, calls = len(env.safety.names), x.shape[1], math.ceil(duration / env.safety.period)
    corner = CORNER if env.plant and env.plant.is_worst else 0
    h, column = env.constraint_values(x), torch.arange(first, first + batch, device=x.device)
    smallest = Smallest(constraints, x)
    flight = Flight(
        violating=x.new_zeros(constraints + 1, batch),
        steps=x.new_zeros(batch),
        worst=smallest.value,
        when=smallest.when,
        status=x.new_zeros(len(Status), batch),
        yielded=x.new_zeros(constraints, batch),
        slack=x.new_zeros(constraints, batch),
        backup=x.new_zeros(batch),
        excess=x.new_zeros(batch),
        start=torch.cat((x, priority)),
        desired=x.new_zeros(calls, CONTROL_SIZE, batch),
        applied=x.new_zeros(calls, CONTROL_SIZE, batch),
        corners=torch.zeros(calls, corner, batch, dtype=torch.bool, device=x.device),
        column=column,
        number=number,
        conflicts=Conflicts(column[:0], x[0, :0], x[:, :0], x[:CONTROL_SIZE, :0], h[:, :0], h[:, :0]),
    )
    conflicts = [flight.conflicts]
    note_state(flight, smallest, h, 0.0)
    call = itertools.count()
    flown = env.inspect if looks else env.fly
    for hold in flown(controller, duration):
        if hold.correction is not None:
            i, result = next(call), in_full(hold.correction)
            flight.desired[i], flight.applied[i] = hold.desired, hold.applied
            if env.plant and env.plant.is_worst:
                flight.corners[i] = env.plant.corner
            yielded, time = result.slack > ROUNDING, torch.full_like(flight.excess, hold.time)
            status, slack = torch.nn.functional.one_hot(result.status, len(Status)).T, result.slack
            backup = result.backup
            if hold.missed is not None:  # then nothing was asked
                asked = ~hold.missed
                yielded, status, slack, backup = (part * asked for part in (yielded, status, slack, backup))
            parts = column, time, hold.seen, hold.desired, slack, h
            conflicts.append(Conflicts(*(part[..., yielded.any(0)] for part in parts)))
            flight.status += status
            flight.yielded += yielded
            flight.backup += backup
            flight.slack = torch.maximum(flight.slack, slack)
            flight.excess = torch.maximum(flight.excess, (hold.applied.abs() / env.limit).amax(0))
        h = env.constraint_values(hold.after)
        note_state(flight, smallest, h, hold.end)
        if tell:
            tell(hold.end, flight.violating[-1] > 0)
    flight.conflicts = Conflicts(*(torch.cat(parts, -1) for parts in zip(*conflicts, strict=True)))
    return flight


def note_state(flight: Flight, smallest: Smallest, h: Tensor, t: float) -> None:
    """Adds the constraint values (13, B) at t s. NaN counts as violated without end."""
    broken = smallest.note(h, t) < 0.0
    flight.steps += 1
    flight.violating += torch.cat((broken, broken.any(0)[None]))
    flight.worst, flight.when = smallest.value, smallest.when

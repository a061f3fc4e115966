"""Flying a batch of episodes in closed loop, with every constraint checked every second."""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.guidance import Controller
from inspection.state import CONTROL_SIZE
from rta.constraints import CONSTRAINTS
from rta.filter import FilterResult
from rta.qp import Status

ROUNDING = 1e-10  # slack that does not count, in units of h's rate; even rows that never yield reach 1e-12


class Conflicts(NamedTuple):
    """Filter calls with slack, in the order of time; last axis the calls.

    Attributes:
        column: (N,) of the episode; time: (N,) s; state: (16, N); desired: (6, N); slack, h: (13, N).
    """

    column: Tensor
    time: Tensor
    state: Tensor
    desired: Tensor
    slack: Tensor
    h: Tensor

    @classmethod
    def of(cls, t: float, x: Tensor, desired: Tensor, result: FilterResult, h: Tensor) -> "Conflicts":
        """Those of one call of the filter at t s."""
        column = torch.nonzero((result.slack > ROUNDING).any(0)).flatten()
        parts = (part[:, column] for part in (x, desired, result.slack, h))
        return cls(column, torch.full_like(column, t, dtype=x.dtype), *parts)


@dataclasses.dataclass
class Flight:
    """What a batch of episodes did; last axis the episodes, "any" last among 13 + 1 constraints.

    Attributes:
        violating: (14, B) steps at which the constraint was negative, out of `steps`.
        worst: (13, B) smallest value; when: (13, B) s.
        status: (4, B) filter calls by `Status`.
        yielded: (13, B) calls at which a row had slack; slack: (13, B) its largest.
        excess: (B,) largest control in units of its actuator's limit.
        start: (16 + 3, B) initial states and priority vectors; desired, applied: (steps, 6, B) controls.
        column: (B,) of the episode in the batch that was flown; conflicts: calls with slack, by that column.
    """

    violating: Tensor
    worst: Tensor
    when: Tensor
    status: Tensor
    yielded: Tensor
    slack: Tensor
    excess: Tensor
    start: Tensor
    desired: Tensor
    applied: Tensor
    column: Tensor
    conflicts: Conflicts

    def __getitem__(self, chosen: Tensor) -> "Flight":
        """The episodes where `chosen` (B,) bool is set."""
        parts = {name: part[..., chosen] for name, part in vars(self).items() if name != "conflicts"}
        theirs = torch.isin(self.conflicts.column, parts["column"])
        return Flight(**parts, conflicts=Conflicts(*(part[..., theirs] for part in self.conflicts)))


@torch.no_grad()
def fly(
    env: InspectionEnv, controller: Controller, x: Tensor, priority: Tensor, duration: float, decide: float
) -> Flight:
    """Flies one episode per column behind the environment's filter, checked at every second.

    Args:
        x, priority: initial states (16, B) and priority vectors (3, B).
        duration: s; decide: s between two desired controls. In between the filter is given its own last one.
    """
    env.start(x, priority)
    steps, period, batch = round(duration), round(env.safety.period), x.shape[1]
    tally = x.new_zeros(len(CONSTRAINTS), batch)
    flight = Flight(
        violating=x.new_zeros(len(CONSTRAINTS) + 1, batch),
        worst=torch.full_like(tally, torch.inf),
        when=tally.clone(),
        status=x.new_zeros(len(Status), batch),
        yielded=tally.clone(),
        slack=tally.clone(),
        excess=x.new_zeros(batch),
        start=torch.cat((x, priority)),
        desired=x.new_zeros(steps, CONTROL_SIZE, batch),
        applied=x.new_zeros(steps, CONTROL_SIZE, batch),
        column=torch.arange(batch, device=x.device),
        conflicts=Conflicts(*[x.new_zeros(0)] * len(Conflicts._fields)),
    )
    h = env.constraint_values(x)
    note_state(flight, h, 0.0)
    u = x.new_zeros(CONTROL_SIZE, batch)
    conflicts = []
    for i in range(steps):
        if i % decide == 0:
            u = controller(float(i), x)
        flight.desired[i] = u
        if i % period == 0:
            result = env.safety.correct(x, u)
            conflicts.append(Conflicts.of(i, x, u, result, h))
            u = result.control
            flight.status += torch.nn.functional.one_hot(result.status, len(Status)).T
            flight.yielded += result.slack > ROUNDING
            flight.slack = torch.maximum(flight.slack, result.slack)
            flight.excess = torch.maximum(flight.excess, (u.abs() / env.limit).amax(0))
        flight.applied[i] = u
        x = env.integrate(x, u, round(1.0 / env.interval))
        h = env.constraint_values(x)
        note_state(flight, h, i + 1.0)
    flight.conflicts = Conflicts(*(torch.cat(parts, -1) for parts in zip(*conflicts, strict=True)))
    return flight


def note_state(flight: Flight, h: Tensor, t: float) -> None:
    """Adds the constraint values (13, B) at t s, in place. NaN counts as violated without end."""
    h = torch.where(h.isnan(), -torch.inf, h)
    broken = h < 0.0
    flight.violating += torch.cat((broken, broken.any(0)[None]))
    flight.when = torch.where(h < flight.worst, t, flight.when)
    flight.worst = torch.minimum(flight.worst, h)

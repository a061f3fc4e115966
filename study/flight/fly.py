"""The one flight of a batch of episodes, which every command shares, and its record."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from inspection.closed_loop import Controller, Hold, Smallest
from inspection.environment import InspectionEnv
from inspection.reward import stays_clear
from inspection.termination import OUTCOMES
from inspection.transition import METRICS, Transition
from rta.result import Status

SUCCESS = OUTCOMES.index("success")


class Starts(NamedTuple):
    """Holds the initial states of a batch of episodes.

    Attributes:
        x: states (16, B); priority: unit vectors (3, B).
        number: (B,) in [0, 1), which determine the episodes' plants and chiefs; None: 0.
    """

    x: Tensor
    priority: Tensor
    number: Tensor | None = None

    def map(self, change: Callable[[Tensor], Tensor]) -> "Starts":
        """Returns the starts with each part changed."""
        number = None if self.number is None else change(self.number)
        return Starts(change(self.x), change(self.priority), number)

    def repeat(self, times: int) -> "Starts":
        """Returns all starts `times` times, one copy after another."""
        return self.map(lambda part: part.repeat(*(1,) * (part.dim() - 1), times))

    def one(self, case: int) -> "Starts":
        """Returns one of the starts, as a batch."""
        return self.map(lambda part: part[..., case : case + 1])


class Limits:
    """Keeps the constraints' values at the start and after every hold; last axis the episodes, "any" the last row.

    Attributes:
        before, h: (constraints, B) the values at the beginning and at the end of the last hold.
        violating: (constraints + 1, B) number of states with a negative constraint, among `checked` (B,) states.
        at_start: (constraints + 1, B) the same for the start alone.
        worst: (constraints, B) the smallest value, when: (constraints, B) s; NaN counts as minus infinity.
    """

    def __init__(self, env: InspectionEnv) -> None:
        self.env, self.h = env, env.constraint_values(env.x)
        self.smallest = Smallest(len(self.h), env.x)
        self.at_start = with_any(self.smallest.note(self.h) < 0.0).to(env.x)
        self.violating, self.checked = self.at_start.clone(), torch.ones_like(env.x[0])

    def hold(self, hold: Hold, running: Tensor) -> None:
        """Adds the states after a hold of the episodes that are running."""
        self.before, self.h = self.h, self.env.constraint_values(hold.after)
        h = torch.where(running, self.h, math.inf)
        self.violating += with_any(self.smallest.note(h, hold.end) < 0.0)
        self.checked += running

    @property
    def worst(self) -> Tensor:
        return self.smallest.value

    @property
    def when(self) -> Tensor:
        return self.smallest.when


class Observer:
    """Observes episodes in flight; this base does nothing. `running` (B,) bool: the episode has not ended before."""

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        """Sees the episodes at their start."""

    def hold(self, hold: Hold, running: Tensor) -> None:
        """Sees a hold of a control; `Limits` has already added it."""

    def step(self, transition: Transition, running: Tensor) -> None:
        """Sees an interaction; only called in flights that last until the episodes end."""


def with_any(violated: Tensor) -> Tensor:
    """Returns (constraints + 1, B) bool: the given rows and a last one that is their disjunction."""
    return torch.cat((violated, violated.any(0)[None]))


class Calls(Observer):
    """Counts the filter's answers; last axis the episodes. Missed calls are not counted.

    Attributes:
        status: (4, B) calls by `Status`; intervened, backup: (B,) calls.
        violated: (constraints, B) calls at whose true state the constraint was negative.
        excess: (B,) the largest applied control in units of its actuator's limit.
    """

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        constraints, x = len(limits.h), env.x
        self.limits, self.limit = limits, env.limit
        self.status = x.new_zeros(len(Status), x.shape[1])
        self.intervened, self.backup, self.excess = (x.new_zeros(x.shape[1]) for _ in range(3))
        self.violated = x.new_zeros(constraints, x.shape[1])

    def hold(self, hold: Hold, running: Tensor) -> None:
        if hold.correction is None:
            return
        answer: Any = hold.correction  # of the project's own filter
        asked = running if hold.missed is None else running & ~hold.missed
        self.status += torch.nn.functional.one_hot(answer.status, len(Status)).T * asked
        self.intervened += answer.intervened & asked
        self.backup += answer.backup & asked
        self.violated += (self.limits.before < 0.0) & asked
        control = hold.applied.abs() / self.limit
        self.excess = torch.maximum(self.excess, torch.where(running, control.amax(0), 0.0))

    @property
    def count(self) -> Tensor:
        """Returns the number (B,) of calls that the filter answered."""
        return self.status.sum(0)


class Ends(Observer):
    """Keeps how the episodes ended; last axis the episodes.

    Attributes:
        metrics: (6, B) in the order of METRICS; outcome: (B,) index into OUTCOMES.
        violations: (constraints + 1, B) percent of the episode's steps, "any" last.
        clear: (B,) bool, the episode succeeded and two days of free flight stay clear of the chief.
    """

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.c, x = env.c, env.x
        self.metrics = x.new_full((len(METRICS), x.shape[1]), math.nan)
        self.violations = x.new_zeros(len(env.safety.names) + 1, x.shape[1])
        self.outcome = torch.full_like(env.steps, -1)
        self.clear = torch.zeros_like(x[0], dtype=torch.bool)

    def step(self, transition: Transition, running: Tensor) -> None:
        ending = running & transition.done
        any_steps = transition.metrics[METRICS.index("violation_percent")]
        percent = torch.cat((100.0 * transition.violation_steps / transition.steps, any_steps[None]))
        self.metrics = torch.where(ending, transition.metrics, self.metrics)
        self.violations = torch.where(ending, percent, self.violations)
        self.outcome = torch.where(ending, transition.outcome, self.outcome)
        self.clear |= stays_clear(transition.state, ending & (transition.outcome == SUCCESS), self.c)


class Progress(Observer):
    """Shows on a bar how many episodes have flown or ended, how long they have flown, and how many violate a limit.

    Args:
        duration: s, of a flight in which all episodes fly on; None: the flight ends when every episode has ended.
        violating: number of violating episodes in earlier flights.
    """

    def __init__(self, shown: tqdm, duration: float | None = None, violating: int = 0) -> None:
        self.shown, self.duration, self.violating = shown, duration, violating

    def begin(self, env: InspectionEnv, limits: Limits) -> None:
        self.env, self.limits, self.before = env, limits, self.shown.n
        self.ended, self.already = torch.zeros_like(env.time, dtype=torch.bool), self.violating

    def hold(self, hold: Hold, running: Tensor) -> None:
        if self.duration:
            self.show(hold.end, hold.end / self.duration * running.numel())

    def step(self, transition: Transition, running: Tensor) -> None:
        self.ended |= transition.done
        self.show(int(transition.steps.max()) * self.env.c.action_period, int(self.ended.sum()))

    def show(self, seconds: float, done: float) -> None:
        """Updates the bar: s flown, and the number of finished episodes of this flight, which may be a fraction."""
        self.violating = self.already + int((self.limits.violating[-1] > 0).sum())
        self.shown.set_postfix_str(f"{seconds:,.0f} s flown, {self.violating:,} violating", refresh=False)
        self.shown.update(self.before + done - self.shown.n)


@dataclass
class Record:
    """Holds a flight's starts, its constraints, the filter's calls and, if the episodes ended, their ends."""

    starts: Starts
    limits: Limits
    calls: Calls
    ends: Ends | None


@torch.no_grad()
def fly(
    env: InspectionEnv,
    controller: Controller,
    starts: Starts,
    duration: float | None = None,
    observers: Sequence[Observer] = (),
) -> Record:
    """Flies an episode per column of the environment from given starts, and returns the record.

    Args:
        duration: s, for which all episodes fly on whatever happens; None: until every episode has ended.
        observers: further observers of the flight.
    """
    starts = starts.map(lambda part: part.to(env.x.device))
    env.start(*starts)
    limits, calls, ends = Limits(env), Calls(), Ends() if duration is None else None
    watching: list[Observer] = [calls, *([ends] if ends else []), *observers]
    for observer in watching:
        observer.begin(env, limits)
    running = torch.ones_like(env.time, dtype=torch.bool)

    def watch(hold: Hold) -> None:
        limits.hold(hold, running)
        for observer in watching:
            observer.hold(hold, running)

    if duration is not None:
        for hold in env.fly(controller, duration):
            watch(hold)
    while duration is None and running.any():
        transition = env.step(controller, watch)
        for observer in watching:
            observer.step(transition, running)
        running = running & ~transition.done
    return Record(starts, limits, calls, ends)

"""The one closed loop (Sec. RL Control Loop with RTA): controller, filter, plant, and their clocks."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE
from inspection.world.plant import Plant

ROUNDING = 1e-9  # s

# Maps time in s and states (16, B) to desired controls (6, B) in N and N m.
Controller = Callable[[float, Tensor], Tensor]


class Correction(Protocol):
    """Describes what a control filter returns.

    Attributes:
        control: (6, B) in N and N m, to be applied.
        intervened: (B,) bool, whether the control differs from the desired one.
        h: (constraints, B) values at the states that the filter was shown.
    """

    control: Tensor
    intervened: Tensor
    h: Tensor


@dataclass(frozen=True)
class Safety:
    """Holds what the task knows about safety; any functions of the state will do.

    Attributes:
        names: one name per constraint.
        values: maps states (16, B) to constraint values (len(names), B), negative where violated.
        is_safe: maps states (16, B) to (B,) bool, whether an episode may start there.
        correct: maps states and desired controls (6, B) to a `Correction`; None applies the desired controls.
        period: s between two calls of `correct`.
        takes_plant_data: `correct` also takes `inspection.world.plant.Plant.filter_inputs`, by name.
    """

    names: tuple[str, ...] = ()
    values: Callable[[Tensor], Tensor] | None = None
    is_safe: Callable[[Tensor], Tensor] | None = None
    correct: Callable[[Tensor, Tensor], Correction] | None = None
    period: float = 1.0
    takes_plant_data: bool = False


@dataclass(frozen=True)
class Clocks:
    """Holds the periods of a closed loop, in s.

    Attributes:
        decision: between two decisions of the controller.
        report: the longest time between two `Hold`s.
        substep: the longest step of the plant.
        filter: between two calls of the filter; None without one.
        look: between two looks at the chief; None: the chief is not looked at.

    Raises:
        ValueError: a period is no multiple of a shorter one, or the filter's period does not divide the time between
            looks, so that each step of an environment would begin a new filter period.
    """

    decision: float
    report: float
    substep: float
    filter: float | None = None
    look: float | None = None

    def __post_init__(self) -> None:
        named = {
            "the controller's decisions": self.decision,
            "the loop's reports": self.report,
            "the filter's calls": self.filter,
            "the looks at the chief": self.look,
        }
        running = [(name, period) for name, period in named.items() if period]
        rising = sorted(running, key=lambda item: item[1])
        for (short, shorter), (name, period) in combinations(rising, 2):
            if not is_multiple(period, shorter):
                raise ValueError(
                    f"{name} every {period:g} s: must be a multiple of {shorter:g} s, the time between {short}"
                )
        if self.filter and self.look and not is_multiple(self.look, self.filter):
            raise ValueError(
                f"the filter's calls every {self.filter:g} s: must divide {self.look:g} s, "
                "the time between the looks at the chief"
            )
        if not is_multiple(self.control, self.step):
            name = next(name for name, period in rising if period == self.control)
            raise ValueError(
                f"substep = {self.substep:g} s: must divide {self.control:g} s, the time between {name}"
            )

    @property
    def hold(self) -> float:
        """Returns the longest time in s in which only the plant acts."""
        return min(self.control, self.decision, self.report)

    @property
    def control(self) -> float:
        """Returns the time in s for which a control is held: until the next filter call, else decision."""
        return self.filter or min(self.decision, self.look or self.decision)

    @property
    def step(self) -> float:
        """Returns the plant's step in s, which does not depend on how often the plant is looked at."""
        return min(self.substep, self.control)

    def count(self, duration: float) -> int:
        """Returns how many holds fill a duration in s; raises ValueError if it is no multiple of the report period."""
        if not is_multiple(duration, self.report):
            raise ValueError(f"a duration of {duration:g} s: must be a multiple of {self.report:g} s")
        return round(duration / self.hold)


class Hold(NamedTuple):
    """Describes a time in which the control is held.

    Attributes:
        time, end: when it begins and ends, in s; seconds: its length in s.
        state: (16, B) at its beginning; after: (16, B) at its end. Both are true states. A state within a step of the
            plant is computed by a shorter step; the plant does not continue from it.
        desired: (6, B) by the controller, or, between two of its decisions, the filter's last control.
        applied: (6, B) sent to the actuators.
        correction: the filter's answer, if it was called at `time`.
        decided: whether the controller was evaluated at `time`.
        seen: (16, B) the states as controller and filter last saw them.
        acting: (6, B) the mean over the hold of what acts on the plant.
        missed: (B,) bool, whether the call at `time` was missed, so that `applied` is the last control; None: none was.
    """

    time: float
    end: float
    seconds: float
    state: Tensor
    desired: Tensor
    applied: Tensor
    correction: Correction | None
    decided: bool
    after: Tensor
    seen: Tensor
    acting: Tensor
    missed: Tensor | None


def closed_loop(
    x: Tensor,
    controller: Controller,
    correct: Callable[..., Correction] | None,
    integrate: Callable[[Tensor, Tensor, float], Tensor],
    clocks: Clocks,
    duration: float,
    plant: Plant | None = None,
    start: Tensor | None = None,
    takes_plant_data: bool = False,
) -> Iterator[Hold]:
    """Flies from states x (16, B) for a duration in s.

    Args:
        controller: gives the desired controls.
        correct: the filter; None applies the desired controls.
        integrate: returns the states (16, B) after a control (6, B) has acted for a step of the plant, or for less.
        plant: differences from the model; None: states are seen as they are, and controls act as commanded.
        start: the episodes' time at the beginning, (B,) s; None: 0 s.
        takes_plant_data: the filter also takes `Plant.filter_inputs`.

    A call is a call of the filter, or without a filter a decision. After a missed call the next one has the same
    desired control. The plant moves in steps of its own; it does not continue from a state that is read within a step.
    """
    hold = clocks.hold
    decisions, calls = (max(1, round((every or hold) / hold)) for every in (clocks.decision, clocks.filter))
    applied = next_desired = x.new_zeros(CONTROL_SIZE, *x.shape[1:])
    seen, start = x, torch.zeros_like(x[0]) if start is None else start
    step, steps, flown = clocks.step, 0, x  # `flown`: the plant's state after `steps` steps

    for i in range(clocks.count(duration)):
        time, decided = i * hold, i % decisions == 0
        called = i % calls == 0 if correct else decided
        if plant is None:
            seen = x
        elif called:
            seen = plant.sense(start + time, x)
        desired = controller(time, seen) if decided else next_desired
        correction = missed = None
        if called:
            told = plant.filter_inputs(start + time) if plant and takes_plant_data else {}
            correction = correct(seen, desired, **told) if correct else None
            # the filter's last control is its next desired one
            applied = next_desired = desired if correction is None else correction.control
            if plant:
                applied, missed = plant.hold(start + time, applied)
                next_desired = torch.where(missed, desired, applied)
        end, moment, acted = (i + 1) * hold, time, []
        while moment < end - ROUNDING:
            begun = steps * step
            until = min(begun + step, end)
            acting = plant.actuate(start + begun, applied) if plant else applied
            if begun + step < end + ROUNDING:
                after = flown = integrate(flown, acting, step)
                steps += 1
            else:  # the hold ends within a step
                after = integrate(flown, acting, end - begun)
            acted.append((acting, until - moment))
            moment = until
        acting = mean(acted)
        yield Hold(time, end, hold, x, desired, applied, correction, decided, after, seen, acting, missed)
        x = after


def mean(parts: list[tuple[Tensor, float]]) -> Tensor:
    """Returns the mean over time of tensors that hold for the given s each."""
    if len(parts) == 1:
        return parts[0][0]
    total = sum(seconds for _, seconds in parts)
    return torch.stack([part * (seconds / total) for part, seconds in parts]).sum(0)


class Smallest:
    """Keeps the smallest values so far, such as those of constraints along a `closed_loop`.

    Args:
        count: how many values are checked; x: (..., B), which gives the episodes, device and precision.

    Attributes:
        value: (count, B), infinite at first; when: (count, B) in s.
    """

    def __init__(self, count: int, x: Tensor) -> None:
        self.value = x.new_full((count, x.shape[-1]), torch.inf)
        self.when = torch.zeros_like(self.value)

    def note(self, values: Tensor, time: float = 0.0) -> Tensor:
        """Records values (count, B) at a time in s; returns them with minus infinity in place of NaN."""
        values = torch.where(values.isnan(), -torch.inf, values)
        self.when = torch.where(values < self.value, time, self.when)
        self.value = torch.minimum(self.value, values)
        return values


def is_multiple(a: float, b: float) -> bool:
    """Checks whether a is a whole multiple of b, to rounding."""
    return round(a / b) >= 1 and abs(a / b - round(a / b)) < 1e-9

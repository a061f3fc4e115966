"""What both conditions on a control have in common: what is demanded, and what is asked of either.

`rta.conditions.now` has the rate of now, the paper's; `rta.conditions.held` what a control does that is held.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from rta.conditions.rows import ActuatorGroup
from rta.conditions.tangents import Prepared
from rta.qp.programs import ENDLESS, LARGEST_DEMAND, Solver, Status
from rta.result import FilterResult


class Demand(NamedTuple):
    """What is filtered.

    Attributes:
        desired: (6, B) controls in N and N m, as they came.
        wish: (6, B) what is projected of them: any size up to LARGEST_DEMAND limits, zero for NaN.
        control: (6, B) the wish clipped to the actuators' limits. If it satisfies every row this is the projection:
            none that is permitted is nearer to the wish.
        status: (2, B) of each group: HARD where that is not desired.
    """

    desired: Tensor
    wish: Tensor
    control: Tensor
    status: Tensor


# What is computed for every spacecraft, compiled or not, and an example of what it is given.
Part = tuple[Callable[..., list[Tensor]], tuple[Tensor, ...]]


class Condition(Protocol):
    """The rows of both actuator groups, and the controls that satisfy them."""

    @property
    def groups(self) -> Sequence[ActuatorGroup]:
        """Of thrust and of torque."""
        ...

    def prepared(self, x: Tensor, control: Tensor, error_bound: Tensor | None = None) -> list[Prepared]:
        """Each group's rows at states (16, B) and controls (6, B)."""
        ...

    def propose(
        self,
        x: Tensor,
        demand: Demand,
        solver: Solver,
        sent: Tensor | None,
        left: Tensor | None,
        error_bound: Tensor | None = None,
    ) -> FilterResult:
        """What the programs answer.

        Args:
            sent, left: as `SafetyFilter.correct` takes them.
            error_bound: (4, B) by how far the state is off beyond its measurement, in any direction: of position,
                velocity, attitude and rates in m, m/s, rad, rad/s; None: not at all. It counts where controls are held.
        """
        ...

    def parts(self, x: Tensor, u: Tensor) -> list[Part]:
        """What is computed for every spacecraft, and what it is given for a state (16, 1) and a control (6, 1)."""
        ...

    def use(self, functions: Sequence[Callable[..., list[Tensor]]]) -> None:
        """Takes the functions of `parts`, compiled, in their place."""
        ...


def demanded(desired: Tensor, groups: Sequence[ActuatorGroup]) -> Demand:
    """What is filtered where controls (6, B) are desired; thrust or torque of which a number is NaN is no wish."""
    wishes, controls = [], []
    for each in groups:
        part = desired[each.controls]
        part = torch.where(part.isnan().any(0), 0.0, part).clamp(-ENDLESS, ENDLESS)
        times = part.abs().amax(0) / each.limit
        wishes.append(part * (LARGEST_DEMAND / times.clamp(min=LARGEST_DEMAND)))
        controls.append(wishes[-1].clamp(-each.limit, each.limit))
    control = torch.cat(controls)
    status = torch.where(differ(control, desired, groups), Status.HARD, Status.UNTOUCHED)
    return Demand(desired, torch.cat(wishes), control, status)


def differ(one: Tensor, other: Tensor, groups: Sequence[ActuatorGroup]) -> Tensor:
    """(2, B) bool: the groups of controls (6, B) are not the same."""
    return torch.stack([(one != other)[each.controls].any(0) for each in groups])

"""The filter's answer to a call."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from torch import Tensor


class Status(IntEnum):
    """Describes how a control came about, in rising order of trouble."""

    UNTOUCHED = 0  # the desired control is within the actuators' limits and satisfies every condition
    HARD = 1  # clipped or corrected: every condition is satisfied, or the control is verified, or the check replaced it
    SLACK = 2  # the program's control leaves a condition unsatisfied, and what is applied is not verified
    UNSOLVED = (
        3  # the program has no solution, or a number of the state is not finite (zero control); not verified
    )


@dataclass
class FilterResult:
    """Holds the filter's answer per spacecraft; constraints are in the order of `SafetyFilter.names`.

    For one spacecraft there is no axis B, and fields are of the kind of the desired control, see
    `SafetyFilter.__call__`.

    Attributes:
        control: (6, B) safe control in N and N m, within the actuators' limits for any desired control.
        intervened: (B,) bool, whether another control than the desired one is applied.
        verified: (B,) bool, whether the control keeps every limit until the next call, and the backup trajectory after
            it does so, too (`rta.check`; docs/reference/proof.md). With error bounds: for every true state within them,
            and every time of the next call that they allow. Limits of your own are not checked, and do not count.
        backup: (B,) bool, whether the check replaced the program's control.
        active: (constraints, B) bool, whether the barrier condition is active at the program's control.
        slack: (constraints, B) shortfall of the condition under the program's control, before the check, in h's unit
            per s (per s^2 where the relative degree is two); zero where the call is verified or has no solution.
        status: (B,) int64, a `Status`.
        h: (constraints, B) values of the limits, at the given state even where a state is predicted.
    """

    control: Tensor
    intervened: Tensor
    verified: Tensor
    backup: Tensor
    active: Tensor
    slack: Tensor
    status: Tensor
    h: Tensor

    @property
    def violated(self) -> Any:
        """Returns whether some h is negative already, (B,) bool, whatever the program answered."""
        return (self.h < 0.0).any(0)

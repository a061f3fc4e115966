"""What the filter says of a call."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from torch import Tensor


class Status(IntEnum):
    """How a control came about, in rising order of trouble."""

    UNTOUCHED = 0  # the desired control is within the actuators' limits and satisfies every condition
    HARD = 1  # clipped or corrected: every condition is satisfied, or the control is verified, or the check replaced it
    SLACK = 2  # the program's control leaves a condition unsatisfied, and what is applied is not verified
    UNSOLVED = (
        3  # the program has no solution, or a number of the state is not finite (zero control); not verified
    )


@dataclass
class FilterResult:
    """What the filter did, per spacecraft; constraints in the order of `SafetyFilter.names`.

    For one spacecraft without the axis B, and in the kind of the desired control, see `SafetyFilter.__call__`.

    Attributes:
        control: (6, B) safe control in N and N m, within the actuators' limits whatever was desired.
        intervened: (B,) bool, another control than the desired one is applied.
        verified: (B,) bool, the control keeps every limit until the next call, and so does the flight of the backup
            laws after it (`rta.check`; docs/reference/proof.md). With error bounds: for every true state within them,
            and every time of the next call that they allow. Limits of your own are not checked, and do not count.
        backup: (B,) bool, the check replaced the program's control.
        active: (constraints, B) bool, the condition of the constraint binds the program's control.
        slack: (constraints, B) shortfall of the condition under the program's control, before the check, in h's unit
            per s (per s^2 where the relative degree is two); zero where the call is verified or nothing was found.
        status: (B,) int64, a `Status`.
        h: (constraints, B) values of the limits. Where a state is predicted, of the state of now.
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
        """(B,) bool: a limit is broken already, some h is negative, whatever the program answered."""
        return (self.h < 0.0).any(0)

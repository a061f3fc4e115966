"""What the filter says of a call."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass
class FilterResult:
    """What the filter did, per spacecraft; constraints in the order of `SafetyFilter.names`.

    For one spacecraft without the axis B, and in the kind of the desired control, see `SafetyFilter.__call__`.

    Attributes:
        control: (6, B) safe control in N and N m, within the actuators' limits whatever was desired.
        intervened: (B,) bool, another control than the desired one is applied.
        verified: (B,) bool, the control keeps every limit until the next call, and the backup laws' flight from there
            does (`rta.backup`; docs/reference/proof.md). With error bounds:
            whatever is true within them, whenever the next call is, and motion comes into an invariant set. False where
            no backup trajectory is known of motion or attitude. Limits of your own are not checked, and do not count.
        backup: (B,) bool, another control is applied than the programs' solution, for that reason.
        active: (constraints, B) bool, a row of the constraint binds a corrected control.
        slack: (constraints, B) shortfall of the barrier condition without margin, in h's unit per s (per s^2 where
            the relative degree is two); zero unless a program needed slack, or a broken limit asks for more than the
            actuators give. Zero, too, where the paper's filter finds no solution.
        status: (B,) int64, the worse `Status` of the thrust and the torque program; SLACK, at least, where slack is.
        program_status: (2, B) int64, both of them.
        h: (constraints, B) values without margin, exact; that of passive safety by the times of its rows. Where a
            state is predicted, of the state of now.
    """

    control: Tensor
    intervened: Tensor
    verified: Tensor
    backup: Tensor
    active: Tensor
    slack: Tensor
    status: Tensor
    program_status: Tensor
    h: Tensor

    @property
    def violated(self) -> Any:
        """(B,) bool: a limit is broken already, some h is negative, whatever the programs answered."""
        return (self.h < 0.0).any(0)

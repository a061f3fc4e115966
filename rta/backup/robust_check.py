"""The check with error bounds: a control is applied if every backup trajectory within them is safe.

States are known within bounds only, and a control may be held for one call or for several. Torque is applied if, from
every state that may be true, it keeps the attitude's limits while it is held, and a backup trajectory to rest
(`rta.backup.robust_attitude_check`) begins at every call that may end that; thrust likewise with the limits of motion
and a backup trajectory into the terminal set (`rta.backup.robust_motion_check`). Neither trajectory depends on what the
other group does. That keeps the limits from every state from which a backup trajectory begins, whatever is measured.
So, by induction over the true states, none is ever broken (docs/reference/proof.md, *With bounds*).
"""

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state import SIZE, THRUST, TORQUE
from inspection.model.state_checks import LARGEST, is_state
from kernels.control import call, when
from rta.backup import robust_attitude_check, robust_motion_check
from rta.backup.attitude_law import has_rest
from rta.backup.commit import LIMITS, Check
from rta.backup.robust_attitude_constants import AttitudeConstants, NoRestError
from rta.backup.robust_terminal_set import NoInvariantSetError, RobustTerminalSet, thrust
from rta.bounds.uncertainty import Uncertainty
from rta.parameters import RtaParameters


class RobustBackup(Check):
    """The check with error bounds.

    Attributes:
        terminal_set: the law of thrust and its terminal set; attitude: the constants of the law of torque. None: none
            is safe.
    """

    FIXED = ("terminal_set", "attitude", "c", "r", "knows")

    def __init__(
        self,
        terminal_set: RobustTerminalSet | None,
        attitude: AttitudeConstants | None,
        c: Limits,
        r: RtaParameters,
    ) -> None:
        self.terminal_set, self.attitude, self.c, self.r = terminal_set, attitude, c, r
        self.knows = terminal_set is not None, attitude is not None

    @classmethod
    def of(cls, c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> "RobustBackup | None":
        """Returns None without a backup trajectory within the bounds or of this vehicle, or if actuators may fail."""
        if uncertainty.is_zero or uncertainty.health:
            return None
        check = cls(terminal_set_of(c, r, uncertainty), attitude_constants_of(c, r, uncertainty), c, r)
        return check if any(check.knows) else None

    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        found = torch.ones_like(x[0], dtype=torch.bool)
        if self.attitude:
            found &= robust_attitude_check.has_backup_trajectory(x, self.attitude)
        if self.terminal_set:
            found &= robust_motion_check.has_backup_trajectory(x, self.terminal_set)
        return found

    def seen(self, x: Tensor, error_bound: Tensor) -> Tensor:
        return torch.cat((x, error_bound))

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Leaves a group unchecked where one of its limits is surely broken: no backup trajectory begins there.

        States that are not possible cannot be checked.
        """
        possible = is_state(y[:SIZE], self.c) & (y[SIZE:] <= LARGEST).all(0)
        found = possible & (self.may_be_kept(y) >= 0.0)
        return torch.zeros_like(y[:LIMITS], dtype=torch.bool), found

    def may_be_kept(self, y: Tensor) -> Tensor:
        """The most that the least limit of thrust and of torque can be, (2, B); -1 without a backup trajectory."""
        x, error_bound = y[:SIZE], y[SIZE:]
        none = -torch.ones_like(x[0])
        return torch.stack(
            (
                robust_motion_check.may_be_kept(x, error_bound, self.terminal_set)
                if self.terminal_set
                else none,
                robust_attitude_check.may_be_kept(x, error_bound, self.attitude) if self.attitude else none,
            )
        )

    def torque(self, y: Tensor) -> Tensor:
        return call(attitude_law, y, self.attitude) if self.attitude else torch.zeros_like(y[:3])

    def thrust(self, y: Tensor, torque: Tensor) -> Tensor:
        return (
            call(motion_law, y, torque, self.terminal_set) if self.terminal_set else torch.zeros_like(torque)
        )

    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        attitude = motion = torch.zeros_like(asked[0])
        if w := self.attitude:
            (attitude,) = when(asked[1], keeps_attitude, [attitude], y, u, w, waits=True)
        if v := self.terminal_set:
            open_ = asked[0]
            if self.attitude:  # where torque is not safe thrust is looked at with another one
                open_ = open_ & (attitude | ~asked[1])
            (motion,) = when(open_, robust_motion_check.keeps_motion, [motion], y, u, v, self.r, waits=True)
        return torch.stack((motion, attitude))

    def quantised(self, u: Tensor) -> Tensor:
        if not (self.terminal_set and self.terminal_set.uncertainty.is_quantised):
            return u
        return torch.cat(
            (self.terminal_set.uncertainty.quantised(u[THRUST], self.terminal_set.c.max_thrust), u[TORQUE])
        )


def attitude_law(y: Tensor, w: AttitudeConstants) -> Tensor:
    """The law's torque (3, B) in N m."""
    return robust_attitude_check.law(y[:SIZE], w)


def motion_law(y: Tensor, torque: Tensor, w: RobustTerminalSet) -> Tensor:
    """The law's thrust (3, B) in N while torque (3, B) is held."""
    return thrust(y[:SIZE], torque, w)


def keeps_attitude(y: Tensor, u: Tensor, w: AttitudeConstants) -> list[Tensor]:
    """(B,) bool: torque of controls (6, B) keeps the limits, as the backup trajectory does."""
    return [robust_attitude_check.verified(y[:SIZE], u, y[SIZE:], w) >= 0.0]


def terminal_set_of(c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> RobustTerminalSet | None:
    """Returns None where the bounds leave no invariant set, on an ellipse and beside a hull."""
    if c.orbit != "clohessy-wiltshire" or c.hill_rotation or c.planes:
        return None
    try:
        return RobustTerminalSet.of(c, r, uncertainty)
    except NoInvariantSetError:
        return None


def attitude_constants_of(c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> AttitudeConstants | None:
    """Returns None without a backup trajectory to rest within the bounds, or of this vehicle."""
    if not (c.is_circular and not c.hill_rotation and has_rest(c)):
        return None
    try:
        return AttitudeConstants.of(c, r, uncertainty)
    except NoRestError:
        return None

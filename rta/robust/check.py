"""The check with error bounds: a control is applied if every backup trajectory within them is safe.

States are known only within bounds, and a control may be held for one call or for several. Torque is applied if two
conditions hold for every possible true state: torque satisfies the attitude's limits while it is held, and a backup
trajectory to rest (`rta.robust.attitude_check`) begins at every call that may end the hold. Thrust is applied likewise,
with the limits of motion and a backup trajectory into the terminal set (`rta.robust.motion_check`). Neither trajectory
depends on the other group's control. From every state from which a backup trajectory begins, the limits then hold for
any measurement. So, by induction over the true states, no limit is ever violated (docs/reference/proof_with_bounds.md).
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from columns import call, when
from inspection.model.parameters import Limits
from inspection.model.state import SIZE, THRUST, TORQUE
from inspection.model.state_checks import LARGEST, is_state
from inspection.world.uncertainty import Uncertainty
from rta.check.attitude_law import check_rest
from rta.check.commit import LIMITS, Check, NoCheckError, check_frame
from rta.robust import attitude_check, motion_check
from rta.robust.attitude_constants import AttitudeConstants
from rta.robust.prediction import KINDS
from rta.robust.terminal_set import RobustTerminalSet, thrust

T = TypeVar("T")


class RobustCheck(Check):
    """Checks controls with error bounds.

    Attributes:
        terminal_set: the law of thrust and its terminal set; attitude: the constants of the law of torque. None: no
            control of the group is safe.
    """

    size = SIZE + KINDS
    FIXED = ("terminal_set", "attitude", "c", "period", "knows", "reason")

    def __init__(self, c: Limits, period: float, uncertainty: Uncertainty) -> None:
        self.c, self.period = c, period
        self.terminal_set, no_motion = made(terminal_set_of, c, period, uncertainty)
        self.attitude, no_attitude = made(attitude_constants_of, c, period, uncertainty)
        self.knows = self.terminal_set is not None, self.attitude is not None
        why = "; ".join(reason for reason in (no_motion, no_attitude) if reason)
        self.reason = f"{why}, within {uncertainty.said}" if why else ""
        if not any(self.knows):
            raise NoCheckError(self.reason)

    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        found = torch.ones_like(x[0], dtype=torch.bool)
        if self.attitude:
            found &= attitude_check.has_backup_trajectory(x, self.attitude)
        if self.terminal_set:
            found &= motion_check.has_backup_trajectory(x, self.terminal_set)
        return found

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Returns no violated limits, and which groups can be checked, see `Check.fit`.

        A group is not checked where one of its limits is surely violated, since no backup trajectory begins there, or
        where the state is not possible.
        """
        possible = is_state(y[:SIZE], self.c) & (y[SIZE:] <= LARGEST).all(0)
        found = possible & (self.may_be_kept(y) >= 0.0)
        return torch.zeros_like(y[:LIMITS], dtype=torch.bool), found

    def led(self, y: Tensor, broken: Tensor, fit: Tensor) -> Tensor:
        """Returns as `Check.led` which groups follow their law: those that cannot be checked at possible states."""
        known = torch.stack([torch.full_like(fit[0], each) for each in self.knows])
        return known & ~fit & is_state(y[:SIZE], self.c)

    def may_be_kept(self, y: Tensor) -> Tensor:
        """Returns an upper bound of the least limit of thrust and of torque, (2, B); -1 without a backup trajectory."""
        x, error_bound = y[:SIZE], y[SIZE:]
        none = -torch.ones_like(x[0])
        return torch.stack(
            (
                motion_check.may_be_kept(x, error_bound, self.terminal_set) if self.terminal_set else none,
                attitude_check.may_be_kept(x, error_bound, self.attitude) if self.attitude else none,
            )
        )

    def torque(self, y: Tensor) -> Tensor:
        w = self.attitude
        return call(attitude_check.law, y[:SIZE], w, name="attitude_law") if w else torch.zeros_like(y[:3])

    def thrust(self, y: Tensor, torque: Tensor) -> Tensor:
        w = self.terminal_set
        return call(thrust, y[:SIZE], torque, w, name="motion_law") if w else torch.zeros_like(torque)

    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        attitude = motion = torch.zeros_like(asked[0])
        if w := self.attitude:
            (attitude,) = when(asked[1], keeps_attitude, [attitude], y, u, w, waits=True)
        if v := self.terminal_set:
            open_ = asked[0]
            if self.attitude:  # where torque is not safe, thrust is checked later with the replaced torque
                open_ = open_ & (attitude | ~asked[1])
            (motion,) = when(open_, motion_check.keeps_motion, [motion], y, u, v, self.period, waits=True)
        return torch.stack((motion, attitude))

    def with_own(self, u: Tensor, group: int, own: Tensor) -> Tensor:
        """Replaces thrust or torque as `Check.with_own`, rounded to what the actuators can give."""
        u = super().with_own(u, group, own)
        if not (self.terminal_set and self.terminal_set.uncertainty.is_quantised):
            return u
        return torch.cat(
            (self.terminal_set.uncertainty.quantised(u[THRUST], self.terminal_set.c.max_thrust), u[TORQUE])
        )


def keeps_attitude(y: Tensor, u: Tensor, w: AttitudeConstants) -> list[Tensor]:
    """Checks whether torque of controls (6, B) and the backup trajectory satisfy the limits, (B,) bool."""
    least, start = attitude_check.hold_bounds(y[:SIZE], u, y[SIZE:], w)
    return [torch.minimum(least, attitude_check.trajectory_margin(start, w)) >= 0.0]


def made(make: Callable[..., T], *given: Any) -> tuple[T | None, str]:
    """Returns what `make` returns, or None and the reason if no check is known."""
    try:
        return make(*given), ""
    except NoCheckError as error:
        return None, str(error)


def terminal_set_of(c: Limits, period: float, uncertainty: Uncertainty) -> RobustTerminalSet:
    """Returns the terminal set; raises NoCheckError if the bounds leave none, or beside a hull."""
    check_frame(c)
    if c.planes:
        raise NoCheckError("beside a hull no invariant set is known")
    return RobustTerminalSet.of(c, period, uncertainty)


def attitude_constants_of(c: Limits, period: float, uncertainty: Uncertainty) -> AttitudeConstants:
    """Returns the constants; raises NoCheckError if the bounds or the vehicle leave no trajectory to rest."""
    check_frame(c)
    check_rest(c)
    return AttitudeConstants.of(c, period, uncertainty)

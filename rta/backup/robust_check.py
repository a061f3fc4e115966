"""The check with error bounds: a control is applied if it leaves a way from every state within them.

States are known within bounds only, and a control may be held for one call or for several. Torque is applied if, from
every state that may be true, it keeps the attitude's limits while it is held, and a way to rest (`rta.backup.turn`)
begins at every call that may end that; thrust likewise with the limits of motion and a way into the haven
(`rta.backup.homing`). Neither way depends on what the other group does. That keeps the limits from every state from
which a way begins, whatever is measured. So, by induction over the true states, none is ever broken
(docs/reference/proof.md, *With bounds*).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state import SIZE, THRUST, TORQUE
from rta.backup import homing, turn
from rta.backup.attitude_law import has_rest
from rta.backup.commit import LIMITS, Check
from rta.backup.haven import Haven, NoHavenError, thrust
from rta.backup.turning import NoRestError, Turning
from rta.bounds.uncertainty import Uncertainty
from rta.parameters import RtaParameters


class RobustBackup(Check):
    """The check with error bounds.

    Attributes:
        haven: the law of thrust and what its check depends on; turning: that of torque. None: no way is known.
    """

    def __init__(self, haven: Haven | None, turning: Turning | None, r: RtaParameters) -> None:
        self.haven, self.turning, self.r = haven, turning, r
        self.knows = haven is not None, turning is not None

    @classmethod
    def of(cls, c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> "RobustBackup | None":
        """None: no way is known within the bounds or with this vehicle, or actuators may fail."""
        if uncertainty.is_zero or uncertainty.health:
            return None
        check = cls(haven_of(c, r, uncertainty), turning_of(c, r, uncertainty), r)
        return check if any(check.knows) else None

    def has_way(self, x: Tensor) -> Tensor:
        found = torch.ones_like(x[0], dtype=torch.bool)
        if self.turning:
            found &= turn.has_way(x, self.turning)
        if self.haven:
            found &= homing.has_way(x, self.haven)
        return found

    def seen(self, x: Tensor, error_bound: Tensor) -> Tensor:
        return torch.cat((x, error_bound))

    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Of a limit that is broken beyond doubt, its group is not checked: no way begins there."""
        found = y.isfinite().all(0).repeat(2, 1) & (self.may_be_kept(y) >= 0.0)
        return torch.zeros_like(y[:LIMITS], dtype=torch.bool), found

    def may_be_kept(self, y: Tensor) -> Tensor:
        """The most that the least limit of thrust and of torque can be, (2, B); -1 where no way is known."""
        x, error_bound = y[:SIZE], y[SIZE:]
        none = -torch.ones_like(x[0])
        return torch.stack(
            (
                homing.may_be_kept(x, error_bound, self.haven) if self.haven else none,
                turn.may_be_kept(x, error_bound, self.turning) if self.turning else none,
            )
        )

    def torque(self, y: Tensor) -> Tensor:
        return turn.law(y[:SIZE], self.turning) if self.turning else torch.zeros_like(y[:3])

    def thrust(self, y: Tensor, torque: Tensor) -> Tensor:
        return thrust(y[:SIZE], torque, self.haven) if self.haven else torch.zeros_like(torque)

    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        x, error_bound = y[:SIZE], y[SIZE:]
        found = torch.zeros_like(x[:2], dtype=torch.bool)
        if self.haven and 0 in asked:
            found[0] = homing.is_safe(x, u, error_bound, self.haven, self.r)
        if self.turning and 1 in asked:
            found[1] = turn.verified(x, u, error_bound, self.turning) >= 0.0
        return found

    def given(self, u: Tensor) -> Tensor:
        if not (self.haven and self.haven.uncertainty.is_coarse):
            return u
        return torch.cat((self.haven.uncertainty.given(u[THRUST], self.haven.c.max_thrust), u[TORQUE]))


def haven_of(c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> Haven | None:
    """None: the bounds leave no haven, or none is known: on an ellipse and beside a hull."""
    if c.orbit != "clohessy-wiltshire" or c.hill_rotation or c.planes:
        return None
    try:
        return Haven.of(c, r, uncertainty)
    except NoHavenError:
        return None


def turning_of(c: Limits, r: RtaParameters, uncertainty: Uncertainty) -> Turning | None:
    """None: no way to rest is known within the bounds, or with this vehicle."""
    if not (c.is_circular and not c.hill_rotation and has_rest(c)):
        return None
    try:
        return Turning.of(c, r, uncertainty)
    except NoRestError:
        return None

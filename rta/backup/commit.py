"""Propose, check, commit: a control is applied if a backup trajectory keeps all limits after it, else the nearest such.

The nearest is sought between the proposed control and the backup law's, in a few steps; at last it is the law's.
Torque comes first, since the attitude decides where thrust acts. This order is one for all. The backup trajectory is
that of both laws in the model (`rta.backup.nominal_check`), or, with error bounds, any within them
(`rta.backup.robust_check`). Gurriet et al. 2020, backup barriers; Agrawal, Chen and Panagou 2023, gatekeeper.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from inspection.fixed import Fixed
from inspection.model.state import THRUST, TORQUE
from kernels.control import call, loop, when
from rta.constraints.names import PAPERS
from rta.qp.programs import Status
from rta.result import FilterResult

# limits that are kept by thrust, and by torque: the first of Table 3, then the rates
MOTION, ATTITUDE = 7, 3
LIMITS = MOTION + ATTITUDE + 1  # the body rates are one
SLACK_ROUNDED = 1e-9  # in the unit of slack, up to which it is a solver's rounding
CONTROLS = THRUST, TORQUE  # of the groups
SHARES = (0.25, 0.5, 0.75)  # tried between the proposed control and the backup law's


class Check(Fixed, ABC):
    """A check of controls; states y (n, B) are what it is given by `seen`.

    Attributes:
        knows: whether a backup trajectory is known of thrust, and of torque.
    """

    knows: tuple[bool, bool]

    @abstractmethod
    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        """(B,) bool: from true states (16, B) the laws that are known keep their limits for good."""

    @abstractmethod
    def seen(self, x: Tensor, error_bound: Tensor) -> Tensor:
        """What the check depends on: of states (16, B) that may be off by (4, B) more than measured."""

    @abstractmethod
    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """(11, B) bool, limits that are broken already and not asked for; (2, B) bool, groups that can be checked.

        Args:
            h: (13, B) the limits' values.
        """

    @abstractmethod
    def torque(self, y: Tensor) -> Tensor:
        """The law's torque (3, B) in N m."""

    @abstractmethod
    def thrust(self, y: Tensor, torque: Tensor) -> Tensor:
        """The law's thrust (3, B) in N while torque (3, B) is held."""

    def law(self, y: Tensor) -> Tensor:
        """Both laws' control (6, B)."""
        torque = self.torque(y)
        return torch.cat((self.thrust(y, torque), torque))

    @abstractmethod
    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """(2, B) bool: thrust, torque of controls (6, B) keep their limits in a hold and on the backup trajectory.

        Args:
            broken: as of `fit`; asked: (2, B) bool, where each matters; elsewhere nothing is said.
        """

    def quantised(self, u: Tensor) -> Tensor:
        """Rounds controls (6, B) to those that the actuators can give."""
        return u

    def followed(self, y: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """Both laws' controls (6, B) where they are known to be safe, else u; (B,) bool, where they are."""
        return [u, torch.zeros_like(broken[0])]

    def commit(
        self, x: Tensor, error_bound: Tensor, desired: Tensor, result: FilterResult, of_torque: Sequence[bool]
    ) -> FilterResult:
        """What the programs propose at states (16, B), with the controls that may be applied.

        A limit that is kept does not yield: where a control is safe only a broken one, and those of the user's own,
        have slack.

        Args:
            error_bound: (4, B) by how much further than measured the states may be off.
            of_torque: by constraint, torque enforces it; else thrust does.
        """
        y = self.seen(x, error_bound)
        broken, fit = call(self.fit, y, result.h[: len(PAPERS)])
        control, safe, changed = self.committed(y, result.control, broken, fit)
        slack, status = call(concluded, result.slack, result.program_status, broken, safe, changed, of_torque)
        return replace(
            result,
            control=control,
            intervened=(control != desired).any(0),
            verified=safe.all(0) & ~broken.any(0),
            backup=changed.any(0),
            slack=slack,
            status=status.amax(0),
            program_status=status,
        )

    def committed(self, y: Tensor, u: Tensor, broken: Tensor, fit: Tensor) -> list[Tensor]:
        """What is applied in the place of proposed controls (6, B).

        Args:
            broken, fit: as of `fit`.

        Returns:
            Controls (6, B); (2, B) bool: thrust and torque are safe; (2, B) bool: they are other ones.
        """
        safe = self.is_safe(y, u, broken, fit) & fit
        changed = fit & ~safe
        given = y, u, broken, fit, safe
        return when(changed.any(0), self.replaced, [u, safe, changed], *given, waits=True)

    def replaced(self, y: Tensor, u: Tensor, broken: Tensor, fit: Tensor, safe: Tensor) -> list[Tensor]:
        """What is applied in the place of controls that are not safe, as `committed`."""
        no = torch.zeros_like(safe[0])
        turned = fit[1] & ~safe[1]
        u, torque = when(turned, self.nearest, [u, no], y, u, broken, 1, waits=True, name="nearest_torque")
        # thrust is looked at again, with the torque that is applied
        (thrust,) = when(turned & fit[0], self.is_thrust_safe, [safe[0]], y, u, broken, waits=True)
        pushed = fit[0] & ~thrust
        u, other = when(pushed, self.nearest, [u, no], y, u, broken, 0, waits=True, name="nearest_thrust")
        safe, changed = torch.stack((thrust | other, safe[1] | torque)), torch.stack((pushed, turned))
        u, followed = when(~safe.all(0), self.followed, [u, no], y, u, broken, waits=True)
        return [u, safe | followed, changed | followed]

    def is_thrust_safe(self, y: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """(B,) bool."""
        return [self.is_safe(y, u, broken, only(0, broken))[0]]

    def nearest(self, y: Tensor, u: Tensor, broken: Tensor, group: int) -> list[Tensor]:
        """The first safe control between u (6, B) and the law's of a group, else the law's.

        Returns:
            Controls (6, B); (B,) bool: they are safe.
        """
        law = self.torque(y) if group else self.thrust(y, u[TORQUE])
        count, no = torch.zeros_like(broken[0], dtype=torch.int64), torch.zeros_like(broken[0])
        state = [count, self.quantised(with_own(u, group, law)), no]
        given = y, u, broken, law, group
        everywhere = torch.ones_like(no)
        return loop(self.share, state, *given, alive=everywhere, most=len(SHARES) + 1, waits=True)[1:]

    def share(
        self,
        number: Tensor,
        best: Tensor,
        found: Tensor,
        y: Tensor,
        u: Tensor,
        broken: Tensor,
        law: Tensor,
        group: int,
    ) -> tuple[list[Tensor], Tensor]:
        """Tries the next share of the way from a group's controls to its law's (3, B), in turn."""
        share = u.new_tensor((*SHARES, 1.0))[number]
        one = u[CONTROLS[group]]
        between = (one + share * (law - one)).clamp(torch.minimum(one, law), torch.maximum(one, law))
        tried = self.quantised(with_own(u, group, between))
        safe = self.is_safe(y, tried, broken, only(group, broken))[group]
        return [number + 1, torch.where(safe, tried, best), safe], ~safe


def concluded(
    slack: Tensor, status: Tensor, broken: Tensor, safe: Tensor, changed: Tensor, of_torque: Sequence[bool]
) -> tuple[Tensor, Tensor]:
    """Slack (constraints, B) and statuses (2, B) once it is known what is safe and what was changed, (2, B) bool."""
    rates = broken[-1].expand(len(PAPERS) - MOTION - ATTITUDE, -1)
    own = torch.ones_like(slack[len(PAPERS) :], dtype=torch.bool)
    kept = torch.stack([safe[int(torque)] for torque in of_torque]) & ~torch.cat((broken[:-1], rates, own))
    slack = torch.where(kept, 0.0, slack)
    groups = [[each == torque for each in of_torque] for torque in (False, True)]
    yields = torch.stack([(slack[group] > SLACK_ROUNDED).any(0) for group in groups])
    status = torch.where(changed, status.clamp(min=Status.HARD), status)
    return slack, torch.where(safe & ~yields & (status == Status.SLACK), Status.HARD, status)


def only(group: int, broken: Tensor) -> Tensor:
    """(2, B) bool: one group matters."""
    yes = torch.ones_like(broken[0])
    return torch.stack((yes, ~yes) if group == 0 else (~yes, yes))


def with_own(u: Tensor, group: int, own: Tensor) -> Tensor:
    """Controls (6, B) with others (3, B) of a group's own."""
    return torch.cat((own, u[TORQUE]) if group == 0 else (u[THRUST], own))

"""Propose, check, commit: a control is applied if a backup trajectory keeps all limits after it, else the nearest such.

The nearest is sought between the proposed control and the backup law's, in a few steps; at last it is the law's.
Torque comes first, since the attitude decides where thrust acts. This order is one for all. The backup trajectory is
that of both laws in the model (`rta.backup.nominal_check`), or, with error bounds, any within them
(`rta.backup.robust_check`). Gurriet et al. 2020, backup barriers; Agrawal, Chen and Panagou 2023, gatekeeper.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from inspection.fixed import Fixed
from inspection.model.state import THRUST, TORQUE
from rta.constraints.names import PAPERS
from rta.qp.programs import Status, pick, put
from rta.result import FilterResult

# limits that are kept by thrust, and by torque: the first of Table 3, then the rates
MOTION, ATTITUDE = 7, 3
LIMITS = MOTION + ATTITUDE + 1  # the body rates are one
SLACK_ROUNDED = 1e-9  # in the unit of slack, up to which it is a solver's rounding
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
    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        """(2, B) bool: thrust, torque of controls (6, B) keep their limits in a hold and on the backup trajectory.

        Args:
            broken: as of `fit`; asked: the groups that matter; of the other one nothing is said.
        """

    def quantised(self, u: Tensor) -> Tensor:
        """Rounds controls (6, B) to those that the actuators can give."""
        return u

    def follow(self, y: Tensor, u: Tensor, safe: Tensor, changed: Tensor, broken: Tensor) -> None:
        """Puts both laws' controls where no other control is safe, if the laws' are; arguments as in `committed`."""

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
        broken, fit = self.fit(y, result.h[: len(PAPERS)])
        control, safe, changed = self.committed(y, result.control, broken, fit)
        group = torch.tensor(of_torque, device=x.device).long()
        kept = safe[group]
        kept[: MOTION + ATTITUDE] &= ~broken[: MOTION + ATTITUDE]
        kept[MOTION + ATTITUDE : len(PAPERS)] &= ~broken[-1]
        kept[len(PAPERS) :] = False
        slack = result.slack.masked_fill(kept, 0.0)
        yields = torch.stack([(slack[group == i] > SLACK_ROUNDED).any(0) for i in range(2)])
        status = torch.where(changed, result.program_status.clamp(min=Status.HARD), result.program_status)
        status = torch.where(safe & ~yields & (status == Status.SLACK), Status.HARD, status)
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

    def committed(self, y: Tensor, u: Tensor, broken: Tensor, fit: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What is applied in the place of proposed controls (6, B).

        Args:
            broken, fit: as of `fit`.

        Returns:
            Controls (6, B); (2, B) bool: thrust and torque are safe; (2, B) bool: they are other ones.
        """
        u = u.clone()
        safe = self.is_safe(y, u, broken) & fit
        changed = ~safe & fit
        for group, own in ((1, TORQUE), (0, THRUST)):
            columns = torch.nonzero(changed[group]).flatten()
            if not columns.numel():
                continue
            there, asked, others = pick(y, columns), pick(u, columns), pick(broken, columns)
            law = self.thrust(there, asked[TORQUE]) if group == 0 else self.torque(there)

            def is_safe(
                at: Tensor, tried: Tensor, there: Tensor = there, others: Tensor = others, group: int = group
            ) -> Tensor:
                return self.is_safe(pick(there, at), tried, pick(others, at), (group,))[group]

            control, found = nearest(asked, own, law, is_safe, self.quantised)
            put(u, columns, control)
            put(safe[group], columns, found)
            if group == 1:  # thrust is looked at again, with the torque that is applied
                can = pick(fit[0], columns)
                again = self.is_safe(there, control, others, (0,))[0] & can
                put(safe[0], columns, again)
                put(changed[0], columns, ~again & can)
        self.follow(y, u, safe, changed, broken)
        return u, safe, changed


def nearest(
    u: Tensor,
    own: slice,
    law: Tensor,
    is_safe: Callable[[Tensor, Tensor], Tensor],
    quantised: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """Returns the first safe control between u (6, M) and the law's (3, M), else the law's.

    Args:
        own: the controls of a group; is_safe: of indices (k,) of M and controls (6, k), (k,) bool.
        quantised: rounds controls (6, k) to those that the actuators can give.

    Returns:
        Controls (6, M); (M,) bool: they are safe.
    """
    there = u.clone()
    there[own] = law
    best, found = quantised(there), torch.zeros_like(u[0], dtype=torch.bool)
    for share in (*SHARES, 1.0):
        left = torch.nonzero(~found).flatten()
        if not left.numel():
            break
        one, other = pick(u, left), pick(there, left)
        tried = (one + share * (other - one)).clamp(torch.minimum(one, other), torch.maximum(one, other))
        tried = quantised(tried)
        safe = is_safe(left, tried)
        put(best, left[safe], tried[:, safe])
        put(found, left, safe)
    return best, found

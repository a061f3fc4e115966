"""Propose, check, commit: the applied control has a backup trajectory that satisfies all limits, if one is found.

If the proposed control has none, controls on the way to the backup law's are tried in a few steps, the law's last.
Torque comes first, since thrust acts along the attitude. Each check defines its backup trajectory
(`rta.check.nominal`). Gurriet et al. 2020, backup barriers; Agrawal, Chen and Panagou 2023, gatekeeper.
"""

from abc import ABC, abstractmethod
from dataclasses import replace

import torch
from torch import Tensor

from columns import call, loop, when
from inspection.fixed import Fixed
from inspection.model.parameters import Limits
from inspection.model.state import SIZE, THRUST, TORQUE
from rta.names import PAPERS
from rta.result import FilterResult, Status

# numbers of limits on thrust, and on torque without the rates, in the order of Table 3
MOTION, ATTITUDE = 7, 3
LIMITS = MOTION + ATTITUDE + 1  # the body rates count as one limit
CONTROLS = THRUST, TORQUE  # the controls of group 0 and of group 1
SHARES = (0.25, 0.5, 0.75)  # shares of the way from the proposed control to the backup law's


class NoCheckError(ValueError):
    """Signals that no backup laws are known that satisfy the limits for good, and why."""


def check_frame(c: Limits) -> None:
    """Raises NoCheckError where the model includes the turning of Hill's frame, which no backup law counters."""
    if c.hill_rotation:
        raise NoCheckError("the turning of Hill's frame must be left out (hill_rotation = false)")


class Check(Fixed, ABC):
    """Checks controls at states y (n, B), whose first components are those of a state.

    Attributes:
        size: n.
        knows: (bool, bool), whether a backup law is known for thrust, and for torque; reason: why one is not.
    """

    knows: tuple[bool, bool]
    reason: str = ""
    size = SIZE

    @abstractmethod
    def has_backup_trajectory(self, x: Tensor) -> Tensor:
        """Checks from which true states (16, B) the known backup laws satisfy their limits for good, (B,) bool."""

    @abstractmethod
    def fit(self, y: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """Returns which limits are violated already and not checked, (11, B), and which groups can be checked, (2, B).

        Args:
            h: (13, B) the limits' values.
        """

    @abstractmethod
    def torque(self, y: Tensor) -> Tensor:
        """Returns the law's torque (3, B) in N m."""

    @abstractmethod
    def thrust(self, y: Tensor, torque: Tensor) -> Tensor:
        """Returns the law's thrust (3, B) in N while torque (3, B) is held."""

    def law(self, y: Tensor) -> Tensor:
        """Returns both laws' control (6, B)."""
        torque = self.torque(y)
        return torch.cat((self.thrust(y, torque), torque))

    @abstractmethod
    def is_safe(self, y: Tensor, u: Tensor, broken: Tensor, asked: Tensor) -> Tensor:
        """Checks whether a hold of controls (6, B) and the backup trajectory satisfy each group's limits, (2, B) bool.

        Args:
            broken: as returned by `fit`; asked: (2, B) bool, the groups to check; the result is undefined for the
                others.
        """

    def with_own(self, u: Tensor, group: int, own: Tensor) -> Tensor:
        """Replaces thrust (group 0) or torque of controls (6, B) by `own` (3, B)."""
        return torch.cat((own, u[TORQUE]) if group == 0 else (u[THRUST], own))

    def followed(self, y: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """Returns both laws' controls (6, B) where these are safe from y, else u, and where they are. Here: nowhere."""
        return [u, torch.zeros_like(broken[0])]

    def led(self, y: Tensor, broken: Tensor, fit: Tensor) -> Tensor:
        """Returns which groups have a violated limit, and so follow their law back to it, (2, B) bool."""
        return torch.stack((broken[:MOTION].any(0), broken[MOTION:].any(0))) & fit

    def led_back(self, y: Tensor, u: Tensor, led: Tensor) -> list[Tensor]:
        """Replaces controls (6, B) by those of the laws in the groups of `led`."""
        u = self.with_own(u, 1, torch.where(led[1], self.torque(y), u[TORQUE]))
        return [self.with_own(u, 0, torch.where(led[0], self.thrust(y, u[TORQUE]), u[THRUST]))]

    def commit(self, y: Tensor, desired: Tensor, proposed: FilterResult) -> FilterResult:
        """Returns what is applied in place of a proposal at states y (n, B)."""
        broken, fit = call(self.fit, y, proposed.h[: len(PAPERS)])
        led = self.led(y, broken, fit)
        (control,) = when(led.any(0), self.led_back, [proposed.control], y, proposed.control, led, waits=True)
        control, safe, changed = self.committed(y, control, broken, fit)
        changed = changed | led
        found = call(concluded, control, desired, broken, safe, changed, proposed.slack, proposed.status)
        intervened, verified, backup, slack, status = found
        return replace(
            proposed,
            control=control,
            intervened=intervened,
            verified=verified,
            backup=backup,
            slack=slack,
            status=status,
        )

    def committed(self, y: Tensor, u: Tensor, broken: Tensor, fit: Tensor) -> list[Tensor]:
        """Returns what is applied in place of proposed controls (6, B).

        Args:
            broken, fit: as returned by `fit`.

        Returns:
            Controls (6, B); (2, B) bool: thrust and torque are safe; (2, B) bool: they differ from the proposed ones.
        """
        safe = self.is_safe(y, u, broken, fit) & fit
        changed = fit & ~safe
        given = y, u, broken, fit, safe
        return when(changed.any(0), self.replaced, [u, safe, changed], *given, waits=True)

    def replaced(self, y: Tensor, u: Tensor, broken: Tensor, fit: Tensor, safe: Tensor) -> list[Tensor]:
        """Returns what is applied in place of controls that are not safe, as `committed`."""
        no = torch.zeros_like(safe[0])
        turned = fit[1] & ~safe[1]
        u, torque = when(turned, self.nearest, [u, no], y, u, broken, 1, waits=True, name="nearest_torque")
        # check thrust again, with the torque that is applied
        (thrust,) = when(turned & fit[0], self.is_thrust_safe, [safe[0]], y, u, broken, waits=True)
        pushed = fit[0] & ~thrust
        u, other = when(pushed, self.nearest, [u, no], y, u, broken, 0, waits=True, name="nearest_thrust")
        safe, changed = torch.stack((thrust | other, safe[1] | torque)), torch.stack((pushed, turned))
        u, followed = when(~safe.all(0), self.followed, [u, no], y, u, broken, waits=True)
        return [u, safe | followed, changed | followed]

    def is_thrust_safe(self, y: Tensor, u: Tensor, broken: Tensor) -> list[Tensor]:
        """Checks whether thrust of controls (6, B) is safe, (B,) bool."""
        return [self.is_safe(y, u, broken, only(0, broken))[0]]

    def nearest(self, y: Tensor, u: Tensor, broken: Tensor, group: int) -> list[Tensor]:
        """Returns the first safe control between u (6, B) and the law's of a group, else the law's.

        Returns:
            Controls (6, B); (B,) bool: they are safe.
        """
        law = self.torque(y) if group else self.thrust(y, u[TORQUE])
        count, no = torch.zeros_like(broken[0], dtype=torch.int64), torch.zeros_like(broken[0])
        state = [count, self.with_own(u, group, law), no]
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
        tried = self.with_own(u, group, between)
        safe = self.is_safe(y, tried, broken, only(group, broken))[group]
        return [number + 1, torch.where(safe, tried, best), safe], ~safe


def concluded(
    control: Tensor,
    desired: Tensor,
    broken: Tensor,
    safe: Tensor,
    changed: Tensor,
    slack: Tensor,
    status: Tensor,
) -> list[Tensor]:
    """Returns whether controls (6, B) were changed, are verified and replace proposed ones; also slack and statuses.

    A verified control satisfies every limit, whatever slack the program used.
    """
    intervened = (control != desired).any(0)
    verified = safe.all(0) & ~broken.any(0)
    backup = changed.any(0)
    status = torch.where(intervened, status.clamp(min=Status.HARD), status)
    status = torch.where(verified, status.clamp(max=Status.HARD), status)
    return [intervened, verified, backup, torch.where(verified, 0.0, slack), status]


def only(group: int, broken: Tensor) -> Tensor:
    """Selects one group, (2, B) bool."""
    yes = torch.ones_like(broken[0])
    return torch.stack((yes, ~yes) if group == 0 else (~yes, yes))

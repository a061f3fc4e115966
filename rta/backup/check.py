"""Propose, check, commit: a control is applied if it keeps all limits while held, and a way to rest begins at its end.

If not, the nearest control that does, on the way from it to the backup law's; at worst that law's, the first hold of a
way that was verified one call ago. By induction no limit should be violated in the model; along the zone the law leaves
what was verified (docs/reference/proof.md, the counterexample). Gurriet et al. 2020, backup barriers; Agrawal, Chen and
Panagou 2023, gatekeeper.

Torque comes first, since the attitude decides where thrust acts. Limits of motion are kept in whatever attitude.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE, V
from rta.backup import brake, slew
from rta.backup.brake import AT_REST, Braking
from rta.backup.slew import Slewing
from rta.constraints.names import CONSTRAINTS
from rta.qp.programs import Status, pick, put
from rta.result import FilterResult

LOOK = 2.5  # s, between two looks at a hold at most
MOTION, ATTITUDE = (
    7,
    3,
)  # limits that a way keeps by thrust, and by torque: the first of Table 3, then the rates
RATES_ROUNDED = 1e-9  # rad^2/s^2, by which rates at their limit may be beyond, where the plant holds them
SLACK_ROUNDED = 1e-9  # in the unit of slack, up to which it is a solver's rounding
SHARES = (0.25, 0.5, 0.75)  # of the way from what is proposed to the backup law's control, that are tried


class Backup:
    """The check of a filter whose plant is the model.

    Args:
        c: the model and the limits; hold: s, that a control is held.

    Attributes:
        motion, limits: how many limits a way keeps by thrust, and in all, in the order of `CONSTRAINTS`.
    """

    motion, limits = MOTION, MOTION + ATTITUDE

    def __init__(self, c: Limits, hold: float) -> None:
        steps = math.ceil(hold / LOOK)
        # where the plant is stepped more often than a hold is looked at, it would hold the rates elsewhere
        self.c = replace(c, saturate_rates=c.saturate_rates and hold / steps <= c.substep)
        self.slewing = Slewing.of(self.c, hold, steps)
        self.braking = Braking.of(self.c, hold, steps, self.slewing.fastest)

    @staticmethod
    def is_there(c: Limits) -> bool:
        """Whether a way to rest is known: on a circle, beside a sphere, in an attitude that charges and cools."""
        return c.orbit == "clohessy-wiltshire" and not c.hill_rotation and not c.planes and slew.has_rest(c)

    def has_way(self, x: Tensor) -> Tensor:
        """(B,) bool: states (16, B) have a verified way to rest."""
        at = brake.beginning(x, self.braking)
        brakes = either(brake.at_once(at, self.braking), lambda columns: self.brakes(pick(at, columns)))
        return brakes & (slew.way(x, self.slewing) >= 0.0)

    def torque_is_safe(self, x: Tensor, u: Tensor) -> Tensor:
        """(B,) bool: torque of controls (6, B) keeps the attitude's limits and leaves a way to rest."""
        w = self.slewing

        def looked_at(columns: Tensor) -> Tensor:
            y, v = pick(x, columns), pick(u, columns)
            return either(
                slew.at_a_glance(y, v, w), lambda at: slew.verified(pick(y, at), pick(v, at), w) >= 0.0
            )

        return either(slew.at_first_sight(x, u, w), looked_at)

    def thrust_is_safe(self, x: Tensor, u: Tensor) -> Tensor:
        """(B,) bool: thrust of controls (6, B), with their torque, keeps the limits of motion, and a way to rest."""
        w = self.braking

        def looked_at(columns: Tensor) -> Tensor:
            least, end = brake.held(pick(x, columns), pick(u, columns), w, w.free)
            return (least >= 0.0) & self.brakes(brake.beginning(end, w))

        return either(brake.at_a_glance(x, u, w), looked_at)

    def brakes(self, at: Tensor) -> Tensor:
        """(B,) bool: ways from (10, B) as of `brake.beginning` keep the limits of motion and come to rest."""
        safe, flying = torch.zeros_like(at[0], dtype=torch.bool), torch.arange(at.shape[1], device=at.device)
        for _ in range(self.braking.holds):
            rested = norm(at[V]) <= AT_REST
            at, least = brake.braked(at, self.braking)
            kept = least >= 0.0
            put(safe, flying[kept & rested], torch.ones_like(flying[kept & rested], dtype=torch.bool))
            on = torch.nonzero(kept & ~rested).flatten()
            flying, at = flying[on], pick(at, on)
            if not flying.numel():
                break
        return safe

    def commit(
        self, x: Tensor, desired: Tensor, result: FilterResult, of_torque: Sequence[bool]
    ) -> FilterResult:
        """What the programs propose at states (16, B), with the controls that may be applied.

        A limit that is kept does not yield: where a control is verified only constraints of the user's own have slack.

        Args:
            of_torque: by constraint, torque holds it; else thrust does.
        """
        motion, attitude = result.h[: self.motion], result.h[self.motion : self.limits]
        rates = result.h[self.limits : len(CONSTRAINTS)] >= -RATES_ROUNDED
        strange = ~x.isfinite().all(0)  # nothing is known of the way from such a state
        broken = strange | ~(motion >= 0.0).all(0), strange | ~((attitude >= 0.0).all(0) & rates.all(0))
        control, verified, changed = self.committed(x, result.control, broken)
        group = torch.tensor(of_torque, device=x.device).long()
        kept = verified[group]
        kept[len(CONSTRAINTS) :] = False
        slack = result.slack.masked_fill(kept, 0.0)
        yields = torch.stack([(slack[group == i] > SLACK_ROUNDED).any(0) for i in range(2)])
        status = torch.where(changed, result.program_status.clamp(min=Status.HARD), result.program_status)
        status = torch.where(verified & ~yields & (status == Status.SLACK), Status.HARD, status)
        return replace(
            result,
            control=control,
            intervened=(control != desired).any(0),
            verified=verified.all(0),
            backup=changed.any(0),
            slack=slack,
            status=status.amax(0),
            program_status=status,
        )

    def committed(self, x: Tensor, u: Tensor, broken: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """What is applied in the place of proposed controls.

        Args:
            x: states (16, B); u: (6, B) as proposed.
            broken: of motion and of attitude, (B,) bool: one of its limits is violated already, so there is no way.

        Returns:
            Controls (6, B); (2, B) bool: thrust and torque are verified; (2, B) bool: they are other ones.
        """
        u, verified, changed = u.clone(), torch.stack(broken), torch.stack(broken)
        for group, own, law, is_safe in (
            (1, TORQUE, self.slews, self.torque_is_safe),
            (0, THRUST, self.brakes_with, self.thrust_is_safe),
        ):
            verified[group] = is_safe(x, u) & ~broken[group]
            changed[group] = ~verified[group] & ~broken[group]
            columns = torch.nonzero(changed[group]).flatten()
            if columns.numel():
                there, proposed = pick(x, columns), pick(u, columns)
                control, found = nearest(there, proposed, own, law(there, proposed), is_safe)
                put(u, columns, control)
                put(verified[group], columns, found)
        self.follow(x, u, verified, changed, broken[1])
        return u, verified, changed

    def follow(
        self, x: Tensor, u: Tensor, verified: Tensor, changed: Tensor, attitude_is_broken: Tensor
    ) -> None:
        """Where no thrust is seen to be safe, has both groups follow their laws: the way was verified with both."""
        columns = torch.nonzero(changed[0] & ~verified[0] & ~attitude_is_broken).flatten()
        if not columns.numel():
            return
        there, both = pick(x, columns), pick(u, columns)
        both[TORQUE] = self.slews(there, both)
        both[THRUST] = self.brakes_with(there, both)
        put(u, columns, both)
        put(changed[1], columns, torch.ones_like(columns, dtype=torch.bool))
        put(verified[1], columns, self.torque_is_safe(there, both))
        put(verified[0], columns, self.thrust_is_safe(there, both))

    def slews(self, x: Tensor, u: Tensor) -> Tensor:
        """The law's torque (3, B) at states (16, B); controls (6, B) do not matter."""
        return slew.slew(x, self.slewing)

    def brakes_with(self, x: Tensor, u: Tensor) -> Tensor:
        """The law's thrust (3, B) at states (16, B) with the torque of controls (6, B)."""
        return brake.brake(x, u[TORQUE], self.braking)


def verified_or_nearest(
    y: Tensor,
    u: Tensor,
    own: slice,
    may_be_kept: Tensor,
    law: Callable[[Tensor, Tensor], Tensor],
    is_safe: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """What is applied of one group in the place of proposed controls (6, B).

    Args:
        y: (n, B) what `law` and `is_safe` are given, columns of B, states first.
        own: the group's controls; may_be_kept: (B,) bool: none of its limits is violated already for sure.
        law: its controls (3, M) at M columns of y and u; is_safe: (M,) bool: the group's controls are.

    Returns:
        Controls (6, B); (B,) bool each: the group's are verified; they are others.
    """
    u, checked = u.clone(), y.isfinite().all(0) & may_be_kept
    kept = is_safe(y, u) & checked
    changed = ~kept & checked
    columns = torch.nonzero(changed).flatten()
    if columns.numel():
        there, proposed = pick(y, columns), pick(u, columns)
        control, found = nearest(there, proposed, own, law(there, proposed), is_safe)
        put(u, columns, control)
        put(kept, columns, found)
    return u, kept, changed


def nearest(
    x: Tensor, u: Tensor, own: slice, law: Tensor, is_safe: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """The first of controls on the way from u (6, M) to the law's (3, M) that is safe, else the law's.

    Returns:
        Controls (6, M); (M,) bool: they are verified.
    """
    there = u.clone()
    there[own] = law
    best, found = there.clone(), torch.zeros_like(u[0], dtype=torch.bool)
    for share in (*SHARES, 1.0):
        left = torch.nonzero(~found).flatten()
        if not left.numel():
            break
        one, other = pick(u, left), pick(there, left)
        tried = (one + share * (other - one)).clamp(torch.minimum(one, other), torch.maximum(one, other))
        safe = is_safe(pick(x, left), tried)
        put(best, left[safe], tried[:, safe])
        put(found, left, safe)
    return best, found


def either(least: Tensor, look: Callable[[Tensor], Tensor]) -> Tensor:
    """(B,) bool: the least of the limits (B,) is not negative at a glance, or a closer look at the columns finds so."""
    safe = least >= 0.0
    columns = torch.nonzero(~safe).flatten()
    if columns.numel():
        put(safe, columns, look(columns))
    return safe

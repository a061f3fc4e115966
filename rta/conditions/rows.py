"""The barrier conditions a u + b >= 0 of a list of constraints at a batch of states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby

import torch
from torch import Tensor

from inspection.model.attitude import unit
from inspection.model.dynamics import attitude_rate, control_matrix, drift
from inspection.model.parameters import Limits
from inspection.model.state import SIZE, P, Q
from rta.bounds.errors import Errors
from rta.bounds.uncertainty import NOTHING, Uncertainty
from rta.constraints.constraint import ACTUATORS, Barrier, Constraint, check
from rta.lie_derivatives import Function, lie_derivative, lie_derivatives
from rta.parameters import RtaParameters
from rta.qp.programs import total


@dataclass
class Rows:
    """Conditions of one actuator group on u in N or N m.

    Attributes:
        psi: (R, B) Psi_1 where the relative degree is two, else the barrier, less what a measurement may be wrong by.
        a: (R, 3, B); b: (R, B) with margins; b_bare: (R, B) without. Both are less what Psi can lose in a period.
        waived: (R, B) by how much b_bare asks for less than the condition does, see `ActuatorGroup.attainable`.
        h: (constraints, B) values without margin, exact; where the smallest row is h, at the moments of the rows.
        tightening: (R, B) by how much b is less for what the filter does not know; (0, B) where it knows all.
    """

    psi: Tensor
    a: Tensor
    b: Tensor
    b_bare: Tensor
    waived: Tensor
    h: Tensor
    tightening: Tensor


class ActuatorGroup:
    """The constraints that one actuator group holds, and the rows of its program.

    Args:
        held_by: a key of ACTUATORS; others of the constraints are left out.
        constraints: the paper's and your own.

    Attributes:
        held_by; controls: its place in a control; limit: of each of its actuators in N or N m.
        names: of its constraints; of_row: the constraint of each row; weights: the slack weight of each row.
        share: of what the actuators can give, which a row beyond its limit asks for at most.

    Raises:
        ValueError: a constraint of your own is not as it must be, see `check`, one of its derivatives is not finite, or
            its relative degree is other than its number of gains.
    """

    def __init__(
        self,
        held_by: str,
        constraints: Sequence[Constraint],
        c: Limits,
        r: RtaParameters,
        known: Uncertainty = NOTHING,
    ) -> None:
        self.c, self.r, self.known = c, r, known
        self.held_by, self.share = held_by, 1.0
        self.controls = ACTUATORS[held_by]
        self.limit = c.control_limit[self.controls.start]
        own = [each for each in constraints if each.held_by == held_by]
        self.constraints = sorted(own, key=self.kind)  # in the order of their rows
        self.names = tuple(each.name for each in self.constraints)
        self.of_row = [each for each in self.constraints for _ in range(self.count(each))]
        self.weights = [
            r.slack_weight_critical if each.weight is None else each.weight for each in self.of_row
        ]
        self.check([each for each in self.constraints if each.coupled])

    def count(self, each: Constraint) -> int:
        """How many rows a constraint has."""
        return each.rows

    def kind(self, each: Constraint) -> tuple[bool, bool]:
        """Rows of one kind are computed together: whether other controls change them, and errors are not in them."""
        return each.coupled, not self.is_least(each)

    def is_least(self, each: Constraint) -> bool:
        """Whether the least of its barrier within errors is taken."""
        return each.is_least and not self.known.is_nil

    def gain(self, value: float) -> float:
        """A gain in 1/s as used."""
        return self.r.gain(value, self.known.longest_hold)

    def values(self, x: Tensor) -> Tensor:
        """Every h, states (16, ...) to (constraints, ...)."""
        return torch.stack([each.h(x) for each in self.constraints])

    def psi_at(
        self,
        x: Tensor,
        constraints: Sequence[Constraint],
        start: Tensor | None = None,
        after: float = 0.0,
        off: Errors | None = None,
    ) -> Barrier:
        """What is differentiated at states x (16, B), each Psi_1 or barrier: (16, ...) to (R, ...).

        Where x are states so many s after others, `start`, what these were beyond counts. With errors the constraints'
        barriers are to be least ones, and the function takes errors, too.

        Psi_1 = L_f h + alpha(h) with alpha(h) = k1 (h - margin), the HOCBF, within the limit. Beyond it alpha(h) =
        max(k2 h, -recovery) - k1 margin: k1 h would ask for faster cooling than there is in the dark (0.0015 of 1 deg C
        a second, of 0.00036), so that the row could not be satisfied for half an hour, or for a small part of what
        there is (battery). With k2 for k1 the way back is critically damped; -k1 margin, as within the limit, ends it
        in finite time.
        """
        barriers = [each.barrier_at(x, after, off) for each in constraints]
        start = x if start is None else start
        beyond = {i: each.h(start) < 0.0 for i, each in enumerate(constraints) if each.recovery is not None}
        second = [i for i, each in enumerate(constraints) if each.degree == 2]

        def psi(y: Tensor, *off: Errors) -> Tensor:
            rows = {i: barrier(y, *off) for i, barrier in enumerate(barriers) if i not in second}
            if second:
                h, rate = lie_derivative(
                    lambda z: torch.cat([barriers[i](z) for i in second]), y, drift(y, self.c)
                )
                counts = [constraints[i].rows for i in second]
                for i, h_i, rate_i in zip(second, h.split(counts), rate.split(counts), strict=True):
                    each = constraints[i]
                    k1, k2 = map(self.gain, each.gains)
                    alpha = k1 * (h_i - each.margin)
                    if each.recovery is not None:
                        back = (k2 * h_i).clamp(min=-each.recovery) - k1 * each.margin
                        alpha = torch.where(beyond[i], back, alpha)
                    rows[i] = rate_i + alpha
            return torch.cat([rows[i] for i in range(len(constraints))])

        return psi

    def __call__(self, x: Tensor) -> Rows:
        """The conditions at states (16, B)."""
        return self.joined(partial(self.conditions, x), torch.full_like(x[:3], self.limit))

    def joined(self, conditions: Callable[[Sequence[Constraint], bool], Rows], limit: Tensor) -> Rows:
        """The conditions of the constraints that only this group changes, then those of the others."""
        parts = [
            conditions(list(constraints), coupled)
            for (coupled, _), constraints in groupby(self.constraints, self.kind)
        ]
        return self.attainable(
            Rows(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0]))), limit
        )

    def conditions(self, x: Tensor, constraints: Sequence[Constraint], coupled: bool) -> Rows:
        """BC: L_f psi + L_g psi u + alpha(psi) >= 0, less what psi can lose and the worst that others can do."""
        c, r = self.c, self.r
        g = control_matrix(half_a_period_ahead(x, r.period, c), c)
        along = g if coupled else g[:, self.controls]
        psi, lf, a = lie_derivatives(self.psi_at(x, constraints), x, drift(x, c), along)
        rows = [each for each in constraints for _ in range(each.rows)]
        loss = torch.stack([each.loss_at(x) for each in rows])
        if coupled:
            most = a.abs() * x.new_tensor(c.control_limit)[:, None]
            a = a[:, self.controls]
            loss = loss + (most.sum(1) - most[:, self.controls].sum(1))

        gain, margin, inside = self.alpha(psi, rows)
        h = self.reported(x, constraints, psi)
        b, b_bare = lf + gain * (psi - margin) - loss, lf + gain * (psi + inside) - loss
        return Rows(psi, a, b, b_bare, torch.zeros_like(b), h, tightening=psi[:0])

    def alpha(self, psi: Tensor, rows: Sequence[Constraint]) -> tuple[Tensor, Tensor, Tensor]:
        """Of rows (R, B): the gain of alpha(psi) = gain psi, what margin takes off psi, and what it took off before.

        The margin of a constraint of relative degree two stands in Psi_1, of which it takes k1 times as much.
        """

        def fixed(values: list[float]) -> Tensor:
            return psi.new_tensor(values)[:, None]

        margin = fixed([each.margin if each.degree == 1 else 0.0 for each in rows])
        inside = fixed([self.gain(each.gains[0]) * each.margin if each.degree == 2 else 0.0 for each in rows])
        gain = fixed([self.gain(each.gains[-1]) for each in rows])
        gain = gain * (1 + (psi / fixed([each.doubling for each in rows])) ** 2)
        return gain.clamp(max=self.gain(float("inf"))), margin, inside

    @staticmethod
    def reported(x: Tensor, constraints: Sequence[Constraint], psi: Tensor) -> Tensor:
        """h by constraint, (constraints, B), where Psi (R, B) already is h from there."""
        values = []
        for each, rows in zip(constraints, psi.split([each.rows for each in constraints]), strict=True):
            if each.exact:
                values.append(rows.amin(0))
            else:
                values.append(rows[0] if each.degree == 1 and each.barrier is None else each.h(x))
        return torch.stack(values)

    def attainable(self, rows: Rows, limit: Tensor) -> Rows:
        """Rows that ask, beyond their limits, for no more than the actuators can give.

        There dpsi/dt + alpha(psi) >= 0 may exceed it many times: 5 m/s outwards just outside the zone ask for 30 N.
        Such a row got slack, which drives all three thrusters to their limits, two of them across the way back, and
        lets go of every row of its class and below. So -b is at most `limit` |a|, which every attitude can give along
        a, and at most what is there on each axis, sum_j |a_j| room_j. It is zero where a is.

        A row without slack may ask for all of the latter: 1 N may be too late to stay clear of the chief.

        What a row no longer asks for is `waived`, and counts as slack where the control does not give it.

        Args:
            limit: (3, B) of the actuators, what is there of it, in N or N m.
        """
        everything = total(rows.a.abs() * self.room(rows, limit), 1)
        along = (limit.amax(0) * total(rows.a * rows.a, 1).sqrt()).minimum(everything)
        hard = rows.a.new_tensor(self.weights).isinf()[:, None]
        least = -self.share * torch.where(hard, everything, along)
        beyond = self.beyond(rows)
        b, b_bare = (torch.where(beyond, side.maximum(least), side) for side in (rows.b, rows.b_bare))
        return replace(rows, b=b, b_bare=b_bare, waived=b_bare - rows.b_bare)

    def room(self, rows: Rows, limit: Tensor) -> Tensor:
        """How much of each actuator can raise each row within the rows that are bounds: (R, 3, B) in N or N m.

        An actuator at its bound gives no more, and a row that counted on it would not be held by those that are free.
        """
        room = list(limit.expand_as(rows.a).unbind(1))  # of every row
        for i, each in enumerate(self.of_row):
            if each.axis is not None:
                own = rows.a[i, each.axis]
                left = torch.minimum((rows.b[i] / own.abs()).clamp(min=0.0), limit[each.axis])
                against = rows.a[:, each.axis] * own < 0.0
                room[each.axis] = torch.where(against, left.minimum(room[each.axis]), room[each.axis])
        return torch.stack(room, 1)

    def beyond(self, rows: Rows) -> Tensor:
        """(R, B) bool: the constraint is violated; of several rows of relative degree one, by that row."""
        counts = [self.count(each) for each in self.constraints]
        parts = zip(self.constraints, rows.psi.split(counts), rows.h, strict=True)
        return torch.cat(
            [(psi if each.degree == 1 < each.rows else h.expand_as(psi)) < 0.0 for each, psi, h in parts]
        )

    def by_constraint(self, rows: Tensor, join: Callable[[Tensor], Tensor]) -> Tensor:
        """Joins the rows (R, B) of each constraint that has several, (k, B) to (B,); returns (constraints, B)."""
        parts = rows.split([self.count(each) for each in self.constraints])
        return torch.cat([part if len(part) == 1 else join(part)[None] for part in parts])

    def keeps(self, x: Tensor, degree: int) -> Tensor:
        """(B,) bool: Psi of every constraint of a relative degree is non-negative at states (16, B)."""
        constraints = [each for each in self.constraints if each.degree == degree]
        if not constraints:
            return torch.ones_like(x[0], dtype=torch.bool)
        return (self.psi_at(x, constraints)(x) >= 0.0).all(0)

    def check(self, constraints: Sequence[Constraint]) -> None:
        """Compares each h's shape and relative degree at some states with what was given."""
        generator = torch.Generator().manual_seed(0)
        x = torch.randn(SIZE, 64, generator=generator, dtype=torch.float64)
        x[P], x[Q] = 100.0 * x[P], unit(x[Q])
        f, g = drift(x, self.c), control_matrix(x, self.c)
        for each in constraints:
            check(each, x)
            _, _, at_once = lie_derivatives(partial(alone, each.h), x, f, g)
            _, _, at_last = lie_derivatives(self.psi_at(x, [each]), x, f, g)
            if not (at_once.isfinite().all() and at_last.isfinite().all()):
                raise ValueError(f"{each.name}: a derivative of h is not finite: must be at every state")
            too_many = each.degree == 2 and (at_once != 0.0).any()
            if too_many or not (at_last[:, self.controls] != 0.0).any():
                raise ValueError(
                    f"{each.name}: gains = {each.gains!r}: "
                    f"{each.held_by} does not first enter derivative {each.degree} of h"
                )


def alone(h: Function, x: Tensor) -> Tensor:
    """h as the only one of several: states (16, ...) to (1, ...)."""
    return h(x)[None]


def half_a_period_ahead(x: Tensor, period: float, c: Limits) -> Tensor:
    """States (16, B) with the attitude that the body has in the middle of the period.

    Thrust is fixed in the body, so over a period it acts along that attitude. With the attitude at the
    beginning instead, thrust across a pass minutes away turned into it: at 3 deg/s and 0.02 m/s^2 by
    0.02 m of clearance a second, as much as passive safety's gain asks for at the margin.
    """
    q = x[Q] + 0.5 * period * torch.stack(attitude_rate(x, c.hill_rotation, c))
    return torch.cat((x[: Q.start], unit(q), x[Q.stop :]))

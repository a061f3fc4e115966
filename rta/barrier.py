"""The barrier conditions a u + b >= 0 of a list of constraints at a batch of states, of one of two kinds.

The paper's are continuous, of the rate now, L_f psi + L_g psi u + alpha(psi) >= 0. Sampled ones are of a control that
is held for T, in the simulator's own steps phi_T (discrete-time barriers, Agrawal and Sreenath 2017),

    (psi(phi_T(x, u)) - psi(x)) / T + alpha(psi(x)) >= 0,

as the tangent at the control that is desired. As T goes to zero they become the paper's. What a tangent leaves out, and
what the filter does not know of the world, is for the check (`rta.backup`). Where no check is known, sampled rows take
off the latter, to first order.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from operator import attrgetter

import torch
from torch import Tensor

from inspection.model.attitude import quaternion_rate, unit
from inspection.model.dynamics import attitude_rate, control_matrix, drift, integrate
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THRUST, TORQUE, P, Q, V
from rta.bounds.prediction import unsaturated
from rta.bounds.uncertainty import NO_UNCERTAINTY, HoldDisturbance, Uncertainty
from rta.constraints.constraint import ACTUATORS, Constraint, check
from rta.constraints.names import PAPERS
from rta.lie_derivatives import Function, directional, lie_derivative, lie_derivatives
from rta.parameters import RtaParameters
from rta.qp.programs import total

LARGEST_ERROR_SHARE = 0.9  # share of a control that rows count as an error at most
STEP = 2.5  # s, of the steps in which a hold is computed at most


@dataclass
class Rows:
    """Conditions of one actuator group on u in N or N m.

    Attributes:
        psi: (R, B) Psi_1 where the relative degree is two, else the barrier.
        a: (R, 3, B); b: (R, B) with margins; b_no_margin: (R, B) without.
        relaxation: (R, B) by how much b_no_margin asks for less than the condition does, see `attainable`.
        h: (constraints, B) values without margin, exact; where the smallest row is h, at the moments of the rows.
    """

    psi: Tensor
    a: Tensor
    b: Tensor
    b_no_margin: Tensor
    relaxation: Tensor
    h: Tensor


class ActuatorGroup:
    """The constraints of one actuator group, and the rows of its program.

    Args:
        actuator: a key of ACTUATORS; others of the constraints are left out.
        constraints: the paper's and your own.
        checked: its controls are checked, see `rta.backup`.

    Attributes:
        actuator; controls: its place in a control; limit: of each of its actuators in N or N m.
        names: of its constraints; of_row: the constraint of each row; weights: the slack weight of each row.
        kind: of its rows, see `Uncertainty.rows`; hold: s, that sampled ones are of.

    Raises:
        ValueError: a constraint of your own is not as it must be, see `check`, one of its derivatives is not finite, or
            its relative degree is other than its number of gains.
    """

    def __init__(
        self,
        actuator: str,
        constraints: Sequence[Constraint],
        c: Limits,
        r: RtaParameters,
        uncertainty: Uncertainty = NO_UNCERTAINTY,
        checked: bool = True,
    ) -> None:
        self.c, self.r, self.uncertainty = c, r, uncertainty
        self.disturbance = None if checked or uncertainty.is_zero else uncertainty.hold_disturbance(c, r)
        self.actuator, self.kind, self.hold = actuator, uncertainty.rows(r), uncertainty.hold(r)
        self.model = unsaturated(c)  # the rates' own rows hold these: saturated they would have no slope
        self.controls = ACTUATORS[actuator]
        self.limit = c.control_limit[self.controls.start]
        own = [each for each in constraints if each.actuator == actuator]
        self.constraints = sorted(own, key=attrgetter("coupled"))  # in the order of their rows
        self.names = tuple(each.name for each in self.constraints)
        self.of_row = [each for each in self.constraints for _ in range(each.rows)]
        self.weights = [
            r.slack_weight_critical if each.weight is None else each.weight for each in self.of_row
        ]
        self.check([each for each in self.constraints if each.coupled])

    def gain(self, value: float) -> float:
        """A gain in 1/s as used."""
        return self.r.gain(value, self.uncertainty.longest_hold)

    def values(self, x: Tensor) -> Tensor:
        """Every h, states (16, ...) to (constraints, ...)."""
        return torch.stack([each.h(x) for each in self.constraints])

    def psi_at(
        self,
        x: Tensor,
        constraints: Sequence[Constraint],
        start: Tensor | None = None,
        after: float = 0.0,
    ) -> Function:
        """What is differentiated at states x (16, B), each Psi_1 or barrier: (16, ...) to (R, ...).

        Where x are states so many s after others, `start`, what these were beyond counts.

        Psi_1 = L_f h + alpha(h) with alpha(h) = k1 (h - margin), the HOCBF, within the limit. Beyond it alpha(h) =
        max(k2 h, -recovery) - k1 margin: k1 h would ask for faster cooling than there is in the dark (0.0015 of 1 deg C
        a second, of 0.00036), so that the row could not be satisfied for half an hour, or for a small part of what
        there is (battery). With k2 for k1 the way back is critically damped; -k1 margin, as within the limit, ends it
        in finite time.
        """
        barriers = [each.barrier_at(x, after) for each in constraints]
        start = x if start is None else start
        beyond = {i: each.h(start) < 0.0 for i, each in enumerate(constraints) if each.recovery is not None}
        second = [i for i, each in enumerate(constraints) if each.degree == 2]

        def psi(y: Tensor) -> Tensor:
            rows = {i: barrier(y) for i, barrier in enumerate(barriers) if i not in second}
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

    def __call__(self, x: Tensor, control: Tensor | None = None, limit: Tensor | None = None) -> Rows:
        """The conditions at states (16, B).

        Args:
            control: (6, B) at which the tangents of sampled ones are taken, in N and N m; None: at zero.
            limit: (3, B) what is there of each actuator, in N or N m; None: all of it.
        """
        limit = torch.full_like(x[:3], self.limit) if limit is None else limit
        if self.kind == "sampled":
            control = torch.zeros_like(x[:CONTROL_SIZE]) if control is None else control
            rows_of = partial(self.sampled_rows, x, self.near(x, control))
        else:
            rows_of = partial(self.continuous_rows, x)
        # the constraints that only this group changes, then those that the other one changes, too
        parts = [
            rows_of(list(own), coupled) for coupled, own in groupby(self.constraints, attrgetter("coupled"))
        ]
        return self.attainable(
            Rows(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0]))), limit
        )

    def continuous_rows(self, x: Tensor, constraints: Sequence[Constraint], coupled: bool) -> Rows:
        """BC: L_f psi + L_g psi u + alpha(psi) >= 0, less what psi can lose and the worst that others can do."""
        c, r = self.c, self.r
        g = control_matrix(half_a_period_ahead(x, r.period, c), c)
        along = g if coupled else g[:, self.controls]
        psi, lf, a = lie_derivatives(self.psi_at(x, constraints), x, drift(x, c), along)
        loss = torch.stack([each.intersample_drop_at(x) for each in constraints for _ in range(each.rows)])
        return self.conditions(x, constraints, psi, lf, a, loss)

    def sampled_rows(
        self, x: Tensor, control: Tensor, constraints: Sequence[Constraint], coupled: bool
    ) -> Rows:
        """The tangent, at controls (6, B) that are held for T, of (psi(phi_T(x, u)) - psi(x)) / T + alpha(psi(x)) >= 0.

        The rate at no control and its slopes by the controls take the places of L_f psi and L_g psi.
        """
        steps = math.ceil(self.hold / STEP)
        fly = partial(integrate, duration=self.hold / steps, c=self.model, times=steps)
        own = slice(0, CONTROL_SIZE) if coupled else self.controls
        psi, there = self.psi_at(x, constraints)(x), self.psi_at(fly(x, control), constraints, x, self.hold)
        one = torch.eye(CONTROL_SIZE, dtype=x.dtype, device=x.device)[:, own, None].expand(-1, -1, x.shape[1])

        def end(u: Tensor) -> Tensor:
            return there(fly(x[:, None].expand(-1, u.shape[1], -1), u))

        at = control[:, None].repeat(1, one.shape[1], 1)
        after, slope = directional(end, (at,), (one,))
        a = slope / self.hold
        rate = (after[:, 0] - psi) / self.hold - total(a * control[own], 1)
        loss = torch.zeros_like(rate)
        if self.disturbance and any(self.disturbance):
            loss = self.disturbance_loss(
                self.disturbance,
                x,
                control,
                constraints,
                a,
                lambda y: there(fly(y, control[:, None].expand(-1, y.shape[1], -1))),
            )
        return self.conditions(x, constraints, psi, rate, a, loss)

    def disturbance_loss(
        self,
        d: HoldDisturbance,
        x: Tensor,
        control: Tensor,
        constraints: Sequence[Constraint],
        a: Tensor,
        end: Function,
    ) -> Tensor:
        """What sampled rows lose in the worst case within the bounds of states (16, B) and actuators: (R, B).

        The worst state of a row is where its slopes lead: as far as may be in place, velocity, attitude and rates each.

        Args:
            control: (6, B) held; a: (R, 3 or 6, B) slopes by the controls; end: Psi at the end of a hold, of states.
        """
        radii = d.position, d.velocity, d.attitude, d.rate
        shares, unknown = (d.thrust_share, d.torque_share), (d.force, d.torque)
        now, rows = self.psi_at(x, constraints), [each for each in constraints for _ in range(each.rows)]

        def condition(y: Tensor) -> Tensor:
            """Of states (16, k, B), as many as are looked at: (R, k, B)."""
            psi = now(y)
            gain = torch.stack([self.alpha(part, rows)[0] for part in psi.unbind(1)], 1)
            return (end(y) - psi) / self.hold + gain * psi

        worst = x[:, None].repeat(1, len(rows), 1)
        for radius, along in zip(radii, deviations(x), strict=True):
            if radius > 0.0:
                slope = directional(condition, (x[:, None].repeat(1, 3, 1),), (along,))[1]
                towards = slope / total(slope**2, 1).sqrt().clamp(min=1e-30)[:, None]
                worst = worst - radius * total(along[:, None] * towards, 2)
        here = condition(x[:, None])
        lost = here - condition(worst)
        loss = torch.stack([lost[i, i] for i in range(len(rows))]).clamp(min=0.0)
        coupled = a.shape[1] == CONTROL_SIZE
        groups, own = (
            ((THRUST, TORQUE), slice(0, CONTROL_SIZE)) if coupled else ((self.controls,), self.controls)
        )
        # what the row asks of controls, without their errors
        asked = (loss + total(a * control[own], 1) - here[:, 0]).clamp(min=0.0)
        is_known = torch.tensor([each.axis is not None for each in rows], device=x.device)[:, None]
        loss = loss.masked_fill(is_known, 0.0)  # the limits of the rates have taken theirs off already
        for group, part in zip(groups, a.split(3, 1), strict=True):
            i = (THRUST, TORQUE).index(group)
            length = total(part**2, 1).sqrt()
            used = length * total(control[group] ** 2, 0).sqrt()
            if group == self.controls:  # what answers the row is as large as it asks for
                used = used.maximum(asked / (1.0 - min(shares[i], LARGEST_ERROR_SHARE)))
            loss = loss + shares[i] * used + (length * unknown[i]).masked_fill(is_known, 0.0)
        return loss

    def conditions(
        self, x: Tensor, constraints: Sequence[Constraint], psi: Tensor, rate: Tensor, a: Tensor, loss: Tensor
    ) -> Rows:
        """rate + a u + alpha(psi) - loss >= 0 at states (16, B), of psi, rate, loss (R, B).

        Args:
            a: (R, 3, B), or (R, 6, B) where the other group's controls count, too, of which the worst is taken.
        """
        if a.shape[1] == CONTROL_SIZE:
            most = a.abs() * x.new_tensor(self.c.control_limit)[:, None]
            a = a[:, self.controls]
            loss = loss + (most.sum(1) - most[:, self.controls].sum(1))
        gain, margin, psi1_margin = self.alpha(psi, [each for each in constraints for _ in range(each.rows)])
        h = self.reported(x, constraints, psi)
        b, b_no_margin = rate + gain * (psi - margin) - loss, rate + gain * (psi + psi1_margin) - loss
        return Rows(psi, a, b, b_no_margin, torch.zeros_like(b), h)

    def near(self, x: Tensor, control: Tensor) -> Tensor:
        """Controls (6, B) with torque that keeps the rates within their limits over a hold, near which tangents help.

        Full torque for 10 s would turn a body by 50 deg, of which no tangent says anything about less.
        """
        if self.actuator == "thrust":
            return control
        limit = self.c.max_rate - self.uncertainty.rate_offset(self.c)
        per_rate = x.new_tensor(self.c.inertia)[:, None] / self.hold
        low, high = per_rate * (-limit - x[OMEGA]), per_rate * (limit - x[OMEGA])
        torque = control[TORQUE].minimum(high.clamp(min=0.0)).maximum(low.clamp(max=0.0))
        return torch.cat((control[THRUST], torque))

    def alpha(self, psi: Tensor, rows: Sequence[Constraint]) -> tuple[Tensor, Tensor, Tensor]:
        """Per row: class-K gain (capped at 0.5/T), margin subtracted at degree one, k1 * margin contained in Psi_1 at
        degree two.
        """

        def fixed(values: list[float]) -> Tensor:
            return psi.new_tensor(values)[:, None]

        margin = fixed([each.margin if each.degree == 1 else 0.0 for each in rows])
        psi1_margin = fixed(
            [self.gain(each.gains[0]) * each.margin if each.degree == 2 else 0.0 for each in rows]
        )
        gain = fixed([self.gain(each.gains[-1]) for each in rows])
        gain = gain * (1 + (psi / fixed([each.doubling for each in rows])) ** 2)
        return gain.clamp(max=self.gain(float("inf"))), margin, psi1_margin

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

        What a row no longer asks for is its `relaxation`, and counts as slack where the control does not give it.

        Args:
            limit: (3, B) of the actuators, what is there of it, in N or N m.
        """
        everything = total(rows.a.abs() * self.room(rows, limit), 1)
        along = (limit.amax(0) * total(rows.a * rows.a, 1).sqrt()).minimum(everything)
        hard = rows.a.new_tensor(self.weights).isinf()[:, None]
        least = -torch.where(hard, everything, along)
        beyond = self.beyond(rows)
        b, b_no_margin = (
            torch.where(beyond, side.maximum(least), side) for side in (rows.b, rows.b_no_margin)
        )
        return replace(rows, b=b, b_no_margin=b_no_margin, relaxation=b_no_margin - rows.b_no_margin)

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
        counts = [each.rows for each in self.constraints]
        parts = zip(self.constraints, rows.psi.split(counts), rows.h, strict=True)
        return torch.cat(
            [(psi if each.degree == 1 < each.rows else h.expand_as(psi)) < 0.0 for each, psi, h in parts]
        )

    def by_constraint(self, rows: Tensor, join: Callable[[Tensor], Tensor]) -> Tensor:
        """Joins the rows (R, B) of each constraint that has several, (k, B) to (B,); returns (constraints, B)."""
        parts = rows.split([each.rows for each in self.constraints])
        return torch.cat([part if len(part) == 1 else join(part)[None] for part in parts])

    def keeps(self, x: Tensor, degree: int, only_own: bool = False) -> Tensor:
        """(B,) bool: Psi of every constraint of a relative degree is non-negative at states (16, B).

        `only_own` leaves out the paper's limits.
        """
        constraints = [
            each
            for each in self.constraints
            if each.degree == degree and not (only_own and each.name in PAPERS)
        ]
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

            def row(y: Tensor, each: Constraint = each) -> Tensor:
                return each.h(y)[None]

            _, _, at_once = lie_derivatives(row, x, f, g)
            _, _, at_last = lie_derivatives(self.psi_at(x, [each]), x, f, g)
            if not (at_once.isfinite().all() and at_last.isfinite().all()):
                raise ValueError(f"{each.name}: a derivative of h is not finite: must be at every state")
            too_many = each.degree == 2 and (at_once != 0.0).any()
            if too_many or not (at_last[:, self.controls] != 0.0).any():
                raise ValueError(
                    f"{each.name}: gains = {each.gains!r}: "
                    f"{each.actuator} does not first enter derivative {each.degree} of h"
                )


def deviations(x: Tensor) -> tuple[Tensor, ...]:
    """How states (16, B) differ by 1 m, 1 m/s, 1 rad and 1 rad/s along each axis: (16, 3, B) each."""
    found = []
    for part in (P, V, OMEGA):
        along = torch.zeros_like(x)[:, None].repeat(1, 3, 1)
        along[part] = torch.eye(3, dtype=x.dtype, device=x.device)[..., None]
        found.append(along)
    turned = torch.zeros_like(x)[:, None].repeat(1, 3, 1)
    turned[Q] = torch.stack(quaternion_rate(x[Q, None].unbind(), found[2][OMEGA].unbind()))
    return found[0], found[1], turned, found[2]


def half_a_period_ahead(x: Tensor, period: float, c: Limits) -> Tensor:
    """States (16, B) with the attitude that the body has in the middle of the period.

    Thrust is fixed in the body, so over a period it acts along that attitude. With the attitude at the
    beginning instead, thrust across a pass minutes away turned into it: at 3 deg/s and 0.02 m/s^2 by
    0.02 m of clearance a second, as much as passive safety's gain asks for at the margin.
    """
    q = x[Q] + 0.5 * period * torch.stack(attitude_rate(x, c.hill_rotation, c))
    return torch.cat((x[: Q.start], unit(q), x[Q.stop :]))

"""Rows of what a control does that is held: psi(phi_t(x, u)) instead of the rate of psi at x.

phi_t(x, u) is the model's own map of a state under a control held for t, the simulator's. A control is safe if at the
end of its hold (and in its middle, where that is long) every psi is as sampled barriers want it (Agrawal and Sreenath
2017, discrete time; Breeden, Garg and Panagou 2022, sampled data),

    (psi(phi_t(x, u)) - psi(x)) / t + alpha(psi(x)) >= 0.

It is taken as its tangent at a control, and once more at the solution (`SafetyFilter`). Of what the filter does not
know (`rta.bounds.uncertainty`) the worst comes off, each in the unit of psi per s:

    measurement     in a barrier that says its least within errors (`Constraint.is_least`) that is psi, at both ends;
                    to first order in others: sum_i |d psi / d x_i| delta_i off psi within alpha, and its own change
                    over the hold, sum_i |d (psi(phi_t) - psi) / d x_i| delta_i / t
    input           sum_j |u_j| (eps_j |a_j| + most (angle |a without a_j| + angle^2 / 2 |a_j|)), with
                    a = d psi(phi_t) / d u / t; eps_j is what is given less where it helps, or more where it harms; and
                    what the impulse of it does to a least barrier beyond that, to which |u| comes as its tangent
    acceleration    |a| m d: it acts as a force m d in any direction; of angular acceleration likewise

A control may also be held for less than the longest time. On its way psi is held by the parabola between two moments.
The error of thrust there is |u_j| times eps_j, or an angle, of |A(s)|, A(s) the integral of a direction that turns with
the body at omega. For a slope of psi that stays as it is, |A(s)| exceeds its chord over a gap by at most
omega gap^2 / 8 of |a|, which comes off the end of the gap. That is no proof for the way: a parabola can need four times
as much there, the slope turns on the way, and torque's error has no such term. All three are the error's share of what
is of second order in the hold, and are held in flights.

(robust barriers: Jankovic 2018 for inputs, Dean et al. 2021 for measurements).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import norm, quaternion_rate, rotation_matrix, unit
from inspection.model.dynamics import step
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THRUST, TORQUE, P, Q, V
from rta.bounds.errors import Errors, after
from rta.bounds.uncertainty import Uncertainty
from rta.conditions.maps import Maps
from rta.conditions.prediction import unsaturated
from rta.conditions.rows import ActuatorGroup, Rows
from rta.constraints.constraint import Constraint
from rta.lie_derivatives import Function, directional
from rta.parameters import RtaParameters
from rta.qp.programs import total

LONG = 3.0  # s, above which the middle of a hold has rows, too
LEFT = 0.99  # `share`: a little less than there is, so that tangents that ask for more have it
KINDS = 4  # of what is measured: position, velocity, attitude, rates


class HeldGroup(ActuatorGroup):
    """An `ActuatorGroup` whose rows are tangents, at a control, of what that control does while it is held."""

    def __init__(
        self,
        held_by: str,
        constraints: Sequence[Constraint],
        c: Limits,
        r: RtaParameters,
        known: Uncertainty,
    ) -> None:
        hold = known.hold(r)
        self.moments = (0.5 * hold, hold) if hold > LONG else (hold,)  # s, at which rows are
        super().__init__(held_by, constraints, c, r, known)
        self.share = LEFT
        self.is_coarse = held_by == "thrust" and known.is_coarse
        self.model = unsaturated(c)  # the filter holds the rates
        least, self.most = known.thrust if held_by == "thrust" else known.torque
        # shares by which what is given helps less, or harms more
        self.less, self.more = 1.0 - least, self.most - 1.0
        if held_by == "thrust":
            self.push = c.mass * known.acceleration
        else:
            self.push = max(c.inertia) * known.angular_acceleration(c)
        self.angle_at_rest = known.thrust_angle(c, r)
        # by moment, the share of a thruster's error between it and the one before that is not in their chord
        self.bulge = [
            math.sqrt(3.0) * c.max_rate * (end - start) ** 2 / (8.0 * end)
            for start, end in pairwise((0.0, *self.moments))
        ]
        self.measured = known.measured
        self.tightenings = any(self.measured) or known.latency > 0

    def near(self, x: Tensor, control: Tensor) -> Tensor:
        """Controls (6, B) with torque that keeps the rates within their limits over the hold, near which tangents help.

        Full torque for 10 s would turn a body by 50 deg, of which no tangent says anything about less.
        """
        if self.held_by == "thrust":
            return control
        limit = self.c.max_rate - self.known.rate_offset(self.c)
        per_rate = x.new_tensor(self.c.inertia)[:, None] / self.moments[-1]
        low, high = per_rate * (-limit - x[OMEGA]), per_rate * (limit - x[OMEGA])
        torque = control[TORQUE].minimum(high.clamp(min=0.0)).maximum(low.clamp(max=0.0))
        return torch.cat((control[THRUST], torque))

    def count(self, each: Constraint) -> int:
        """How many rows a constraint has."""
        return each.rows * len(self.moments)

    def tangents(self, x: Tensor, control: Tensor, error_bound: Tensor, limit: Tensor) -> Rows:
        """The tangents at states (16, B) and controls (6, B); see `conditions_at` and `attainable`."""
        return self.joined(partial(self.conditions_at, x, control, error_bound), limit)

    def conditions_at(
        self,
        x: Tensor,
        control: Tensor,
        error_bound: Tensor,
        constraints: Sequence[Constraint],
        coupled: bool,
    ) -> Rows:
        """The tangents of the condition at states (16, B) and controls (6, B), see the module.

        Args:
            error_bound: (4, B) by how far the state is off beyond its measurement, in any direction: of position,
                velocity, attitude and rates in m, m/s, rad, rad/s.
        """
        own = slice(0, CONTROL_SIZE) if coupled else self.controls
        flown, u_there = self.after(x, control, error_bound, constraints, own, coupled)
        psi, nominal, curvature, by_x, by_u, by_impulse = flown
        before, later = psi[0], psi[1:]  # (moments, R, B)
        t = x.new_tensor(self.moments)[:, None, None]
        rate, slope = (later - before) / t, by_u[1:] / t[..., None]
        u = control[own]
        loss = torch.zeros_like(rate)
        if coupled:  # what others do may become their worst
            limit = x.new_tensor(self.c.control_limit)[:, None]
            others = torch.ones_like(limit).index_fill(
                0, torch.arange(6, device=x.device)[self.controls], 0.0
            )
            worst = others * (slope.abs() * limit + slope * u_there)
            loss = loss + total(worst, 2)
            u, slope, u_there = (part[..., self.controls, :] for part in (u, slope, u_there))
        length = total(slope * slope, 2).sqrt()
        tightening = length * self.push
        blur = torch.zeros_like(before)
        if by_x.shape[-2]:
            blur = self.off(by_x[0], error_bound, coupled)
            tightening = tightening + self.off((by_x[1:] - by_x[0]) / t[..., None], error_bound, coupled)
        # the input's error, as a tangent: |u_j| rises with the sign of u_j, from zero with that which helps
        sign = torch.where(u == 0.0, slope.sign(), u.sign())
        weight = torch.where(slope * sign > 0.0, self.less * slope.abs(), self.more * slope.abs())
        if self.held_by == "thrust":
            across = (length[:, :, None] ** 2 - slope**2).clamp(min=0.0).sqrt()
            angle = self.angle(error_bound)
            weight = weight + self.most * angle * (across + angle / 2 * slope.abs())  # sin and 1 - cos
            bulge = t.new_tensor(self.bulge)[:, None, None]
            between = bulge * length * (max(self.less, self.more) + self.most * angle)
            weight = weight + between[:, :, None]
            # of an impulse, share |u| t / m, that least barriers have beyond the slopes
            per_thrust = self.known.thrust_share(angle) / self.c.mass
            slope = slope + by_impulse[1:, :, None] * per_thrust * unit(u)
        tangent = slope - weight * sign
        tightening_now = tightening + total(weight * u.abs(), 2)

        rows = [each for each in constraints for _ in range(each.rows)]
        gain, margin, inside = self.alpha(before, rows)
        hidden = nominal - psi  # what errors take off a least barrier
        in_least = (hidden[1:] - hidden[0]) / t + gain * hidden[0]
        # between two moments psi is at least the parabola through both that hangs by its curvature; it is not negative
        # if the sum of both is at least 4 times that
        off = torch.cat((blur[None], blur + (tightening_now * t)[:-1]))  # where a gap begins
        least = (1.0 - gain * t) * (before - blur)
        loss = loss + (4.0 * curvature - (psi[:-1] - off) - least).clamp(min=0.0) / t
        at_zero = rate - total(slope * u_there, 2) - loss - tightening - gain * blur
        b = at_zero + gain * (before - margin)
        b_bare = at_zero + gain * (before + inside)
        h = self.reported(x, constraints, before)

        def by_row(part: Tensor) -> Tensor:
            """(moments, R, ..., B) to (R moments, ..., B)."""
            return part.transpose(0, 1).flatten(0, 1)

        return Rows(
            by_row((before - blur).expand_as(rate)),
            by_row(tangent),
            by_row(b),
            by_row(b_bare),
            torch.zeros_like(by_row(b_bare)),
            h,
            by_row(tightening_now + gain * blur + in_least),
        )

    def tightened(self, tightening: Tensor) -> Tensor:
        """By constraint, the psi (or h, where the relative degree is two) at which alpha(psi) is the tightening (k, B).

        With doubling d, y + y^3 = tightening / (gain d) for y = psi / d has the root 2 / sqrt(3) sinh(asinh(..) / 3).
        """
        values = []
        for each, own in zip(self.constraints, tightening, strict=True):
            gain, d = self.gain(each.gains[-1]), each.doubling
            psi = own / gain
            if d < math.inf:
                psi = d * 2 / math.sqrt(3.0) * ((1.5 * math.sqrt(3.0) * psi / d).asinh() / 3).sinh()
            psi = psi.maximum(own / self.gain(math.inf))
            values.append(psi / self.gain(each.gains[0]) if each.degree == 2 else psi)
        return torch.stack(values)

    def after(
        self,
        x: Tensor,
        control: Tensor,
        error_bound: Tensor,
        constraints: Sequence[Constraint],
        own: slice,
        coupled: bool,
    ) -> tuple["Flown", Tensor]:
        """`flown` at the control, for a barrier that looks ahead without the group's own, and those controls.

        How near a free flight comes to the chief is convex in thrust: its tangent anywhere is below it, and the one at
        no thrust leaves coasting, which holds it. At 1 N for 10 s it may be on the far side of the chief.

        Returns:
            As `flown`; the own controls (R, m, B) of each row's tangent.
        """
        still = control.index_fill(0, torch.arange(6, device=x.device)[self.controls], 0.0)
        kinds = [each.later is not None for each in constraints]
        parts: dict[bool, list[list[Tensor]]] = {}
        for ahead, u in ((False, control), (True, still)):
            own_kind = [each for each, kind in zip(constraints, kinds, strict=True) if kind == ahead]
            if own_kind:
                counts = [each.rows for each in own_kind]
                flown = [part.split(counts, 1) for part in self.flown(x, u, error_bound, own_kind, coupled)]
                there = [u[own].expand(count, -1, -1)[None] for count in counts]
                parts[ahead] = [list(part) for part in zip(*flown, there, strict=True)]
        in_order = [parts[kind].pop(0) for kind in kinds]
        joined = [torch.cat(part, 1) for part in zip(*in_order, strict=True)]
        return Flown(*joined[:-1]), joined[-1]

    def flown(
        self,
        x: Tensor,
        control: Tensor,
        error_bound: Tensor,
        constraints: Sequence[Constraint],
        coupled: bool,
    ) -> "Flown":
        """psi at the beginning and at each moment, and its derivatives by what is measured and by the own controls.

        psi is exact, at the end of the map. Its derivatives are those there, times the map's to first order in n t,
        0.01 at 10 s: a velocity moves a position by t, a force acts along the mean of the body's attitudes R(s), a rate
        turns by them, too.
        """
        is_least = self.is_least(constraints[0])
        # what errors of thrust do to what is convex in it, as how near a free flight comes, slopes bound
        thrust = control[THRUST] if constraints[0].later is None else torch.zeros_like(control[THRUST])
        errors = partial(self.errors_after, error_bound)

        def psi_after(y: Tensor, seconds: float) -> tuple[Function, Tensor, Function]:
            """What is enforced at states (16, B) so many s into the hold, where it is, and the same if nothing is off.

            The least of a barrier is taken at states and impulses, (17, B).
            """
            if not is_least:
                psi = self.psi_at(y, constraints, x, seconds)
                return psi, y, psi
            impulse = self.impulse(thrust, error_bound, seconds)
            psi = self.psi_at(y, constraints, x, seconds, errors(seconds, impulse))
            least = partial(within, psi, partial(errors, seconds))
            return least, torch.cat((y, impulse[None])), psi

        least, there, psi = psi_after(x, 0.0)
        y, by_slopes = x, self.tightenings and not is_least
        if by_slopes:
            before, by_x = self.differentiated(least, there, coupled)
        else:
            before = least(there)
            by_x = before.new_zeros(len(before), 0, before.shape[1])
        values, curvatures, slopes_x, slopes_u = [before], [], [by_x], []
        nominal, slopes_impulse = [psi(x) if is_least else before], [torch.zeros_like(before)]
        turned = once = x.new_zeros(3, 3, x.shape[1])  # the integrals of R and of s R over the hold so far
        earlier = 0.0
        for moment in self.moments:
            gap = moment - earlier
            middle = step(y, control, gap / 2, self.model)
            end = step(middle, control, gap / 2, self.model)
            least, there, psi = psi_after(end, moment)
            value, by_end = self.differentiated(least, there, coupled)
            nominal.append(psi(end) if is_least else value)
            slopes_impulse.append(by_end[:, -1] if is_least else torch.zeros_like(value))
            by_end = by_end[:, :-1] if is_least else by_end
            if constraints[0].later is None:
                between, there, _ = psi_after(middle, moment - gap / 2)
                hanging = between(there)
                curvatures.append(((values[-1] + value) / 2 - hanging).clamp(min=0.0))
            else:
                curvatures.append(torch.zeros_like(value))
            first, second, third = (rotation_matrix(part[Q]) for part in (y, middle, end))  # Simpson's rule
            turned = turned + gap / 6 * (first + 4.0 * second + third)
            half = earlier + gap / 2
            once = once + gap / 6 * (earlier * first + 4.0 * half * second + moment * third)
            to_end = third.transpose(0, 1)
            maps = Maps(x, moment, turned, once, to_end, self.c)
            slopes_x.append(maps.by_state(by_end, self.held_by, coupled) if by_slopes else by_x)
            slopes_u.append(maps.by_control(by_end, self.held_by, coupled))
            values.append(value)
            y, earlier = end, moment
        return Flown(
            torch.stack(values),
            torch.stack(nominal),
            torch.stack(curvatures),
            torch.stack(slopes_x),
            torch.stack([torch.zeros_like(slopes_u[0]), *slopes_u]),
            torch.stack(slopes_impulse),
        )

    def impulse(self, thrust: Tensor, error_bound: Tensor, seconds: float) -> Tensor:
        """(B,) m/s, by how much a velocity may change otherwise where thrust (3, B) in N acts for so many s."""
        share = self.known.thrust_share(self.angle(error_bound))
        return (share * norm(thrust) / self.c.mass + self.known.acceleration) * seconds

    def angle(self, error_bound: Tensor) -> Tensor:
        """(B,) rad, between a thruster's mean direction over the hold and that of the rows at most."""
        return self.angle_at_rest + error_bound[2] + error_bound[3] * self.moments[-1] / 2

    def errors_after(self, error_bound: Tensor, seconds: float, impulse: Tensor) -> Errors:
        """Those of states after so many s of a hold, and an impulse in m/s."""
        return after(self.known.errors(error_bound[0], error_bound[1]), seconds, self.c, impulse)

    def differentiated(self, psi: Function, y: Tensor, coupled: bool) -> tuple[Tensor, Tensor]:
        """psi (R, B) at states (16, B), with an impulse (17, B), and its derivatives (R, D, B) along `directions`."""
        along = self.directions(y, coupled)
        value, slopes = directional(psi, (y[:, None].repeat(1, along.shape[1], 1),), (along,))
        return value[:, 0], slopes

    def directions(self, x: Tensor, coupled: bool) -> Tensor:
        """(16, D, B) unit changes of what is measured: of p and v for thrust, of attitude and rates for torque.

        With an impulse, (17, D, B), that comes last.
        """
        one = torch.eye(len(x), dtype=x.dtype, device=x.device)[..., None].expand(-1, -1, x.shape[1])
        turns = one.new_zeros(len(x), 3, x.shape[1])
        turns[Q] = torch.stack([torch.stack(quaternion_rate(x[Q], one[:3, i])) for i in range(3)], 1)
        parts = {"thrust": [one[:, P], one[:, V]], "torque": [turns, one[:, OMEGA]]}
        wanted = [*parts["thrust"], *parts["torque"]] if coupled else parts[self.held_by]
        return torch.cat([*wanted, one[:, SIZE:]], 1)

    def off(self, slopes: Tensor, error_bound: Tensor, coupled: bool) -> Tensor:
        """By how much psi may be off, from its slopes (..., D, B) along `directions`."""
        kinds = range(4) if coupled else {"thrust": (0, 1), "torque": (2, 3)}[self.held_by]
        off = torch.zeros_like(slopes[..., 0, :])
        for part, kind in zip(slopes.split(3, -2), kinds, strict=True):
            one, two, three = part.unbind(-2)
            off = off + self.measured[kind] * (one.abs() + two.abs() + three.abs())
            off = off + error_bound[kind] * (one * one + two * two + three * three).sqrt()
        return off

    def beyond(self, rows: Rows) -> Tensor:
        """(R, B) bool: the constraint is violated or its barrier may be."""
        counts = [self.count(each) for each in self.constraints]
        parts = zip(self.constraints, rows.psi.split(counts), rows.h, strict=True)
        return torch.cat([(psi < 0.0) | ((h < 0.0) & (each.degree == 2)) for each, psi, h in parts])


def within(psi: Callable[..., Tensor], errors: Callable[[Tensor], Errors], z: Tensor) -> Tensor:
    """A least barrier of states and impulses, (17, ...) to (R, ...)."""
    return psi(z[:SIZE], errors(z[SIZE]))


class Flown(NamedTuple):
    """What a hold does to psi of R rows, at its beginning and at each of its moments.

    Attributes:
        psi: (1 + moments, R, B), of a least barrier (`Constraint.is_least`) the least that it may be.
        nominal: (1 + moments, R, B) the same of a state that is not off.
        curvature: (moments, R, B) how far psi hangs in the middle between two of them.
        by_x: (1 + moments, R, D, B) derivatives by the D of `directions`; D = 0 of least barriers.
        by_u: (1 + moments, R, m, B) by the own controls; by_impulse: (1 + moments, R, B) by that in m/s.
    """

    psi: Tensor
    nominal: Tensor
    curvature: Tensor
    by_x: Tensor
    by_u: Tensor
    by_impulse: Tensor

"""Programs of one actuator group's rows, and their repetition where rows are tangents at a control."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, reduce
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from rta.conditions.held_rows import HeldGroup
from rta.conditions.rows import ActuatorGroup, Rows
from rta.qp.programs import FEASIBLE, HOPELESS, REDUNDANT, Problems, Solver, Status, pick, put, total

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6

TOLERATED = 1e-6  # in units of the actuators' limits, by which rows themselves may be short
INSET = 1e-3  # in the same unit, by which tangents ask for more, so that few of them are enough
# Programs solved for one control at most; with 4, one in 200,000 random calls at 10 s was not settled.
PASSES = 8
PASSES_AT_REST = 3  # of the second search
IN_VAIN = 2  # passes in a row that bring nothing where rows yield, after which no more are tried
FARTHEST = 100.0  # above all distances squared, in the same unit, or that of a demand beyond the limits
ABOVE = 1e6  # by how much what a row lacks counts more than in the next class


class Prepared(NamedTuple):
    """What is computed for every spacecraft, corrected or not, for one actuator group.

    Attributes:
        psi, a, b, b_bare, waived, h, tightening: the fields of `Rows`.
        length: (R, B) of the rows per actuator limit.
        lowest: (1, B) left-hand side of the scaled rows under the desired control; negative or NaN where it must
            be corrected.
    """

    psi: Tensor
    a: Tensor
    b: Tensor
    b_bare: Tensor
    waived: Tensor
    h: Tensor
    tightening: Tensor
    length: Tensor
    lowest: Tensor


def scaled(rows: Rows, control: Tensor, limit: Tensor | float) -> Prepared:
    """Rows in units of the actuators' limits, and what a control (3, B) in these units leaves of them."""
    a = rows.a * limit
    length = total(a * a, 1).sqrt().clamp(min=SHORTEST_ROW)  # thirty times as fast as Tensor.norm
    left = (total(a * control, 1) + rows.b) / length
    return Prepared(
        rows.psi,
        rows.a,
        rows.b,
        rows.b_bare,
        rows.waived,
        rows.h,
        rows.tightening,
        length,
        lowest=smallest(left)[None],
    )


def prepared_now(group: ActuatorGroup, x: Tensor, control: Tensor) -> Prepared:
    """A group's rows of the rate of now at states (16, B), and what controls (6, B) leave of them."""
    return scaled(group(x), control[group.controls] / group.limit, group.limit)


def smallest(rows: Tensor) -> Tensor:
    """(R, B) to (B,), in operations that fuse with those around."""
    return reduce(torch.minimum, rows.unbind())


def problems(group: ActuatorGroup, prepared: Prepared, desired: Tensor, limit: Tensor | float) -> Problems:
    """The programs of rows as prepared, and of controls (3, M) in units of the actuators' limits."""
    b, b_bare = (
        (side / prepared.length).clamp(HOPELESS, REDUNDANT) for side in (prepared.b, prepared.b_bare)
    )
    a = prepared.a * (limit / prepared.length[:, None])
    return Problems(desired, a, b, b_bare, desired.new_tensor(group.weights))


def answered(
    group: ActuatorGroup, asked: Problems, length: Tensor, control: Tensor, status: Tensor
) -> tuple[Tensor, Tensor]:
    """By constraint, (constraints, M): whether a row binds the controls (3, M), and how far one falls short."""
    reached = total(asked.a * control, 1)
    with_margins = (reached + asked.b).amin(0) >= -FEASIBLE
    binding = reached + torch.where(with_margins, asked.b, asked.b_bare) <= FEASIBLE
    short = -(reached + asked.b_bare).clamp(max=0.0) * length
    short = short.masked_fill(status < Status.SLACK, 0.0)
    return (
        group.by_constraint(binding, partial(torch.any, dim=0)),
        group.by_constraint(short, partial(torch.amax, dim=0)),
    )


def shortfall(group: ActuatorGroup, prepared: Prepared, control: Tensor) -> Tensor:
    """By constraint, (constraints, B): what controls (3, B) in N or N m do not give of what rows waived, at least 0."""
    left = total(prepared.a * control, 1) + prepared.b_bare - prepared.waived
    short = (prepared.waived > 0.0) & (left < -FEASIBLE * prepared.length)
    return group.by_constraint(torch.where(short, -left, 0.0), partial(torch.amax, dim=0))


def with_shortfall(status: Tensor, slack: Tensor) -> Tensor:
    """Statuses (B,): SLACK, at least, where slack (constraints, B) says that a row is not satisfied."""
    return torch.where((slack > 0.0).any(0), status.clamp(min=Status.SLACK), status)


class Settling:
    """The search for controls that hold the rows themselves, not only their tangents at the desired ones.

    What is convex lies within its tangents, so a solution may break it. Then the tangents there are added, and the
    program is solved again (Kelley 1960). For what is left when that ends the search begins again at no control, and
    the solution goes back towards it: from there to the solution a concave psi is at least its chord. Where thrusters
    give some values only, their neighbours of the solution are tried. What is still broken is counted as slack.

    Args:
        run: what computes the rows of the group, see `rta.conditions.held`.
        given: its other arguments, of the columns that are corrected, M.
        desired: (3, M) controls in units of the actuators' limits, beyond these, too.

    Attributes:
        control: (3, M) the best so far in units of the actuators' limits; status: (M,).
        active, slack: (constraints, M), as in `rta.filter.FilterResult`.
        score: (M,) what is greater the better a control is; size: (M,) what distances are measured by.
    """

    def __init__(
        self,
        group: HeldGroup,
        run: Callable[..., list[Tensor]],
        solver: Solver,
        given: list[Tensor],
        desired: Tensor,
    ) -> None:
        self.group, self.run, self.solver, self.given, self.desired = group, run, solver, given, desired
        self.limit = group.limit * given[-1][group.controls]
        self.size = desired.abs().amax(0).clamp(min=1.0)
        self.control = torch.zeros_like(self.desired)
        self.score = torch.full_like(self.desired[0], -torch.inf)
        self.status = torch.full_like(self.score, Status.UNSOLVED, dtype=torch.int64)
        self.active = self.score.new_zeros(len(group.constraints), len(self.score), dtype=torch.bool)
        self.slack = torch.zeros_like(self.active, dtype=self.score.dtype)

    def search(self, prepared: Prepared) -> list[Tensor]:
        """From the rows at controls near the desired ones to control (3, M) in N or N m, status, active and slack."""
        asked = inset(problems(self.group, prepared, self.desired, self.limit))
        todo, broken = torch.arange(len(self.score), device=self.score.device), []
        in_vain = torch.zeros_like(todo)
        for number in range(PASSES):
            answer = self.solver.solve(asked)
            solved = answer.status < Status.UNSOLVED
            tangents, within, held, better = self.take(todo, answer.control, solved)
            # of rows that yield no cut is kept, so that they may go on in a circle
            in_vain = torch.where(better | (answer.status == Status.HARD), 0, in_vain + 1)
            worthwhile = (in_vain < IN_VAIN) & (number < PASSES - 1)
            left = torch.nonzero(~held & solved & ~worthwhile).flatten()
            broken.append((todo[left], pick(answer.control, left), pick(within, left)))
            again = torch.nonzero(~held & solved & worthwhile).flatten()
            if not again.numel():
                break
            todo, in_vain = todo[again], in_vain[again]
            asked = with_tangents(asked[again], inset(tangents[again]), answer.status[again] == Status.SLACK)
        columns, u, within = (torch.cat(parts, -1) for parts in zip(*broken, strict=True))
        if columns.numel():
            self.from_rest(columns)
            self.go_back(columns, u, within)
        if self.group.is_coarse:
            self.settle_for_what_is_given()
        return [self.control * self.group.limit, self.status, self.active, self.slack]

    def at(self, columns: Tensor, u: Tensor) -> tuple[Problems, Prepared]:
        """The rows' tangents at controls u (3, m) of these columns, and the rows as prepared."""
        x, control, error_bound, left = (pick(part, columns) for part in self.given)
        control[self.group.controls] = u * self.group.limit
        there = Prepared(*self.run(x, control, error_bound, left))
        return problems(self.group, there, u, pick(self.limit, columns)), there

    def take(self, columns: Tensor, u: Tensor, solved: Tensor) -> tuple[Problems, Tensor, Tensor, Tensor]:
        """Takes controls (3, m) where they are better: the nearest of those that hold the rows, else the least short.

        Returns:
            The tangents there; how far u is within the rows, (R, m); (m,) bool, it holds them; it is clearly better.
        """
        tangents, there = self.at(columns, u)
        within = total(tangents.a * u, 1) + tangents.b_bare
        away = (u - pick(self.desired, columns)) / self.size[columns]
        least, distance = within.amin(0), (away**2).sum(0)
        held = least >= -TOLERATED
        status = torch.where(held, Status.HARD, Status.SLACK).masked_fill(~solved, Status.UNSOLVED)
        score = torch.where(held, FARTHEST - distance, -self.shortage(within)).nan_to_num(-torch.inf)
        before = self.score[columns]
        better = torch.nonzero(before.isinf() | (solved & (score > before))).flatten()
        active, slack = answered(self.group, tangents, there.length, u, status)
        slack = slack.maximum(shortfall(self.group, there, u * pick(self.limit, columns)))
        for whole, part in (
            (self.control, u),
            (self.status, status),
            (self.active, active),
            (self.slack, slack),
            (self.score, score),
        ):
            put(whole, columns[better], pick(part, better))
        clearly = score - before > TOLERATED * before.abs().clamp(min=1.0)
        return tangents, within * there.length, held, clearly | before.isinf()

    def shortage(self, within: Tensor) -> Tensor:
        """(m,) what controls lack where rows (R, m) are within so much, each class far more than those below it."""
        weights, lack = self.group.weights, torch.zeros_like(within[0])
        for highest in sorted(set(weights), reverse=True):
            own = [i for i, weight in enumerate(weights) if weight == highest]
            lack = ABOVE * lack + (-TOLERATED - within[own].amin(0)).clamp(min=0.0)
        return lack

    def from_rest(self, columns: Tensor) -> None:
        """Takes the least control that holds the rows, if tangents near no control lead to it.

        Far away they lose what psi hangs between two moments there, and may exclude every small control.
        """
        rest = torch.zeros_like(pick(self.desired, columns))
        tangents, _ = self.at(columns, rest)
        for _ in range(PASSES_AT_REST):
            answer = self.solver.solve(inset(replace(tangents, desired=rest)))
            solved = answer.status < Status.UNSOLVED
            tangents, _, held, _ = self.take(columns, answer.control, solved)
            left = torch.nonzero(~held & solved).flatten()
            if not left.numel():
                break
            columns, rest, tangents = columns[left], pick(rest, left), tangents[left]

    def go_back(self, columns: Tensor, u: Tensor, within: Tensor) -> None:
        """Where no control of the group's own holds the rows, takes as much of controls u (3, m) as does, too."""
        still = torch.zeros_like(u)
        tangents, there = self.at(columns, still)
        at_rest = tangents.b_bare * there.length
        share = torch.where(within < 0.0, at_rest / (at_rest - within), 1.0).amin(0)
        possible = at_rest.amin(0) >= 0.0
        self.take(columns, torch.where(possible, share * u, u), torch.ones_like(possible))

    def settle_for_what_is_given(self) -> None:
        """Takes the best of what the thrusters give next to the controls so far.

        Where none of these holds the rows the program is solved again, with rows that hold however its solution is
        rounded, a u + b >= sum_i |a_i| gap / 2; where not even that helps, all or nothing of each axis is tried.
        """
        known, limit = self.group.known, self.group.limit
        before, self.control = self.control, known.given(self.control * limit, limit) / limit
        self.score = torch.full_like(self.score, -torch.inf)
        solved = torch.nonzero(self.status < Status.UNSOLVED).flatten()
        self.try_neighbours(solved, pick(before, solved))
        broken = torch.nonzero(self.status == Status.SLACK).flatten()
        if not broken.numel():
            return
        tangents, _ = self.at(broken, pick(self.control, broken))
        cushion = total(tangents.a.abs(), 1) * known.gap / 2 / limit
        b, b_bare = tangents.b - cushion, tangents.b_bare - cushion
        asked = replace(tangents, desired=pick(self.desired, broken), b=b, b_bare=b_bare)
        self.try_neighbours(broken, self.solver.solve(asked).control)
        broken = torch.nonzero(self.status == Status.SLACK).flatten()
        most = torch.full_like(pick(self.desired, broken), known.largest_thrust(limit) / limit)
        self.try_corners(broken, (-most, torch.zeros_like(most), most))

    def try_neighbours(self, columns: Tensor, u: Tensor) -> None:
        """Takes the best of what the thrusters give next to controls u (3, m)."""
        given = self.group.known.neighbours(u * self.group.limit, self.group.limit)
        self.try_corners(columns, [part / self.group.limit for part in given])

    def try_corners(self, columns: Tensor, values: Sequence[Tensor]) -> None:
        """Takes the best of the controls that have one of these values (3, m) on each axis."""
        if not columns.numel():
            return
        for corner in product(values, repeat=3):
            u = torch.stack([value[i] for i, value in enumerate(corner)])
            self.take(columns, u, torch.ones_like(columns, dtype=torch.bool))


def with_tangents(asked: Problems, tangents: Problems, anew: Tensor) -> Problems:
    """Programs with these tangents, too; where `anew` (M,) with these alone, the others having left no control."""
    times = len(asked.b) // len(tangents.b)

    def both(before: Tensor, after: Tensor) -> Tensor:
        repeated = after.repeat(times, *(1,) * (after.dim() - 1))
        return torch.cat((torch.where(anew, repeated, before), after))

    return Problems(
        asked.desired,
        both(asked.a, tangents.a),
        both(asked.b, tangents.b),
        both(asked.b_bare, tangents.b_bare),
        torch.cat((asked.weight, tangents.weight)),
    )


def inset(asked: Problems) -> Problems:
    """Programs that ask for a little more."""
    return replace(asked, b=asked.b - INSET, b_bare=asked.b_bare - INSET)

"""Programs of one actuator group's rows, and their repetition where rows are tangents at a control."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from rta.held_rows import HeldGroup
from rta.qp import FEASIBLE, HOPELESS, REDUNDANT, Problems, Solver, Status, pick, put, total
from rta.rows import ActuatorGroup, Rows

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6

TOLERATED = 1e-6  # in units of the actuators' limits, by which rows themselves may be short
INSET = 1e-3  # in the same unit, by which tangents ask for more, so that few of them are enough
PASSES = 4  # programs solved for one control at most


class Prepared(NamedTuple):
    """What is computed for every spacecraft, corrected or not, for one actuator group.

    Attributes:
        psi, a, b, b_bare, h, doubt: the fields of `Rows`.
        length: (R, B) of the rows per actuator limit.
        lowest: (1, B) left-hand side of the scaled rows under the desired control; negative or NaN where it must
            be corrected.
    """

    psi: Tensor
    a: Tensor
    b: Tensor
    b_bare: Tensor
    h: Tensor
    doubt: Tensor
    length: Tensor
    lowest: Tensor


def scaled(rows: Rows, control: Tensor, limit: Tensor | float) -> Prepared:
    """Rows in units of the actuators' limits, and what a control (3, B) in these units leaves of them."""
    a = rows.a * limit
    length = total(a * a, 1).sqrt().clamp(min=SHORTEST_ROW)  # thirty times as fast as Tensor.norm
    left = (total(a * control, 1) + rows.b) / length
    return Prepared(
        *(getattr(rows, field.name) for field in fields(Rows)), length=length, lowest=smallest(left)[None]
    )


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


def settle(
    group: HeldGroup,
    run: Callable[..., list[Tensor]],
    solver: Solver,
    prepared: Prepared,
    given: list[Tensor],
) -> list[Tensor]:
    """Controls (3, M) that hold the rows themselves, not only their tangents at the desired ones.

    What is convex lies within its tangents, so a solution may break it. Then the tangents there are added, and the
    program is solved again (Kelley 1960). What is left after PASSES goes back towards no control: from there to the
    solution a concave psi is at least its chord. What is still broken is counted as slack.

    Args:
        run: `SafetyFilter.prepare_held` of the group.
        prepared: of these columns, at the desired controls; given: its other arguments, of these columns.

    Returns:
        Control (3, M) in N or N m, status (M,), active and slack (constraints, M).
    """
    x, control, spread, left = given
    desired, limit = control[group.controls] / group.limit, group.limit * left[group.controls]

    def at(columns: Tensor, u: Tensor) -> tuple[Problems, Tensor, Tensor]:
        """The rows' tangents at controls u (3, m) of these columns, their lengths, and how far u is within them."""
        controls, *others = (pick(part, columns) for part in (control, x, spread, left))
        controls[group.controls] = u * group.limit
        there = Prepared(*run(others[0], controls, *others[1:]))
        tangents = problems(group, there, u, pick(limit, columns))
        return tangents, there.length, total(tangents.a * u, 1) + tangents.b_bare

    asked = inset(problems(group, prepared, desired, limit))
    wholes = [
        torch.zeros_like(desired),
        torch.zeros_like(desired[0], dtype=torch.int64),
        torch.zeros_like(prepared.h, dtype=torch.bool),
        torch.zeros_like(prepared.h),
        torch.full_like(desired[0], -torch.inf),  # how far the best control is within the rows
    ]

    def keep(columns: Tensor, u: Tensor, solved: Tensor) -> tuple[Problems, Tensor, Tensor]:
        """Takes controls that are better than those before; returns their tangents and which columns go on."""
        tangents, length, within = at(columns, u)
        least = within.amin(0)
        held = least >= -TOLERATED
        status = torch.where(held, Status.HARD, Status.SLACK).masked_fill(~solved, Status.UNSOLVED)
        better = torch.nonzero((least > pick(wholes[-1], columns)) | ~solved).flatten()
        parts = [u, status, *answered(group, tangents, length, u, status), least]
        for whole, part in zip(wholes, parts, strict=True):
            put(whole, columns[better], pick(part, better))
        return tangents, within * length, torch.nonzero(solved & ~held).flatten()

    todo = torch.arange(desired.shape[1], device=desired.device)
    for i in range(PASSES):
        answer = solver.solve(asked)
        tangents, within, again = keep(todo, answer.control, answer.status < Status.UNSOLVED)
        todo, u, within = todo[again], pick(answer.control, again), pick(within, again)
        if not again.numel() or i == PASSES - 1:
            break
        asked = joined(asked[again], inset(tangents[again]), answer.status[again] == Status.SLACK)
    if todo.numel():  # where no control of the group's own is held, a part of the way to the solution is
        still = torch.zeros_like(u)
        _, length, at_rest = at(todo, still)
        at_rest = at_rest * length
        share = torch.where(within < 0.0, at_rest / (at_rest - within), 1.0).amin(0)
        keep(
            todo, torch.where(at_rest.amin(0) >= 0.0, share * u, u), torch.ones_like(share, dtype=torch.bool)
        )
    return [wholes[0] * group.limit, *wholes[1:-1]]


def joined(asked: Problems, tangents: Problems, anew: Tensor) -> Problems:
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

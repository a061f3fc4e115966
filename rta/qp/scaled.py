"""Converts an actuator group's rows to its program, in units of the actuators' limits, and the answer back."""

from functools import partial, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from rta.barrier import ActuatorGroup
from rta.qp.programs import FEASIBLE, HOPELESS, REDUNDANT, Status, total

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6


class ScaledRows(NamedTuple):
    """Rows of one actuator group with their scale, computed for every spacecraft, corrected or not.

    Attributes:
        psi, a, b, b_no_margin, relaxation, h: the fields of `Rows`.
        length: (R, B) of the rows per actuator limit.
        lowest: (B,) left-hand side of the scaled rows under the desired control; negative or NaN where it must
            be corrected.
    """

    psi: Tensor
    a: Tensor
    b: Tensor
    b_no_margin: Tensor
    relaxation: Tensor
    h: Tensor
    length: Tensor
    lowest: Tensor


def scale_rows(group: ActuatorGroup, x: Tensor, control: Tensor, left: Tensor | None = None) -> ScaledRows:
    """Computes a group's rows at states (16, B), and what controls (6, B) in N and N m leave of them.

    Args:
        left: (6, B) the share that each actuator gives of its command; None: all of it.
    """
    limit: Tensor | float = group.limit
    if left is None:
        rows = group(x, control)
    else:
        limit = group.limit * left[group.controls]
        rows = group(x, left * control, limit)
    a = rows.a * limit
    length = total(a * a, 1).sqrt().clamp(min=SHORTEST_ROW)  # thirty times as fast as Tensor.norm
    within = (total(a * (control[group.controls] / group.limit), 1) + rows.b) / length
    return ScaledRows(**vars(rows), length=length, lowest=smallest(within))


def smallest(rows: Tensor) -> Tensor:
    """(R, B) to (B,), in operations that fuse with those around."""
    return reduce(torch.minimum, rows.unbind())


class Program(NamedTuple):
    """The programs of a group, as of `Problems`, in units of the actuators' limits."""

    desired: Tensor
    a: Tensor
    b: Tensor
    b_no_margin: Tensor


def to_qp(group: ActuatorGroup, rows: ScaledRows, desired: Tensor, left: Tensor | None = None) -> Program:
    """Returns the programs of scaled rows and of desired controls (3, M) in N or N m.

    Args:
        left: (3, M) the share that each of the group's actuators gives; None: all of it.
    """
    limit = group.limit if left is None else group.limit * left
    b, b_no_margin = ((side / rows.length).clamp(HOPELESS, REDUNDANT) for side in (rows.b, rows.b_no_margin))
    return Program(desired / group.limit, rows.a * (limit / rows.length[:, None]), b, b_no_margin)


def from_qp(
    group: ActuatorGroup, asked: Program, length: Tensor, control: Tensor, status: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns by constraint, (constraints, M), whether a row binds the controls (3, M), and how far one falls short."""
    reached = total(asked.a * control, 1)
    with_margins = (reached + asked.b).amin(0) >= -FEASIBLE
    binding = reached + torch.where(with_margins, asked.b, asked.b_no_margin) <= FEASIBLE
    short = -(reached + asked.b_no_margin).clamp(max=0.0) * length
    short = short.masked_fill(status < Status.SLACK, 0.0)
    return (
        group.by_constraint(binding, partial(torch.any, dim=0)),
        group.by_constraint(short, partial(torch.amax, dim=0)),
    )


def shortfall(group: ActuatorGroup, rows: ScaledRows, control: Tensor) -> Tensor:
    """Returns by constraint, (constraints, B), how far controls (3, B) in N or N m fall short of relaxed rows, or 0."""
    reached = total(rows.a * control, 1) + rows.b_no_margin - rows.relaxation
    short = (rows.relaxation > 0.0) & (reached < -FEASIBLE * rows.length)
    return group.by_constraint(torch.where(short, -reached, 0.0), partial(torch.amax, dim=0))


def with_shortfall(status: Tensor, slack: Tensor) -> Tensor:
    """Statuses (B,): SLACK, at least, where slack (constraints, B) says that a row is not satisfied."""
    return torch.where((slack > 0.0).any(0), status.clamp(min=Status.SLACK), status)

"""The filter's programs solved all at once by the dual active-set method of Goldfarb and Idnani (1983).

Each program is a projection, min |x - x_des|^2 / 2 subject to A_i x + b_i >= 0: the bounds are rows of their
own, and slack is one more variable sqrt(w_i) delta_i per soft row. From x = x_des, with no row active, rows
become active one by one, the most violated first, at the cost of active ones whose multiplier falls to zero,
until no row is violated or the active rows exclude the next one. No more rows can be active than there are
variables, so the state of a program is small, and one step is the same arithmetic for all of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rta.piqp_solver import PiqpSolver
from rta.qp import Problems, Solutions, Status, kkt_residual, total

VIOLATED = 1e-10  # a row is violated below minus this, in units of the actuators' limits
DEPENDENT = 1e-16  # |z|^2 / |a|^2 up to which a row is a combination of the active ones
BLOCKING = 1e-12  # change of a multiplier per step length that counts as none
ACCURATE = 1e-8  # largest KKT residual that is not solved again by PIQP
ROUND = 4  # steps between two looks at which programs are unfinished
MAX_ROUNDS = 16

RUNNING, OPTIMAL, INFEASIBLE = 0, 1, 2


class State(NamedTuple):
    """N programs of D variables between two steps; the K = D slots hold the active rows.

    Attributes:
        x: (D, N). multiplier: (K, N) of the active rows, zero in empty slots.
        row: (K, N) index of the active rows, -1 in empty slots.
        inverse: (K, D, N) pseudo-inverse of the active rows, zero in empty slots.
        entering: (N,) the row on its way to active; its multiplier `pressure` (N,) is zero before it started.
        outcome: (N,) RUNNING, OPTIMAL or INFEASIBLE.
    """

    x: Tensor
    multiplier: Tensor
    row: Tensor
    inverse: Tensor
    entering: Tensor
    pressure: Tensor
    outcome: Tensor


class BatchedSolver:
    """All programs of a batch at once, on their own device; PIQP solves what remains."""

    def __init__(self) -> None:
        self.fallback = PiqpSolver()
        self._advance: Callable[[Tensor, Tensor, State], State] = advance

    def compile(self) -> None:
        """Compiles the steps of the programs without slack; those with slack are rare."""
        self._advance = torch.compile(advance, dynamic=True)

    def solve(self, problems: Problems) -> Solutions:
        """See `Solver`."""
        desired, weight = problems.desired, problems.weight
        control = torch.zeros_like(desired)
        status = torch.full_like(desired[0], Status.UNSOLVED, dtype=torch.int64)
        residual = torch.full_like(desired[0], torch.inf)
        finite = problems.finite

        nothing = torch.full_like(weight, torch.inf)
        stages = (
            ("b", nothing, Status.HARD),
            ("b_bare", nothing, Status.HARD),
            ("b_bare", weight, Status.SLACK),
        )
        left, part = None, problems
        left = torch.nonzero(finite).flatten()
        for side, slack_weight, outcome in stages:
            if not left.numel():
                break
            part = problems if left.numel() == finite.numel() else problems[left]
            b = getattr(part, side)
            u, multiplier, solved = project(part.desired, part.a, b, slack_weight, self._advance)
            error = kkt_residual(u, multiplier, part.desired, part.a, b, slack_weight)
            accepted = (solved == OPTIMAL) & (error <= ACCURATE)
            columns = left[accepted]
            control[:, columns] = u[:, accepted]
            status[columns] = outcome
            residual[columns] = error[accepted]
            left = left[solved == INFEASIBLE]

        again = torch.nonzero(finite & (status == Status.UNSOLVED)).flatten()
        if again.numel():
            answer = self.fallback.solve(problems[again])
            control[:, again] = answer.control
            status[again] = answer.status
            residual[again] = answer.residual
        return Solutions(control, status, residual)


def project(
    desired: Tensor, a: Tensor, b: Tensor, weight: Tensor, step: Callable[[Tensor, Tensor, State], State]
) -> tuple[Tensor, Tensor, Tensor]:
    """Controls (3, N), multipliers of the rows (R, N) and outcomes (N,) of programs with these slack weights."""
    soft = torch.nonzero(weight.isfinite()).flatten()
    rows, batch, slacks = len(a), a.shape[-1], len(soft)
    box = torch.eye(3, dtype=a.dtype, device=a.device)
    normals = a.new_zeros(rows + 6, 3 + slacks, batch)
    normals[:rows, :3] = a
    normals[rows:, :3] = torch.cat((box, -box))[..., None]
    normals[soft, torch.arange(3, 3 + slacks, device=a.device)] = weight[soft].rsqrt()[:, None]
    offsets = torch.cat((b, b.new_ones(6, batch)))
    state = start(torch.cat((desired, desired.new_zeros(slacks, batch))))

    running = torch.arange(batch, device=a.device)
    part, whole = state, True
    for _ in range(MAX_ROUNDS):
        part = step(normals, offsets, part)
        state = (
            part
            if whole
            else State(*(old.index_copy(-1, running, new) for old, new in zip(state, part, strict=True)))
        )
        kept = torch.nonzero(part.outcome == RUNNING).flatten()
        if not kept.numel():
            break
        running, whole = running[kept], False
        normals, offsets = normals.index_select(-1, kept), offsets.index_select(-1, kept)
        part = State(*(x.index_select(-1, kept) for x in part))

    multiplier = a.new_zeros(rows + 6, batch)
    multiplier.scatter_add_(0, state.row.clamp(min=0), state.multiplier)
    return state.x[:3].clamp(-1.0, 1.0), multiplier[:rows], state.outcome


def start(x: Tensor) -> State:
    """The unconstrained optimum x (D, N), where no row is active."""
    variables, batch = x.shape
    return State(
        x=x,
        multiplier=torch.zeros_like(x),
        row=torch.full_like(x, -1, dtype=torch.int64),
        inverse=x.new_zeros(variables, variables, batch),
        entering=x.new_zeros(batch, dtype=torch.int64),
        pressure=x.new_zeros(batch),
        outcome=x.new_full((batch,), RUNNING, dtype=torch.int64),
    )


def advance(a: Tensor, b: Tensor, state: State) -> State:
    """A few steps of all programs with rows (R, D, N) and offsets (R, N)."""
    for _ in range(ROUND):
        state = one_step(a, b, state)
    return state


def one_step(a: Tensor, b: Tensor, state: State) -> State:
    """One step: the entering row becomes active, or an active row that blocks its way leaves."""
    x, multiplier, row, inverse, entering, pressure, outcome = state
    slots = torch.arange(len(row), device=row.device)[:, None]
    s = total(a * x, 1) + b
    shortest, worst = s.min(0)
    optimal = (shortest >= -VIOLATED) & (pressure == 0.0)
    entering = torch.where(pressure > 0.0, entering, worst)
    normal = take(a, entering)
    active = a.gather(0, row.clamp(min=0)[:, None].expand_as(inverse))

    # the multipliers of the active rows change by -r, and x moves along z, per unit of pressure
    r = total(inverse * normal, 1)
    z = normal - total(active * r[:, None], 0)
    z2 = total(z * z, 0)
    free = (z2 > DEPENDENT * total(normal * normal, 0)) & (row.amin(0) < 0)
    full = torch.where(free, -take(s, entering) / z2, torch.inf)
    partial, blocking = torch.where(r > BLOCKING, multiplier / r, torch.inf).min(0)
    length = torch.minimum(full, partial)
    outcome = torch.where(
        outcome == RUNNING,
        torch.where(optimal, OPTIMAL, torch.where(length.isinf(), INFEASIBLE, RUNNING)),
        outcome,
    )
    length = torch.where(outcome == RUNNING, length, 0.0)
    x = x + torch.where(free, length, 0.0) * z
    multiplier = multiplier - length * r
    pressure = pressure + length

    enters = (outcome == RUNNING) & (full <= partial)
    leaves = (outcome == RUNNING) & (full > partial)
    enters_here = enters & (slots == row.argmin(0))
    leaves_here = leaves & (slots == blocking)
    # rank-one update of the pseudo-inverse
    left = take(inverse, blocking)
    shed = total(inverse * left, 1) / total(left * left, 0)
    direction = torch.where(enters, z / z2, left)
    share = torch.where(enters, torch.where(enters_here, -1.0, r), torch.where(leaves, shed, 0.0))
    inverse = torch.where(leaves_here[:, None], 0.0, inverse - share[:, None] * direction)
    multiplier = torch.where(enters_here, pressure, torch.where(leaves_here, 0.0, multiplier))
    row = torch.where(enters_here, entering, torch.where(leaves_here, -1, row))
    pressure = torch.where(enters, 0.0, pressure)
    return State(x, multiplier, row, inverse, entering, pressure, outcome)


def take(rows: Tensor, index: Tensor) -> Tensor:
    """rows[index[n], ..., n] for each n: (R, ..., N) and (N,) to (..., N)."""
    return rows.gather(0, index.expand(1, *rows.shape[1:-1], -1))[0]

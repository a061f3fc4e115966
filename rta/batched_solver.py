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
from rta.qp import Problems, Solutions, Status, kkt_residual, pick, put, total

VIOLATED = 1e-12  # a row is violated below minus this, in units of the actuators' limits
DEPENDENT = 1e-16  # |z|^2 / |a|^2 up to which a row counts as a combination of the active ones
BLOCKING = 1e-12  # fall of a multiplier per unit of pressure that counts as none
ACCURATE = 1e-8  # largest KKT residual that is not solved again by PIQP
ROUND = 2  # steps between two looks at which programs are unfinished: what most programs take
MAX_ROUNDS = 50  # beyond which PIQP takes over; recorded programs take up to 5, with slack up to 8

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


Step = Callable[[Tensor, Tensor, State], State]


class BatchedSolver:
    """All programs of a batch at once, on their own device; PIQP solves again what is not solved accurately."""

    def __init__(self) -> None:
        self.fallback = PiqpSolver()
        self._step: Step = step

    def compile(self) -> None:
        """Compiles the step for programs without slack; those with slack are rare and keep the eager one."""
        compiled = torch.compile(step, dynamic=True)

        def several(a: Tensor, b: Tensor, state: State) -> State:
            # torch.compile would compile anew for a batch of one
            return compiled(a, b, state) if a.shape[-1] > 1 else step(a, b, state)

        probe = torch.zeros(3, 64, dtype=torch.float64)
        several(probe.new_zeros(17, 3, 64), probe.new_ones(17, 64), start(probe))
        self._step = several

    def solve(self, problems: Problems) -> Solutions:
        """See `Solver`."""
        control = torch.zeros_like(problems.desired)
        status = torch.full_like(control[0], Status.UNSOLVED, dtype=torch.int64)
        residual = torch.full_like(control[0], torch.inf)
        finite = problems.finite

        none = torch.full_like(problems.weight, torch.inf)  # no row has slack
        stages = (
            (problems.b, none, self._step, Status.HARD),
            (problems.b_bare, none, self._step, Status.HARD),
            (problems.b_bare, problems.weight, step, Status.SLACK),
        )
        left = torch.nonzero(finite).flatten()
        for side, weight, advance, solved in stages:
            if not left.numel():
                break
            desired, a, b = (pick(x, left) for x in (problems.desired, problems.a, side))
            u, multiplier, outcome = project(desired, a, b, weight, advance)
            error = kkt_residual(u, multiplier, desired, a, b, weight)
            accurate = (outcome == OPTIMAL) & (error <= ACCURATE)
            put(control, left, u)
            put(status, left, torch.where(accurate, solved, Status.UNSOLVED))
            put(residual, left, error)
            left = left[outcome == INFEASIBLE]

        again = torch.nonzero(finite & (status == Status.UNSOLVED)).flatten()
        if again.numel():
            answer = self.fallback.solve(problems[again])
            put(control, again, answer.control)
            put(status, again, answer.status)
            put(residual, again, answer.residual)
        return Solutions(control, status, residual)


def project(
    desired: Tensor, a: Tensor, b: Tensor, weight: Tensor, advance: Step
) -> tuple[Tensor, Tensor, Tensor]:
    """Solves the programs with these slack weights.

    Args:
        desired: (3, N); a: (R, 3, N); b: (R, N); weight: (R,).
        advance: `step` or its compiled form.

    Returns:
        Controls (3, N), multipliers of the rows (R, N) and outcomes (N,).
    """
    rows, batch = b.shape
    normals, offsets = with_bounds_and_slack(a, b, weight)
    slacks = normals.shape[1] - 3
    every = part = start(torch.cat((desired, desired.new_zeros(slacks, batch))))
    running = torch.arange(batch, device=a.device)
    for _ in range(MAX_ROUNDS):
        for _ in range(ROUND):
            part = advance(normals, offsets, part)
        for old, new in zip(every, part, strict=True):
            put(old, running, new)
        columns = torch.nonzero(part.outcome == RUNNING).flatten()
        if not columns.numel():
            break
        running = running[columns]
        normals, offsets = pick(normals, columns), pick(offsets, columns)
        part = State(*(pick(x, columns) for x in part))

    multiplier = b.new_zeros(rows + 6, batch)
    multiplier.scatter_add_(0, every.row.clamp(min=0), every.multiplier)
    return every.x[:3].clamp(-1.0, 1.0), multiplier[:rows], every.outcome


def with_bounds_and_slack(a: Tensor, b: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (R + 6, D, N) and offsets (R + 6, N) in D variables: controls and sqrt(w_i) delta_i of soft rows i."""
    batch = b.shape[1]
    soft = torch.nonzero(weight.isfinite()).flatten()
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    bounds = torch.cat((eye, -eye))[..., None].expand(-1, -1, batch)
    normals, offsets = torch.cat((a, bounds)), torch.cat((b, b.new_ones(6, batch)))
    if soft.numel():
        slack = torch.diag(weight.rsqrt())[:, soft]
        slack = torch.cat((slack, slack.new_zeros(6, soft.numel())))
        normals = torch.cat((normals, slack[..., None].expand(-1, -1, batch)), 1)
    return normals, offsets


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


def step(a: Tensor, b: Tensor, state: State) -> State:
    """One step of running programs: a row becomes active, or an active row that blocks its way leaves.

    Args:
        a: rows (R, D, N). b: offsets (R, N).
    """
    x, multiplier, row, inverse, entering, pressure, outcome = state
    s = total(a * x, 1) + b
    lowest, violated_most = s.min(0)
    entering = torch.where(pressure > 0.0, entering, violated_most)
    active = a.gather(0, row.clamp(min=0)[:, None].expand_as(inverse))
    normal = take(a, entering)
    r, z, z2 = directions(active, inverse, normal)

    # how far until the entering row holds with equality, and until the multiplier of an active one is zero
    free = (z2 > DEPENDENT * total(normal * normal, 0)) & (row.amin(0) < 0)
    full = torch.where(free, -take(s, entering) / z2, torch.inf)
    partial, blocking = torch.where(r > BLOCKING, multiplier / r, torch.inf).min(0)
    length = torch.minimum(full, partial)

    optimal = (lowest >= -VIOLATED) & (pressure == 0.0)
    now = torch.where(optimal, OPTIMAL, torch.where(length.isinf(), INFEASIBLE, RUNNING))
    outcome = torch.where(outcome == RUNNING, now, outcome)
    length = torch.where(outcome == RUNNING, length, 0.0)
    x = x + torch.where(free, length, 0.0) * z
    multiplier = multiplier - length * r
    pressure = pressure + length

    slots = torch.arange(len(row), device=row.device)[:, None]
    enters, leaves = (outcome == RUNNING) & (full <= partial), (outcome == RUNNING) & (full > partial)
    enters_here, leaves_here = enters & (slots == row.argmin(0)), leaves & (slots == blocking)
    # the pseudo-inverse stays one of the rows still active: its entries for other rows lose a share of one direction
    lost = take(inverse, blocking)
    direction = torch.where(enters, z / z2, lost)
    share = torch.where(enters, r, torch.where(leaves, total(inverse * lost, 1) / total(lost * lost, 0), 0.0))
    share = torch.where(enters_here, -1.0, share)
    inverse = torch.where(leaves_here[:, None], 0.0, inverse - share[:, None] * direction)
    multiplier = torch.where(enters_here, pressure, torch.where(leaves_here, 0.0, multiplier))
    row = torch.where(enters_here, entering, torch.where(leaves_here, -1, row))
    pressure = torch.where(enters, 0.0, pressure)
    return State(x, multiplier, row, inverse, entering, pressure, outcome)


def directions(active: Tensor, inverse: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The entering row (D, N) as a combination r (K, N) of the active ones and a rest z (D, N); also |z|^2.

    Per unit of the entering row's multiplier, those of the active rows change by -r and x moves along z.
    """
    r = total(inverse * normal, 1)
    z = normal - total(active * r[:, None], 0)
    more = total(inverse * z, 1)  # once is not enough where rows are nearly parallel
    r, z = r + more, z - total(active * more[:, None], 0)
    return r, z, total(z * z, 0)


def take(rows: Tensor, index: Tensor) -> Tensor:
    """rows[index[n], ..., n] for each n: (R, ..., N) and (N,) to (..., N)."""
    return rows.gather(0, index.expand(1, *rows.shape[1:-1], -1))[0]

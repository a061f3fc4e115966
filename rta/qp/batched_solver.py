"""The filter's programs solved all at once by the dual active-set method of Goldfarb and Idnani (1983).

Each program is a projection, min |x - x_des|^2 / 2 subject to A_i x + b_i >= 0: the bounds are rows of their
own, and slack is one more variable sqrt(w_i) delta_i per soft row. From x_des clipped to the bounds, where those it
is beyond are active, rows become active one by one, the most violated first, at the cost of active ones whose
multiplier falls to zero, until no row is violated or the active rows exclude the next one. No more rows can be
active than there are variables, so the state of a program is small, and one step is the same arithmetic for all
of them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kernels.compiled import Compiled
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import (
    REDUNDANT,
    Problems,
    Solutions,
    Status,
    kkt_residual,
    least_violating,
    pick,
    put,
    stages,
    total,
)

ACCURATE = 1e-8  # largest KKT residual that is not solved again by PIQP
VIOLATED = 1e-12  # a row is violated below minus this, in units of the actuators' limits
DEPENDENT = 1e-16  # |z|^2 / |a|^2 up to which a row counts as a combination of the active ones
BLOCKING = 1e-12  # fall of a multiplier per unit of pressure that counts as none
STEPS = 3  # of the attempt, one for each row that becomes active or leaves
STEPS_SAMPLED = 6  # of sampled rows: the filter's own limits of the rates are three rows more at a time
ROUND = 2  # steps between two looks at which programs are unfinished
MAX_ROUNDS = 50  # beyond which PIQP takes over; recorded programs take up to 5, with slack up to 8
PIQP_FIRST = ("cpu",)  # devices where PIQP solves what the attempt leaves faster than steps uncompiled

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

    def multipliers(self, rows: int) -> Tensor:
        """Of the first so many rows, active or not: (rows, N)."""
        index = torch.arange(rows, device=self.row.device)[:, None, None]
        return total(torch.where(self.row == index, self.multiplier, 0.0), 1)


class BatchedSolver:
    """All programs of a batch at once, on their own device; PIQP solves again what is not solved accurately."""

    def __init__(self, steps: int = STEPS) -> None:
        self.fallback, self.steps = PiqpSolver(), steps
        self.piqp_first: tuple[str, ...] | None = None  # devices; None: PIQP_FIRST
        self._attempt: Callable[..., list[Tensor]] = partial(attempt, steps=steps)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.steps,)

    def compile(self, rows: Sequence[int], batch: int, device: torch.device | str) -> None:
        """See `Solver`. Few programs go beyond the attempt, and these are not compiled."""
        attempted = partial(attempt, steps=self.steps)
        compiled = {}
        for count in sorted(rows):
            probe = torch.zeros(count, 3, 1, dtype=torch.float64, device=device)
            compiled[count] = Compiled(attempted, probe[0], probe, probe[:, 0], batch=batch)

        def padded(desired: Tensor, a: Tensor, b: Tensor) -> list[Tensor]:
            count = next((count for count in compiled if count >= len(a)), None)
            if count is None:
                return attempted(desired, a, b)
            if missing := count - len(a):
                a = torch.cat((a, a.new_zeros(missing, *a.shape[1:])))
                b = torch.cat((b, b.new_full((missing, b.shape[1]), REDUNDANT)))
            return compiled[count](desired, a, b)

        self._attempt = padded

    def solve(self, problems: Problems) -> Solutions:
        """See `Solver`."""
        control, residual = self._attempt(problems.desired, problems.a, problems.b)
        residual = residual[0]
        # NaN is unsolved; the attempt does not look at b_no_margin, nor whether what is desired ends
        solved = (residual <= ACCURATE) & (problems.desired.sum(0) + problems.b_no_margin.sum(0)).isfinite()
        status = torch.where(solved, Status.HARD, Status.UNSOLVED)
        left = torch.nonzero(status == Status.UNSOLVED).flatten()
        if left.numel():
            answer = self._rest(problems[left])
            control, residual = control.clone(), residual.clone()
            put(control, left, answer.control)
            put(status, left, answer.status)
            put(residual, left, answer.residual)
        return Solutions(control, status, residual)

    def _rest(self, problems: Problems) -> Solutions:
        """Whatever the attempt leaves: by steps and, where these are not accurate, by PIQP, or the other way round."""
        piqp_first = problems.desired.device.type in (
            PIQP_FIRST if self.piqp_first is None else self.piqp_first
        )
        one, other = (self.fallback.solve, by_steps) if piqp_first else (by_steps, self.fallback.solve)
        return completed(one(problems), other, problems)


class PiqpThenSteps(PiqpSolver):
    """PIQP, and by steps what it leaves.

    Rows that only a corner of the bounds satisfies have no interior, along which PIQP would find its way.
    """

    def solve(self, problems: Problems) -> Solutions:
        """See `Solver`."""
        return completed(super().solve(problems), by_steps, problems)


def completed(answer: Solutions, other: Callable[[Problems], Solutions], problems: Problems) -> Solutions:
    """Puts another solver's answers, where it has one, in place of what a first one left unsolved."""
    again = torch.nonzero(problems.finite & (answer.status == Status.UNSOLVED)).flatten()
    if again.numel():
        second = other(problems[again])
        # what neither solves keeps the first one's least-violating control
        taken = torch.nonzero(second.status != Status.UNSOLVED).flatten()
        for whole, part in (
            (answer.control, second.control),
            (answer.status, second.status),
            (answer.residual, second.residual),
        ):
            put(whole, again[taken], pick(part, taken))
    return answer


def by_steps(problems: Problems) -> Solutions:
    """Solves stage by stage, each until every program is optimal or infeasible."""
    control = torch.zeros_like(problems.desired)
    status = torch.full_like(control[0], Status.UNSOLVED, dtype=torch.int64)
    residual = torch.full_like(control[0], torch.inf)
    left = finite = torch.nonzero(problems.finite).flatten()
    candidates = [problems.desired, torch.zeros_like(control)]
    for side, weight, solved in stages(problems):
        if not left.numel():
            break
        desired, a, b = (pick(x, left) for x in (problems.desired, problems.a, side))
        u, multiplier, outcome = project(desired, a, b, weight)
        error = kkt_residual(u, multiplier, desired, a, b, weight)
        # infeasible ones, too: of a row that only a corner of the bounds satisfies a last digit may be missed
        accurate = (outcome != RUNNING) & (error <= ACCURATE)
        put(control, left, u)
        put(status, left, torch.where(accurate, solved, Status.UNSOLVED))
        put(residual, left, torch.where(accurate, error, torch.inf))
        candidates.append(torch.full_like(control, torch.nan))
        infeasible = (outcome == INFEASIBLE) & ~accurate
        put(candidates[-1], left, u.masked_fill(infeasible, torch.nan))
        left = left[infeasible]
    unsolved = finite[status[finite] == Status.UNSOLVED]
    put(control, unsolved, least_violating([pick(u, unsolved) for u in candidates], problems[unsolved]))
    return Solutions(control, status, residual)


def attempt(desired: Tensor, a: Tensor, b: Tensor, steps: int = STEPS) -> list[Tensor]:
    """Some steps of hard programs, enough for nearly every one that is feasible, without looking at a value.

    Args:
        desired: (3, N); a: (R, 3, N); b: (R, N).

    Returns:
        Controls (3, N) and residuals (1, N), NaN where an argument is.
    """
    nothing = torch.full_like(b[:, 0], torch.inf)  # no row has slack
    normals, offsets = with_bounds(a, b)
    state = start(desired, len(b))
    for _ in range(steps):
        state = step(normals, offsets, state)
    u = state.x.clamp(-1.0, 1.0)
    return [u, kkt_residual(u, state.multipliers(len(b)), desired, a, b, nothing)[None]]


def project(desired: Tensor, a: Tensor, b: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Solves the programs with these slack weights.

    Args:
        desired: (3, N); a: (R, 3, N); b: (R, N); weight: (R,).

    Returns:
        Controls (3, N), multipliers of the rows (R, N) and outcomes (N,).
    """
    rows, batch = b.shape
    normals, offsets = with_bounds(a, b)
    normals = with_slack(normals, weight)
    slacks = normals.shape[1] - 3
    every = part = start(desired, rows, slacks)
    running = torch.arange(batch, device=a.device)
    for _ in range(MAX_ROUNDS):
        for _ in range(ROUND):
            part = step(normals, offsets, part)
        for old, new in zip(every, part, strict=True):
            put(old, running, new)
        columns = torch.nonzero(part.outcome == RUNNING).flatten()
        if not columns.numel():
            break
        running = running[columns]
        normals, offsets = pick(normals, columns), pick(offsets, columns)
        part = State(*(pick(x, columns) for x in part))
    return every.x[:3].clamp(-1.0, 1.0), every.multipliers(rows), every.outcome


def with_bounds(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (R + 6, 3, N) and offsets (R + 6, N), those of the actuators' limits last."""
    batch = b.shape[1]
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    bounds = torch.cat((eye, -eye))[..., None].expand(-1, -1, batch)
    return torch.cat((a, bounds)), torch.cat((b, b.new_ones(6, batch)))


def with_slack(normals: Tensor, weight: Tensor) -> Tensor:
    """Rows (R + 6, 3, N) in D variables: controls and sqrt(w_i) delta_i of soft rows i, of R weights."""
    soft = torch.nonzero(weight.isfinite()).flatten()
    slack = torch.diag(weight.rsqrt())[:, soft]
    slack = torch.cat((slack, slack.new_zeros(6, soft.numel())))
    return torch.cat((normals, slack[..., None].expand(-1, -1, normals.shape[2])), 1)


def start(desired: Tensor, rows: int, slacks: int = 0) -> State:
    """The optimum within the bounds alone, where those are active, after so many rows, that desired (3, N) is beyond.

    Their multipliers are what it is beyond them. From x = x_des the steps would lose as many digits as it is large.
    """
    batch = desired.shape[1]
    within = desired.clamp(-1.0, 1.0)
    inwards = (within - desired).sign()  # the normals of the bounds
    of_bound = rows + torch.arange(3, device=desired.device)[:, None] + torch.where(inwards < 0.0, 3, 0)
    more = desired.new_zeros(slacks, batch)
    x = torch.cat((within, more))
    return State(
        x=x,
        multiplier=torch.cat(((within - desired).abs(), more)),
        row=torch.cat((torch.where(inwards == 0.0, -1, of_bound), more.long() - 1)),
        inverse=torch.eye(3 + slacks, dtype=x.dtype, device=x.device)[..., None]
        * torch.cat((inwards, more))[:, None],
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

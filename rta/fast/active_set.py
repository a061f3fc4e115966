"""The filter's programs by the dual active-set method of Goldfarb and Idnani (1983), for any batch.

For three controls u in units of their actuators' limits, with the bounds among the conditions (rows),

    minimise |u - u_des|^2 / 2 + sum_i w_i delta_i^2 / 2   subject to   a_i u + b_i + delta_i >= 0.

The method starts at u_des clipped to the bounds; bounds that u_des exceeds are active. In each step the most violated
row becomes active, or an active row whose multiplier has fallen to zero leaves. The method ends when no row is violated
(optimal), or when the active rows exclude the next one (infeasible).

An active row with slack has delta_i = -(a_i u + b_i), and the multiplier w_i delta_i. It restricts no control, but adds
its cost to the Hessian,

    H = 1 + sum_i w_i a_i a_i'   over active rows with slack.

Active rows that must hold are independent normals in three dimensions, so three places suffice for them. With H = L L'
the method's N* and z are those of the normals L^-1 a_i, orthonormalised.

With large weights, rows use slack only where they conflict. So at first all rows must hold; only where that is
infeasible they get their slack.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from columns import loop, when
from rta.result import Status

ACCURATE = 1e-8  # largest KKT residual of a program that counts as solved
VIOLATED = 1e-12  # a row is violated below minus this, in units of the actuators' limits
DEPENDENT = 1e-16  # |z|^2 / |a|^2 up to which a row counts as a combination of the active ones
BLOCKING = 1e-12  # a smaller fall of a multiplier per unit of pressure counts as zero
NEGATIVE = 1e-9  # a multiplier below minus this counts as negative
ATTEMPTED = 3  # steps of all programs at once; in each step a row becomes active or leaves
MOST_STEPS = 100  # steps of a stage; a program that needs more counts as unsolved

RUNNING, OPTIMAL, INFEASIBLE = 0, 1, 2
Lower = list[list[Tensor]]  # L, its rows up to the diagonal


class State(NamedTuple):
    """Holds N programs between two steps; rows are numbered from the bounds on.

    Attributes:
        u: (3, N). soft: (R, N) bool, active rows that have slack.
        row, multiplier: (3, N) of active rows that must hold; -1 and zero in empty places.
        entering: (N,) the row on its way to active; its multiplier `pressure` (N,) is zero before it started.
        outcome: (N,) RUNNING, OPTIMAL or INFEASIBLE.
    """

    u: Tensor
    soft: Tensor
    row: Tensor
    multiplier: Tensor
    entering: Tensor
    pressure: Tensor
    outcome: Tensor


def solve(
    desired: Tensor, a: Tensor, b: Tensor, weight: Tensor, wanted: Tensor, attempted: int = ATTEMPTED
) -> tuple[Tensor, Tensor]:
    """Solves programs where `wanted` is true, all at once, on their own device.

    Args:
        desired: (3, N); a: (R, 3, N) rows of about unit length; b: (R, N).
        weight: (R, N) of slack, zero for rows that must hold; wanted: (N,) bool.
        attempted: steps that every program takes first; programs that need more continue in a loop that waits. 0: none.

    Returns:
        Controls (3, N) and `Status` (N,). Controls are zero where no solution is found. The result is undefined where
        `wanted` is false.
    """
    found = [torch.zeros_like(desired), torch.full_like(desired[0], Status.UNSOLVED, dtype=torch.int64)]
    if attempted:
        found = when(wanted, attempt, found, desired, a, b, attempted)
    left = wanted & (found[1] == Status.UNSOLVED)
    u, status = when(left, by_stages, found, desired, a, b, weight, waits=True)
    return u, status


def attempt(desired: Tensor, a: Tensor, b: Tensor, steps: int) -> list[Tensor]:
    """Takes some steps of programs without slack, enough for nearly every feasible one.

    Returns the same as `by_stages`.
    """
    finite = (desired.sum(0) + b.sum(0)).isfinite()  # the residual does not show NaN or infinity in these
    a, b = with_bounds(a, b)
    none, state = torch.zeros_like(b), begin(desired, len(b))
    for _ in range(steps):
        state, _ = step(*state, desired, a, b, none)
    u, residual = residual_of(state, desired, a, b, none)
    solved = (residual <= ACCURATE) & finite  # false for NaN
    return [torch.where(solved, u, 0.0), torch.where(solved, Status.HARD, Status.UNSOLVED)]


def by_stages(desired: Tensor, a: Tensor, b: Tensor, weight: Tensor) -> list[Tensor]:
    """Returns controls (3, N) and statuses (N,) of programs, without slack, then with it.

    Controls are zero where there is no solution.
    """
    finite = (desired.sum(0) + total(total(a, 0), 0) + b.sum(0)).isfinite()
    a, b = with_bounds(a, b)
    weight = torch.cat((weight.new_zeros(6, weight.shape[1]), weight))
    status = torch.full_like(desired[0], Status.UNSOLVED, dtype=torch.int64)
    state = [torch.zeros_like(status), torch.zeros_like(desired), status]
    return loop(stage, state, desired, a, b, weight, alive=finite, most=2)[1:]


def stage(
    number: Tensor, control: Tensor, status: Tensor, desired: Tensor, a: Tensor, b: Tensor, weight: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Solves programs without slack (number 0) or with slack (1); continues where there is no solution."""
    steep = torch.where(number > 0, weight, 0.0)
    everywhere = torch.ones_like(number, dtype=torch.bool)
    start = begin(desired, len(a))
    state = State(*loop(step, start, desired, a, b, steep, alive=everywhere, most=MOST_STEPS))
    u, off = residual_of(state, desired, a, b, steep)
    # infeasible programs, too: rounding may miss a row that only a corner of the bounds satisfies
    solved = (state.outcome != RUNNING) & (off <= ACCURATE)
    control = torch.where(solved, u, control)
    status = torch.where(solved, torch.where(number > 0, Status.SLACK, Status.HARD), status)
    return [number + 1, control, status], ~solved


def total(x: Tensor, dim: int) -> Tensor:
    """Returns the sum over a short dimension, added up in order: Tensor.sum may round otherwise in another batch."""
    return reduce(torch.add, x.unbind(dim))


def kkt_residual(
    u: Tensor, multiplier: Tensor, desired: Tensor, a: Tensor, b: Tensor, relief: Tensor
) -> Tensor:
    """Returns the largest violation of the optimality conditions of min |u - u_des|^2 / 2 + sum_i w_i delta_i^2 / 2.

    With multipliers lambda of the rows, delta_i = lambda_i / w_i and s_i = a_i u + b_i + delta_i, they are

        stationarity       u = clip(u_des + sum_i lambda_i a_i, -1, 1), the bounds' multipliers eliminated
        primal             s_i >= 0
        dual               lambda_i >= 0
        complementarity    min(lambda_i, 1) s_i = 0, since rounding of s_i times a large lambda_i is no violation

    Args:
        u, desired: (3, N); multiplier, b: (R, N); a: (R, 3, N).
        relief: (R, N), 1 / w_i, zero for rows without slack.

    Returns:
        (N,) in units of the actuators' limits; NaN where an argument is NaN.
    """
    s = total(a * u, 1) + b + multiplier * relief
    stationarity = u - (desired + total(a * multiplier[:, None], 0)).clamp(-1.0, 1.0)
    complementarity = multiplier.clamp(max=1.0) * s
    return torch.cat((stationarity.abs(), -s, -multiplier, complementarity.abs())).amax(0)


def with_bounds(a: Tensor, *sides: Tensor) -> list[Tensor]:
    """Returns rows (6 + R, 3, N) and sides (6 + R, N), those of the actuators' limits first."""
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    bounds = torch.cat((eye, -eye))[..., None].expand(-1, -1, a.shape[-1])
    return [torch.cat((bounds, a)), *(torch.cat((b.new_ones(6, b.shape[1]), b)) for b in sides)]


def begin(desired: Tensor, rows: int) -> State:
    """Returns the optimum within the bounds alone; bounds that the desired control (3, N) exceeds are active.

    The multipliers of active bounds are the excess. Steps from u = u_des would lose digits in proportion to the excess.
    """
    within = desired.clamp(-1.0, 1.0)
    inwards = (within - desired).sign()  # the normals of the bounds
    of_bound = torch.arange(3, device=desired.device)[:, None] + torch.where(inwards < 0.0, 3, 0)
    none = torch.zeros_like(of_bound[0])
    return State(
        u=within,
        soft=desired.new_zeros(rows, desired.shape[1], dtype=torch.bool),
        row=torch.where(inwards == 0.0, -1, of_bound),
        multiplier=(within - desired).abs(),
        entering=none,
        pressure=torch.zeros_like(desired[0]),
        outcome=none,
    )


def residual_of(state: State, desired: Tensor, a: Tensor, b: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the controls within the bounds, and `kkt_residual` (N,); weight: zero for rows that must hold."""
    u = state.u.clamp(-1.0, 1.0)
    rows = torch.arange(len(a), device=a.device)[:, None, None]
    of_places = total(torch.where(state.row == rows, state.multiplier, 0.0), 1)
    of_slack = (-weight * (total(a * state.u, 1) + b)).clamp(min=0.0)
    multiplier = of_places + torch.where(state.soft, of_slack, 0.0)
    relief = torch.where(weight > 0.0, 1.0 / weight, 0.0)
    return u, kkt_residual(u, multiplier[6:], desired, a[6:], b[6:], relief[6:])


def step(
    u: Tensor, soft: Tensor, row: Tensor, multiplier: Tensor, entering: Tensor, pressure: Tensor, outcome: Tensor,
    desired: Tensor, a: Tensor, b: Tensor, weight: Tensor,
) -> tuple[State, Tensor]:  # fmt: skip
    """Makes a row active, or makes an active row that blocks its way leave.

    Args:
        u to outcome: a `State`; a: (R, 3, N) rows; b: (R, N); weight: (R, N) of rows that have slack, else zero.

    Returns:
        The next `State`, and (N,) bool, whether the program is not finished.
    """
    places = Places.of(cholesky(torch.where(soft, weight, 0.0), a), a, b, row)

    # Remove rounding errors from the optimum of the active rows.
    lhs = total(a * u, 1) + b
    pushed = total(a * torch.where(soft, -weight * lhs, 0.0)[:, None], 0)
    pushed = pushed + reduce(torch.add, [n * m for n, m in zip(places.normals, multiplier, strict=True)])
    pushed = pushed + take(a, entering) * pressure
    change, more = places.corrected(u - desired - pushed, u)
    u, multiplier = u + change, multiplier + more

    lhs = total(a * u, 1) + b
    rows = torch.arange(len(a), device=a.device)[:, None]
    is_active = soft | (row[:, None] == rows).any(0)
    lowest, most_violated = torch.where(is_active, torch.inf, lhs).min(0)
    entering = torch.where(pressure > 0.0, entering, most_violated)
    normal, own_side, own_weight = take(a, entering), take(b, entering), take(weight, entering)
    relief = torch.where(own_weight > 0.0, 1.0 / own_weight, 0.0)

    # Per unit of the entering row's multiplier, u moves along z, and multipliers fall: by r in places, by `fall` of
    # rows with slack. The normal is the combination r of the normals in places, and a rest; z is H^-1 of this rest.
    rest, along = places.apart(forwards(places.lower, normal))
    r, z, z2 = places.combination(along), backwards(places.lower, rest), total(rest * rest, 0)
    fall = weight * total(a * z, 1)
    z2 = z2 + relief
    is_free = z2 > DEPENDENT * (total(normal * normal, 0) + relief)
    # The step's length until the entering row holds with equality, and until a multiplier is zero; a multiplier that
    # rounding has made negative leaves at once.
    force = -weight * lhs  # multipliers of rows with slack
    below, below_soft = multiplier < -NEGATIVE, soft & (force < -NEGATIVE)
    is_below = below.any(0) | below_soft.any(0)
    full = -(total(normal * u, 0) + own_side + pressure * relief) / z2
    full = torch.where(is_free & ~is_below, full, torch.inf)
    of_places = torch.where(r > BLOCKING, multiplier.clamp(min=0.0) / r, torch.inf)
    of_soft = torch.where(soft & (fall > BLOCKING), force.clamp(min=0.0) / fall, torch.inf)
    of_places, place = torch.where(below, 0.0, of_places).min(0)
    of_soft, soft_row = torch.where(below_soft, 0.0, of_soft).min(0)
    partial = torch.minimum(of_places, of_soft)
    length = torch.minimum(full, partial)

    is_optimal = ~(lowest < -VIOLATED) & ~(pressure > 0.0) & ~is_below
    goes = ~is_optimal & ~length.isinf()
    outcome = torch.where(is_optimal, OPTIMAL, torch.where(length.isinf(), INFEASIBLE, RUNNING))
    length = torch.where(goes, length, 0.0)
    u = u + torch.where(is_free, length, 0.0) * z
    multiplier = multiplier - length * r
    pressure = pressure + length

    enters, leaves = goes & (full <= partial), goes & (full > partial)
    from_place = of_places <= of_soft
    numbers = torch.arange(3, device=a.device)[:, None]
    enters_here = enters & (own_weight == 0.0) & (numbers == row.argmin(0))
    leaves_here = leaves & from_place & (numbers == place)
    soft = soft | (enters & (own_weight > 0.0) & (rows == entering))
    soft = soft & ~(leaves & ~from_place & (rows == soft_row))
    row = torch.where(enters_here, entering, torch.where(leaves_here, -1, row))
    multiplier = torch.where(enters_here, pressure, torch.where(leaves_here, 0.0, multiplier))
    pressure = torch.where(enters, 0.0, pressure)
    return State(u, soft, row, multiplier, entering, pressure, outcome), goes


class Places(NamedTuple):
    """Holds active rows that must hold: L^-1 of their normals, orthonormalised in turn; zero in empty places.

    Attributes:
        lower: L; normals: (3, N) of each place; sides: (N,) of each; basis: (3, N) of each.
        share: for each L^-1 normal, its parts along the basis vectors up to its own.
    """

    lower: Lower
    normals: list[Tensor]
    sides: list[Tensor]
    basis: list[Tensor]
    share: list[list[Tensor]]

    @classmethod
    def of(cls, lower: Lower, a: Tensor, b: Tensor, row: Tensor) -> "Places":
        """Returns the places of rows of a (R, 3, N) and b (R, N) by their indices (3, N)."""
        found = cls(lower, [], [], [], [])
        for index in row.unbind():
            normal, side = (torch.where(index >= 0, take(x, index.clamp(min=0)), 0.0) for x in (a, b))
            rest, along = found.apart(forwards(lower, normal))
            size = total(rest * rest, 0).sqrt()
            found.normals.append(normal)
            found.sides.append(side)
            found.share.append([*along, size])
            found.basis.append(torch.where(size > 0.0, rest / size, 0.0))
        return found

    def apart(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Returns the part of x (3, N) across the basis and the parts along it; two passes for nearly parallel rows."""
        along = [torch.zeros_like(x[0])] * len(self.basis)
        for _ in range(2):
            more = [total(q * x, 0) for q in self.basis]
            for q, m in zip(self.basis, more, strict=True):
                x = x - m * q
            along = [p + m for p, m in zip(along, more, strict=True)]
        return x, along

    def combination(self, along: list[Tensor]) -> Tensor:
        """Returns the multipliers (3, N) of the normals whose sum has the parts `along` the basis."""
        found: list[Tensor] = []
        for k in reversed(range(3)):
            left = along[k] - dot([self.share[i][k] for i in range(2, k, -1)], found, along[k])
            found.append(torch.where(self.share[k][k] > 0.0, left / self.share[k][k], 0.0))
        return torch.stack(found[::-1])

    def corrected(self, off: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the changes of u (3, N) and of multipliers (3, N); off: (3, N) error of stationarity."""
        missed = [total(n * u, 0) + b for n, b in zip(self.normals, self.sides, strict=True)]
        along: list[Tensor] = []
        for k in range(3):
            left = -missed[k] - dot(self.share[k][:k], along, missed[k])
            along.append(torch.where(self.share[k][k] > 0.0, left / self.share[k][k], 0.0))
        across, parts = self.apart(forwards(self.lower, off))
        change = reduce(torch.add, [q * y for q, y in zip(self.basis, along, strict=True)]) - across
        change = backwards(self.lower, change)
        return change, self.combination([y + p for y, p in zip(along, parts, strict=True)])


def cholesky(weight: Tensor, a: Tensor) -> Lower:
    """Returns L of 1 + sum w a a' for weights (R, N) and rows (R, 3, N)."""
    lower: Lower = []
    heavy = weight[:, None] * a
    for i in range(3):
        row: list[Tensor] = []
        for j in range(i + 1):
            h = total(heavy[:, i] * a[:, j], 0) + float(i == j)
            rest = h - dot(row, row if i == j else lower[j], h)
            row.append(rest.sqrt() if i == j else rest / lower[j][j])
        lower.append(row)
    return lower


def forwards(lower: Lower, x: Tensor) -> Tensor:
    """Returns L^-1 x of (3, N)."""
    found: list[Tensor] = []
    for part, row in zip(x, lower, strict=True):
        found.append((part - dot(row, found, part)) / row[-1])
    return torch.stack(found)


def backwards(lower: Lower, x: Tensor) -> Tensor:
    """Returns L'^-1 x of (3, N)."""
    found: list[Tensor] = []
    for i in reversed(range(3)):
        column = [lower[k][i] for k in range(2, i, -1)]
        found.append((x[i] - dot(column, found, x[i])) / lower[i][i])
    return torch.stack(found[::-1])


def dot(one: Sequence[Tensor], other: Sequence[Tensor], like: Tensor) -> Tensor:
    """Returns the sum of products of pairs, up to the shorter length; zero like `like` if there are no pairs."""
    pairs = [x * y for x, y in zip(one, other, strict=False)]
    return reduce(torch.add, pairs) if pairs else torch.zeros_like(like)


def take(rows: Tensor, index: Tensor) -> Tensor:
    """Returns rows[index[n], ..., n] for each n: (R, ..., N) and (N,) to (..., N)."""
    return rows.gather(0, index.expand(1, *rows.shape[1:-1], -1))[0]

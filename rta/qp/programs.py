"""The filter's quadratic programs: what is asked of a solver and what it must answer.

For three controls u in units of their actuators' limits,

    minimise |u - u_des|^2 + sum_i w_i delta_i^2   subject to   A_i u + b_i + delta_i >= 0,  -1 <= u <= 1.

u_des may be beyond the limits, as in the paper: what is nearest to it is not always nearest to what is left of it
within them. What is more than LARGEST_DEMAND times a limit is shortened to that first, see there.

Rows are first held with margins, then without. Where both are infeasible, slack is given by priority: to the rows of
the lowest weight alone, then to those of the next as well, and so on, until some control satisfies the rest. So the
rows of a weight are held wherever they and those above can be; rows that have slack share it by their weights.

Thrust and torque enter disjoint constraints, so the paper's six-variable program is exactly two of these for its rows
without slack. Otherwise not: rows are scaled to unit length, which makes b and delta multiples of the actuators'
limits, so slack is weighted per unit-length row; and sampled rows of thrust take the torque as given.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from typing import Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from kernels.control import pick

Array = TypeVar("Array", Tensor, np.ndarray)

FEASIBLE = 1e-7  # largest row violation of an accepted solution, in units of the actuators' limits
REDUNDANT = 2.0  # |A_i u| <= sqrt(3) inside the box, so a row with b >= 2 can never bind
# A longer demand d is shortened to d', in its direction, so that no digits are lost. The projection u' of d' then gives
# as much along d as any control v that is permitted but for 3 / (4 LARGEST_DEMAND): (d' - u') . (v - u') <= 0, so
# d . (v - u') / |d| <= u' . (v - u') / |d'| <= |v|^2 / (4 |d'|) with |v|^2 <= 3 and |d'| >= LARGEST_DEMAND.
LARGEST_DEMAND = 1e3  # in units of the actuators' limits, of an axis
ENDLESS = 1e30  # N or N m, for infinity, and for all that is beyond
HOPELESS = -100.0  # keeps the slack of a row that no control can satisfy in a range that solvers resolve


class Status(IntEnum):
    """How a control came about, in rising order of trouble."""

    UNTOUCHED = 0  # the desired control is within the actuators' limits and satisfies every row
    HARD = 1  # projected into the limits or corrected, every row satisfied, at worst without its margin
    SLACK = 2  # a row is not satisfied, by its slack: they conflict, or a broken limit asks for more than there is
    UNSOLVED = 3  # no solver call succeeded: the least-violating candidate, zero if rows are not finite


@dataclass(frozen=True)
class Problems:
    """N programs of R rows each, float64, on any device.

    Attributes:
        desired: (3, N), of any size up to LARGEST_DEMAND.
        a: (R, 3, N) rows, of unit length or shorter.
        b: (R, N) with the margins; b_no_margin: (R, N) without, never smaller. Margins are spent before a limit is.
        weight: (R,) slack weights and priorities, infinite for a row that must hold.
    """

    desired: Tensor
    a: Tensor
    b: Tensor
    b_no_margin: Tensor
    weight: Sequence[float]

    def __getitem__(self, columns: Tensor) -> "Problems":
        """The programs at these indices (M,)."""
        desired, a, b, b_no_margin = (
            pick(part, columns) for part in (self.desired, self.a, self.b, self.b_no_margin)
        )
        return Problems(desired, a, b, b_no_margin, self.weight)

    @property
    def finite(self) -> Tensor:
        """(N,) bool: the program holds neither NaN nor infinity, which every sum would show."""
        sums = self.desired.sum(0) + self.a.sum((0, 1)) + self.b.sum(0) + self.b_no_margin.sum(0)
        return sums.isfinite()


@dataclass(frozen=True)
class Solutions:
    """What a solver answers, on the problems' device.

    Attributes:
        control: (3, N) within [-1, 1].
        status: (N,) int64, a `Status`.
        residual: (N,) `kkt_residual` of the program that was solved, infinite where none was.
    """

    control: Tensor
    status: Tensor
    residual: Tensor


def stages(problems: Problems) -> Iterator[tuple[Tensor, Tensor, Status]]:
    """What is tried in turn, until it is feasible: sides b (R, N), slack weights (R,) and what a solution is then."""
    hard = problems.desired.new_full((len(problems.weight),), torch.inf)
    weight = problems.desired.new_tensor(problems.weight)
    yield problems.b, hard, Status.HARD
    yield problems.b_no_margin, hard, Status.HARD
    for highest in weight[weight.isfinite()].unique():  # in ascending order
        yield problems.b_no_margin, torch.where(weight <= highest, weight, hard), Status.SLACK


class Solver(Protocol):
    """Solves `Problems` by `stages`."""

    def solve(self, problems: Problems, wanted: Tensor | None = None) -> Solutions:
        """Solves programs where they are wanted, (N,) bool, None: all; of the others nothing is said."""
        ...


def total(x: Tensor, dim: int) -> Tensor:
    """The sum over a short dimension, added up in order: Tensor.sum may round otherwise in another batch."""
    return reduce(torch.add, x.unbind(dim))


def least_violating(candidates: Sequence[Tensor], problems: Problems) -> Tensor:
    """Returns (3, N), the last resort: of candidate controls the first that violates the rows without margin least.

    Rows that must hold decide first, by the sum of d_i^2; then the others, by that of w_i d_i^2, their slack's cost.
    """
    weight = problems.desired.new_tensor(problems.weight)
    must = weight.isinf()
    weight = weight.masked_fill(must, 0.0)[:, None]
    best = torch.zeros_like(problems.desired)
    least, least_soft = torch.full_like(best[:2], torch.inf)
    for control in candidates:
        u = control.clamp(-1.0, 1.0)
        short = (-total(problems.a * u, 1) - problems.b_no_margin).clamp(min=0.0) ** 2
        hard, soft = total(short * must[:, None], 0), total(short * weight, 0)
        better = (hard < least) | ((hard == least) & (soft < least_soft))
        best = torch.where(better, u, best)
        least, least_soft = torch.where(better, hard, least), torch.where(better, soft, least_soft)
    return best


def kkt_residual(u: Array, multiplier: Array, desired: Array, a: Array, b: Array, relief: Array) -> Array:
    """The largest violation of the optimality conditions of min |u - u_des|^2 / 2 + sum_i w_i delta_i^2 / 2.

    With multipliers lambda of the rows, delta_i = lambda_i / w_i and s_i = A_i u + b_i + delta_i, they are

        stationarity       u = clip(u_des + sum_i lambda_i A_i, -1, 1), the bounds' multipliers eliminated
        primal             s_i >= 0
        dual               lambda_i >= 0
        complementarity    min(lambda_i, 1) s_i = 0, since rounding of s_i times a large lambda_i says little

    Args:
        u, desired: (3, N); multiplier, b: (R, N); a: (R, 3, N). All NumPy's, or all PyTorch's.
        relief: (R, 1) or (R, N), 1 / w_i, zero for rows without slack.

    Returns:
        (N,) in units of the actuators' limits; NaN where an argument is.
    """
    xp = torch if isinstance(u, Tensor) else np
    s = sum((a * u).swapaxes(0, 1)) + b + multiplier * relief
    stationarity = u - (desired + sum(a * multiplier[:, None])).clip(-1.0, 1.0)
    complementarity = multiplier.clip(max=1.0) * s
    return xp.amax(xp.concatenate((abs(stationarity), -s, -multiplier, abs(complementarity))), 0)

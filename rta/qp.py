"""The filter's quadratic programs: what is asked of a solver and what it must answer.

For three controls u in units of their actuators' limits,

    minimise |u - u_des|^2 + sum_i w_i delta_i^2   subject to   A_i u + b_i + delta_i >= 0,  -1 <= u <= 1.

Thrust and torque enter disjoint constraints, so the paper's six-variable program is exactly two of these.
Rows are scaled to unit length, which makes b and delta multiples of the actuators' limits.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np

FEASIBLE = 1e-7  # largest row violation of an accepted solution, in units of the actuators' limits
REDUNDANT = 2.0  # |A_i u| <= sqrt(3) inside the box, so a row with b >= 2 can never bind
HOPELESS = -100.0  # keeps the slack of a row that no control can satisfy in a range that solvers resolve


class Status(IntEnum):
    """How a control came about, in rising order of trouble."""

    UNTOUCHED = 0  # the desired control satisfies every row
    HARD = 1  # corrected, every row satisfied, at worst without its margin
    SLACK = 2  # no control satisfies every row: the weighted slack decided
    UNSOLVED = 3  # no solver call succeeded: the least-violating control known, zero if rows are not finite


@dataclass(frozen=True)
class Problems:
    """N programs of R rows each, float64.

    Attributes:
        desired: (N, 3) within [-1, 1].
        a: (N, R, 3) rows, of unit length or shorter.
        b: (N, R) with the margins; b_bare: (N, R) without, never smaller. Margins are spent before a limit is.
        weight: (R,) slack weights, infinite for a row that must hold.
    """

    desired: np.ndarray
    a: np.ndarray
    b: np.ndarray
    b_bare: np.ndarray
    weight: np.ndarray


class Solver(Protocol):
    """Solves `Problems`: returns controls (N, 3) within [-1, 1] and statuses (N,) int64."""

    def solve(self, problems: Problems) -> tuple[np.ndarray, np.ndarray]: ...


def residual(u: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a u + b: (..., 3), (..., R, 3), (..., R) to (..., R); negative where a row is violated."""
    return (a @ u[..., None])[..., 0] + b


def least_violating(
    candidates: list[np.ndarray], a: np.ndarray, b: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """The candidate (3,) with the smallest weighted violation; rows that must hold decide first."""
    clipped = [np.clip(u, -1.0, 1.0) for u in candidates if np.isfinite(u).all()]
    must = np.isinf(weight)

    def violation(u: np.ndarray) -> tuple[float, float]:
        short = np.maximum(0.0, -residual(u, a, b))
        return float((short[must] ** 2).sum()), float((weight[~must] * short[~must] ** 2).sum())

    return min(clipped, key=violation)

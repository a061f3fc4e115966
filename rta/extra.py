"""Constraints of your own beside the paper's 13, and their barrier conditions a u + b >= 0."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.attitude import unit
from inspection.dynamics import control_matrix, drift
from inspection.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, P, Q
from rta.lie_derivatives import Function, high_order, lie_derivatives
from rta.rows import Barriers, Row, Rows

ACTUATORS = {"thrust": THRUST, "torque": TORQUE}


@dataclass(frozen=True)
class Constraint:
    """h(x) >= 0, to be held by one actuator group.

    Attributes:
        name: in results, after the paper's 13.
        h: states (16, ...) to (...), of operations that PyTorch differentiates forward.
        held_by: "thrust" or "torque".
        gains: class-kappa gains in 1/s: one where these controls change dh/dt (relative degree one), two where
            they change its derivative (HOCBF: Psi_1 = dh/dt + k1 h and dPsi_1/dt + k2 Psi_1 >= 0).
        margin: subtracted from h, in its unit, for what h loses within one period beyond its linear prediction.
        weight: of its slack and so its priority in a conflict, see `rta.qp`; infinite where it must hold, None for the
            filter's own `slack_weight_critical`.
    """

    name: str
    h: Function
    held_by: str
    gains: tuple[float, ...]
    margin: float = 0.0
    weight: float | None = None

    def __post_init__(self) -> None:
        if self.held_by not in ACTUATORS:
            raise ValueError(f"{self.name}: held_by = {self.held_by!r}: must be {' or '.join(ACTUATORS)}")
        if len(self.gains) not in (1, 2) or not all(0 < gain < math.inf for gain in self.gains):
            raise ValueError(f"{self.name}: gains = {self.gains!r}: must be one or two positive numbers, 1/s")
        if not 0 <= self.margin < math.inf or not (self.weight is None or self.weight > 0):
            raise ValueError(f"{self.name}: margin must be finite and not negative, weight positive")


def check_values(each: Constraint, x: Tensor) -> None:
    """Raises ValueError where h of states (16, B), or with an axis of directions between, is not as it must be."""
    h = each.h(x)
    if not h.isfinite().all():
        raise ValueError(
            f"{each.name}: h is not finite: must be at every state, beyond other constraints too"
        )
    if h.shape != x.shape[1:]:
        raise ValueError(f"{each.name}: h of states (16, B) has shape {tuple(h.shape)}: must be (B,)")
    directions = 1 + CONTROL_SIZE  # the middle axis of `lie_derivatives`
    wide = x[:, None].expand(-1, directions, -1)
    try:
        fits = each.h(wide).shape == wide.shape[1:]
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"{each.name}: h of states (16, {directions}, B) must have shape ({directions}, B): "
            "constants in h must broadcast over all trailing axes"
        )


class ExtraBarriers:
    """Builds the rows of the constraints that one actuator group holds.

    Thrust and torque have programs of their own, so the controls of the other group are taken to do their worst: what
    they can take off dpsi/dt, the sum of |L_g psi| times their limits, is taken off b.

    Args:
        constraints: all of them; those that another group holds are left out.
        held_by: a key of ACTUATORS; barriers: of the same filter.

    Attributes:
        rows: what is fixed about each row, one per constraint.

    Raises:
        ValueError: an h or its derivative is not finite, h has the wrong shape or does not broadcast over several
            trailing axes, or its relative degree is other than its number of gains.
    """

    def __init__(self, constraints: Sequence[Constraint], held_by: str, barriers: Barriers) -> None:
        self.held_by, self.barriers = held_by, barriers
        self.constraints = [each for each in constraints if each.held_by == held_by]
        self.rows = [self.row(each) for each in self.constraints]
        if self.constraints:
            self.check()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the group's constraints."""
        return tuple(each.name for each in self.constraints)

    def gain(self, value: float) -> float:
        """The gain in 1/s as used at the filter's period."""
        return self.barriers.r.gain(value, self.barriers.period)

    def row(self, each: Constraint) -> Row:
        """What is fixed about a constraint's row: the last gain, the margin, which Psi_1 holds already, the weight."""
        *first, last = map(self.gain, each.gains)
        weight = self.barriers.r.slack_weight_critical if each.weight is None else each.weight
        if first:
            return Row(each.name, last, 0.0, weight, lead=first[0] * each.margin)
        return Row(each.name, last, each.margin, weight)

    def values(self, x: Tensor) -> Tensor:
        """h, states (16, ...) to (constraints, ...)."""
        return torch.cat([x[:0], *(each.h(x)[None] for each in self.constraints)])

    def psi_of(self, each: Constraint) -> Function:
        """h, or Psi_1 = dh/dt + k1 (h - margin) where the relative degree is two."""
        if len(each.gains) == 1:
            return each.h
        k1 = self.gain(each.gains[0])
        return high_order(each.h, lambda h: k1 * (h - each.margin), lambda y: drift(y, self.barriers.c))

    def psi(self, x: Tensor) -> Tensor:
        """`psi_of` all, states (16, ...) to (constraints, ...)."""
        return torch.cat([x[:0], *(self.psi_of(each)(x)[None] for each in self.constraints)])

    def along_flow(self, h: Function, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`lie_derivatives` along f and all six controls."""
        c = self.barriers.c
        return lie_derivatives(h, x, drift(x, c), control_matrix(self.barriers.half_a_period_ahead(x), c))

    def __call__(self, x: Tensor) -> Rows:
        """The conditions on the group's controls at states (16, B)."""
        psi, lf, lg = self.along_flow(self.psi, x)
        limit = x.new_tensor(self.barriers.c.control_limit)[:, None]
        own = ACTUATORS[self.held_by]
        most = lg.abs() * limit
        worst = most.sum(1) - most[:, own].sum(1)
        return self.barriers.condition(self.rows, self.values(x), psi, lf, lg[:, own], worst)

    def is_safe(self, x: Tensor) -> Tensor:
        """(B,) bool: every h and every Psi_1 is non-negative."""
        return (self.values(x) >= 0.0).all(0) & (self.psi(x) >= 0.0).all(0)

    def check(self) -> None:
        """Compares each h's shape and relative degree at some states with what was given."""
        generator = torch.Generator().manual_seed(0)
        x = torch.randn(SIZE, 64, generator=generator, dtype=torch.float64)
        x[P], x[Q] = 100.0 * x[P], unit(x[Q])
        for each in self.constraints:
            check_values(each, x)
        _, _, first = self.along_flow(self.values, x)
        _, _, last = self.along_flow(self.psi, x)
        for each, at_once, at_last in zip(self.constraints, first, last, strict=True):
            if not (at_once.isfinite() & at_last.isfinite()).all():
                raise ValueError(f"{each.name}: a derivative of h is not finite: must be at every state")
            too_many = len(each.gains) == 2 and (at_once != 0.0).any()
            if too_many or not (at_last[ACTUATORS[self.held_by]] != 0.0).any():
                raise ValueError(
                    f"{each.name}: gains = {each.gains!r}: "
                    f"{self.held_by} does not first enter derivative {len(each.gains)} of h"
                )

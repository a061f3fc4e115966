"""What the filter must know of a constraint h(x) >= 0: one entry, of the paper's 13 and of your own alike."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE, THRUST, TORQUE
from rta.constraints.names import ATTITUDE, TRANSLATIONAL
from rta.lie_derivatives import Function

ACTUATORS = {"thrust": THRUST, "torque": TORQUE}


@dataclass(frozen=True)
class Constraint:
    """h(x) >= 0, to be enforced by one actuator group; functions are written for one spacecraft, (16, ...) to (...).

    Attributes:
        name: in results.
        h: what is reported, without margin, of operations that PyTorch differentiates forward.
        actuator: "thrust" or "torque", which enforces it.
        gains: class-kappa gains in 1/s: one where these controls change dh/dt (relative degree one), two where
            they change its derivative (HOCBF: Psi_1 = dh/dt + k1 h and dPsi_1/dt + k2 Psi_1 >= 0).
        margin: subtracted from h, in its unit.
        weight: of its slack and so its priority in a conflict, see `rta.qp.programs`; infinite where it must hold, None
            for the filter's own `slack_weight_critical`.
        barrier: what is enforced in h's place, where that differs: maps states (16, B) to the function of states
            (16, ...) to (rows, ...) that is differentiated there.
        rows: how many rows the barrier has.
        intersample_drop: how far Psi (Psi_1 where the relative degree is two, else the barrier) can fall within one
            period below its linear prediction, over the period: half the period times the largest second derivative. A
            number or a function of states. Without it a state on the boundary could leave the safe set in one period.
        doubling: the Psi at which the gain has doubled, gain * (1 + (Psi / doubling)^2): alpha is then an odd cubic,
            until the gain reaches 0.5 / period.
        coupled: the other group's controls change it, too; they are then taken to do their worst.
        recovery: at relative degree two, how fast h is to rise at most on its way back from beyond the limit, in its
            unit per s; None where the gains may ask for anything.
        looks_ahead: `barrier` is also given by how many s the states are into a hold, to look at the same moments.
        exact: the smallest of the barrier's rows is h itself.
        axis: of the one actuator of the group that changes it, so that its row is a bound of that actuator; None for
            all others.
    """

    name: str
    h: Function
    actuator: str
    gains: tuple[float, ...]
    margin: float = 0.0
    weight: float | None = None
    barrier: Callable[..., Function] | None = None
    rows: int = 1
    intersample_drop: float | Function = 0.0
    doubling: float = math.inf
    coupled: bool = True
    recovery: float | None = None
    looks_ahead: bool = False
    exact: bool = False
    axis: int | None = None

    def __post_init__(self) -> None:
        if self.actuator not in ACTUATORS:
            raise ValueError(f"{self.name}: actuator = {self.actuator!r}: must be {' or '.join(ACTUATORS)}")
        if not callable(self.h):
            raise ValueError(f"{self.name}: h = {self.h!r}: must be a function of states (16, ...) to (...)")
        if (
            not isinstance(self.gains, tuple | list)
            or len(self.gains) not in (1, 2)
            or not all(isinstance(gain, Real) and 0 < gain < math.inf for gain in self.gains)
        ):
            raise ValueError(
                f"{self.name}: gains = {self.gains!r}: must be a tuple of one or two positive numbers, 1/s: (0.2,)"
            )
        if not isinstance(self.margin, Real) or not 0 <= self.margin < math.inf:
            raise ValueError(f"{self.name}: margin = {self.margin!r}: must be a finite number, not negative")
        if self.weight is not None and not (isinstance(self.weight, Real) and self.weight > 0):
            raise ValueError(f"{self.name}: weight = {self.weight!r}: must be a positive number or None")

    @property
    def degree(self) -> int:
        """The relative degree."""
        return len(self.gains)

    def barrier_at(self, x: Tensor, after: float = 0.0) -> Function:
        """What is differentiated at states (16, B), so many s into a hold: (16, ...) to (rows, ...)."""
        if self.barrier is None:
            return lambda y: self.h(y)[None]
        return self.barrier(x, after) if self.looks_ahead else self.barrier(x)

    def intersample_drop_at(self, x: Tensor) -> Tensor:
        """`intersample_drop` at states (16, B): (B,)."""
        drop = self.intersample_drop
        return drop(x) if callable(drop) else x.new_full(x.shape[1:], drop)


def in_order(thrust: Sequence[Any], torque: Sequence[Any]) -> tuple[Any, ...]:
    """Joins what is known of each constraint of both groups in the order of the filter's names."""
    m, n = len(TRANSLATIONAL), len(ATTITUDE)
    return (*thrust[:m], *torque[:n], *thrust[m:], *torque[n:])


def joined(thrust: Tensor, torque: Tensor) -> Tensor:
    """`in_order` of tensors (k, B) and (m, B)."""
    return torch.cat(in_order(thrust.split(1), torque.split(1)))


def check(each: Constraint, x: Tensor) -> None:
    """Raises ValueError where h of states (16, B), or with an axis of directions between, is not as it must be."""
    h = value(each, x)
    if not torch.is_tensor(h):
        raise ValueError(f"{each.name}: h is of type {type(h).__name__}: must be a tensor")
    if h.shape != x.shape[1:]:
        raise ValueError(f"{each.name}: h of states (16, B) has shape {tuple(h.shape)}: must be (B,)")
    if not h.isfinite().all():
        raise ValueError(
            f"{each.name}: h is not finite: must be at every state, beyond other constraints too"
        )
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


def value(each: Constraint, x: Tensor) -> Any:
    """h of states (16, B), whatever it is; raises ValueError where h itself raises what a wrong shape or type does."""
    try:
        return each.h(x)
    except (RuntimeError, IndexError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{each.name}: h of states (16, B) in float64 cannot be computed: {reason}; must be a tensor (B,)"
        ) from error

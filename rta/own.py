"""Limits of your own, entries like the paper's (docs/guides/your_own_constraint.md), and the checks of such entries."""

import math
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from inspection.model.attitude import unit
from inspection.model.dynamics import control_matrix, drift
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, P, Q
from rta.lie_derivatives import lie_derivatives
from rta.limits import Limit
from rta.paper import hocbf

OWN: dict[str, Limit] = {}  # every command flies with these limits; `rta.names.OWN` has their names


def some_states() -> Tensor:
    """Returns random states (16, 64) of a spacecraft, to try limits with."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(SIZE, 64, generator=generator, dtype=torch.float64)
    x[P], x[Q] = 100.0 * x[P], unit(x[Q])
    return x


def influence(limit: Limit, c: Limits) -> tuple[float, float]:
    """Returns by how much full thrust, and full torque, change a limit's condition, in h's unit per s (or s^2)."""
    x = some_states()
    psi = hocbf(limit, c)
    _, _, slopes = lie_derivatives(lambda y: psi(y)[None], x, drift(x, c), control_matrix(x, c))
    most = (slopes.abs() * x.new_tensor(c.control_limit)[:, None]).sum(-1)[0]
    return most[THRUST].sum().item(), most[TORQUE].sum().item()


def check(name: str, limit: Any, c: Limits) -> None:
    """Raises ValueError if a limit is malformed, with the reason.

    h must accept states (16, B), and states with an axis of directions before the batch. PyTorch must be able to
    differentiate its operations forward. A control must first enter the derivative of h that the number of gains says.
    """
    if not isinstance(limit, Limit):
        raise ValueError(f"{name}: must be a Limit(h, gains, weight), not {type(limit).__name__}")
    if not callable(limit.h):
        raise ValueError(
            f"{name}: h = {limit.h!r}: must be a function of states (16, ...) and constants to (...)"
        )
    gains = limit.gains
    if (
        not isinstance(gains, tuple | list)
        or len(gains) not in (1, 2)
        or not all(isinstance(gain, Real) and 0 < gain < math.inf for gain in gains)
    ):
        raise ValueError(
            f"{name}: gains = {gains!r}: must be a tuple of one or two positive numbers, 1/s: (0.2,)"
        )
    if limit.weight is not None and not (isinstance(limit.weight, Real) and 0 < limit.weight < math.inf):
        raise ValueError(f"{name}: weight = {limit.weight!r}: must be a positive number or None")
    x = some_states()
    check_value(name, limit, x, c)
    f, g = drift(x, c), control_matrix(x, c)
    last = hocbf(limit, c)
    _, _, at_once = lie_derivatives(lambda y: limit.h(y, c)[None], x, f, g)
    _, _, at_last = lie_derivatives(lambda y: last(y)[None], x, f, g)
    if not (at_once.isfinite().all() and at_last.isfinite().all()):
        raise ValueError(f"{name}: a derivative of h is not finite: must be at every state")
    if (len(gains) == 2 and (at_once != 0.0).any()) or not (at_last != 0.0).any():
        raise ValueError(f"{name}: gains = {gains!r}: no control first enters derivative {len(gains)} of h")


def check_value(name: str, limit: Limit, x: Tensor, c: Limits) -> None:
    """Raises ValueError if h of states (16, B) is no tensor (B,) of finite numbers."""
    try:
        h: Any = limit.h(x, c)
    except (RuntimeError, IndexError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"{name}: h of states (16, B) in float64 cannot be computed: {reason}; must be a tensor (B,)"
        ) from error
    if not torch.is_tensor(h):
        raise ValueError(f"{name}: h is of type {type(h).__name__}: must be a tensor")
    if h.shape != x.shape[1:]:
        raise ValueError(f"{name}: h of states (16, B) has shape {tuple(h.shape)}: must be (B,)")
    if not h.isfinite().all():
        raise ValueError(f"{name}: h is not finite: must be at every state, beyond other constraints too")
    directions = 1 + CONTROL_SIZE  # the middle axis of `lie_derivatives`
    wide = x[:, None].expand(-1, directions, -1)
    try:
        fits = limit.h(wide, c).shape == wide.shape[1:]
    except RuntimeError:
        fits = False
    if not fits:
        raise ValueError(
            f"{name}: h of states (16, {directions}, B) must have shape ({directions}, B): "
            "constants in h must broadcast over all trailing axes"
        )

"""Validation of the filter's input, as a float64 batch, and conversion of answers to the kind of the input."""

import math
import warnings
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, SIZE, Q, T
from inspection.model.state_checks import OFF_UNIT, unit_warnings
from rta.result import FilterResult

# How far a quaternion's length may be from 1: float32 resolves 1e-7, and a state estimate in float32 drifts by more.
UNIT = {torch.float32: OFF_UNIT}
UNIT_ELSE = 1e-6
ROUNDED = 1e-12  # how far a quaternion's length in double precision may be from 1 without being normalised
INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


class FilterInput:
    """Holds a state and a desired control, validated.

    Args:
        c: the task's constants.

    Attributes:
        x: states (16, B), float64; desired: controls (6, B), float64, both on the desired control's device.
        single: whether they are one spacecraft's.

    Raises:
        ValueError: see `SafetyFilter.__call__`.
    """

    def __init__(self, x: Any, desired: Any, c: Limits) -> None:
        state, control = numbers("state", x), numbers("desired control", desired)
        check_shape("state", state, SIZE)
        check_shape("desired control", control, CONTROL_SIZE)
        if state.shape[1:] != control.shape[1:]:
            raise ValueError(
                f"state of shape {tuple(state.shape)} with desired control of shape {tuple(control.shape)}: "
                "must be of equally many spacecraft"
            )
        self.c = c
        self.single = control.ndim == 1
        self.tensors = torch.is_tensor(desired)
        self.dtype = control.dtype if control.dtype == torch.float32 else torch.float64
        self.x, self.desired = (
            part.to(control.device, torch.float64).view(len(part), -1) for part in (state, control)
        )
        for name, part in (("state", self.x), ("desired control", self.desired)):
            if not math.isfinite(part.sum()) and not part.isfinite().all():
                raise ValueError(f"{name} holds NaN or infinity: must be finite")
        coldest, least = self.x[T].amin().item(), -c.zero_celsius
        if coldest <= least:
            raise ValueError(
                f"temperature {coldest:g} deg C (component {T} of the state): must be above {least:g} deg C"
            )
        length, tolerance = norm(self.x[Q]), UNIT.get(state.dtype, UNIT_ELSE)
        off = (length - 1.0).abs()
        farthest = off.max().item()
        if farthest > tolerance:
            wrong = torch.nonzero(off > tolerance).flatten()
            where = "" if self.single else f" in column {wrong[0].item()}"
            raise ValueError(
                f"quaternion (components 6 to 9 of the state){where}: must have length 1 to {tolerance:g}, "
                f"has {length[wrong[0]].item():.9g}"
            )
        if farthest > ROUNDED:  # another length would be read as another angle to the Sun
            self.x = self.x.clone()
            self.x[Q] = torch.where(off > ROUNDED, self.x[Q] / length, self.x[Q])

    def warn(self) -> None:
        """Warns, at the line that called the filter, of a state that seems to be in other units."""
        for warning in unit_warnings(self.x, self.c):
            warnings.warn(f"state: {warning}", stacklevel=4)  # one level is a decorator's

    def answer(self, result: FilterResult) -> FilterResult:
        """Converts the filter's answer to the kind of the desired control."""
        return FilterResult(*(self.in_kind(getattr(result, field.name)) for field in fields(result)))

    def in_kind(self, part: Tensor) -> Any:
        """Converts a field (..., B) of the filter's answer to the kind of the desired control."""
        if part.dtype != self.dtype and part.is_floating_point():
            # towards zero: rounding to nearest could exceed the actuators' limits
            near = part.to(self.dtype)
            beyond = near.double().abs() > part.abs()
            part = torch.where(beyond, torch.nextafter(near, torch.zeros_like(near)), near)
        kind = part if self.tensors else part.numpy()
        return kind[..., 0][()] if self.single else kind


def numbers(name: str, given: Any) -> Tensor:
    """Returns the input as a tensor of float64, float32 or integers."""
    if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
        raise ValueError(f"{name} holds masked numbers: must be known")
    if not torch.is_tensor(given):
        try:
            array = np.asarray(given)
            if array.dtype.kind not in "fiu":
                raise TypeError
            # PyTorch does not support every integer type, nor other byte orders
            dtype = np.float64 if array.dtype.kind in "iu" else array.dtype.newbyteorder("=")
            given = torch.from_numpy(np.array(array, dtype, order="C"))  # a copy: tensors are writable
        except (TypeError, ValueError):
            if isinstance(given, np.ndarray):
                raise wrong_type(name, given) from None
            raise ValueError(
                f"{name}: must be a NumPy array, a PyTorch tensor or a list of numbers"
            ) from None
    if given.dtype not in (torch.float64, torch.float32, *INTEGERS):
        raise wrong_type(name, given)
    if given.layout != torch.strided:
        raise ValueError(f"{name} of layout {given.layout}: must be dense")
    return given.detach()


def wrong_type(name: str, given: Any) -> ValueError:
    return ValueError(f"{name} of type {given.dtype}: must be float64, float32 or integers")


def check_shape(name: str, part: Tensor, size: int) -> None:
    """Raises ValueError for all shapes but (size,) and (size, B)."""
    if part.ndim in (1, 2) and len(part) == size and part.numel():
        return
    transpose = part.ndim == 2 and part.shape[1] == size
    raise ValueError(
        f"{name} of shape {tuple(part.shape)}: must be ({size},), or ({size}, B) for a batch, components first"
        + (": transpose it" if transpose else "")
    )

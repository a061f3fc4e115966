"""Recorded functions: their arguments, results, expressions, and the functions that they call."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from numpy import ndarray
from torch import Tensor

from kernels.operations.expressions import MASK, NUMBER, Program

LETTER = {NUMBER: "V", MASK: "M"}  # types of values in C
TYPES = {
    torch.float64: "double",
    torch.float32: "float",
    torch.bool: "bool",
    torch.int64: "long",
}  # in memory


@dataclass(frozen=True)
class Part:
    """Describes an argument or a result of a printed function.

    Attributes:
        name: in C; shape: per column; kind: "double", "float", "bool" or "long" in memory.
    """

    name: str
    shape: tuple[int, ...]
    kind: str

    @property
    def size(self) -> int:
        """Returns the number of components."""
        return math.prod(self.shape)

    @property
    def values(self) -> str:
        """Returns MASK for truth values, else NUMBER."""
        return MASK if self.kind == "bool" else NUMBER

    def array(self, start: str = "") -> str:
        """Returns the declaration of an array of vectors in C; start: of its name."""
        return f"{LETTER[self.values]} {start}{self.name}[{self.size}]"


@dataclass(frozen=True)
class Recorded:
    """Holds a recorded function.

    Attributes:
        name: in C; about: the first line of its docstring.
        inputs, outputs: its arguments and results in their order; values: of each result, see `kernels.recorder`.
        long: length of the axis that is looped over, see `kernels.printer.printed`.
        dtypes: of the results; like: turns a list of tensors into what the function returns.
    """

    name: str
    about: str
    program: Program
    inputs: list[Part]
    outputs: list[Part]
    values: list[ndarray]
    long: int
    dtypes: list[torch.dtype]
    like: Callable[[list[Tensor]], Any]


@dataclass
class Called:
    """Holds all functions that a printed function calls, each recorded once.

    Args:
        real: the type of their numbers, "double" or "float".
        single: they are printed for one column, so they receive no mask of columns.

    Attributes:
        names: of functions in C, also of those that are being recorded.
        by_key: recordings by the key of `kernels.calls.one`; by_name: the same, functions before their callers.
        kept: objects whose id() is in a key, kept so that no other object gets the id.
        is_double: whether one of them computed float64.
    """

    real: str
    single: bool
    names: set[str] = field(default_factory=set)
    by_key: dict[tuple[Any, ...], Recorded] = field(default_factory=dict)
    by_name: dict[str, Recorded] = field(default_factory=dict)
    kept: list[Any] = field(default_factory=list)
    is_double: bool = False

    def free(self, name: str) -> str:
        """Reserves the name for a function, or the name with a number if it is taken."""
        names = (name, *(f"{name}_{i}" for i in range(2, len(self.names) + 3)))
        found = next(each for each in names if each not in self.names)
        self.names.add(found)
        return found


def part_of(name: str, column: Tensor) -> Part:
    """Returns the part that describes a tensor (..., 1) as an argument or a result."""
    if not column.dim() or column.shape[-1] != 1:
        raise NotImplementedError(
            f"{name} of shape {tuple(column.shape)} has no columns and cannot be printed as C"
        )
    if column.dtype not in TYPES:
        raise NotImplementedError(f"{name} of {column.dtype} cannot be printed as C")
    return Part(name, tuple(column.shape[:-1]), TYPES[column.dtype])


def element(part: Part, place: tuple[int, ...], shape: Sequence[int]) -> str:
    """Returns a component of an argument in C; along the long axis, shorter in `shape`, by the loop's index."""
    strides = [math.prod(part.shape[i + 1 :]) for i in range(len(part.shape))]
    axes = list(zip(place, strides, shape, part.shape, strict=True))
    at = sum(i * stride * (whole // short) for i, stride, short, whole in axes)
    long = [stride for _, stride, short, whole in axes if short != whole]
    return f"{part.name}[{at} + {long[0]} * i]" if long else f"{part.name}[{at}]"

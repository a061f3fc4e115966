"""A function of tensors printed as C: one line per scalar operation, for vectors of columns or for a single one.

A printed function takes and fills arrays of V, component first, and nothing else: V is a number, or a vector of the
compiler's with one column per lane. What is printed does not depend on which; `vector.h` and `scalar.h` say what V is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kernels.modes import in_full_precision
from kernels.operations.expressions import Program
from kernels.recorder import Recorder, evaluated
from kernels.text import TYPES, Body, Part

LEAST_LONG = 64  # an axis of less may be as long as another one


@dataclass(frozen=True)
class Printed:
    """A function as C.

    Attributes:
        name: in C; inputs, outputs: its arguments in their order, those without components left out.
        real: the type of its numbers; statements: how many it has.
        text: of the function.
        shapes, dtypes: of all results; given: shapes of all arguments, also of those without components.
    """

    name: str
    inputs: list[Part]
    outputs: list[Part]
    real: str
    statements: int
    text: str
    shapes: list[torch.Size]
    given: list[torch.Size]
    dtypes: list[torch.dtype]


@in_full_precision
def printed(
    function: Callable[..., Sequence[Tensor]],
    *examples: Tensor,
    name: str = "run",
    long: int = 0,
    names: tuple[Sequence[str], Sequence[str]] | None = None,
) -> Printed:
    """A function of tensors (..., B), whose columns are independent, as C for one column or a vector of them.

    It computes in single precision if neither an argument nor anything that is computed is of double precision.

    Args:
        function: without control flow that depends on values.
        examples: arguments of one column.
        name: in C.
        long: length of an axis that is looped over instead of written out, as of a table of points; 0: none is.
            The length of another axis must be no multiple of it.
        names: of arguments and results in C; None: x0, x1, ... and y0, y1, ...

    Raises:
        NotImplementedError: an operation of it cannot be printed; names it, and the line that wants it.
    """
    given, found = names or ([f"x{i}" for i in range(len(examples))], None)
    inputs = [part_of(n, x) for n, x in zip(given, examples, strict=True)]
    real = "float" if {"float"} <= {part.kind for part in inputs} <= {"float", "bool"} else "double"
    recorder = Recorder(Program(real), long)
    results, values = evaluated(function, examples, inputs, recorder)
    if real == "float" and recorder.is_double:
        recorder = Recorder(Program("double"), long)
        results, values = evaluated(function, examples, inputs, recorder)
    found = found or [f"y{i}" for i in range(len(results))]
    outputs = [part_of(n, y) for n, y in zip(found, results, strict=True)]
    body = Body(recorder.program, long)
    for part, array in zip(outputs, values, strict=True):
        body.returns(part, array)
    some, others = ([part for part in parts if part.size] for parts in (inputs, outputs))
    text, count = body.text(name, some, others)
    return Printed(
        name,
        some,
        others,
        recorder.program.real,
        count,
        text,
        [y.shape[:-1] for y in results],
        [x.shape[:-1] for x in examples],
        [y.dtype for y in results],
    )


def if_long(length: int) -> int:
    """`long` of `printed` for an axis of any length: 0 where another one may be as long, so that it is written out."""
    return length if length >= LEAST_LONG else 0


def part_of(name: str, column: Tensor) -> Part:
    """A tensor (..., 1) as an argument or a result."""
    if not column.dim() or column.shape[-1] != 1:
        raise NotImplementedError(
            f"{name} of shape {tuple(column.shape)} has no columns and cannot be printed as C"
        )
    if column.dtype not in TYPES:
        raise NotImplementedError(f"{name} of {column.dtype} cannot be printed as C")
    return Part(name, tuple(column.shape[:-1]), TYPES[column.dtype])

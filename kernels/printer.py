"""Functions of tensors printed as C: one line per scalar operation, for vectors of columns or for a single column.

A printed function reads and fills arrays of V, component first, and nothing else. V is a number, or a vector of the
compiler with one column per lane. The printed text is the same for both; `vector.h` and `scalar.h` define V. Only calls
and loops differ (`columns`): for vectors they pass a mask of the columns that need them.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kernels.calls import recorded
from kernels.parts import Part
from kernels.text import Body
from kernels.waiting import waiting
from precision import in_full_precision

CALL = re.compile(r"^ +(\w+)\(", re.MULTILINE)  # a statement of C


@dataclass(frozen=True)
class Printed:
    """Holds a function as C.

    Attributes:
        name: in C; inputs, outputs: its arguments in their order, without those that have no components.
        real: the type of its numbers; text: of the function.
        shapes, dtypes: of all results; given: shapes of all arguments, also of those without components.
        is_told: whether its first argument in C is the mask `on`.
        parts: the functions that it calls, each after those that it calls itself.
        waiting: code that computes a batch instead, if loops wait, see `kernels.waiting`; "": none does.
    """

    name: str
    inputs: list[Part]
    outputs: list[Part]
    real: str
    text: str
    shapes: list[torch.Size]
    given: list[torch.Size]
    dtypes: list[torch.dtype]
    is_told: bool
    parts: list[str]
    waiting: str


@in_full_precision
def printed(
    function: Callable[..., Sequence[Tensor]],
    *examples: Tensor,
    name: str = "run",
    long: int = 0,
    names: tuple[Sequence[str], Sequence[str]] | None = None,
    single: bool = False,
) -> Printed:
    """Prints a function of tensors (..., B) with independent columns as C, for one column or a vector of columns.

    It computes in single precision if no argument and no intermediate result is of double precision.

    Args:
        function: without control flow that depends on values.
        examples: arguments of one column.
        name: in C.
        long: length of an axis that is looped over instead of written out, as of a table of points; 0: none is.
            The length of another axis must be no multiple of it.
        names: of arguments and results in C; None: x0, x1, ... and result_0, result_1, ...
        single: for one column only.

    Raises:
        NotImplementedError: an operation of the function cannot be printed; names it, and the line that needs it.
    """
    found, called = recorded(function, examples, name, names, long, single)
    own, *others = (Body(each, called) for each in (found, *called.by_name.values()))
    text = own.text(is_told=own.asks)
    batch = "" if single else waiting(own)
    parts = {}
    for each in others:
        about = each.function.about.replace("*/", "* /")
        comment = f"/* {about} */" if about else ""
        parts[each.function.name] = f"{comment}\n{each.text(is_told=not single)}"
    return Printed(
        name=name,
        inputs=own.inputs,
        outputs=own.outputs,
        real=called.real,
        text=text,
        shapes=[torch.Size(part.shape) for part in found.outputs],
        given=[torch.Size(part.shape) for part in found.inputs],
        dtypes=found.dtypes,
        is_told=own.asks,
        parts=called_by(batch or text, parts),
        waiting=batch,
    )


def called_by(text: str, parts: dict[str, str]) -> list[str]:
    """Returns of functions, by name, those that a text calls, directly or not; each calls only those before it."""
    wanted = set(CALL.findall(text))
    for name in reversed(parts):
        if name in wanted:
            wanted |= set(CALL.findall(parts[name]))
    return [part for name, part in parts.items() if name in wanted]

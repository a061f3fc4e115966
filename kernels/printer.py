"""A traced function printed as C: one line per scalar operation, for vectors of spacecraft or for a single one.

A printed function takes and fills arrays of V, component first, and nothing else: V is a number, or a vector of the
compiler's with one spacecraft per lane. What is printed does not depend on which; `prelude` says what V is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kernels.expressions import MASK, NUMBER, REDUCTIONS, Expression, Program, Value, kind_of
from kernels.operations import VIEWS, Operations, objects
from kernels.trace import TRACING

REALS = {torch.float64: "double", torch.float32: "float"}
TYPES = {torch.float64: "double", torch.float32: "float", torch.bool: "bool", torch.int64: "long"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}
START = {"sum": 0.0, "least": math.inf, "most": -math.inf, "any": False}


@dataclass(frozen=True)
class Part:
    """An argument or a result of a printed function.

    Attributes:
        name: in C; shape: per spacecraft; kind: "double", "float", "bool" or "long" in memory.
    """

    name: str
    shape: tuple[int, ...]
    kind: str

    @property
    def size(self) -> int:
        """How many components it has."""
        return math.prod(self.shape)

    @property
    def is_mask(self) -> bool:
        """Whether it holds truth values."""
        return self.kind == "bool"


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


def printed(
    function: Callable[..., list[Tensor]],
    *examples: Tensor,
    name: str = "run",
    long: int = 0,
    names: tuple[Sequence[str], Sequence[str]] | None = None,
) -> Printed:
    """A function of tensors (..., B), whose columns are independent, as C for one column or a vector of them.

    Args:
        function: without control flow that depends on values.
        examples: arguments of one column.
        name: in C.
        long: length of an axis that is looped over instead of written out, as of a table of points.
        names: of arguments and results in C; None: x0, x1, ... and y0, y1, ...

    Raises:
        NotImplementedError: an operation of it cannot be printed.
    """
    real = next((REALS[x.dtype] for x in examples if x.dtype in REALS), "double")
    given, found = names or (None, None)
    given = given or [f"x{i}" for i in range(len(examples))]
    program = Program()
    results, values = evaluated(function, examples, given, program, long, real)
    found = found or [f"y{i}" for i in range(len(results))]
    inputs = [Part(n, tuple(x.shape[:-1]), TYPES[x.dtype]) for n, x in zip(given, examples, strict=True)]
    outputs = [Part(n, tuple(y.shape[:-1]), TYPES[y.dtype]) for n, y in zip(found, results, strict=True)]
    body = Body(program, long, inputs, real)
    for part, array in zip(outputs, values, strict=True):
        body.returns(part, array)
    text, count = body.text(name, outputs)
    return Printed(
        name,
        [part for part in inputs if part.size],
        [part for part in outputs if part.size],
        real,
        count,
        text,
        [y.shape[:-1] for y in results],
        [x.shape[:-1] for x in examples],
        [y.dtype for y in results],
    )


class Recorder(TorchDispatchMode):
    """Has every operation that PyTorch runs done on scalar values, too.

    Tensors that share memory have arrays that do, so that what is written in place is seen in all of them. A tensor
    that no recorded operation made is a constant.
    """

    def __init__(self, program: Program, long: int, real: str) -> None:
        super().__init__()
        self.program, self.real, self.operations = program, real, Operations(program, long)
        self.arrays: dict[
            int, tuple[Tensor, ndarray]
        ] = {}  # with the tensor, so that no other is given its id

    def put(self, tensor: Tensor, array: ndarray) -> None:
        """Says what a tensor's values are."""
        self.arrays[id(tensor)] = tensor, array

    def values(self, given: Any) -> Any:
        """The values of a tensor, and of those in lists; anything else as it is."""
        if isinstance(given, Tensor):
            known = self.arrays.get(id(given))
            return known[1] if known else constant(self.program, given, self.operations.long)
        return [self.values(each) for each in given] if isinstance(given, list | tuple) else given

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """One operation."""
        kwargs = kwargs or {}
        result = function(*args, **kwargs)
        name = function._schema.name.split("::")[1]
        if not isinstance(result, Tensor | list | tuple):
            if name in LOOKS and any(isinstance(v, Expression) for x in args for v in self.values(x).flat):
                raise NotImplementedError("control flow that depends on values cannot be printed as C")
            return result
        first = next((x for x in (*args, *kwargs.values()) if isinstance(x, Tensor)), None)
        self.operations.lengths = tuple(first.shape) if first is not None else ()
        options = {
            key: self.values(each) for key, each in kwargs.items() if key not in WHERE_AND_OF_WHAT_TYPE
        }
        found = self.operations.call(
            name.removesuffix("_") if name != "_to_copy" else name, *self.values(args), **options
        )
        if name.endswith("_"):
            array = self.values(args[0])
            array[...] = self.typed(found, args[0].dtype, name)
        elif isinstance(result, Tensor):
            if not any(result is each for each in args):
                self.put(result, found if name in VIEWS else self.typed(found, result.dtype, name))
        else:
            for tensor, array in zip(result, found, strict=True):
                self.put(tensor, array)
        return result

    def typed(self, found: ndarray, dtype: torch.dtype, name: str) -> ndarray:
        """Values as their type in PyTorch has them: numbers as truth values or the reverse, or in single precision."""
        p = self.program
        if dtype == torch.bool:
            as_one = p.mask
        elif dtype == torch.float32 and self.real == "double":
            as_one = partial(p.apply, "single")
        elif dtype == torch.int64 and name == "_to_copy":
            as_one = partial(p.call, "trunc")
        else:
            as_one = p.number
        result = np.empty(found.shape, dtype=object)
        for place in np.ndindex(found.shape):
            result[place] = as_one(found[place])
        return result


LOOKS = ("_local_scalar_dense", "is_nonzero", "equal")  # at values
WHERE_AND_OF_WHAT_TYPE = (
    "dtype",
    "device",
    "layout",
    "pin_memory",
    "memory_format",
    "implicit",
    "non_blocking",
)


@torch.no_grad()
def evaluated(
    function: Callable[..., list[Tensor]],
    examples: Sequence[Tensor],
    names: Sequence[str],
    program: Program,
    long: int,
    real: str,
) -> tuple[list[Tensor], list[ndarray]]:
    """What a function returns of examples, and the values of that, (..., 1) each."""
    recorder = Recorder(program, long, real)
    inputs = [x.clone() for x in examples]
    for name, x in zip(names, inputs, strict=True):
        recorder.put(
            x, argument(program, Part(name, tuple(x.shape[:-1]), TYPES[x.dtype]), recorder.operations)
        )
    with TRACING, recorder:
        results = function(*inputs)
    return results, [recorder.values(each) for each in results]


def argument(program: Program, part: Part, operations: Operations) -> ndarray:
    """The values of an input."""
    shape = operations.short(part.shape)
    found = np.empty((*shape, 1), dtype=object)
    for place in np.ndindex(shape):
        kind = MASK if part.is_mask else NUMBER
        found[(*place, 0)] = program.input(element(part, place, shape), kind, shape != part.shape)
    return found


def constant(program: Program, tensor: Tensor, long: int) -> ndarray:
    """The values of a constant; tables along the long axis."""
    array = tensor.cpu().numpy()
    if not long or long not in array.shape:
        return objects(array)
    axis = array.shape.index(long)
    entries = np.moveaxis(array, axis, -1)
    found = np.empty(entries.shape[:-1], dtype=object)
    for place in np.ndindex(found.shape):
        found[place] = program.table(entries[place].tolist())
    return np.expand_dims(found, axis)


class Body:
    """The lines of a printed function.

    What varies along the long axis is computed in loops over it, one for each stage of reductions.
    """

    def __init__(self, program: Program, long: int, inputs: Sequence[Part], real: str) -> None:
        self.program, self.long, self.inputs, self.real = program, long, inputs, real
        self.stores: list[tuple[str, Value, str]] = []  # place, value, kind

    def returns(self, part: Part, array: ndarray) -> None:
        """Has the function fill an output."""
        shape = tuple(1 if self.long and size == self.long else size for size in part.shape)
        array = np.broadcast_to(array, (*shape, 1))
        for place in np.ndindex(shape):
            value, text = array[(*place, 0)], element(part, place, shape)
            value = self.program.mask(value) if part.is_mask else self.program.number(value)
            self.stores.append((text, value, MASK if part.is_mask else NUMBER))

    def text(self, name: str, outputs: Sequence[Part]) -> tuple[str, int]:
        """The function, and how many statements it has."""
        needed = self.needed()
        last = max((each.stage for each in needed), default=0)
        used = sorted({int(each.arguments[0]) for each in needed if each.operation == "table"})
        lines = [f"    static const real table{i}[{self.long}] = {{{self.entries(i)}}};" for i in used]
        for stage in range(last + 1):
            own = [each for each in needed if not each.varies and each.stage == stage]
            lines += [self.line(each, 1) for each in own if each.operation not in (*REDUCTIONS, "input")]
            lines += self.loop(needed, stage, stage == last)
        lines += [
            f"    {place} = {self.operand(value, kind)};"
            for place, value, kind in self.stores
            if not varying(place)
        ]
        whole = "\n".join(lines)
        unused = [part for part in self.inputs if part.size and f"{part.name}[" not in whole]
        lines += [f"    (void){part.name};" for part in unused]
        given = [
            f"const {letter(part.is_mask)} {part.name}[{part.size}]" for part in self.inputs if part.size
        ]
        found = [f"{letter(part.is_mask)} {part.name}[{part.size}]" for part in outputs if part.size]
        head = f"static void {name}({', '.join([*given, *found])})"
        return "\n".join([head, "{", *lines, "}", ""]), len(lines)

    def needed(self) -> list[Expression]:
        """All expressions that an output needs, in order."""
        wanted = {value.index for _, value, _ in self.stores if isinstance(value, Expression)}
        return with_arguments(self.program.expressions, wanted)

    def entries(self, table: int) -> str:
        """The numbers of a table in C."""
        return ", ".join(self.literal(value) for value in self.program.tables[table])

    def loop(self, needed: list[Expression], stage: int, is_last: bool) -> list[str]:
        """The loop over the long axis after this stage: what the reductions of the next one add up, at last outputs."""
        reductions = [each for each in needed if each.operation in REDUCTIONS and each.stage == stage + 1]
        stores = [each for each in self.stores if is_last and varying(each[0])]
        if not reductions and not stores:
            return []
        wanted = {a.index for each in reductions for a in each.arguments if isinstance(a, Expression)}
        wanted |= {value.index for _, value, _ in stores if isinstance(value, Expression)}
        inside = [each for each in needed if each.varies and each.operation != "input"]
        lines = []
        for each in reductions:
            start = "NO" if each.kind == MASK else f"ALL({self.literal(START[each.operation])})"
            lines.append(f"    {letter(each.kind == MASK)} t{each.index} = {start};")
        lines.append(f"    for (int i = 0; i < {self.long}; i++) {{")
        lines += [self.line(each, 2) for each in with_arguments(inside, wanted)]
        for each in reductions:
            total = f"t{each.index}"
            joined = formula(REDUCTIONS[each.operation], total, self.operand(each.arguments[0], each.kind))
            lines.append(f"        {total} = {joined};")
        lines += [f"        {place} = {self.operand(value, kind)};" for place, value, kind in stores]
        return [*lines, "    }"]

    def line(self, each: Expression, depth: int) -> str:
        """The statement of an expression."""
        start = f"{'    ' * depth}const {letter(each.kind == MASK)} t{each.index} = "
        if each.operation == "table":
            return f"{start}ALL(table{each.arguments[0]}[i]);"
        whole = each.operation not in INFIX
        return f"{start}{formula(each.operation, *(self.operand(a, whole=whole) for a in each.arguments))};"

    def operand(self, value: Value, kind: str | None = None, whole: bool = True) -> str:
        """A value in C: as a V or M, or where it need not be a vector as a number."""
        if isinstance(value, Expression):
            return str(value.arguments[0]) if value.operation == "input" else f"t{value.index}"
        if (kind or kind_of(value)) == MASK:
            return "YES" if value else "NO"
        return f"ALL({self.literal(value)})" if whole else self.literal(value)

    def literal(self, value: float) -> str:
        """A number in C that is exactly this one."""
        if math.isnan(value):
            return "NAN"
        text = "INFINITY" if math.isinf(value) else repr(abs(float(value)))
        text += "f" if self.real == "float" and not math.isinf(value) else ""
        return f"(-{text})" if math.copysign(1.0, value) < 0.0 else text


def element(part: Part, place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """A component of an argument in C; where its axis is the long one (1 in `shape`), the loop's."""
    strides = [math.prod(part.shape[i + 1 :]) for i in range(len(part.shape))]
    at = sum(i * stride for i, stride in zip(place, strides, strict=True))
    long = [s for s, one, whole in zip(strides, shape, part.shape, strict=True) if one != whole]
    return f"{part.name}[{at} + {long[0]} * i]" if long else f"{part.name}[{at}]"


def varying(place: str) -> bool:
    """Whether a component is one of those along the long axis."""
    return place.endswith("* i]")


def with_arguments(expressions: Sequence[Expression], wanted: set[int]) -> list[Expression]:
    """Those that are wanted, by index, and all that they are computed from, in order."""
    wanted = set(wanted)
    for each in reversed(expressions):
        if each.index in wanted:
            wanted |= {a.index for a in each.arguments if isinstance(a, Expression)}
    return [each for each in expressions if each.index in wanted]


def letter(is_mask: bool) -> str:
    """The type of a value in C."""
    return "M" if is_mask else "V"


def formula(operation: str, *operands: str) -> str:
    """An operation on operands in C."""
    if operation in INFIX:
        return f"{operands[0]} {INFIX[operation]} {operands[1]}"
    if operation == "neg":
        return f"-{operands[0]}"
    return f"{operation.upper()}({', '.join(operands)})"

"""Expressions as the lines of a function in C."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray

from kernels.operations.expressions import MASK, NUMBER, REDUCTIONS, Expression, Program, Value, kind_of

# in memory
TYPES = {torch.float64: "double", torch.float32: "float", torch.bool: "bool", torch.int64: "long"}
INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}
WIDTH = 110  # of a table's lines
START = {"sum": 0.0, "least": math.inf, "most": -math.inf, "any": False}


@dataclass(frozen=True)
class Part:
    """An argument or a result of a printed function.

    Attributes:
        name: in C; shape: per column; kind: "double", "float", "bool" or "long" in memory.
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


class Body:
    """The lines of a printed function.

    What varies along the long axis is computed in loops over it, one for each stage of reductions.
    """

    def __init__(self, program: Program, long: int) -> None:
        self.program, self.long = program, long
        self.tables = list(program.tables.values())
        self.stores: list[tuple[str, Value, str]] = []  # place, value, kind

    def returns(self, part: Part, array: ndarray) -> None:
        """Has the function fill an output."""
        shape = array.shape[:-1]
        for place in np.ndindex(shape):
            value, text = array[(*place, 0)], element(part, place, shape)
            value = self.program.mask(value) if part.is_mask else self.program.number(value)
            self.stores.append((text, value, MASK if part.is_mask else NUMBER))

    def text(self, name: str, inputs: Sequence[Part], outputs: Sequence[Part]) -> tuple[str, int]:
        """The function, and how many statements it has."""
        lines = self.lines()
        whole = "\n".join(lines)
        lines += [f"    (void){part.name};" for part in inputs if f"{part.name}[" not in whole]
        given = [f"const {letter(part.is_mask)} {part.name}[{part.size}]" for part in inputs]
        found = [f"{letter(part.is_mask)} {part.name}[{part.size}]" for part in outputs]
        head = f"static void {name}({', '.join([*given, *found])})"
        return "\n".join([head, "{", *lines, "}", ""]), len(lines)

    def lines(self) -> list[str]:
        """The statements that fill the outputs."""
        wanted = {value.index for _, value, _ in self.stores if isinstance(value, Expression)}
        needed = with_arguments(self.program.expressions, wanted)
        last = max((each.stage for each in needed), default=0)
        used = sorted({int(each.arguments[0]) for each in needed if each.operation in ("table", "lookup")})
        lines = [self.table(i) for i in used]
        for stage in range(last + 1):
            own = [each for each in needed if not each.varies and each.stage == stage]
            lines += [self.line(each, 1) for each in own if each.operation not in (*REDUCTIONS, "input")]
            lines += self.loop(needed, stage, stage == last)
        stores = [each for each in self.stores if not varying(each[0])]
        return lines + [f"    {place} = {self.operand(value, kind)};" for place, value, kind in stores]

    def table(self, index: int) -> str:
        """A table in C."""
        numbers = ", ".join(self.literal(value) for value in self.tables[index])
        rows = textwrap.indent(textwrap.fill(numbers, WIDTH, break_long_words=False), " " * 8)
        return f"    static const real table{index}[{self.long}] = {{\n{rows}\n    }};"

    def loop(self, needed: list[Expression], stage: int, is_last: bool) -> list[str]:
        """The loop over the long axis after this stage: what the reductions of the next one add up, at last outputs."""
        reductions = [each for each in needed if each.operation in REDUCTIONS and each.stage == stage + 1]
        stores = [each for each in self.stores if is_last and varying(each[0])]
        if not reductions and not stores:
            return []
        wanted = {a.index for each in reductions for a in each.arguments if isinstance(a, Expression)}
        wanted |= {value.index for _, value, _ in stores if isinstance(value, Expression)}
        inside = [each for each in needed if each.varies and each.operation != "input"]
        lines = [f"    {line}" for each in reductions for line in self.starts(each)]
        lines.append(f"    for (int i = 0; i < {self.long}; i++) {{")
        lines += [self.line(each, 2) for each in with_arguments(inside, wanted)]
        lines += [f"        {line}" for each in reductions for line in self.joins(each)]
        lines += [f"        {place} = {self.operand(value, kind)};" for place, value, kind in stores]
        return [*lines, "    }"]

    def starts(self, each: Expression) -> list[str]:
        """The statements that a reduction begins with."""
        start = (
            "NO" if each.kind == MASK else f"ALL({self.literal(START[each.operation.removesuffix('_at')])})"
        )
        if each.operation.endswith("_at"):
            return [f"V t{each.index} = ALL({self.literal(0.0)});", f"V of_t{each.index} = {start};"]
        return [f"{letter(each.kind == MASK)} t{each.index} = {start};"]

    def joins(self, each: Expression) -> list[str]:
        """The statements that take one more entry into a reduction."""
        total, entry = f"t{each.index}", self.operand(each.arguments[0], each.kind)
        if not each.operation.endswith("_at"):
            return [f"{total} = {formula(REDUCTIONS[each.operation], total, entry)};"]
        # the first one stays, also if it is NaN, and NaN comes before all else
        stays = f"of_{total} <= {entry}" if each.operation == "least_at" else f"{entry} <= of_{total}"
        return [
            f"const M is_{total} = AND(NOT({stays}), of_{total} == of_{total});",
            f"{total} = SELECT(is_{total}, ALL(i), {total});",
            f"of_{total} = SELECT(is_{total}, {entry}, of_{total});",
        ]

    def line(self, each: Expression, depth: int) -> str:
        """The statement of an expression."""
        start = f"{'    ' * depth}const {letter(each.kind == MASK)} t{each.index} = "
        if each.operation == "table":
            return f"{start}ALL(table{each.arguments[0]}[i]);"
        if each.operation == "lookup":
            return f"{start}LOOKUP(table{each.arguments[0]}, {self.long}, {self.operand(each.arguments[1])});"
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
        text += "f" if self.program.real == "float" and not math.isinf(value) else ""
        return f"(-{text})" if math.copysign(1.0, value) < 0.0 else text


def element(part: Part, place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """A component of an argument in C; along the long axis, which is shorter in `shape`, the loop's."""
    strides = [math.prod(part.shape[i + 1 :]) for i in range(len(part.shape))]
    axes = list(zip(place, strides, shape, part.shape, strict=True))
    at = sum(i * stride * (whole // short) for i, stride, short, whole in axes)
    long = [stride for _, stride, short, whole in axes if short != whole]
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

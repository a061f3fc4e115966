"""Expressions printed as the lines of a function in C."""

import math
import re
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.calls import ONCE
from kernels.operations.expressions import MASK, REDUCTIONS, Expression, Value, kind_of
from kernels.parts import LETTER, Called, Part, Recorded, element

INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}
WIDTH = 120  # of lines
LOOPS = ("loop", "waiting")
ALONG = "* i]"  # the end of a component along the long axis
START = {"sum": 0.0, "least": math.inf, "most": -math.inf, "any": False}


class Repeated(NamedTuple):
    """Describes a loop, or a function that is called where a condition holds.

    Attributes:
        callee: the body; state: what it changes; given: its other arguments.
        most: the largest number of calls, ONCE: see `columns.when`; alive: the columns to begin with.
        start: the initial state; values: of the arguments `given`.
    """

    callee: Recorded
    state: list[Part]
    given: list[Part]
    most: str
    alive: Value
    start: list[Value]
    values: list[Value]

    @property
    def passed(self) -> list[Part]:
        """Returns the part of the state that the body receives."""
        return [] if self.most == ONCE else self.state


class Body:
    """Prints the lines of a function.

    Values that vary along the long axis are computed in loops over it, one for each stage of reductions.

    Attributes:
        inputs, outputs: arguments and results that have components.
        stores: what the function fills: place, value, kind; needed: all expressions of which these are made.
        waits: the loops that wait; asks: whether it calls functions that take the mask `on`.
    """

    def __init__(self, function: Recorded, called: Called) -> None:
        self.function, self.called, self.long = function, called, function.long
        self.inputs, self.outputs = (
            [part for part in parts if part.size] for parts in (function.inputs, function.outputs)
        )
        self.tables = list(function.program.tables.values())
        self.stores: list[tuple[str, Value, str]] = []
        for part, array in zip(function.outputs, function.values, strict=True):
            shape, as_kind = array.shape[:-1], getattr(function.program, part.values)
            places = np.ndindex(shape)
            self.stores += [
                (element(part, at, shape), as_kind(array[(*at, 0)]), part.values) for at in places
            ]
        wanted = {value.index for _, value, _ in self.stores if isinstance(value, Expression)}
        self.needed = with_arguments(function.program.expressions, wanted)
        self.waits = [each for each in self.needed if each.operation == "waiting"]
        self.asks = not called.single and any(each.operation in (*LOOPS, "call") for each in self.needed)

    def text(self, is_told: bool) -> str:
        """Returns the function; `is_told`: it receives the mask `on`."""
        lines = self.lines()
        whole = "\n".join(lines)
        given = ["M on"] if is_told else []
        given += [f"const {part.array()}" for part in self.inputs]
        found = [part.array() for part in self.outputs]
        names = [*(["on"] if is_told else []), *(part.name for part in self.inputs)]
        lines += [f"    (void){name};" for name in names if not re.search(rf"\b{name}\b", whole)]
        head = f"static void {self.function.name}({', '.join([*given, *found])})"
        return "\n".join(map(folded, [head, "{", *lines, "}", ""]))

    def lines(self) -> list[str]:
        """Returns the statements that fill the outputs."""
        last = max((each.stage for each in self.needed), default=0)
        used = sorted(
            {int(each.arguments[0]) for each in self.needed if each.operation in ("table", "lookup")}
        )
        lines = [self.table(i) for i in used]
        for stage in range(last + 1):
            own = [each for each in self.needed if not each.varies and each.stage == stage]
            lines += [self.line(each, 1) for each in own if each.operation not in REDUCTIONS]
            lines += self.loop(self.needed, stage, stage == last)
        stores = [each for each in self.stores if not each[0].endswith(ALONG)]
        lines += [f"    {place} = {self.operand(value, kind)};" for place, value, kind in stores]
        return [line for line in lines if line]

    def table(self, index: int) -> str:
        """Returns a table in C."""
        numbers = ", ".join(self.literal(value) for value in self.tables[index])
        rows = textwrap.indent(textwrap.fill(numbers, WIDTH - 10, break_long_words=False), " " * 8)
        return f"    static const real table{index}[{self.long}] = {{\n{rows}\n    }};"

    def loop(self, needed: list[Expression], stage: int, is_last: bool) -> list[str]:
        """Returns the loop over the long axis after this stage.

        It computes the reductions of the next stage or, at the last stage, the outputs.
        """
        reductions = [each for each in needed if each.operation in REDUCTIONS and each.stage == stage + 1]
        stores = [each for each in self.stores if is_last and each[0].endswith(ALONG)]
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
        """Returns the statements that initialise a reduction."""
        start = (
            "NO" if each.kind == MASK else f"ALL({self.literal(START[each.operation.removesuffix('_at')])})"
        )
        if each.operation.endswith("_at"):
            return [f"V t{each.index} = ALL({self.literal(0.0)});", f"V of_t{each.index} = {start};"]
        return [f"{LETTER[each.kind]} t{each.index} = {start};"]

    def joins(self, each: Expression) -> list[str]:
        """Returns the statements that add one more entry to a reduction."""
        total, entry = f"t{each.index}", self.operand(each.arguments[0], each.kind)
        if not each.operation.endswith("_at"):
            return [f"{total} = {formula(REDUCTIONS[each.operation], total, entry)};"]
        # the first extreme entry stays, also if it is NaN, and NaN comes before all other entries
        stays = f"of_{total} <= {entry}" if each.operation == "least_at" else f"{entry} <= of_{total}"
        return [
            f"const M is_{total} = AND(NOT({stays}), of_{total} == of_{total});",
            f"{total} = SELECT(is_{total}, ALL(i), {total});",
            f"of_{total} = SELECT(is_{total}, {entry}, of_{total});",
        ]

    def line(self, each: Expression, depth: int) -> str:
        """Returns the statement of an expression; "" if it needs none."""
        if each.operation in ("input", "result"):
            return ""
        if each.operation == "call":
            return textwrap.indent("\n".join(self.call(each)), "    " * depth)
        if each.operation in LOOPS:
            return textwrap.indent("\n".join(self.repeat(each)), "    " * depth)
        start = f"{'    ' * depth}const {LETTER[each.kind]} t{each.index} = "
        if each.operation == "table":
            return f"{start}ALL(table{each.arguments[0]}[i]);"
        if each.operation == "lookup":
            return f"{start}LOOKUP(table{each.arguments[0]}, {self.long}, {self.operand(each.arguments[1])});"
        if each.operation == "entry":
            name, first, apart, count, index = each.arguments
            return f"{start}{name}[{first} + {apart} * PLACE({count}, {self.operand(index)})];"
        whole = each.operation not in INFIX
        return f"{start}{formula(each.operation, *(self.operand(a, whole=whole) for a in each.arguments))};"

    # calls and loops

    def call(self, each: Expression) -> list[str]:
        """Returns the statements of a call."""
        name, on, *values = each.arguments
        callee, start = self.called.by_name[name], f"t{each.index}_"
        made, given = self.arrays(start, callee.inputs, values)
        results = [f"{start}{y.name}" for y in callee.outputs if y.size]
        return [
            *made,
            *declared(start, callee.outputs),
            f"{name}({', '.join([*self.told(on), *given, *results])});",
        ]

    def repeat(self, each: Expression) -> list[str]:
        """Returns the statements of a loop. Columns that have ended keep their values."""
        it, start = self.repeated(each), f"t{each.index}_"
        made, given = self.arrays(start, it.given, it.values)
        made += self.begun(start, it)
        alive, single = self.operand(it.alive, MASK), self.called.single
        own = [f"{start}{y.name}" for y in it.state if y.size]
        if single and it.most == ONCE:
            return [*made, f"if ({alive}) {{", f"    {it.callee.name}({', '.join([*given, *own])});", "}"]
        passed = own if it.passed else []
        following = [f"next_{y.name}" for y in it.callee.outputs if y.size]
        body = [
            *declared("next_", it.callee.outputs),
            f"{it.callee.name}({', '.join([*self.told(f'{start}on'), *passed, *given, *following])});",
            *(line for y in it.state if y.size for line in self.taken(y, start)),
        ]
        anywhere = f"{start}on" if single else f"ANY({start}on)"
        head = f"if ({anywhere}) {{"
        if it.most != ONCE:
            head = f"for (int k = 0; k < {it.most} && {anywhere}; ++k) {{"
            body.append(f"{start}on = AND({start}on, next_{it.callee.outputs[-1].name}[0]);")
        return [*made, f"M {start}on = {alive};", head, *(f"    {line}" for line in body), "}"]

    def repeated(self, each: Expression) -> Repeated:
        """Returns the description of a loop."""
        name, most, alive, *values = each.arguments
        callee = self.called.by_name[name]
        state = callee.outputs if most == ONCE else callee.outputs[:-1]
        given = callee.inputs if most == ONCE else callee.inputs[len(state) :]
        count = sum(part.size for part in state)
        return Repeated(callee, state, given, most, alive, values[:count], values[count:])

    def begun(self, start: str, it: Repeated) -> list[str]:
        """Returns the statements that set the initial state."""
        lines, values = [], list(it.start)
        for y in it.state:
            own, values = values[: y.size], values[y.size :]
            if y.size:
                texts = [self.operand(v, y.values) for v in own]
                lines.append(f"{y.array(start)} = {{{', '.join(texts)}}};")
        return lines

    def taken(self, y: Part, start: str) -> list[str]:
        """Returns the statements that set the next state in the columns that need it."""
        to, new = f"{start}{y.name}[i]", f"next_{y.name}[i]"
        if not self.called.single:
            new = f"{'CHOOSE' if y.values == MASK else 'SELECT'}({start}on, {new}, {to})"
        return [f"for (int i = 0; i < {y.size}; ++i) {{", f"    {to} = {new};", "}"]

    def told(self, on: Value | str) -> list[str]:
        """Returns the mask argument of a call: none for one column."""
        return [] if self.called.single else [on if isinstance(on, str) else self.operand(on, MASK)]

    def arrays(
        self, start: str, inputs: Sequence[Part], values: Sequence[Value]
    ) -> tuple[list[str], list[str]]:
        """Returns the statements that place arguments side by side if they are not yet, and the arguments to pass."""
        made, given = [], []
        for x in inputs:
            own, values = values[: x.size], values[x.size :]
            texts = [self.operand(v, x.values) for v in own]
            found = side_by_side(texts)
            if x.size and found is None:
                made.append(f"const {x.array(start)} = {{{', '.join(texts)}}};")
            given += [found or f"{start}{x.name}"] if x.size else []
        return made, given

    def operand(self, value: Value, kind: str | None = None, whole: bool = True) -> str:
        """Returns a value in C: a V or M, or a number where a vector is not needed."""
        if isinstance(value, Expression):
            return str(value.arguments[-1]) if value.operation in ("input", "result") else f"t{value.index}"
        if (kind or kind_of(value)) == MASK:
            return "YES" if value else "NO"
        return f"ALL({self.literal(value)})" if whole else self.literal(value)

    def literal(self, value: float) -> str:
        """Returns a number in C that is exactly this one."""
        if math.isnan(value):
            return "NAN"
        text = "INFINITY" if math.isinf(value) else repr(abs(float(value)))
        text += "f" if self.called.real == "float" and not math.isinf(value) else ""
        return f"(-{text})" if math.copysign(1.0, value) < 0.0 else text


def folded(text: str) -> str:
    """Wraps lines of C at WIDTH."""
    lines = []
    for line in text.split("\n"):
        indent = len(line) - len(line.lstrip()) + 4
        lines.append(
            line if len(line) <= WIDTH else textwrap.fill(line, WIDTH, subsequent_indent=" " * indent)
        )
    return "\n".join(lines)


def side_by_side(texts: Sequence[str]) -> str | None:
    """Returns the array element at which texts begin, if they are its neighbouring elements in order, else None."""
    found = re.fullmatch(r"(\w+)\[(\d+)\]", texts[0]) if texts else None
    if not found or any(text != f"{found[1]}[{int(found[2]) + i}]" for i, text in enumerate(texts)):
        return None
    return found[1] if found[2] == "0" else f"&{found[1]}[{found[2]}]"


def declared(start: str, parts: Sequence[Part]) -> list[str]:
    """Returns the declarations of results."""
    return [f"{y.array(start)};" for y in parts if y.size]


def with_arguments(expressions: Sequence[Expression], wanted: set[int]) -> list[Expression]:
    """Returns the wanted expressions, by index, and all from which they are computed, in order."""
    wanted = set(wanted)
    for each in reversed(expressions):
        if each.index in wanted:
            wanted |= {a.index for a in each.arguments if isinstance(a, Expression)}
    return [each for each in expressions if each.index in wanted]


def formula(operation: str, *operands: str) -> str:
    """Returns an operation on operands in C."""
    if operation in INFIX:
        return f"{operands[0]} {INFIX[operation]} {operands[1]}"
    if operation == "neg":
        return f"-{operands[0]}"
    return f"{operation.upper()}({', '.join(operands)})"

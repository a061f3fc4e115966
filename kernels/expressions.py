"""Scalar expressions of one spacecraft: each is written once, literals fold, and what nobody needs is dropped.

A value is a Python number or truth value (a literal), or an `Expression`. Folding multiplies nothing by zero that is
not known to be finite: 0 x is 0 here, so NaN and infinity of x are lost where a derivative is zero by its structure.
Whoever calls printed code with such numbers says at the entrance which columns are finite.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

NUMBER, MASK = "number", "mask"


@dataclass(frozen=True, eq=False, slots=True)
class Expression:
    """An operation on values.

    Attributes:
        operation: "input", "table", an operator or a function of C's math.h.
        arguments: values, or what identifies an input or a table's entry.
        kind: NUMBER or MASK.
        index: its place among all expressions of a program; arguments come before.
        stage: how many reductions over the long axis lie before it.
        varies: it differs along the long axis.
    """

    operation: str
    arguments: tuple["Value | str", ...]
    kind: str
    index: int
    stage: int = 0
    varies: bool = False


Value = Expression | float | int | bool


def divided(a: float, b: float) -> float:
    """a / b as C has it: infinite or NaN for b = 0."""
    with np.errstate(all="ignore"):
        return float(np.float64(a) / np.float64(b))


FOLDED: dict[str, Callable[..., Value]] = {  # of literals, as C computes them
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": divided,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": lambda a: not a,
    "fabs": abs,
    "rint": lambda a: float(np.rint(a)),
    "floor": lambda a: float(np.floor(a)),
    "trunc": lambda a: float(np.trunc(a)),
    "single": lambda a: float(np.float32(a)),
}
COMMUTATIVE = {"add", "mul", "eq", "and", "or"}
REDUCTIONS = {"sum": "add", "least": "min", "most": "max", "any": "or"}


class Program:
    """All expressions of a function, each once."""

    def __init__(self) -> None:
        self.expressions: list[Expression] = []
        self.known: dict[tuple[object, ...], Expression] = {}
        self.tables: list[tuple[float, ...]] = []

    def make(
        self,
        operation: str,
        *arguments: "Value | str",
        kind: str = NUMBER,
        varies: bool | None = None,
        stage: int | None = None,
    ) -> Expression:
        """The expression, new or known."""
        own = [a for a in arguments if isinstance(a, Expression)]
        key = (operation, *(identity(a) for a in arguments))
        if key not in self.known:
            self.known[key] = Expression(
                operation,
                arguments,
                kind,
                len(self.expressions),
                max((a.stage for a in own), default=0) if stage is None else stage,
                any(a.varies for a in own) if varies is None else varies,
            )
            self.expressions.append(self.known[key])
        return self.known[key]

    def input(self, text: str, kind: str, varies: bool = False) -> Expression:
        """What C calls `text`."""
        return self.make("input", text, kind=kind, varies=varies)

    def table(self, values: Sequence[float]) -> Value:
        """The entry of a constant table along the long axis; a literal where all are equal."""
        entries = tuple(values)
        if all(entry == entries[0] for entry in entries):
            return entries[0]
        kind = MASK if isinstance(entries[0], bool) else NUMBER
        numbers = tuple(float(entry) for entry in entries)
        if numbers not in self.tables:
            self.tables.append(numbers)
        entry = self.make("table", str(self.tables.index(numbers)), varies=True)
        return self.not_(self.eq(entry, 0.0)) if kind == MASK else entry

    def apply(self, operation: str, *arguments: Value, kind: str = NUMBER) -> Value:
        """An operation, folded where all arguments are literals."""
        if operation in FOLDED and not any(isinstance(a, Expression) for a in arguments):
            return FOLDED[operation](*arguments)
        if operation in COMMUTATIVE:
            arguments = tuple(sorted(arguments, key=identity))
        return self.make(operation, *arguments, kind=kind)

    # numbers

    def number(self, a: Value) -> Value:
        """A truth value as 0 or 1; numbers as they are."""
        if isinstance(a, Expression):
            return self.select(a, 1.0, 0.0) if a.kind == MASK else a
        return float(a)

    def add(self, a: Value, b: Value) -> Value:
        a, b = self.number(a), self.number(b)
        if is_literal(a, 0.0) or is_literal(b, 0.0):
            return b if is_literal(a, 0.0) else a
        if is_negated(b):
            return self.sub(a, b.arguments[0])
        return self.sub(b, a.arguments[0]) if is_negated(a) else self.apply("add", a, b)

    def sub(self, a: Value, b: Value) -> Value:
        a, b = self.number(a), self.number(b)
        if is_literal(b, 0.0):
            return a
        if is_literal(a, 0.0):
            return self.neg(b)
        return self.add(a, b.arguments[0]) if is_negated(b) else self.apply("sub", a, b)

    def mul(self, a: Value, b: Value) -> Value:
        a, b = self.number(a), self.number(b)
        for one, other in ((a, b), (b, a)):
            if is_literal(one, 0.0):
                return 0.0
            if is_literal(one, 1.0):
                return other
            if is_literal(one, -1.0):
                return self.neg(other)
            if is_negated(one):
                return self.neg(self.mul(one.arguments[0], other))
        return self.apply("mul", a, b)

    def div(self, a: Value, b: Value) -> Value:
        a, b = self.number(a), self.number(b)
        if is_literal(b, 1.0) or (is_literal(a, 0.0) and isinstance(b, Expression)):
            return a
        return self.neg(self.div(a.arguments[0], b)) if is_negated(a) else self.apply("div", a, b)

    def neg(self, a: Value) -> Value:
        a = self.number(a)
        if not isinstance(a, Expression):
            return -a
        return a.arguments[0] if is_negated(a) else self.make("neg", a)

    def call(self, function: str, *arguments: Value) -> Value:
        """A function of math.h."""
        numbers = [self.number(a) for a in arguments]
        if not any(isinstance(a, Expression) for a in numbers):
            return float(getattr(np, NUMPY.get(function, function))(*(np.float64(a) for a in numbers)))
        return self.make(function, *numbers)

    def power(self, a: Value, exponent: float) -> Value:
        """a ** exponent; whole ones are multiplied out."""
        if exponent == 0.5:
            return self.call("sqrt", a)
        if exponent < 0.0:
            return self.div(1.0, self.power(a, -exponent))
        if exponent != int(exponent) or exponent > 8:
            return self.call("pow", a, exponent)
        if exponent <= 1.0:
            return self.number(a) if exponent else 1.0
        half = self.power(a, exponent // 2)
        square = self.mul(half, half)
        return self.mul(square, a) if exponent % 2 else square

    def min(self, a: Value, b: Value) -> Value:
        """The smaller one; NaN if either is."""
        return self.extreme("min", self.number(a), self.number(b))

    def max(self, a: Value, b: Value) -> Value:
        """The larger one; NaN if either is."""
        return self.extreme("max", self.number(a), self.number(b))

    def extreme(self, operation: str, a: Value, b: Value) -> Value:
        if not isinstance(a, Expression) and not isinstance(b, Expression):
            return float(np.minimum(a, b) if operation == "min" else np.maximum(a, b))
        if not isinstance(a, Expression):
            a, b = b, a
        if a is b or is_literal(b, math.inf if operation == "min" else -math.inf):
            return a
        # where one is a literal no NaN needs to be looked for: it fails the comparison, and a is taken
        return self.make(operation if isinstance(b, Expression) else f"{operation}_literal", a, b)

    # truth values

    def mask(self, a: Value) -> Value:
        """A number as a truth value, true where it is not zero."""
        if isinstance(a, Expression):
            return a if a.kind == MASK else self.not_(self.eq(a, 0.0))
        return bool(a)

    def lt(self, a: Value, b: Value) -> Value:
        return self.apply("lt", self.number(a), self.number(b), kind=MASK)

    def le(self, a: Value, b: Value) -> Value:
        return self.apply("le", self.number(a), self.number(b), kind=MASK)

    def eq(self, a: Value, b: Value) -> Value:
        return self.apply("eq", self.number(a), self.number(b), kind=MASK)

    def not_(self, a: Value) -> Value:
        a = self.mask(a)
        if isinstance(a, Expression) and a.operation == "not":
            return a.arguments[0]
        return self.apply("not", a, kind=MASK)

    def and_(self, a: Value, b: Value) -> Value:
        a, b = self.mask(a), self.mask(b)
        for one, other in ((a, b), (b, a)):
            if not isinstance(one, Expression):
                return other if one else False
        return a if a is b else self.apply("and", a, b, kind=MASK)

    def or_(self, a: Value, b: Value) -> Value:
        a, b = self.mask(a), self.mask(b)
        for one, other in ((a, b), (b, a)):
            if not isinstance(one, Expression):
                return True if one else other
        return a if a is b else self.apply("or", a, b, kind=MASK)

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        """a where the condition is true, else b."""
        condition = self.mask(condition)
        if not isinstance(condition, Expression):
            return a if condition else b
        if identity(a) == identity(b):
            return a
        both = [kind_of(each) for each in (a, b)]
        if both == [MASK, MASK]:
            return self.or_(self.and_(condition, a), self.and_(self.not_(condition), b))
        return self.make("select", condition, self.number(a), self.number(b))

    # along the long axis

    def reduce(self, operation: str, a: Value, count: int) -> Value:
        """The sum, least, most or any of what varies along the long axis of so many entries."""
        if not isinstance(a, Expression) or not a.varies:
            return self.mul(self.number(a), float(count)) if operation == "sum" else a
        a = self.mask(a) if operation == "any" else self.number(a)
        return self.make(operation, a, kind=a.kind, varies=False, stage=a.stage + 1)


NUMPY = {"acos": "arccos", "asin": "arcsin", "atan": "arctan", "atan2": "arctan2", "asinh": "arcsinh"} | {
    "fabs": "abs",
    "pow": "power",
}


def kind_of(a: Value) -> str:
    """NUMBER or MASK."""
    return a.kind if isinstance(a, Expression) else MASK if isinstance(a, bool | np.bool_) else NUMBER


def identity(a: "Value | str") -> tuple[int, object]:
    """What tells values apart, 0.0 from -0.0 and from false, and orders them."""
    if isinstance(a, Expression):
        return 0, a.index
    if isinstance(a, str):
        return 1, a
    return 2, repr(bool(a) if isinstance(a, np.bool_) else a)


def is_literal(a: Value, value: float) -> bool:
    """Whether a is this number."""
    return not isinstance(a, Expression) and not isinstance(a, bool) and a == value


def is_negated(a: Value) -> bool:
    """Whether a is -b."""
    return isinstance(a, Expression) and a.operation == "neg"

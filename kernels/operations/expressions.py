"""Scalar expressions of one column: each is written once, literals fold, and unneeded ones are dropped.

A value is a Python number or truth value (a literal), or an `Expression`. Folding is exact, except for zeros that are
known beforehand. Most derivatives are such zeros, and they must cost nothing:

    0 x and 0 / x are 0          where x is NaN or infinite, or x in 0 / x is zero, PyTorch has NaN
    x + 0 is x, 0 - x is -x      a result that is zero may have the other sign

The caller of printed code must itself mark columns with numbers that are not finite at the entrance. NaN and infinity
pass through everything else as through PyTorch's operations.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeGuard

import numpy as np

ELEMENT = re.compile(r"(\w+)\[(\d+)\]")  # of an array in C
NUMBER, MASK = "number", "mask"
MOST = 120_000  # expressions; with so many the compiler takes one to two minutes


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Expression:
    """Describes an operation on values.

    Attributes:
        operation: "input", "table", an operator or a function of C's math.h.
        arguments: values; for an input or a table the text or number that identifies it.
        kind: NUMBER or MASK.
        index: its place among all expressions of a program; arguments come before.
        stage: how many reductions over the long axis lie before it.
        varies: it differs along the long axis.
    """

    operation: str
    arguments: tuple[Any, ...]
    kind: str
    index: int
    stage: int = 0
    varies: bool = False


Value = Expression | float | int | bool


def of_numpy(name: str) -> Callable[..., float]:
    """Returns a function of NumPy for literals: infinite or NaN where the function of C is."""

    def run(*numbers: float) -> float:
        with np.errstate(all="ignore"):
            return float(getattr(np, name)(*(np.float64(number) for number in numbers)))

    return run


def rounded_to_single(a: float) -> float:
    """Returns a number in single precision."""
    with np.errstate(all="ignore"):
        return float(np.float32(a))


# results of operations on literals, as C computes them
FOLDED: dict[str, Callable[..., Value]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": lambda a: not a,
    "fabs": abs,
    "single": rounded_to_single,
    "erf": math.erf,
    "erfc": math.erfc,
    "asinh": of_numpy("arcsinh"),
    **{name: of_numpy(f"arc{name[1:]}") for name in ("acos", "asin", "atan", "atan2", "acosh", "atanh")},
    **{name: of_numpy(other) for name, other in {"div": "divide", "pow": "power", "min": "minimum",
                                                "max": "maximum"}.items()},
    **{name: of_numpy(name) for name in ("sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "expm1",
                                         "log", "log2", "log10", "log1p", "rint", "floor", "ceil", "trunc", "fmod",
                                         "hypot", "copysign")},
}  # fmt: skip
COMMUTATIVE = {"add", "mul", "eq", "and", "or"}
# operations that join the entries along the long axis; the last two give the index of the first extreme one
REDUCTIONS = {"sum": "add", "least": "min", "most": "max", "any": "or", "least_at": "le", "most_at": "le"}
# operations that do not round a number of single precision
EXACT = {
    "neg",
    "fabs",
    "select",
    "min",
    "max",
    "min_literal",
    "max_literal",
    "rint",
    "floor",
    "ceil",
    "trunc",
}


class Program:
    """Holds all expressions of a function, each once.

    Args:
        real: "double" or "float", the type of its numbers.
        is_one: it computes one column, so that an index may be an address.
    """

    def __init__(self, real: str = "double", is_one: bool = False) -> None:
        self.real, self.is_one = real, is_one
        self.min, self.max = partial(self.extreme, "min"), partial(self.extreme, "max")
        self.and_, self.or_ = partial(self.connected, "and"), partial(self.connected, "or")
        self.expressions: list[Expression] = []
        self.known: dict[tuple[object, ...], Expression] = {}
        self.tables: dict[bytes, tuple[float, ...]] = {}
        self.singles: set[int] = set()  # indices of numbers that single precision can hold

    def make(
        self,
        operation: str,
        *arguments: "Value | str",
        kind: str = NUMBER,
        varies: bool | None = None,
        stage: int | None = None,
    ) -> Expression:
        """Returns the expression, new or known."""
        key = (operation, *[a.index if isinstance(a, Expression) else identity(a) for a in arguments])
        found = self.known.get(key)
        if found is None:
            if len(self.expressions) == MOST:
                raise NotImplementedError(f"after {MOST:,} others, too many for a C compiler,")
            own = [a for a in arguments if isinstance(a, Expression)]
            if stage is None:
                stage = max([a.stage for a in own], default=0)
            if varies is None:
                varies = any([a.varies for a in own])
            found = Expression(operation, arguments, kind, len(self.expressions), stage, varies)
            self.known[key] = found
            self.expressions.append(found)
        return found

    def input(self, text: str, kind: str, varies: bool = False, single: bool = False) -> Expression:
        """Returns the value that C calls `text`; `single`: a number of single precision."""
        found = self.make("input", text, kind=kind, varies=varies)
        if single:
            self.singles.add(found.index)
        return found

    def table(self, values: Sequence[float]) -> Value:
        """Returns the entry of a constant table along the long axis; a literal if all are equal."""
        if len({identity(entry) for entry in values}) == 1:
            return values[0]
        numbers = np.array(values, dtype=float)
        self.tables.setdefault(numbers.tobytes(), tuple(numbers.tolist()))
        entry = self.make("table", str(list(self.tables).index(numbers.tobytes())), varies=True)
        return self.mask(entry) if isinstance(values[0], bool) else entry

    def lookup(self, entry: Value, index: Value) -> Value:
        """Returns a value along the long axis at a computed index."""
        if not isinstance(entry, Expression) or not entry.varies:
            return entry
        if entry.operation != "table":
            raise NotImplementedError("of what is computed, along an axis that is looped over,")
        return self.make("lookup", *entry.arguments, index)

    def entry(self, entries: Sequence[Value], index: Value) -> Value:
        """Returns the entry at a computed index, the last one if there is none."""
        if self.is_one and (array := evenly_apart(entries)):
            return self.make("entry", *array, index, kind=kind_of(entries[0]))
        result = entries[-1]
        for i in reversed(range(len(entries) - 1)):
            result = self.select(self.eq(index, float(i)), entries[i], result)
        return result

    def apply(self, operation: str, *arguments: Value, kind: str = NUMBER) -> Value:
        """Returns an operation, folded if all arguments are literals."""
        if operation in FOLDED and not any([isinstance(a, Expression) for a in arguments]):
            found: Any = FOLDED[operation](*arguments)
            return rounded_to_single(found) if self.real == "float" and kind == NUMBER else found
        if operation in COMMUTATIVE:
            arguments = tuple(sorted(arguments, key=identity))
        return self.make(operation, *arguments, kind=kind)

    # numbers

    def number(self, a: Value) -> Expression | float:
        """Returns a truth value as 0 or 1; numbers as they are."""
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
            if not isinstance(one, Expression):
                if one == 0.0 and isinstance(other, Expression):
                    return 0.0
                if one == 1.0:
                    return other
                if one == -1.0:
                    return self.neg(other)
            elif one.operation == "neg":
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
        """Returns a call of a function of math.h."""
        return self.apply(function, *(self.number(a) for a in arguments))

    def power(self, a: Value, exponent: float) -> Value:
        """Returns a ** exponent; whole exponents up to 8 are multiplied out."""
        if exponent in (-0.5, -1.0, -2.0):
            return self.div(1.0, self.power(a, -exponent))
        if exponent == 0.5:
            return self.call("sqrt", a)
        if not exponent.is_integer() or not 0.0 <= exponent <= 8.0:
            return self.call("pow", a, exponent)
        if exponent <= 1.0:
            return self.number(a) if exponent else 1.0
        half = self.power(a, exponent // 2)
        square = self.mul(half, half)
        return self.mul(square, a) if exponent % 2 else square

    def extreme(self, operation: str, a: Value, b: Value) -> Value:
        """Returns the smaller one ("min") or the larger one ("max"); NaN if either is NaN."""
        a, b = self.number(a), self.number(b)
        if isinstance(a, Expression) and isinstance(b, Expression):
            return a if a is b else self.make(operation, a, b)
        if isinstance(b, Expression):
            a, b = b, a
        if not isinstance(a, Expression) or isinstance(b, Expression):
            return self.apply(operation, a, b)
        if math.isnan(b) or b == (math.inf if operation == "min" else -math.inf):
            return b if math.isnan(b) else a
        # with one literal no test for NaN is needed: NaN fails the comparison, and a is taken
        return self.make(f"{operation}_literal", a, b)

    def whole(self, a: Value) -> Value:
        """Returns a number without its fraction."""
        return self.number(a) if kind_of(a) == MASK else self.call("trunc", a)

    def single(self, a: Value) -> Value:
        """Returns a number rounded to single precision, as every operation on float32 does."""
        a = self.number(a)
        if isinstance(a, Expression):
            parts = [b for b in a.arguments if kind_of(b) == NUMBER] if a.operation in EXACT else []
            if parts and all(self.is_single(b) for b in parts):
                self.singles.add(a.index)
            if self.is_single(a):
                return a
        found = self.apply("single", a)
        if isinstance(found, Expression):
            self.singles.add(found.index)
        return found

    def is_single(self, a: Value) -> bool:
        """Checks whether a number is known to be one of single precision."""
        if isinstance(a, Expression):
            return a.index in self.singles
        return identity(a) == identity(rounded_to_single(a))

    # truth values

    def mask(self, a: Value) -> Value:
        """Returns a number as a truth value, true if it is not zero."""
        if not isinstance(a, Expression):
            return bool(a)
        if a.operation == "select" and a.arguments[1:] == (1.0, 0.0):
            return a.arguments[0]
        return a if a.kind == MASK else self.not_(self.eq(a, 0.0))

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

    def connected(self, operation: str, a: Value, b: Value) -> Value:
        """Returns a and b, or a or b."""
        a, b = self.mask(a), self.mask(b)
        for one, other in ((a, b), (b, a)):
            if not isinstance(one, Expression):
                return other if one == (operation == "and") else one
        return a if a is b else self.apply(operation, a, b, kind=MASK)

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        """Returns a if the condition is true, else b."""
        condition = self.mask(condition)
        if not isinstance(condition, Expression):
            return a if condition else b
        if identity(a) == identity(b):
            return a
        if condition.operation == "not":
            return self.select(condition.arguments[0], b, a)
        if kind_of(a) == kind_of(b) == MASK:
            return self.or_(self.and_(condition, a), self.and_(self.not_(condition), b))
        return self.make("select", condition, self.number(a), self.number(b))

    # along the long axis

    def reduce(self, operation: str, a: Value, count: int) -> Value:
        """Returns the sum, least, most or any of a value's entries along the long axis, or an extreme entry's index.

        `count` is the length of the axis.
        """
        if not isinstance(a, Expression) or not a.varies:
            if operation.endswith("_at"):
                return 0.0
            return self.mul(self.number(a), float(count)) if operation == "sum" else a
        entry = self.mask(a) if operation == "any" else self.number(a)
        kind = MASK if operation == "any" else NUMBER
        return self.make(operation, entry, kind=kind, varies=False, stage=a.stage + 1)


def kind_of(a: Value) -> str:
    """Returns NUMBER or MASK."""
    return a.kind if isinstance(a, Expression) else MASK if isinstance(a, bool | np.bool_) else NUMBER


def identity(a: "Value | str") -> tuple[int, object]:
    """Returns a key that tells values apart, 0.0 from -0.0 and from false, and orders them."""
    if isinstance(a, Expression):
        return 0, a.index
    if isinstance(a, str):
        return 1, a
    return 2, repr(bool(a) if isinstance(a, np.bool_) else a)


def evenly_apart(entries: Sequence[Value]) -> tuple[str, ...]:
    """Returns the array's name, first index, spacing and count if inputs lie evenly apart in it, else ()."""
    inputs = [e for e in entries if isinstance(e, Expression) and e.operation == "input" and not e.varies]
    found = [match for e in inputs if (match := ELEMENT.fullmatch(e.arguments[0]))]
    places = [int(each[2]) for each in found]
    if len(places) < max(2, len(entries)) or len({each[1] for each in found}) > 1:
        return ()
    first, apart = places[0], places[1] - places[0]
    if apart < 1 or places != list(range(first, places[-1] + 1, apart)):
        return ()
    return found[0][1], str(first), str(apart), str(len(places))


def is_literal(a: Value, value: float) -> bool:
    """Checks whether a is this number."""
    return not isinstance(a, Expression) and not isinstance(a, bool) and a == value


def is_negated(a: Value) -> TypeGuard[Expression]:
    """Checks whether a is -b."""
    return isinstance(a, Expression) and a.operation == "neg"

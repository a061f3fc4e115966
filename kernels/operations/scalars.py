"""PyTorch's operations on each element, as operations on values; the names are PyTorch's."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from kernels.operations.expressions import MASK, Program, Value, kind_of

Scalar = Callable[..., Value]

# functions with the same name in C
SAME = ("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh",
        "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "erf", "erfc", "floor", "ceil", "trunc",
        "atan2", "hypot", "fmod", "copysign")  # fmt: skip


def scalars(p: Program) -> dict[str, Scalar]:
    """Returns all operations, for a program that collects the expressions."""
    same = {name: partial(p.call, name) for name in SAME}
    return same | arithmetic(p) | comparisons(p) | of_numbers(p)


def arithmetic(p: Program) -> dict[str, Scalar]:
    """Returns sums, products and quotients."""

    def add(a: Value, b: Value, alpha: float = 1) -> Value:
        if alpha == -1:
            return p.sub(a, b)
        return p.add(a, p.mul(float(alpha), b))

    def divided(a: Value, b: Value, rounding_mode: str | None = None) -> Value:
        if rounding_mode == "floor":
            return floor_divided(p, a, b)
        return p.call(rounding_mode, p.div(a, b)) if rounding_mode else p.div(a, b)

    def remainder(a: Value, b: Value) -> Value:
        rest = p.call("fmod", a, b)
        return p.select(has_other_sign(p, rest, b), p.add(rest, b), rest)

    return {
        "add": add,
        "sub": lambda a, b, alpha=1: add(a, b, -alpha),
        "mul": p.mul,
        "div": divided,
        "floor_divide": partial(floor_divided, p),
        "remainder": remainder,
        "pow": lambda a, b: p.power(a, float(b)) if isinstance(b, int | float) else p.call("pow", a, b),
    }


def comparisons(p: Program) -> dict[str, Scalar]:
    """Returns the operations with truth values as results."""

    def of_truths(name: str, operation: Scalar) -> Scalar:
        """Returns the operation for truth values only, since integers have no bits here."""

        def run(*given: Value) -> Value:
            if any(kind_of(a) != MASK for a in given):
                raise NotImplementedError(f"{name} of integers")
            return operation(*given)

        return run

    logical: dict[str, Scalar] = {
        "and": p.and_,
        "or": p.or_,
        "not": p.not_,
        "xor": lambda a, b: p.select(p.mask(a), p.not_(b), p.mask(b)),
    }
    return {
        "lt": p.lt,
        "le": p.le,
        "gt": lambda a, b: p.lt(b, a),
        "ge": lambda a, b: p.le(b, a),
        "eq": p.eq,
        "ne": lambda a, b: p.not_(p.eq(a, b)),
        **{f"logical_{name}": operation for name, operation in logical.items()},
        **{f"bitwise_{name}": of_truths(f"bitwise_{name}", each) for name, each in logical.items()},
        "isnan": lambda a: p.not_(p.eq(a, a)),
        "isinf": lambda a: p.eq(p.call("fabs", a), math.inf),
        "isfinite": lambda a: p.lt(p.call("fabs", a), math.inf),
    }


def of_numbers(p: Program) -> dict[str, Scalar]:
    """Returns functions of numbers, and choices between them."""

    def clamp(a: Value, low: Any = None, high: Any = None) -> Value:
        """Returns NaN for NaN; where the bounds cross, the upper bound."""
        a = a if low is None else p.max(a, low)
        return a if high is None else p.min(a, high)

    return {
        "neg": p.neg,
        **{name: p.number for name in ("positive", "conj_physical")},
        "abs": partial(p.call, "fabs"),
        "reciprocal": partial(p.div, 1.0),
        "rsqrt": lambda a: p.div(1.0, p.call("sqrt", a)),
        "sign": lambda a: p.sub(p.number(p.lt(0.0, a)), p.number(p.lt(a, 0.0))),
        "round": partial(p.call, "rint"),
        "sigmoid": lambda a: p.div(1.0, p.add(1.0, p.call("exp", p.neg(a)))),
        "relu": lambda a: p.max(a, 0.0),
        "minimum": p.min,
        "maximum": p.max,
        "where": p.select,
        **{name: clamp for name in ("clamp", "clamp_min")},
        "clamp_max": p.min,
    }


def has_other_sign(p: Program, rest: Value, b: Value) -> Value:
    """Checks whether the rest of a division is neither zero nor of the divisor's sign."""
    negative = p.lt(rest, 0.0)
    differs = p.select(p.lt(b, 0.0), p.not_(negative), negative)
    return p.and_(p.not_(p.eq(rest, 0.0)), differs)


def floor_divided(p: Program, a: Value, b: Value) -> Value:
    """Returns a // b as in PyTorch: from the exact remainder, so that 1 // 0.1 is 9."""
    rest = p.call("fmod", a, b)
    whole = p.div(p.sub(a, rest), b)
    whole = p.sub(whole, has_other_sign(p, rest, b))
    down = p.call("floor", whole)
    down = p.add(down, p.lt(0.5, p.sub(whole, down)))
    down = p.select(p.eq(whole, 0.0), p.call("copysign", 0.0, p.div(a, b)), down)
    return p.select(p.eq(b, 0.0), p.div(a, b), down)

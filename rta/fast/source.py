"""Parts of C99 for flight software: printed functions with the definitions that they need, constants, tables."""

import math
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from kernels.build import OF_ONE, OF_TWO, OWN, QUICK, header, macro
from kernels.printer import Printed
from rta.fast.filter import latency
from rta.filter import SafetyFilter

SCALAR, FUNCTIONS = header("scalar.h"), header("functions.h")


def driver_text(name: str) -> str:
    """Returns the text of a file of the folder driver."""
    return (files("rta.fast") / "driver" / name).read_text(encoding="utf-8")


def for_one(parts: Sequence[Printed]) -> str:
    """Returns printed functions for one spacecraft, with the definitions that they need."""
    text = "\n".join(each for part in parts for each in (*part.parts, part.text))
    return operations(text) + "\n" + text


def operations(text: str) -> str:
    """Returns the definitions that a text for one spacecraft needs."""
    called = set(re.findall(r"\b([A-Z][A-Z0-9_]*)\(", text))
    functions = ""
    if called & {name.upper() for name in OWN}:
        functions = FUNCTIONS
        called |= set(re.findall(r"\b([A-Z][A-Z0-9_]*)\(", functions))
    of_c = {macro(name, "double"): name for name in (*QUICK, *OF_ONE, *OF_TWO, "fabs")}
    own = [f"#define {call}(...) {of_c[call]}(__VA_ARGS__)" for call in sorted(called & of_c.keys())]
    needed = []
    for line in SCALAR.splitlines():
        defined = re.match(r"#define (\w+)", line)
        if not defined or re.search(rf"\b{defined[1]}\b", text + functions):
            needed.append(line)
    return "\n".join(["typedef double real;", *needed, *own, functions, ""])


def interface(safety_filter: SafetyFilter) -> str:
    """Returns in C the constants of a filter that its caller needs."""
    sent, (thrust, *_, torque) = latency(safety_filter), safety_filter.c.control_limit
    return "\n".join(
        [
            define("SAFETY_FILTER_PERIOD", float(safety_filter.period), "s, between two calls"),
            define("SAFETY_FILTER_THRUST", float(thrust), "N, of each axis at most"),
            define("SAFETY_FILTER_TORQUE", float(torque), "N m, of each axis at most"),
            define("SAFETY_FILTER_CONSTRAINTS", len(safety_filter.names)),
            define("SAFETY_FILTER_LATENCY", sent, "periods, age of a state at most"),
            define("SAFETY_FILTER_SENT_ROOM", max(1, sent)),
            "",
        ]
    )


def define(name: str, value: Any, comment: str = "") -> str:
    """Returns a named constant in C."""
    number = literal(value) if isinstance(value, float) else str(value)
    return f"#define {name} {number}" + (f" /* {comment} */" if comment else "")


def table(declaration: str, values: Sequence[Any], comment: str = "") -> str:
    """Returns a table in C."""
    return f"static const {declaration} = {entries(values)};" + (f" /* {comment} */" if comment else "")


def entries(values: Sequence[Any]) -> str:
    """Returns numbers, or lists of them, in braces; shorter lists are filled up with zeros."""
    longest = max((len(v) for v in values if isinstance(v, list | tuple)), default=0)
    padded = ([*v, *[0] * (longest - len(v))] if isinstance(v, list | tuple) else v for v in values)
    texts = (entries(v) if isinstance(v, list | tuple) else literal(v) for v in padded)
    return "{" + ", ".join(texts) + "}"


def literal(value: float) -> str:
    """Returns a number in C that is exactly this one."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value!r})" if value < 0 else repr(value)

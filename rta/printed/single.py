"""The filter's C in single precision: the same text with other types, literals, functions and tolerances."""

import re

from kernels.build import OF_ONE, OF_TWO, QUICK

# What rounding of 6e-8 leaves room for, in place of double precision's. The solver's are by the largest error of its
# own: sums of three products of a unit and a side of up to 100, of which at most 2 count where rows can be held.
TOLERANCES = {
    "VIOLATED": "1e-6f",
    "DEPENDENT": "1e-7f",
    "BLOCKING": "1e-6f",
    "ACCURATE": "1e-2f",
    "ROUNDED": "5e-7f",
    "FEASIBLE": "1e-5f",
}
LARGEST, SMALLEST = 3.4028234e38, 1e-37  # numbers that stay what they are
FUNCTIONS = (*QUICK, *OF_ONE, *OF_TWO, "fabs", "fmin", "fmax")
COMMENT = re.compile(r"(/\*.*?\*/|\"[^\"\n]*\")", re.DOTALL)  # or a text
LITERAL = re.compile(r"(?<![\w.])(\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])")
CALL = re.compile(rf"\b({'|'.join(FUNCTIONS)})(?=\()")
TOLERANCE = re.compile(rf"(?m)^(#define ({'|'.join(TOLERANCES)})) \S+")


def single(text: str) -> str:
    """C in double precision as C in single precision; comments and texts stay."""
    parts = COMMENT.split(text)
    parts[::2] = map(of_code, parts[::2])
    return "".join(parts)


def of_code(text: str) -> str:
    """`single` of what holds no comment."""
    text = TOLERANCE.sub(lambda match: f"{match[1]} {TOLERANCES[match[2]]}", text)
    text = LITERAL.sub(lambda match: literal(match[1]), text)
    return CALL.sub(r"\1f", re.sub(r"\bdouble\b", "float", text))


def literal(text: str) -> str:
    """A literal; of what guards a division and is out of reach, 1e-300 for a square and 1e-150, the tenth root."""
    value = float(text)
    if value > LARGEST:
        return f"{LARGEST}f"
    if 0.0 < value < SMALLEST:
        return f"{value**0.1:.3g}f"
    return f"{text}f"

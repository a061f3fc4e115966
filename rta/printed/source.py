"""The filter for one spacecraft as C99 for flight software: its constants, a driver, and its rows.

The driver in the folder of that name is written by hand and the same for every filter; what a filter's configuration
decides is constants. Its rows, and how a state is predicted, are printed as functions that the driver declares.
"""

import math
import re
from collections.abc import Sequence
from functools import partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from inspection.model.state import THRUST, TORQUE
from kernels.build import OF_ONE, OF_TWO, OWN, QUICK, header, macro
from kernels.printer import Printed, if_long, printed
from rta.barrier import ActuatorGroup
from rta.bounds.health import AXES, slewing
from rta.constraints.constraint import in_order, joined
from rta.printed import check_functions
from rta.qp import batched_solver
from rta.qp import programs as qp
from rta.qp.scaled import ScaledRows

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

# Rows of a program that can be active at once, and steps for each of them; a stage of a program that would take more
# counts as unsolved.
ACTIVE_MOST = 40
STEPS_PER_ROW = 4

GROUPS = ("thrust", "torque")
SCALAR, FUNCTIONS = header("scalar.h"), header("functions.h")


def source(safety_filter: "SafetyFilter", parts: Sequence[Printed] | None = None) -> str:
    """All of the filter in C, in one text; the function to call is `safety_filter`.

    Args:
        parts: what `functions` and `checks` of one print, if it is known.
    """
    parts = parts or [*functions(safety_filter), *check_functions.checks(safety_filter)]
    drivers, printed_text = map(driver_text, driver_files(safety_filter)), text_of(parts)
    texts = [*drivers, printed_text]
    head = ["#include <math.h>\n", interface(safety_filter), driver_text("filter.h")]
    return "\n".join([*head, constants(safety_filter, parts, "\n".join(texts)), *texts])


def driver_text(name: str) -> str:
    """A file of the driver."""
    return (files("rta.printed") / "driver" / name).read_text(encoding="utf-8")


def driver_files(safety_filter: "SafetyFilter") -> list[str]:
    """The files of the driver that a filter needs."""
    programs = ["solver.c", "rows.c"] if safety_filter.propose.kind != "none" else []
    check = [*check_files(safety_filter), "commit_one.c"] if safety_filter.backup else []
    return ["numbers.c", "round.c", *programs, *check, "filter.c"]


def check_files(safety_filter: "SafetyFilter") -> list[str]:
    """The files of the driver that check one spacecraft, and vectors of them."""
    return ["commit.c", "flight.c" if safety_filter.uncertainty.is_zero else "robust_check.c"]


def functions(safety_filter: "SafetyFilter") -> list[Printed]:
    """The functions that the driver declares, printed."""
    f, (x, u) = safety_filter, safety_filter.probe("cpu")
    uncertainty, given = f.uncertainty, ("x", "control", *(["left"] if f.uncertainty.health else []))
    names: list[tuple[str, tuple[str, ...], tuple[str, ...]]]
    names = [(f"{name}_rows", given, ScaledRows._fields) for name in GROUPS if f.propose.kind != "none"]
    if uncertainty.latency:
        names.append(("predict", ("x", "error_bound", "u"), ("x_after", "error_bound_after")))
    long = if_long(len(f.c.planes))  # of a hull
    found = [
        printed(run, *examples, name=name, names=(before, after), long=long)
        for (run, examples), (name, before, after) in zip(f.propose.batch_functions(x, u), names, strict=True)
    ]
    if f.propose.kind == "none":
        found.append(printed(partial(values, f), x, name="values", names=(("x",), ("h",)), long=long))
    if uncertainty.is_quantised:
        run = partial(quantised_thrust, f)
        found.append(printed(run, u[THRUST], name="quantised_thrust", names=(("thrust",), ("quantised",))))
    if uncertainty.health:
        names_of_turn = ("x", "torque", "left"), ("given",)
        examples = x, u[TORQUE], torch.ones_like(u)
        found.append(
            printed(partial(turn_in_time, f), *examples, name="turn_in_time", names=names_of_turn, long=AXES)
        )
    return found


def values(safety_filter: "SafetyFilter", x: Tensor) -> list[Tensor]:
    """`SafetyFilter.values`."""
    return [joined(*(group.values(x) for group in safety_filter.groups))]


def quantised_thrust(safety_filter: "SafetyFilter", thrust: Tensor) -> list[Tensor]:
    """`Uncertainty.quantised`."""
    return [safety_filter.uncertainty.quantised(thrust, safety_filter.c.max_thrust)]


def turn_in_time(safety_filter: "SafetyFilter", x: Tensor, torque: Tensor, left: Tensor) -> list[Tensor]:
    """`slewing`."""
    f = safety_filter
    return [slewing(x, torque, left, f.c, f.parameters, f.uncertainty)]


def for_one(parts: Sequence[Printed]) -> str:
    """Printed functions for one spacecraft, and what they are made of."""
    text = text_of(parts)
    return operations(text) + "\n" + text


def text_of(parts: Sequence[Printed]) -> str:
    """Printed functions."""
    return "\n".join(part.text for part in parts)


def operations(text: str) -> str:
    """What a text for one spacecraft is made of that is printed, or written alike."""
    called = set(re.findall(r"\b([A-Z][A-Z0-9_]*)\(", text))
    functions = ""
    if called & {name.upper() for name in OWN}:
        functions = FUNCTIONS
        called |= set(re.findall(r"\b([A-Z][A-Z0-9_]*)\(", functions))
    of_c = {macro(name, "double"): name for name in (*QUICK, *OF_ONE, *OF_TWO, "fabs")}
    own = [f"#define {call}(...) {of_c[call]}(__VA_ARGS__)" for call in sorted(called & of_c.keys())]
    needed = [line for line in SCALAR.splitlines() if is_needed(line, text + functions)]
    return "\n".join(["typedef double real;", *needed, *own, functions, ""])


def is_needed(line: str, text: str) -> bool:
    """Whether a line of SCALAR defines something that occurs in a text, or is no definition."""
    defined = re.match(r"#define (\w+)", line)
    return not defined or re.search(rf"\b{defined[1]}\b", text) is not None


def interface(safety_filter: "SafetyFilter") -> str:
    """The constants of a filter that who calls it needs, in C."""
    uncertainty = safety_filter.uncertainty
    return "\n".join(
        [
            define("SAFETY_FILTER_PERIOD", float(safety_filter.period), "s, between two calls"),
            define("SAFETY_FILTER_THRUST", float(safety_filter.groups[0].limit), "N, of each axis at most"),
            define("SAFETY_FILTER_TORQUE", float(safety_filter.groups[1].limit), "N m, of each axis at most"),
            define("SAFETY_FILTER_CONSTRAINTS", len(safety_filter.names)),
            define("SAFETY_FILTER_LATENCY", uncertainty.latency, "periods, age of a state at most"),
            define("SAFETY_FILTER_SENT_ROOM", max(1, uncertainty.latency)),
            define("SAFETY_FILTER_HEALTH", int(uncertainty.health), "1: what is left of actuators is given"),
            "",
        ]
    )


def constants(safety_filter: "SafetyFilter", parts: Sequence[Printed], text: str) -> str:
    """What the driver depends on of a filter's configuration, and the functions that it calls, in C.

    Args:
        text: of all that follows.
    """
    groups = safety_filter.groups
    rows = max(len(group.weights) for group in groups)
    soft = max(sum(map(math.isfinite, group.weights)) for group in groups)
    classes = max(len({w for w in group.weights if math.isfinite(w)}) for group in groups)
    places = in_order(*([(i, k) for k in range(len(group.names))] for i, group in enumerate(groups)))
    lines = [
        "/* Of two numbers the first is of thrust, the second of torque. */",
        define("CONSTRAINTS", "SAFETY_FILTER_CONSTRAINTS"),
        define("GROUP_CONSTRAINTS_MAX", max(len(group.names) for group in groups)),
        define("GROUP_ROWS_MAX", rows),
        define("ROWS_MAX", "(6 + GROUP_ROWS_MAX)", "of a program, with the actuators' limits"),
        define("ACTIVE_MAX", min(3 + soft, ACTIVE_MOST), "rows, beyond which a stage counts as unsolved"),
        define("STEPS_MAX", f"({STEPS_PER_ROW} * ACTIVE_MAX)", "of a stage, the same"),
        define("CLASSES_MAX", classes, "different weights of rows that have slack"),
        define("LATENCY", "SAFETY_FILTER_LATENCY"),
        define("HEALTH", "SAFETY_FILTER_HEALTH"),
        define(
            "QUANTISED", int(safety_filter.uncertainty.is_quantised), "1: thrusters give some values only"
        ),
        define("PROGRAMS", int(safety_filter.propose.kind != "none"), "0: there are no rows"),
        *tolerances(),
        "static const double LIMIT[2] = {SAFETY_FILTER_THRUST, SAFETY_FILTER_TORQUE};",
        "#if PROGRAMS",
        table("int ROWS[2]", [len(group.weights) for group in groups]),
        table("int CONSTRAINT_OF_ROW[2][GROUP_ROWS_MAX]", [constraint_of_row(group) for group in groups]),
        table("double WEIGHT[2][GROUP_ROWS_MAX]", [group.weights for group in groups], "of slack, by row"),
        "#endif",
        table("int CONSTRAINTS_OF[2]", [len(group.names) for group in groups]),
        table(
            "int PLACE[2][GROUP_CONSTRAINTS_MAX]",
            [[places.index((i, k)) for k in range(len(group.names))] for i, group in enumerate(groups)],
            "in the constraints' order, of each of a group",
        ),
    ]
    lines += [define(name, *said) for name, said in check_functions.constants(safety_filter.backup).items()]
    if safety_filter.backup:
        lines.append(group_of(safety_filter))
    return "\n".join([*lines, operations(text), *map(declared, parts)]) + "\n"


def group_of(safety_filter: "SafetyFilter") -> str:
    """Which group enforces each constraint, in C."""
    torque = [int(name in safety_filter.groups[1].names) for name in safety_filter.names]
    return table("int GROUP_OF[CONSTRAINTS]", torque, "0: thrust enforces it, 1: torque")


def tolerances() -> list[str]:
    """The solver's and the programs'; numbers without a unit are in that of a program."""
    return [
        "\n/* Controls of a program are in units of the actuators' limits, and so are these. */",
        define("VIOLATED", batched_solver.VIOLATED, "a row is violated below minus this"),
        define(
            "DEPENDENT", batched_solver.DEPENDENT, "|z|^2 / |normal|^2 up to which a row counts as dependent"
        ),
        define("BLOCKING", batched_solver.BLOCKING, "fall of a multiplier per unit of pressure that is none"),
        define(
            "ACCURATE", batched_solver.ACCURATE, "violation of optimality up to which a program is solved"
        ),
        define("ROUNDED", 0.0, "of the multipliers' sum, what rounding may bring into that"),
        define("FEASIBLE", qp.FEASIBLE, "violation of a row that counts as none"),
        define(
            "REDUNDANT", qp.REDUNDANT, "|a u| <= sqrt(3) within the limits: with b >= 2 a row never binds"
        ),
        define("LARGEST_DEMAND", qp.LARGEST_DEMAND, "longer demands are shortened to it"),
        define("ENDLESS", qp.ENDLESS, "N or N m, for infinity"),
        define("HOPELESS", qp.HOPELESS, "keeps the slack of a row that no control can hold in range"),
        "",
    ]


def declared(function: Printed) -> str:
    """The prototype of a printed function for one spacecraft; arrays of several axes are row-major."""
    given = [f"const V {part.name}[{part.size}]" for part in function.inputs]
    found = [f"V {part.name}[{part.size}]" for part in function.outputs]
    return f"static void {function.name}({', '.join([*given, *found])});"


def constraint_of_row(group: ActuatorGroup) -> list[int]:
    """By row, the index of its constraint."""
    return [k for k, each in enumerate(group.constraints) for _ in range(each.rows)]


def define(name: str, value: Any, comment: str = "") -> str:
    """A named constant in C."""
    number = literal(value) if isinstance(value, float) else str(value)
    return f"#define {name} {number}" + (f" /* {comment} */" if comment else "")


def table(declaration: str, values: Sequence[Any], comment: str = "") -> str:
    """A table in C."""
    return f"static const {declaration} = {entries(values)};" + (f" /* {comment} */" if comment else "")


def entries(values: Sequence[Any]) -> str:
    """Numbers, or lists of them, in braces; shorter lists are filled up with zeros."""
    longest = max((len(v) for v in values if isinstance(v, list | tuple)), default=0)
    padded = ([*v, *[0] * (longest - len(v))] if isinstance(v, list | tuple) else v for v in values)
    texts = (entries(v) if isinstance(v, list | tuple) else literal(v) for v in padded)
    return "{" + ", ".join(texts) + "}"


def literal(value: float) -> str:
    """A number in C that is exactly this one."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value!r})" if value < 0 else repr(value)

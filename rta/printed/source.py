"""The filter for one spacecraft as C99 for flight software: its constants, a driver, and its rows.

The driver in the folder of that name is written by hand and the same for every filter; what a filter's configuration
decides is constants. Its rows, and how a state is predicted, are printed as functions that the driver declares.
"""

import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from torch import Tensor

from inspection.model.state import CONTROL_SIZE, SIZE
from kernels import Printed, if_long, printed
from rta.backup import homing
from rta.bounds.health import NEAR
from rta.conditions import tangents
from rta.conditions.held_rows import KINDS, HeldGroup
from rta.conditions.rows import ActuatorGroup
from rta.conditions.tangents import PASSES, Prepared, prepared_now
from rta.constraints.constraint import in_order
from rta.constraints.names import CONSTRAINTS
from rta.printed import way
from rta.qp import batched_solver
from rta.qp import programs as qp

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

# Rows of a program that can be active at once, and steps for each of them; a stage of a program that would take more
# counts as unsolved. Where controls are held, more could be independent, up to 163. Of the programs of a million states
# at and beyond the limits of a filter called every 10 s none had more than 29 active, none took more than 86 steps.
ACTIVE_MOST = 40
STEPS_PER_ROW = 4

GROUPS = ("thrust", "torque")
SCALAR = (files("kernels") / "scalar.h").read_text(encoding="utf-8")


def source(safety_filter: "SafetyFilter", parts: Sequence[Printed] | None = None) -> str:
    """All of the filter in C, in one text; the function to call is `safety_filter`.

    Args:
        parts: what `functions` and `checks` of one print, if it is known.
    """
    parts = parts or [*functions(safety_filter), *way.of_one(way.checks(safety_filter))]
    return driver(safety_filter) + "\n" + for_one(parts)


def driver(safety_filter: "SafetyFilter") -> str:
    """All of the filter in C but for the functions that are declared in it, in one text."""
    names = ["filter.h", *driver_files(safety_filter)]
    texts = [driver_text(name) for name in names]
    return "\n".join(
        ["#include <math.h>\n", interface(safety_filter), *texts[:1], constants(safety_filter), *texts[1:]]
    )


def driver_text(name: str) -> str:
    """A file of the driver."""
    return (files("rta.printed") / "driver" / name).read_text(encoding="utf-8")


def driver_files(safety_filter: "SafetyFilter") -> list[str]:
    """The files of the driver that a filter needs."""
    commit = ["commit.c"] if safety_filter.backup else []
    if not safety_filter.holds:
        return ["solver.c", "programs.c", *commit, "filter_now.c"]
    known = safety_filter.known
    optional = [("thrusters.c", known.is_coarse), ("health.c", known.health)]
    used = [name for name, is_used in optional if is_used]
    turn = ["turn.c"] if safety_filter.turn else []
    turn += ["homing.c"] if safety_filter.homing else []
    return ["solver.c", "programs.c", "search.c", *used, *commit, *turn, "filter_held.c"]


def functions(safety_filter: "SafetyFilter") -> list[Printed]:
    """The functions that the driver declares, printed."""
    given = safety_filter.probe("cpu")
    parts: Sequence[tuple[Callable[..., Sequence[Tensor]], tuple[Tensor, ...]]]
    parts = [(partial(prepared_now, group), given) for group in safety_filter.groups]
    if safety_filter.holds:
        parts = safety_filter.condition.parts(*given)
    names: list[tuple[str, tuple[tuple[str, ...], tuple[str, ...]]]]
    names = [(f"{name}_rows", (("x", "control", "error_bound", "left"), Prepared._fields)) for name in GROUPS]
    names.append(("predict", (("x", "error_bound", "u"), ("x_after", "error_bound_after"))))
    long = if_long(len(safety_filter.c.planes))  # of a hull
    return [
        printed(run, *examples, name=name, names=(before[: len(examples)], after), long=long)
        for (run, examples), (name, (before, after)) in zip(parts, names, strict=False)
    ]


def held_groups(safety_filter: "SafetyFilter") -> list[HeldGroup]:
    """Thrust and torque where controls are held; none where rows are of the rate now."""
    return [group for group in safety_filter.groups if isinstance(group, HeldGroup)]


def for_one(parts: Sequence[Printed]) -> str:
    """Printed functions for one spacecraft, and what they are made of."""
    text = "\n".join(part.text for part in parts)
    calls = sorted(
        set(re.findall(r"\b([A-Z][A-Z0-9_]*)\(", text)) - set(re.findall(r"define (\w+)\(", SCALAR))
    )
    own = [f"#define {call}(...) {call.lower()}(__VA_ARGS__)" for call in calls]
    known = [line for line in SCALAR.splitlines() if is_needed(line, text)]
    return "\n".join(["typedef double real;", *known, *own, "", text])


def is_needed(line: str, text: str) -> bool:
    """Whether a line of SCALAR defines something that occurs in a text, or is no definition."""
    defined = re.match(r"#define (\w+)", line)
    return not defined or re.search(rf"\b{defined[1]}\b", text) is not None


def interface(safety_filter: "SafetyFilter") -> str:
    """The constants of a filter that who calls it needs, in C."""
    known, held = safety_filter.known, safety_filter.holds
    return "\n".join(
        [
            define("SAFETY_FILTER_PERIOD", float(safety_filter.period), "s, between two calls"),
            define("SAFETY_FILTER_THRUST", float(safety_filter.groups[0].limit), "N, of each axis at most"),
            define("SAFETY_FILTER_TORQUE", float(safety_filter.groups[1].limit), "N m, of each axis at most"),
            define("SAFETY_FILTER_CONSTRAINTS", len(safety_filter.names)),
            define("SAFETY_FILTER_LATENCY", known.latency, "periods, age of a state at most"),
            define("SAFETY_FILTER_SENT_ROOM", max(1, known.latency)),
            define(
                "SAFETY_FILTER_HEALTH", int(held and known.health), "1: what is left of actuators is told"
            ),
            "",
        ]
    )


def constants(safety_filter: "SafetyFilter") -> str:
    """What the driver depends on of a filter's configuration, and the functions that it calls, in C."""
    groups, holds = safety_filter.groups, safety_filter.holds
    passes = PASSES if holds else 1
    rows = max(len(group.weights) for group in groups)
    soft = max(sum(map(math.isfinite, group.weights)) for group in groups)
    classes = max(len({w for w in group.weights if math.isfinite(w)}) for group in groups)
    places = in_order(*([(i, k) for k in range(len(group.names))] for i, group in enumerate(groups)))
    lines = [
        "/* Of two numbers the first is of thrust, the second of torque. */",
        define("CONSTRAINTS", "SAFETY_FILTER_CONSTRAINTS"),
        define("GROUP_CONSTRAINTS_MAX", max(len(group.names) for group in groups)),
        define("GROUP_ROWS_MAX", rows),
        define("PASSES", passes, "programs solved for one control at most, each with a group's rows more"),
        define("ROWS_MAX", "(6 + (PASSES * GROUP_ROWS_MAX))", "of a program, with the actuators' limits"),
        define(
            "ACTIVE_MAX", min(3 + passes * soft, ACTIVE_MOST), "rows, beyond which a stage counts as unsolved"
        ),
        define("STEPS_MAX", f"({STEPS_PER_ROW} * ACTIVE_MAX)", "of a stage, the same"),
        define("CLASSES_MAX", classes, "different weights of rows that have slack"),
        define("LATENCY", "SAFETY_FILTER_LATENCY"),
        define("HEALTH", "SAFETY_FILTER_HEALTH"),
        define("COARSE", int(holds and safety_filter.known.is_coarse), "1: thrusters give some values only"),
        *tolerances(holds),
        "static const double LIMIT[2] = {SAFETY_FILTER_THRUST, SAFETY_FILTER_TORQUE};",
        table("int ROWS[2]", [len(group.weights) for group in groups]),
        table("int CONSTRAINTS_OF[2]", [len(group.names) for group in groups]),
        table("int CONSTRAINT_OF_ROW[2][GROUP_ROWS_MAX]", [constraint_of_row(group) for group in groups]),
        table("double WEIGHT[2][GROUP_ROWS_MAX]", [group.weights for group in groups], "of slack, by row"),
        table(
            "int PLACE[2][GROUP_CONSTRAINTS_MAX]",
            [[places.index((i, k)) for k in range(len(group.names))] for i, group in enumerate(groups)],
            "in the constraints' order, of each that a group holds",
        ),
    ]
    if holds:
        lines += held_constants(safety_filter)
    lines.append(
        define("BACKUP", int(safety_filter.backup is not None), "1: controls are checked, see commit.c")
    )
    if safety_filter.backup:
        lines += [define(name, *said) for name, said in way.constants(safety_filter.backup).items()]
        kept = [int(name in CONSTRAINTS) for name in safety_filter.names]
        lines.append(table("int IS_KEPT[CONSTRAINTS]", kept, "where a way is verified"))
        lines += [f"static void {name}({given});" for name, given in way.DECLARED.items()]
    if safety_filter.homing:
        lines.append(
            define("HELD_CALLS", homing.calls(safety_filter.homing.haven), "thrust is checked, see homing.c")
        )
        lines += [f"static void {name}({given});" for name, given in way.OF_HOMING.items()]
    if safety_filter.turn:
        lines.append(define("TURN", 1, "torque is checked, see turn.c"))
        lines += [f"static void {name}({given});" for name, given in way.OF_TURN.items()]
    if safety_filter.homing or safety_filter.turn:
        lines += [define(name, *said) for name, said in way.trials().items()]
        kept = [int(name in CONSTRAINTS) for name in safety_filter.names]
        lines.append(table("int IS_KEPT[CONSTRAINTS]", kept, "where a way is verified"))
    lines += [declared(name, group, holds) for name, group in zip(GROUPS, groups, strict=True)]
    if holds and safety_filter.known.latency:
        given = f"const double x[{SIZE}], const double error_bound[{KINDS}], const double u[{CONTROL_SIZE}]"
        lines.append(
            f"static void predict({given},\n    double x_after[{SIZE}], double error_bound_after[{KINDS}]);"
        )
    return "\n".join(lines) + "\n"


def tolerances(holds: bool) -> list[str]:
    """The solver's, the programs' and the tangents'; numbers without a unit are in that of a program."""
    lines = [
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
    ]
    if holds:
        lines += [
            define("TOLERATED", tangents.TOLERATED, "by which rows themselves may be short"),
            define("INSET", tangents.INSET, "by which tangents ask for more, so that few of them are enough"),
            define("PASSES_AT_REST", tangents.PASSES_AT_REST, "of the second search"),
            define(
                "IN_VAIN",
                tangents.IN_VAIN,
                "passes in a row that bring nothing, after which no more are tried",
            ),
            define("FARTHEST", tangents.FARTHEST, "above all distances squared"),
            define("ABOVE", tangents.ABOVE, "what a row lacks counts so much more than in the next class"),
        ]
    return [*lines, ""]


def held_constants(safety_filter: "SafetyFilter") -> list[str]:
    """What only the driver of held controls needs."""
    c, r, known = safety_filter.c, safety_filter.parameters, safety_filter.known
    group = held_groups(safety_filter)[0]
    constraints = in_order(*(each.constraints for each in safety_filter.groups))
    first = [group.gain(each.gains[0]) if each.degree == 2 else 0.0 for each in constraints]
    lines = [
        table("double INERTIA[3]", c.inertia, "kg m^2"),
        define("HOLD", group.moments[-1], "s, the longest time that a control is held"),
        define(
            "RATE_LIMIT", c.max_rate - known.rate_offset(c), "rad/s, of each axis relative to Hill's frame"
        ),
        table("double LAST_GAIN[CONSTRAINTS]", [group.gain(each.gains[-1]) for each in constraints], "1/s"),
        table("double FIRST_GAIN[CONSTRAINTS]", first, "1/s; 0 of relative degree one"),
        table(
            "double DOUBLING[CONSTRAINTS]",
            [each.doubling for each in constraints],
            "barrier at twice the gain",
        ),
        define("LARGEST_GAIN", group.gain(math.inf), "1/s"),
    ]
    if known.is_coarse:
        lines += [
            define("MINIMUM_THRUST", float(known.minimum_thrust), "N; 0: none"),
            define("THRUST_QUANTUM", float(known.thrust_quantum), "N; 0: none"),
            define("LARGEST_THRUST", known.largest_thrust(c.max_thrust), "N, that the thrusters give"),
            define("THRUST_GAP", known.gap, "N, between two values that they give"),
            define("ABOVE_LEAST", 1e-9, "of itself: the least, rounded down, would be nothing"),
        ]
    if known.health:
        lines += [
            define("NEAR_RADIUS", NEAR, "of the radius, along axes that give less, which is left as it is"),
            define("COSINE_OF_EXCLUSION", math.cos(c.field_of_view / 2 + c.exclusion_buffer)),
            define(
                "LEAST_TORQUE", known.torque[0], "share of what the model's torque does, of a healthy axis"
            ),
            define(
                "NATURAL_ACCELERATION", c.max_thrust / c.mass - c.max_acceleration, "m/s^2, the strongest"
            ),
            define(
                "LEAST_BRAKING", known.max_acceleration(c, r), "m/s^2, of healthy thrusters in any attitude"
            ),
            define("MAX_DISTANCE", float(c.max_distance), "m, of the keep-in zone"),
        ]
    return lines


def declared(name: str, group: ActuatorGroup, holds: bool) -> str:
    """The function of a group's rows, see `struct rows`; arrays of the rows' normals are row-major."""
    rows, constraints = len(group.weights), len(group.names)
    more = f", const double error_bound[{KINDS}], const double left[{CONTROL_SIZE}]" if holds else ""
    tightening = f" double tightening[{rows}]," if holds else ""
    return (
        f"static void {name}_rows(const double x[{SIZE}], const double control[{CONTROL_SIZE}]{more},\n"
        f"    double psi[{rows}], double a[{3 * rows}], double b[{rows}], double b_bare[{rows}],\n"
        f"    double waived[{rows}], double h[{constraints}],{tightening} double length[{rows}], double lowest[1]);"
    )


def constraint_of_row(group: ActuatorGroup) -> list[int]:
    """By row, the index of its constraint."""
    return [k for k, each in enumerate(group.constraints) for _ in range(group.count(each))]


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

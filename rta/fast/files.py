"""The filter in C as a directory for flight software: header, source, example, vectors, test and Makefile."""

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Sequence
from itertools import chain
from pathlib import Path
from textwrap import wrap

from torch import Tensor

from inspection.model.dynamics import step
from kernels.cache import remembered
from kernels.exported import REFUSES_FAST_MATH, check_directory, check_prefix, prefixed
from kernels.printer import printed
from rta.fast.filter import latency, printed_answer
from rta.fast.source import define, driver_text, entries, for_one, interface, table
from rta.fast.vectors import vectors
from rta.filter import SafetyFilter
from rta.names import UNITS
from rta.result import Status

VERSION = "1.0.0"  # of this program
MARK = "Written by main.py export --filter"  # on the first line of each
NOT_VERIFIED = "NOT VERIFIED: no campaign is known that has flown this filter."
TOLERANCE = 1e-9  # of controls in the test, in units of the actuators' limits
TOLERANCE_OF_H = 1e-9  # of h in the test, relative for values above 1
NAME = "safety_filter"  # the beginning of the names of files, functions, types and macros
NAMES = ("safety_filter.h", "safety_filter.c", "safety_filter_vectors.h", "test_safety_filter.c", "example.c")
SUMS = "safety_filter.sha256"
BUILT = ("test_safety_filter", "example", "safety_filter.o", "safety_filter.su")  # made by the Makefile
WIDTH = 115  # characters in a line

STATE = {  # components by name: unit and meaning
    **{f"position_{i}": "m, in Hill's frame: x away from the Earth, y along the orbit" for i in "xyz"},
    **{f"velocity_{i}": "m/s, in Hill's frame" for i in "xyz"},
    **{f"attitude_{i}": "quaternion of length 1 from the body's frame to Hill's" for i in "xyzw"},
    **{f"rate_{i}": "rad/s, of the body relative to Hill's frame, in the body's" for i in "xyz"},
    "temperature": "deg C, of the surface whose limit is kept",
    "energy": "kJ, in the battery",
    "sun": "rad, angle of the Sun from +x in Hill's x-y plane",
}
CONTROL = {f"thrust_{i}": "N, in the body's frame" for i in "xyz"}
CONTROL |= {f"torque_{i}": "N m, in the body's frame" for i in "xyz"}
MEANING = {
    Status.UNTOUCHED: "the desired control, which satisfies every condition",
    Status.HARD: "clipped or corrected: it satisfies every condition, is verified, or the check replaced the program's",
    Status.SLACK: "the program's control leaves a condition unsatisfied, and what is applied is not verified",
    Status.UNSOLVED: "no solution, a state that is too old, or one with NaN (zero control); not verified",
}


def write(
    safety_filter: SafetyFilter,
    directory: str | Path,
    verified: str = NOT_VERIFIED,
    configuration: str = "",
    prefix: str = NAME,
) -> dict[str, str]:
    """Writes a filter, with limits of your own, into a directory, which may hold an older one.

    Args:
        verified: the header's text on verification; configuration: the SHA-256 of all settings, "": of the filter's
            own.
        prefix: of all files, functions, types and macros, so that several filters fit into one program.

    Returns:
        The text of each file.

    Raises:
        ValueError: the directory holds anything else, or the prefix is no name in C; OSError: it cannot be written.
    """
    folder = Path(directory)
    check_prefix(prefix)
    names, built = ([prefixed(each, NAME, prefix) for each in own] for own in ((*NAMES, SUMS), BUILT))
    check_directory(folder, "filter", MARK, (*names, "Makefile"), built)
    texts = sources(safety_filter, verified, configuration, prefix)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return texts


def sources(
    safety_filter: SafetyFilter,
    verified: str = NOT_VERIFIED,
    configuration: str = "",
    prefix: str = NAME,
    only: Sequence[str] = (*NAMES, "Makefile", SUMS),
) -> dict[str, str]:
    """Returns the text of each file in `only`, by name; see `write`."""

    def change(text: str) -> str:
        return prefixed(text, NAME, prefix)

    source = change(implementation(safety_filter))
    settings = configuration or fingerprint(safety_filter)
    head = change(header(safety_filter, verified, settings, digest(source)))
    sums = [f"{digest(text)}  {change(name)}" for name, text in zip(NAMES, (head, source), strict=False)]
    texts: dict[str, Callable[[], str]] = {
        "safety_filter.h": lambda: head,
        "safety_filter.c": lambda: source,
        "safety_filter_vectors.h": lambda: change(vectors_header(safety_filter)),
        "test_safety_filter.c": lambda: f"/* {MARK}. */\n" + change(driver_text("test_safety_filter.c")),
        "example.c": lambda: (
            f"/* {MARK}. */\n" + change(driver_text("example.c") + "\n" + model(safety_filter))
        ),
        "Makefile": lambda: f"# {MARK}.\n" + change(driver_text("safety_filter.mk")),
        SUMS: lambda: "\n".join([f"# {MARK}", *sums, ""]),
    }
    return {change(name): texts[name]() for name in only}


def digest(text: str) -> str:
    """Returns the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(safety_filter: SafetyFilter) -> str:
    """Returns the SHA-256 of a filter's parts; for limits of their names, gains and weights."""
    _, parts = safety_filter.__reduce__()
    limits = [(name, limit.gains, limit.weight) for name, limit in safety_filter.limits.items()]
    plain = [vars(part) for part in parts if dataclasses.is_dataclass(part)]
    return digest(json.dumps([*plain, limits], sort_keys=True, default=repr))


# the header


def header(safety_filter: SafetyFilter, verified: str, configuration: str, source: str) -> str:
    """Returns the text of safety_filter.h."""
    places = [(name, f"h in {UNITS.get(name, 'a unit of its own')}") for name in safety_filter.names]
    status = [(each.name, text) for each, text in MEANING.items()]
    lines = [
        f"/* {MARK}: a safety filter for one spacecraft.",
        " *",
        *(f" * {line}".rstrip() for line in (*folded(verified), *folded(about(safety_filter)))),
        " */",
        "#ifndef SAFETY_FILTER_H",
        "#define SAFETY_FILTER_H",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        "",
        f'#define SAFETY_FILTER_VERSION "{VERSION}"',
        f'#define SAFETY_FILTER_CONFIGURATION "{configuration}" /* SHA-256 */',
        f'#define SAFETY_FILTER_SOURCE "{source}" /* SHA-256 of safety_filter.c */',
        define(
            "SAFETY_FILTER_VERIFIED",
            int(not verified.startswith("NOT VERIFIED")),
            "1: by the campaigns above",
        ),
        "",
        interface(safety_filter),
        enumeration("state", "STATE_", list(STATE.items())),
        enumeration("control", "CONTROL_", list(CONTROL.items())),
        enumeration("constraint", "H_", places),
        enumeration("status", "", status),
        driver_text("filter.h"),
        "extern const char *const safety_filter_names[SAFETY_FILTER_CONSTRAINTS]; /* of the constraints */",
        "",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def about(safety_filter: SafetyFilter) -> str:
    """Explains the numbers of the header to its reader."""
    return (
        f"It is to be called every {safety_filter.period:g} s, with the state as measured and the control that is "
        f"wanted, and answers with the control to hold. It computes in double precision, allocates nothing, does "
        "not recurse, has no global state, and needs math.h alone. All vectors are in the order of the enumerations. "
        "It does not notice a quaternion whose length is not 1. If a desired thrust or torque is NaN, all three of "
        "them are read as zero, which is filtered."
    )


def folded(text: str) -> list[str]:
    """Returns paragraphs in lines of WIDTH, followed by an empty line."""
    parts = [wrap(part, WIDTH, subsequent_indent="  ") or [""] for part in text.splitlines()]
    return [*chain(*parts), ""]


def enumeration(kind: str, prefix: str, members: Sequence[tuple[str, str]]) -> str:
    """Returns an enumeration whose members have comments; raises ValueError if two have the same name in C."""
    members = [(prefix + re.sub(r"\W", "_", name, flags=re.ASCII), text) for name, text in members]
    names = [name.upper() for name, _ in members]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two constraints would be {twice[0]} in C: give one of them another name")
    lines = [
        f"    SAFETY_FILTER_{name.upper()} = {i}, /* {text} */" for i, (name, text) in enumerate(members)
    ]
    lines[-1] = lines[-1].replace(", /*", "  /*", 1)
    return "\n".join([f"enum safety_filter_{kind} {{", *lines, "};", ""])


# the source


def implementation(safety_filter: SafetyFilter) -> str:
    """Returns the text of safety_filter.c: functions stand before their callers, the order of a call last."""
    function = remembered(printed_answer, safety_filter, True)
    strings = [json.dumps(name, ensure_ascii=False) for name in safety_filter.names]
    names = ",\n".join(f"    {each}" for each in strings).replace("??", r"?\?")  # without trigraphs
    sent = define("SENT", "&sent[0][0]," if latency(safety_filter) else "")
    return "\n".join(
        [
            f"/* {MARK}: see safety_filter.h. The order of a call is in `filter`, near the end; V is a number, M a",
            " * truth value. */",
            '#include "safety_filter.h"',
            "",
            "#include <math.h>",
            "",
            REFUSES_FAST_MATH.format(name="safety_filter.c"),
            "",
            f"const char *const safety_filter_names[SAFETY_FILTER_CONSTRAINTS] = {{\n{names}\n}};",
            "",
            for_one([function]),
            sent,
            driver_text("call.c"),
        ]
    )


# the test's vectors, and the example's model


def vectors_header(safety_filter: SafetyFilter) -> str:
    """Returns the text of safety_filter_vectors.h."""
    found = vectors(safety_filter)
    result, count = found.result, found.state.shape[1]
    inputs = ",\n".join(of_call(*(part[..., i] for part in found[:3])) for i in range(count))
    return "\n".join(
        [
            f"/* {MARK}: calls of the filter, and what Python answers. */",
            "#ifndef SAFETY_FILTER_VECTORS_H",
            "#define SAFETY_FILTER_VECTORS_H",
            "",
            "#include <math.h>",
            "",
            '#include "safety_filter.h"',
            "",
            define("VECTORS", count),
            define("TOLERANCE", TOLERANCE, "of controls, in units of the actuators' limits"),
            define("TOLERANCE_OF_H", TOLERANCE_OF_H, "of the constraints' values, relative to those above 1"),
            "",
            f"static const struct safety_filter_input given[VECTORS] = {{\n{inputs}\n}};",
            "",
            table("int expected_status[VECTORS]", result.status.tolist()),
            table("int expected_verified[VECTORS]", result.verified.int().tolist()),
            table("int expected_backup[VECTORS]", result.backup.int().tolist()),
            table("int expected_violated[VECTORS]", result.violated.int().tolist()),
            table("double expected_control[VECTORS][6]", result.control.T.tolist()),
            table("double expected_h[VECTORS][SAFETY_FILTER_CONSTRAINTS]", result.h.T.tolist()),
            table("int expected_active[VECTORS][SAFETY_FILTER_CONSTRAINTS]", result.active.T.int().tolist()),
            "",
            "#endif",
            "",
        ]
    ).replace("}, {", "},\n    {")


def of_call(x: Tensor, desired: Tensor, sent: Tensor) -> str:
    """Returns the initialiser of a struct safety_filter_input."""
    parts = [f".state = {entries(x.tolist())}", f".desired = {entries(desired.tolist())}"]
    if len(sent):
        parts += [f".sent = {entries(sent.tolist())}", f".sent_count = {len(sent)}"]
    return "    {" + ",\n     ".join(parts) + "}"


def model(safety_filter: SafetyFilter) -> str:
    """Returns the step of the model that example.c flies."""
    x, u = safety_filter.probe()[:2]
    second = printed(
        lambda x, u: [step(x, u, 1.0, safety_filter.c)],
        x,
        u,
        name="model_step",
        names=(("x", "u"), ("y",)),
        single=True,
    )
    return for_one([second])

"""Control flow while it is recorded, see `kernels.control`: what is called becomes a function of C of its own.

A call or a loop is one expression, of all values that it is given; its results are expressions of it. A function is
told in which columns it is wanted (`on`), and asks for no more of what it calls itself. For one column it is only
called where it is wanted, and is not told.
"""

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from kernels.exported import TAKEN
from kernels.operations.expressions import MASK, NUMBER, Expression, Program, Value
from kernels.operations.shapes import filled
from kernels.parts import Called, Part, Recorded, has_tensors, mapped, part_of
from kernels.recorder import ACTIVE, Recorder, evaluated, tensors

OWN = re.compile(  # names that printed text has itself, see kernels.waiting
    "[ty][0-9]+|on|[ik]|next.*|at|column|count|end|first|in|in_step|lanes?|last|list|loop|out|out_step|segment|start|there|to|"
    "turns|wants|work"
)
ONCE = "once"  # how often `when` calls a function


def active() -> Recorder | None:
    """What records this thread's operations; None: nothing does."""
    return ACTIVE.all[-1] if ACTIVE.all else None


def recorded(
    function: Callable[..., Any],
    examples: Sequence[Tensor],
    name: str,
    names: tuple[Sequence[str], Sequence[str]] | None,
    long: int,
    single: bool,
) -> tuple[Recorded, Called]:
    """A function, and all that it calls; arguments as of `kernels.printer.printed`."""
    given, results = names or ([f"x{i}" for i in range(len(examples))], None)
    kinds = {part_of(each, x).kind for each, x in zip(given, examples, strict=True)}
    for real in ("float", "double") if {"float"} <= kinds <= {"float", "bool"} else ("double",):
        called = Called(real, single)
        found = record(called, function, examples, name, given, results, long)
        if real == "double" or not called.is_double:
            break
    return found, called


def record(
    called: Called,
    function: Callable[..., Any],
    examples: Sequence[Tensor],
    name: str,
    given: Sequence[str],
    results: Sequence[str] | None,
    long: int,
) -> Recorded:
    """A function of tensors, with names of its arguments and, None: as it names them, of its results."""
    inputs = [part_of(each, x) for each, x in zip(given, examples, strict=True)]
    program = Program(called.real, called.single)
    recorder = Recorder(program, long, True if called.single else program.input("on", MASK), called)
    returned, values = evaluated(function, examples, inputs, recorder)
    called.is_double |= recorder.is_double
    listed = [returned] if isinstance(returned, Tensor) else list(returned)
    results = results or getattr(returned, "_fields", [f"y{i}" for i in range(len(listed))])
    results = [f"{each}_after" if each in given else each for each in results]
    return Recorded(
        name=name,
        about=(inspect.getdoc(function) or "").split("\n")[0],
        program=program,
        inputs=inputs,
        outputs=[part_of(each, y) for each, y in zip(results, listed, strict=True)],
        values=values,
        long=long,
        dtypes=[y.dtype for y in listed],
        like=like(returned),
    )


def like(returned: Any) -> Callable[[list[Tensor]], Any]:
    """Makes of a list of tensors what a function returned: a tensor, a named tuple, or the list."""
    if isinstance(returned, Tensor):
        return lambda tensors: tensors[0]
    return type(returned)._make if hasattr(returned, "_make") else list


# what `kernels.control` records


def call(recorder: Recorder, function: Callable[..., Any], given: Sequence[Any], long: int, name: str) -> Any:
    """A function that is printed once."""
    callee = one(recorder, function, function, given, None, long, name)
    found = recorder.program.make("call", callee.name, recorder.on, *values_of(recorder, given))
    return callee.like(results_of(recorder, callee, found))


def loop(
    recorder: Recorder,
    body: Callable[..., tuple[Sequence[Tensor], Tensor]],
    state: Sequence[Tensor],
    given: Sequence[Any],
    alive: Tensor,
    most: int,
    waits: bool,
    long: int,
) -> list[Tensor]:
    """A loop, whose body is printed as a function."""

    def turn(*all_given: Any) -> list[Tensor]:
        following, goes_on = body(*all_given)
        return [*following, goes_on]

    if most < 1:
        return list(state)
    both = (*state, *given)
    names = [*names_of(body, both)[: len(state)], "goes_on"]
    callee = one(recorder, body, turn, both, names, long, "")
    return repeated(recorder, callee, alive, str(most), waits, state, values_of(recorder, both))


def when(
    recorder: Recorder,
    condition: Tensor,
    function: Callable[..., Sequence[Tensor]],
    otherwise: Sequence[Tensor],
    given: Sequence[Any],
    waits: bool,
    long: int,
    name: str,
) -> list[Tensor]:
    """A function that is called where a condition holds."""
    callee = one(recorder, function, function, given, None, long, name)
    values = [*values_of(recorder, otherwise), *values_of(recorder, given)]
    return repeated(recorder, callee, condition, ONCE, waits, otherwise, values)


def repeated(
    recorder: Recorder,
    callee: Recorded,
    alive: Tensor,
    most: str,
    waits: bool,
    state: Sequence[Tensor],
    values: Sequence[Value],
) -> list[Tensor]:
    """What becomes of a state; values: of it, and of all else that is given."""
    check_state(callee, state)
    on = recorder.program.and_(recorder.on, recorder.values(alive).item())
    if on is False:
        return list(state)
    made = recorder.program.make("waiting" if waits else "loop", callee.name, most, on, *values)
    return results_of(recorder, callee, made)[: len(state)]


def check_state(callee: Recorded, state: Sequence[Tensor]) -> None:
    """Raises ValueError where a function does not return what a state is: shapes and types, in order."""
    before = [(tuple(x.shape[:-1]), x.dtype) for x in state]
    after = [(part.shape, dtype) for part, dtype in zip(callee.outputs, callee.dtypes, strict=True)]
    if before != after[: len(before)] or len(after) - len(before) > 1:
        raise ValueError(f"{callee.name} returns {after} in the place of {before}")


def one(
    recorder: Recorder,
    key: Callable[..., Any],
    function: Callable[..., Any],
    given: Sequence[Any],
    results: Sequence[str] | None,
    long: int,
    name: str,
) -> Recorded:
    """What is recorded of a function for what it is given: tensors of these shapes, the rest as it is.

    Args:
        key: tells the function from others.
    """
    called = recorder.called
    known = key, long, name, *map(told_apart, given)
    if known not in called.by_key:
        names = [name for pair in zip(names_of(key, given), given, strict=True) for name in leaves(*pair)]

        def run(*columns: Tensor) -> Any:
            each = iter(columns)
            return function(*mapped(lambda _: next(each), list(given)))

        run.__doc__ = inspect.getdoc(key)
        with recorder.aside():
            examples = [x.detach().clone() for x in tensors(given)]
            free = called.free(name or key.__name__.lstrip("_"))
            found = record(called, run, examples, free, names, results, long)
        called.kept.append(given)
        called.by_key[known] = called.by_name[found.name] = found
    return called.by_key[known]


def told_apart(given: Any) -> Any:
    """What tells something that a function is given from others."""
    if isinstance(given, Tensor):
        return tuple(given.shape), given.dtype
    return (type(given), *map(told_apart, given)) if has_tensors(given) else id(given)


def leaves(name: str, given: Any) -> list[str]:
    """The names of the tensors in what a function calls by a name."""
    if isinstance(given, Tensor):
        return [name]
    if not has_tensors(given):
        return []
    fields = getattr(given, "_fields", range(len(given)))
    return [
        leaf for field, each in zip(fields, given, strict=True) for leaf in leaves(f"{name}_{field}", each)
    ]


def names_of(function: Callable[..., Any], given: Sequence[Any]) -> list[str]:
    """What a function calls its arguments, where C may call them so, else x0, x1, ..."""
    named = [
        name
        for name, each in inspect.signature(function).parameters.items()
        if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)
    ]
    named = [*named, *[""] * (len(given) - len(named))][: len(given)]
    fit = [(name, f"{name}_", f"x{i}") for i, name in enumerate(named)]
    return [next(each for each in names if is_free(each)) for names in fit]


def is_free(name: str) -> bool:
    """Whether C, and printed text, let an argument have a name."""
    return (
        bool(re.fullmatch("[a-z][a-z0-9_]*", name)) and not TAKEN.fullmatch(name) and not OWN.fullmatch(name)
    )


def values_of(recorder: Recorder, given: Sequence[Any]) -> list[Value]:
    """All values of the tensors among what is given, as their types have them."""
    p, found = recorder.program, list[Value]()
    for x in tensors(given):
        found += [p.mask(v) if x.dtype == torch.bool else p.number(v) for v in recorder.values(x).flat]
    if any(isinstance(v, Expression) and v.varies for v in found):
        raise NotImplementedError("a call along an axis that is looped over cannot be printed as C")
    return found


def results_of(recorder: Recorder, callee: Recorded, called: Expression) -> list[Tensor]:
    """The results of a call or a loop, as tensors that are known to the recorder."""
    found = []
    for part, dtype in zip(callee.outputs, callee.dtypes, strict=True):
        with recorder.aside():
            tensor = torch.zeros(*part.shape, 1, dtype=dtype)
        kind = MASK if part.is_mask else NUMBER
        values: list[Value] = [
            recorder.program.make("result", called, result(called, part, i), kind=kind)
            for i in range(part.size)
        ]
        recorder.is_double |= dtype == torch.float64
        recorder.put(tensor, filled(values, tuple(tensor.shape)))
        found.append(tensor)
    return found


def result(called: Expression, part: Part, i: int) -> str:
    """What C calls a component of a result."""
    return f"t{called.index}_{part.name}[{i}]"

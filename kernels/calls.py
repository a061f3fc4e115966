"""Records the control flow of `columns`: every called function becomes a C function.

A call or a loop is one expression of all its arguments, and its results are expressions of it. A function for vectors
receives a mask `on` of the columns that need it, and passes on at most this mask. A function of one column is called
only where it is needed, without a mask.
"""

import functools
import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from columns import mapped, tensors_in
from kernels.build import header
from kernels.exported import TAKEN
from kernels.operations.expressions import MASK, Expression, Program, Value
from kernels.operations.shapes import filled
from kernels.parts import Called, Part, Recorded, part_of
from kernels.recorder import Recorder, evaluated

# names that the headers and printed text use themselves
HEADERS = "vector.h", "scalar.h", "functions.h", "waiting.h"
TEXT = re.compile(
    "t[0-9]+.*|on|[ik]|next_.*|(segment|loop)(_[0-9]+)?|(load|store)_.*|mem...|straight|turns|next|start|end|in|in_step|at|"
    "column|count|first|lanes?|last|list|out|out_step|ready|real|record|there|to|wants|whole|work"
)
ONCE = "once"  # the number of calls by `when`


class Recording(Recorder):
    """Records a function with control flow, by the methods that `columns` calls."""

    def call(self, function: Callable[..., Any], given: Sequence[Any], long: int, name: str) -> Any:
        """Records a call of a function that is printed once."""
        callee = self.one(function, function, given, None, long, name)
        found = self.program.make("call", callee.name, self.on, *self.values_of(given))
        return callee.like(self.results_of(callee, found))

    def loop(
        self,
        body: Callable[..., tuple[Sequence[Tensor], Tensor]],
        state: Sequence[Tensor],
        given: Sequence[Any],
        alive: Tensor,
        most: int,
        waits: bool,
        long: int,
    ) -> list[Tensor]:
        """Records a loop, whose body is printed as a function."""

        def turn(*all_given: Any) -> list[Tensor]:
            following, goes_on = body(*all_given)
            return [*following, goes_on]

        if most < 1:
            return [x.clone() for x in state]
        both = (*state, *given)
        names = [*names_of(body, both)[: len(state)], "goes_on"]
        callee = self.one(body, turn, both, names, long, "")
        return self.repeated(callee, alive, str(most), waits, state, self.values_of(both))

    def when(
        self,
        condition: Tensor,
        function: Callable[..., Sequence[Tensor]],
        otherwise: Sequence[Tensor],
        given: Sequence[Any],
        waits: bool,
        long: int,
        name: str,
    ) -> list[Tensor]:
        """Records a function that is called where a condition holds."""
        callee = self.one(function, function, given, None, long, name)
        values = [*self.values_of(otherwise), *self.values_of(given)]
        return self.repeated(callee, condition, ONCE, waits, otherwise, values)

    def repeated(
        self,
        callee: Recorded,
        alive: Tensor,
        most: str,
        waits: bool,
        state: Sequence[Tensor],
        values: Sequence[Value],
    ) -> list[Tensor]:
        """Returns a loop's results; values: of the state, then of the other arguments.

        Raises ValueError if the results differ from the state in number, shape or type.
        """
        before = [(tuple(x.shape[:-1]), x.dtype) for x in state]
        after = [(part.shape, dtype) for part, dtype in zip(callee.outputs, callee.dtypes, strict=True)]
        if before != after[: len(before)] or len(after) - len(before) > 1:
            raise ValueError(f"{callee.name} returns {after} in the place of {before}")
        on = self.program.and_(self.on, self.values(alive).item())
        if on is False:
            return [x.clone() for x in state]
        made = self.program.make("waiting" if waits else "loop", callee.name, most, on, *values)
        return self.results_of(callee, made)[: len(state)]

    def one(
        self,
        key: Callable[..., Any],
        function: Callable[..., Any],
        given: Sequence[Any],
        results: Sequence[str] | None,
        long: int,
        name: str,
    ) -> Recorded:
        """Records a function, identified by `key`, once for each kind of arguments (`told_apart`)."""
        called = self.called
        known = key, long, name, *map(told_apart, given)
        if known not in called.by_key:
            names = [name for pair in zip(names_of(key, given), given, strict=True) for name in leaves(*pair)]

            def run(*columns: Tensor) -> Any:
                each = iter(columns)
                return function(*mapped(lambda _: next(each), list(given)))

            run.__doc__ = inspect.getdoc(key)
            with self.aside():
                examples = [x.detach().clone() for x in tensors_in(given)]
                free = called.free(fit([name or getattr(key, "__name__", "of_partial")])[0])
                found = record(called, run, examples, free, names, results, long)
            called.kept.append(given)
            called.by_key[known] = called.by_name[found.name] = found
        return called.by_key[known]

    def values_of(self, given: Sequence[Any]) -> list[Value]:
        """Returns all values of the tensors among the arguments, in the tensors' types."""
        p, found = self.program, list[Value]()
        for x in tensors_in(given):
            found += [p.mask(v) if x.dtype == torch.bool else p.number(v) for v in self.values(x).flat]
        if any(isinstance(v, Expression) and v.varies for v in found):
            raise NotImplementedError("a call along an axis that is looped over cannot be printed as C")
        return found

    def results_of(self, callee: Recorded, called: Expression) -> list[Tensor]:
        """Returns the results of a call or a loop as tensors that the recorder knows."""
        found = []
        for part, dtype in zip(callee.outputs, callee.dtypes, strict=True):
            with self.aside():
                tensor = torch.zeros(*part.shape, 1, dtype=dtype)
            values: list[Value] = [
                self.program.make("result", called, result(called, part, i), kind=part.values)
                for i in range(part.size)
            ]
            self.is_double |= dtype == torch.float64
            self.put(tensor, filled(values, tuple(tensor.shape)))
            found.append(tensor)
        return found


def recorded(
    function: Callable[..., Any],
    examples: Sequence[Tensor],
    name: str,
    names: tuple[Sequence[str], Sequence[str]] | None,
    long: int,
    single: bool,
) -> tuple[Recorded, Called]:
    """Returns a recorded function, and all functions that it calls; arguments as in `kernels.printer.printed`."""
    given, results = names or ([f"x{i}" for i in range(len(examples))], None)
    kinds = {part_of(each, x).kind for each, x in zip(given, examples, strict=True)}
    for real in ("float", "double") if {"float"} <= kinds <= {"float", "bool"} else ("double",):
        called = Called(real, single, names={name})
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
    """Records one function.

    Args:
        given, results: names of its arguments and results (None: its named tuple's fields, else result_0,
            result_1, ...); they are made valid in C.
    """
    given = fit(given)
    inputs = [part_of(each, x) for each, x in zip(given, examples, strict=True)]
    program = Program(called.real, called.single)
    recorder = Recording(program, long, True if called.single else program.input("on", MASK), called)
    returned, values = evaluated(function, examples, inputs, recorder)
    called.is_double |= recorder.is_double
    listed = [returned] if isinstance(returned, Tensor) else list(returned)
    results = results or getattr(returned, "_fields", [f"result_{i}" for i in range(len(listed))])
    results = fit([*given, *(f"{each}_after" if each in given else each for each in results)])[len(given) :]
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


def like(returned: Any) -> Callable[[Sequence[Any]], Any]:
    """Returns how a list of results becomes what a function returns: a tensor, a named tuple or a list."""
    if isinstance(returned, Tensor):
        return lambda results: results[0]
    return getattr(returned, "_make", list)


def told_apart(given: Any) -> Any:
    """Returns what decides whether two arguments need two recordings."""
    if isinstance(given, Tensor):
        return tuple(given.shape), given.dtype
    if isinstance(given, list | tuple):
        return (type(given), *map(told_apart, given))
    return (type(given), given) if isinstance(given, bool | int | float | str) else id(given)


def leaves(name: str, given: Any) -> list[str]:
    """Returns the names of the tensors in an argument, from the argument's name."""
    if isinstance(given, Tensor):
        return [name]
    if not tensors_in(given):
        return []
    fields = getattr(given, "_fields", range(len(given)))
    return [
        leaf for field, each in zip(fields, given, strict=True) for leaf in leaves(f"{name}_{field}", each)
    ]


def names_of(function: Callable[..., Any], given: Sequence[Any]) -> list[str]:
    """Returns a function's names for its arguments, or x0, x1, ... for arguments without a name."""
    try:
        parameters = inspect.signature(function).parameters.items()
    except ValueError:  # raised for a function of PyTorch
        parameters = {}.items()
    named = [name for name, p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    named += [f"x{i}" for i in range(len(named), len(given))]
    return named[: len(given)]


def fit(names: Sequence[str]) -> list[str]:
    """Makes names that are valid in C for arguments and results of one function: all different and unused elsewhere."""
    found: list[str] = []
    for name in names:
        own = re.sub(r"^(?=[0-9]|next_)", "x_", re.sub(r"\W", "", name, flags=re.ASCII).strip("_") or "x")
        own = own[0].lower() + own[1:]
        while TAKEN.fullmatch(own) or TEXT.fullmatch(own) or own in words() or own in found:
            own += "_"
        found.append(own)
    return found


@functools.cache
def words() -> frozenset[str]:
    """Returns the names of the functions that the headers define."""
    text = "\n".join(map(header, HEADERS))
    return frozenset(re.findall(r"^static .*?(\w+)\([^(]*$", text, re.MULTILINE))


def result(called: Expression, part: Part, i: int) -> str:
    """Returns the name in C of a component of a result."""
    return f"t{called.index}_{part.name}[{i}]"

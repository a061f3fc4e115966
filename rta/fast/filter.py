"""The fast filter of a batch: `SafetyFilter.answer` as one C function on a CPU, or batched on another device."""

from copy import copy
from typing import TypeVar

import torch
from torch import Tensor

from columns import if_long
from kernels.build import library
from kernels.cache import remembered
from kernels.compiled import Compiled, Kernel, sources
from kernels.printer import Printed, printed
from rta.check.commit import Check
from rta.fast.active_set import ATTEMPTED
from rta.fast.program import FastProgram
from rta.filter import SafetyFilter
from rta.paper import PaperFilter
from rta.result import FilterResult

AnyFilter = TypeVar("AnyFilter", bound=SafetyFilter)

GIVEN = ("x", "desired", "sent")
FOUND = ("control", "intervened", "verified", "backup", "active", "slack", "status", "h")


def fast(safety_filter: AnyFilter, device: torch.device | str = "cpu", batch: int = 1) -> AnyFilter:
    """Returns a fast copy of a filter with the same results, for tensors on the given device.

    With the batched solver on a CPU the whole call is one C function. With PIQP the conditions and the check are
    compiled. On a GPU the conditions are compiled, and the programs are solved for the whole batch at once. Compiling
    takes up to ten seconds, once: compiled code is kept across runs.

    Args:
        batch: about how many spacecraft a call will have.

    Raises:
        NoCompilerError: no C compiler works; NotImplementedError: a limit of your own cannot be printed.
    """
    f, on_cpu = safety_filter, torch.device(device).type == "cpu"
    if f.parameters.solver == "batched" and on_cpu:
        return in_c(batched(f))
    made = FastProgram(f.c, f.limits) if f.parameters.solver == "batched" else PaperFilter(f.c, f.limits)
    rows = Compiled(
        lambda x: list(made.evaluated(x)), f.probe(device)[0], batch=batch, long=if_long(len(f.c.planes))
    )
    found = f.with_parts(copy(made), f.check)
    found.program.evaluated = lambda x: rows(x)  # type: ignore[method-assign,assignment,return-value]
    return found.with_parts(found.program, check_in_c(found)) if found.check and on_cpu else found


def batched(safety_filter: AnyFilter) -> AnyFilter:
    """Returns a copy whose programs are solved for the whole batch at once, not compiled."""
    return safety_filter.with_parts(FastProgram(safety_filter.c, safety_filter.limits), safety_filter.check)


def in_c(f: AnyFilter) -> AnyFilter:
    """Returns a copy whose `answer` and `is_safe` are computed in C, both in one library."""
    answer, accepts = remembered(printed_answer, f, False), remembered(printed_is_safe, f)
    both = library({**sources(answer), **sources(accepts, apart=False)})
    found = f.with_parts(f.program, f.check)
    of_answer, of_accepts = Kernel(answer, f.probe(), both), Kernel(accepts, f.probe()[:1], both)
    found.answer = lambda *given: FilterResult(*of_answer(*given))  # type: ignore[method-assign]
    found.accepts = lambda x: of_accepts(x)[0]  # type: ignore[method-assign]
    return found


def printed_answer(f: SafetyFilter, single: bool) -> Printed:
    """Prints `answer` as C; single: for one spacecraft, whose programs do not wait for others."""
    own = f.with_parts(FastProgram(f.c, f.limits, 0 if single else ATTEMPTED), f.check)

    def answer(*given: Tensor) -> list[Tensor]:
        return list(vars(own.answer(*given)).values())

    given = f.probe()
    return printed(answer, *given, name="filter", names=(GIVEN[: len(given)], FOUND), single=single)


def printed_is_safe(f: SafetyFilter) -> Printed:
    """Prints `accepts` as C."""
    return printed(lambda x: [f.accepts(x)], f.probe()[0], name="accepts", names=(("x",), ("found",)))


def latency(f: SafetyFilter) -> int:
    """Returns how many sent controls `answer` takes."""
    return sum(len(sent) for sent in f.probe()[2:])


def check_in_c(safety_filter: SafetyFilter) -> Check:
    """Returns a copy of a filter's check that decides in C; the programs are solved elsewhere."""
    check = safety_filter.check
    assert check
    x, u = safety_filter.probe()[:2]
    y = torch.cat((x, x.new_zeros(check.size - len(x), 1)))
    proposed = safety_filter.program.correct(x, u)

    def commit(y: Tensor, desired: Tensor, *given: Tensor) -> list[Tensor]:
        return list(vars(check.commit(y, desired, FilterResult(*given))).values())

    def has_backup_trajectory(x: Tensor) -> list[Tensor]:
        return [check.has_backup_trajectory(x)]

    in_c, from_here = Compiled(commit, y, u, *vars(proposed).values()), Compiled(has_backup_trajectory, x)
    found = copy(check)
    found.commit = lambda y, desired, proposed: FilterResult(*in_c(y, desired, *vars(proposed).values()))  # type: ignore[method-assign]
    found.has_backup_trajectory = lambda x: from_here(x)[0]  # type: ignore[method-assign]
    return found

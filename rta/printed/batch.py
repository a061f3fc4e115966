"""The filter of a batch on a CPU, compiled: `SafetyFilter.answer` printed as C for vectors of spacecraft."""

from copy import copy
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE
from kernels.build import library
from kernels.cache import remembered
from kernels.compiled import Kernel, sources
from kernels.printer import Printed, printed
from rta.backup.commit import LIMITS
from rta.backup.nominal_check import NominalBackup
from rta.propose import solver_of

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

GIVEN = ("x", "desired", "sent", "left")
FOUND = ("control", "intervened", "verified", "backup", "active", "slack", "status", "program_status", "h")


def batch_filter(safety_filter: "SafetyFilter") -> tuple[Kernel, Kernel | None]:
    """Compiles `SafetyFilter.answer`, and its `flights` where there are any; raises as `kernels.compiled.Compiled`."""
    f = uncompiled(safety_filter)
    function = remembered(recorded, f, False)
    if not isinstance(f.backup, NominalBackup):
        return Kernel(function, examples(f)), None
    flying = remembered(recorded_flights, f)
    both = library({**sources(function), **sources(flying, apart=False)})
    return Kernel(function, examples(f), both), Kernel(flying, examples_of_flights(f), both)


def flights(safety_filter: "SafetyFilter") -> Kernel:
    """Compiles `NominalBackup.fly`; raises as `kernels.compiled.Compiled`."""
    return Kernel(remembered(recorded_flights, uncompiled(safety_filter)), examples_of_flights(safety_filter))


def uncompiled(safety_filter: "SafetyFilter") -> "SafetyFilter":
    """Returns a copy without compiled parts, which have no digest and cannot be recorded."""
    found = copy(safety_filter)
    if safety_filter.backup is None and found.backup is not None:  # somebody has taken it away
        object.__setattr__(found, "backup", None)
    return found


def recorded(safety_filter: "SafetyFilter", single: bool) -> Printed:
    """Prints `SafetyFilter.answer` as C.

    Args:
        single: for one spacecraft, whose programs wait for no others.
    """
    solver = solver_of(safety_filter.groups)
    if single:
        solver.attempted = 0
    own = uncompiled(safety_filter)
    own.propose.solver = solver

    def answer(*given: Tensor) -> list[Tensor]:
        return list(vars(own.answer(*given)).values())

    given = examples(safety_filter)
    return printed(answer, *given, name="filter", names=(GIVEN[: len(given)], FOUND), single=single)


def examples(safety_filter: "SafetyFilter") -> list[Tensor]:
    """What `SafetyFilter.answer` is given, of one spacecraft."""
    x, u = safety_filter.probe("cpu")
    if safety_filter.uncertainty.is_zero:
        return [x, u]
    return [x, u, u.expand(safety_filter.uncertainty.latency, CONTROL_SIZE, 1), torch.ones_like(u)]


def recorded_flights(safety_filter: "SafetyFilter") -> Printed:
    """`NominalBackup.fly` in C."""
    backup = safety_filter.backup
    assert isinstance(backup, NominalBackup)

    def fly(x: Tensor, broken: Tensor, asked: Tensor) -> list[Tensor]:
        return [backup.fly(x, broken, asked)]

    given = examples_of_flights(safety_filter)
    return printed(fly, *given, name="flights", names=(("x", "broken", "asked"), ("found",)))


def examples_of_flights(safety_filter: "SafetyFilter") -> list[Tensor]:
    """What `NominalBackup.fly` is given, of one spacecraft."""
    x, _ = safety_filter.probe("cpu")
    none = torch.zeros(LIMITS, 1, dtype=torch.bool)
    return [x, none, ~none[:2]]

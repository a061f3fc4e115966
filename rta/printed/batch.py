"""The filter of a batch on a CPU, compiled: what most spacecraft need is printed as C for vectors of them.

One C function does all of a call. For all spacecraft it computes the rows, takes a desired control that satisfies them
and attempts the programs of the others. What the attempt leaves, the driver that is exported solves one by one.
"""

import ctypes
from collections.abc import Sequence
from copy import copy
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE, SIZE
from kernels.build import for_vectors, library
from kernels.cache import remembered
from kernels.compiled import check, in_shares, over_columns, pointers, strided, timed
from kernels.printer import Printed, if_long, printed
from rta.backup.nominal_check import NominalBackup
from rta.barrier import ActuatorGroup
from rta.constraints.constraint import joined
from rta.printed.check_functions import checks, constants
from rta.printed.source import check_files, define, driver_text, functions, group_of, source
from rta.propose import Found
from rta.qp.batched_solver import ACCURATE, STEPS, STEPS_SAMPLED, attempt
from rta.qp.programs import Status
from rta.qp.scaled import ScaledRows, from_qp, to_qp

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

PROBED = 256  # columns whose time says what a column takes
FLIGHT = 2e-5  # s, that a flight of the backup laws takes on one core, about


class Columns:
    """The C function `filter_batch` of a library, see driver/batch/batch.h, called as `SafetyFilter.correct`.

    Attributes:
        seconds: that a spacecraft takes on one core.
    """

    def __init__(self, found: ctypes.CDLL, safety_filter: "SafetyFilter", seconds: float) -> None:
        self.constraints, self.has_bounds = len(safety_filter.names), not safety_filter.uncertainty.is_zero
        self.latency, self.seconds = safety_filter.uncertainty.latency, seconds
        self.run = over_columns(found, "filter_batch")
        self.run.restype = ctypes.c_long

    def __call__(
        self, x: Tensor, desired: Tensor, sent: Tensor | None = None, left: Tensor | None = None
    ) -> tuple[list[Tensor], int]:
        """As `SafetyFilter.correct`, of at most `latency` controls sent.

        Returns:
            The fields of `FilterResult`; how many spacecraft have no solution.
        """
        columns, count = x.shape[1], self.constraints
        numbers = torch.empty(CONTROL_SIZE + 2 * count, columns, dtype=torch.float64)
        statuses = torch.empty(3, columns, dtype=torch.int64)
        truths = torch.empty(3 + count, columns, dtype=torch.bool)
        check("x", x, torch.float64, (SIZE, columns))
        check("desired", desired, torch.float64, (CONTROL_SIZE, columns))
        given = [strided(x), strided(desired)]
        if self.has_bounds:
            sent, left = self.aged(sent, x), torch.ones_like(desired) if left is None else left
            check("sent", sent, torch.float64, (self.latency, CONTROL_SIZE, columns))
            check("left", left, torch.float64, (CONTROL_SIZE, columns))
            given += [strided(sent), strided(left)]
        arguments = (*pointers(given), *pointers([numbers, statuses, truths]))
        unsolved = in_shares(lambda first, last: self.run(first, last, *arguments), columns, self.seconds)
        control, slack, h = numbers.split((CONTROL_SIZE, count, count))
        intervened, verified, backup = truths[:3]
        fields = [control, intervened, verified, backup, truths[3:], slack, statuses[0], statuses[1:], h]
        return fields, unsolved

    def aged(self, sent: Tensor | None, x: Tensor) -> Tensor:
        """`latency` controls sent (latency, 6, B), NaN where a state is younger."""
        missing = self.latency - (0 if sent is None else len(sent))
        if sent is not None and not missing:
            return sent
        never = x.new_full((missing, CONTROL_SIZE, x.shape[1]), torch.nan)
        return never if sent is None else torch.cat((never, sent))


class BatchFilter(Columns):
    """`SafetyFilter.correct` of batches on a CPU, but for what no solver call of the driver's solves.

    Attributes:
        statements: of a spacecraft, that are printed for vectors.

    Raises as `kernels.compiled.Compiled`.
    """

    def __init__(self, safety_filter: "SafetyFilter") -> None:
        f = safety_filter
        own, check_parts, parts = remembered(recorded, copy(f))  # what is compiled has no digest
        self.statements = sum(part.statements for part in parts)
        many = [
            for_vectors("double"),
            define("LATENCY", f.uncertainty.latency),
            *(part.text for part in parts),
            *checked(f, check_parts),
            define("HEALTH", int(f.uncertainty.health)),
            driver_text("batch/batch.c"),
        ]
        one = [source(f, [*own, *check_parts]), by_column(f)]
        found = library({"one": "\n".join(one), "many": "\n".join(many)})
        super().__init__(found, f, 0.0)
        if isinstance(f.backup, NominalBackup):
            f.backup.flights = Flights(f, found)
        x, u = (part.expand(-1, PROBED).contiguous() for part in f.probe("cpu"))
        self.seconds = min(timed(self, x, u) for _ in range(3)) / PROBED


class Flights:
    """`NominalBackup.has_trajectories` of states on a CPU, by a C function of a library.

    Args:
        found: the library; None: one is made of the filter's check alone. Raises as `kernels.compiled.Compiled`.
    """

    def __init__(self, safety_filter: "SafetyFilter", found: ctypes.CDLL | None = None) -> None:
        if found is None:
            check_parts = remembered(checks, copy(safety_filter))
            found = library(
                {"flights": "\n".join([for_vectors("double"), *checked(safety_filter, check_parts)])}
            )
        self.run = over_columns(found, "filter_flights")

    def __call__(self, x: Tensor, broken: Tensor, asked: Sequence[int] = (0, 1)) -> Tensor:
        """As `NominalBackup.has_trajectories`."""
        wanted = torch.zeros(2, x.shape[1], dtype=torch.bool)
        wanted[list(asked)] = True
        result = torch.empty(2, x.shape[1], dtype=torch.bool)
        arguments = *pointers([strided(x), strided(broken), wanted]), *pointers([result])
        in_shares(lambda first, last: self.run(first, last, *arguments), x.shape[1], FLIGHT)
        return result


def checked(safety_filter: "SafetyFilter", check_parts: Sequence[Printed]) -> list[str]:
    """What a batch's check is made of in C for vectors of spacecraft; of the model also `Flights`."""
    f = safety_filter
    texts = [
        define("CONSTRAINTS", len(f.names)),
        define("QUANTISED", int(f.uncertainty.is_quantised)),
        *(define(name, *said) for name, said in constants(f.backup).items()),
    ]
    files = ["batch/batch.h", "batch/columns.c"]
    if f.backup:
        texts += [group_of(f), *(part.text for part in check_parts)]
        files = ["round.c", *check_files(f), *files]
        own = ["commit", "flights", "hopeful"] if isinstance(f.backup, NominalBackup) else ["sure"]
        files += [f"batch/{name}.c" for name in own]
    return [*texts, *map(driver_text, files)]


def recorded(safety_filter: "SafetyFilter") -> tuple[list[Printed], list[Printed], list[Printed]]:
    """What is printed of a filter: `functions`, `checks`, and what else is for vectors."""
    own, check_parts = functions(safety_filter), checks(safety_filter)
    for_many = [part for part in own if part.name in ("predict", "quantised_thrust")]
    return own, check_parts, [printed_attempt(safety_filter), *for_many]


def by_column(safety_filter: "SafetyFilter") -> str:
    """The C function that has a batch's column filtered by the exported filter, whose header stands before."""
    bounds = define("HAS_BOUNDS", int(not safety_filter.uncertainty.is_zero))
    return "\n".join([bounds, driver_text("batch/batch.h"), driver_text("batch/one.c")])


def printed_attempt(safety_filter: "SafetyFilter") -> Printed:
    """`first_attempt` in C."""
    names = ("x", "desired"), ("control", "slack", "h", "program_status", "active", "left")
    run, long = partial(first_attempt, safety_filter), if_long(len(safety_filter.c.planes))  # of a hull
    return printed(run, *safety_filter.probe("cpu"), name="first_attempt", names=names, long=long)


def first_attempt(safety_filter: "SafetyFilter", x: Tensor, desired: Tensor) -> list[Tensor]:
    """What is proposed with no more than an attempt at its programs: states (16, B), desired controls (6, B).

    Returns:
        control (6, B); slack, h (constraints, B); program statuses (2, B); active (constraints, B); (1, B) bool, a
        program is left to be solved.
    """
    x = x.masked_fill(x.isinf(), torch.nan)  # infinitely safe is no state either
    left = [torch.zeros_like(x[0], dtype=torch.bool)]
    steps = STEPS_SAMPLED if safety_filter.is_sampled else STEPS

    def solve_group(
        group: ActuatorGroup, rows: ScaledRows, projected: Tensor, found: Found, share: Tensor | None
    ) -> Found:
        asked = to_qp(group, rows, projected / group.limit, share)
        u, residual = attempt(asked.desired, asked.a, asked.b, steps)
        active, slack = from_qp(group, asked, rows.length, u, torch.full_like(found.status, Status.HARD))
        safe = rows.lowest[0] >= 0.0  # NaN is not
        left.append(~(safe | ((residual[0] <= ACCURATE) & asked.b_no_margin.sum(0).isfinite())))
        control = torch.where(safe, found.control, u * group.limit)
        status = torch.where(safe, found.status, Status.HARD)
        return found._replace(control=control, status=status, active=active & ~safe, slack=slack)

    propose = safety_filter.propose
    rows_of = [partial(propose.rows, group) for group in propose.groups]
    control, found = propose.torque_then_thrust(x, desired, None, rows_of, solve_group)
    slack, h, active = (joined(*(getattr(each, name) for each in found)) for name in ("slack", "h", "active"))
    status = torch.stack([each.status for each in found])
    return [control, slack, h, status, active, torch.stack(left).any(0)[None]]

"""The filter of a batch on a CPU, compiled: what most spacecraft need is printed as C for vectors of them.

One C function does all of a call. For all spacecraft it computes the rows, takes a desired control that satisfies them
and attempts the programs of the others. What the attempt leaves, the driver that is exported solves one by one.
"""

import ctypes
import re
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE
from kernels import Kernel, Printed, batch, if_long, library, printed
from kernels.build import for_vectors
from kernels.cache import remembered
from kernels.compiled import check, in_shares, over_columns, pointers, strided, timed
from rta.backup.homing import calls
from rta.conditions.condition import demanded
from rta.conditions.held_rows import HeldGroup
from rta.conditions.rows import ActuatorGroup
from rta.conditions.tangents import (
    TOLERATED,
    Prepared,
    answered,
    inset,
    prepared_now,
    problems,
    shortfall,
    with_shortfall,
)
from rta.constraints.constraint import joined
from rta.printed.source import GROUPS, define, driver_text, functions, held_groups, source, table
from rta.printed.way import AT_A_GLANCE, checks, constants, limits, of_one
from rta.qp.batched_solver import ACCURATE, STEPS_HELD, attempt
from rta.qp.programs import Problems, Status, total

if TYPE_CHECKING:
    from rta.filter import SafetyFilter

PROBED = 256  # columns whose time says what a column takes


class Columns:
    """The C function `filter_batch` of a library, see driver/batch/batch.h, called as `SafetyFilter.correct`.

    Attributes:
        seconds: that a spacecraft takes on one core.
    """

    def __init__(self, found: ctypes.CDLL, safety_filter: "SafetyFilter", seconds: float) -> None:
        self.constraints, self.holds = len(safety_filter.names), safety_filter.holds
        self.latency, self.seconds = safety_filter.known.latency, seconds
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
        blocks = 4 if self.holds else 2
        numbers = torch.empty(CONTROL_SIZE + blocks * count, columns, dtype=torch.float64)
        statuses = torch.empty(3, columns, dtype=torch.int64)
        truths = torch.empty(3 + count, columns, dtype=torch.bool)
        check("x", x, torch.float64, (SIZE, columns))
        check("desired", desired, torch.float64, (CONTROL_SIZE, columns))
        given = [strided(x), strided(desired)]
        if self.holds:
            sent, left = self.aged(sent, x), torch.ones_like(desired) if left is None else left
            check("sent", sent, torch.float64, (self.latency, CONTROL_SIZE, columns))
            check("left", left, torch.float64, (CONTROL_SIZE, columns))
            given += [strided(sent), strided(left)]
        arguments = (*pointers(given), *pointers([numbers, statuses, truths]))
        unsolved = in_shares(lambda first, last: self.run(first, last, *arguments), columns, self.seconds)
        slack, h, *tightenings = (numbers[CONTROL_SIZE + i * count :][:count] for i in range(blocks))
        nothing = numbers.new_zeros(1, 1).expand(count, columns)
        uncertainty, tightened = tightenings or (nothing, nothing)
        control, (intervened, verified, backup), active = numbers[:CONTROL_SIZE], truths[:3], truths[3:]
        status, program_status = statuses[0], statuses[1:]
        checked = (intervened, verified, backup)
        fields = [control, *checked, active, slack, status, program_status, h, uncertainty, tightened]
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
        parts: of the filter's condition where controls are held, see `rta.conditions.held`.

    Raises as `kernels.Compiled`.
    """

    def __init__(self, safety_filter: "SafetyFilter") -> None:
        holds = safety_filter.holds
        own, ways, parts = remembered(recorded, safety_filter)
        shared = own if holds else []  # which Python calls, too
        self.statements = sum(part.statements for part in parts)
        backup = safety_filter.backup
        many = [
            for_vectors("double"),
            define("CONSTRAINTS", len(safety_filter.names)),
            define("LATENCY", safety_filter.known.latency),
        ]
        many.append(define("BACKUP", int(backup is not None)))
        many.append(define("TURN", int(safety_filter.turn is not None)))
        many.append(define("HELD_CALLS", calls(safety_filter.homing.haven) if safety_filter.homing else 0))
        known = constants(backup) if backup else limits()
        many += [define(name, *said) for name, said in known.items()]
        many += [*(part.text for part in parts), *(batch(part) for part in shared)]
        many += [part.text for part in ways if part.name in AT_A_GLANCE]
        many += [driver_text("batch/batch.h"), driver_text("batch/columns.c"), driver_text("batch/commit.c")]
        if holds:
            many += [driver_text("batch/block.c"), *(of_group(i, safety_filter) for i in range(2))]
        many.append(driver_text("batch/held.c" if holds else "batch/now.c"))
        one = [source(safety_filter, [*own, *of_one(ways)]), by_column(holds)]
        found = library({"one": "\n".join(one), "many": "\n".join(many)})
        super().__init__(found, safety_filter, 0.0)
        self.parts = [Kernel(part, found) for part in shared]
        x, u = (part.expand(-1, PROBED).contiguous() for part in safety_filter.probe("cpu"))
        self.seconds = min(timed(self, x, u) for _ in range(3)) / PROBED


def recorded(safety_filter: "SafetyFilter") -> tuple[list[Printed], list[Printed], list[Printed]]:
    """What is printed of a filter: `functions`, `checks`, and what else is for vectors."""
    own, ways = functions(safety_filter), checks(safety_filter)
    return own, ways, held_parts(safety_filter, own) if safety_filter.holds else now_parts(safety_filter)


def by_column(holds: bool) -> str:
    """The C function that has a batch's column filtered by the exported filter, whose header stands before."""
    return "\n".join([define("HOLDS", int(holds)), driver_text("batch/batch.h"), driver_text("batch/one.c")])


def of_group(index: int, safety_filter: "SafetyFilter") -> str:
    """The C function that corrects one group's controls where they are held."""
    name, group = GROUPS[index], held_groups(safety_filter)[index]
    places = [safety_filter.names.index(each) for each in group.names]
    upper = name.upper()
    constants = [
        define(f"{upper}_INDEX", index),
        define(f"{upper}_ROWS", len(group.weights)),
        define(f"{upper}_OWN", len(group.names), "constraints"),
        define(f"{upper}_COARSE", int(group.is_coarse), "the answer is rounded to what thrusters give"),
        table(f"int {upper}_PLACE[{len(places)}]", places, "of its constraints"),
    ]
    own = re.sub(r"\bgroup_", f"{name}_", driver_text("batch/group.c"))
    return "\n".join([*constants, re.sub(r"\bGROUP_", f"{upper}_", own)])


# where rows are of the rate of now


def now_parts(safety_filter: "SafetyFilter") -> list[Printed]:
    """What is printed for vectors: all of it at once, for both groups begin alike."""
    names = ("x", "desired"), ("control", "slack", "h", "program_status", "active", "left")
    run = partial(first_attempt, safety_filter)
    long = if_long(len(safety_filter.c.planes))  # of a hull
    return [printed(run, *safety_filter.probe("cpu"), name="first_attempt", names=names, long=long)]


def first_attempt(safety_filter: "SafetyFilter", x: Tensor, desired: Tensor) -> list[Tensor]:
    """The filter with no more than an attempt at its programs: states (16, B), desired controls (6, B).

    Returns:
        control (6, B); slack, h (constraints, B); program statuses (2, B); active (constraints, B); (1, B) bool, a
        program is left to be solved.
    """
    x = x.masked_fill(x.isinf(), torch.nan)  # infinitely safe is no state either
    _, wish, control, clipped = demanded(desired, safety_filter.groups)
    controls, statuses, parts, left = [], [], [], torch.zeros_like(x[0], dtype=torch.bool)
    for i, group in enumerate(safety_filter.groups):
        prepared = prepared_now(group, x, control)
        asked = problems(group, prepared, wish[group.controls] / group.limit, group.limit)
        u, solved = attempted(asked)
        active, slack = answered(group, asked, prepared.length, u, torch.full_like(clipped[i], Status.HARD))
        safe = prepared.lowest[0] >= 0.0  # NaN is not
        left = left | ~(safe | solved)
        controls.append(torch.where(safe, control[group.controls], u * group.limit))
        slack = slack.maximum(shortfall(group, prepared, controls[i]))
        statuses.append(with_shortfall(torch.where(safe, clipped[i], Status.HARD), slack))
        parts.append((active & ~safe, slack, prepared.h))
    active, slack, h = (joined(*each) for each in zip(*parts, strict=True))
    return [torch.cat(controls), slack, h, torch.stack(statuses), active, left[None]]


def attempted(asked: Problems, steps: int | None = None) -> tuple[Tensor, Tensor]:
    """Controls (3, B) of an attempt at programs, and (B,) bool, they solve these accurately."""
    u, residual = attempt(asked.desired, asked.a, asked.b, *([steps] if steps else []))
    return u, (residual[0] <= ACCURATE) & asked.b_bare.sum(0).isfinite()


# where controls are held


def held_parts(safety_filter: "SafetyFilter", rows: list[Printed]) -> list[Printed]:
    """What is printed for vectors: `functions`, which are given, and of each group an attempt and a judgement."""
    x, u = safety_filter.probe("cpu")
    left = torch.ones_like(u)
    parts = [
        *rows,
        printed(
            partial(begin, safety_filter), u, left, name="begin",
            names=(("desired", "left"), ("wish", "control", "program_status", "open")),
        )
    ]  # fmt: skip
    for name, group, own in zip(GROUPS, held_groups(safety_filter), rows, strict=False):
        fields = [torch.zeros(*part.shape, 1, dtype=torch.float64) for part in own.outputs]
        given = tuple(part.name for part in own.outputs)
        more = {
            "near": (partial(near, group), (x, u), (("x", "control"), ("nearby",))),
            "attempt": (
                partial(attempt_at, group), (*fields, u, u, u, left),
                ((*given, "wish", "control", "nearby", "left"), ("answer", "safe", "solved")),
            ),
            "judge": (
                partial(judge, group), (*fields, u, left),
                ((*given, "answer", "left"), ("held", "active", "slack")),
            ),
            "report": (
                partial(report, group), (*fields, u, left),
                ((*given, "control", "left"), ("value", "uncertainty", "tightened", "lacking")),
            ),
        }  # fmt: skip
        parts += [
            printed(run, *examples, name=f"{name}_{verb}", names=names)
            for verb, (run, examples, names) in more.items()
        ]
    return parts


def begin(safety_filter: "SafetyFilter", desired: Tensor, left: Tensor) -> list[Tensor]:
    """What is filtered in the place of desired controls (6, B): within the limits, and what the thrusters give.

    Returns:
        what is projected, and control (6, B); program statuses (2, B); (1, B) bool: the spacecraft may have to turn a
        weak axis away.
    """
    known = safety_filter.known
    _, wish, clipped, status = demanded(desired, safety_filter.groups)
    control = torch.cat((known.given(clipped[THRUST], safety_filter.c.max_thrust), clipped[TORQUE]))
    given = (control != clipped)[THRUST].any(0)
    wish = torch.cat((torch.where(given, control[THRUST], wish[THRUST]), wish[TORQUE]))
    status = torch.stack((torch.where(given, Status.HARD, status[0]), status[1]))
    weak = (left < 1.0).any(0) if known.health else torch.zeros_like(given)
    return [wish, control, status, weak[None]]


def near(group: HeldGroup, x: Tensor, control: Tensor) -> list[Tensor]:
    """`HeldGroup.near`."""
    return [group.near(x, control)]


def attempt_at(group: HeldGroup, *given: Tensor) -> list[Tensor]:
    """An attempt at the programs of rows near controls: `Prepared`, wishes, controls, those nearby, and `left`.

    Returns:
        controls (6, B) with the answer for the group's own; (1, B) bool, the control is safe; the attempt is accurate.
    """
    prepared, (wish, control, nearby, left) = Prepared(*given[:-4]), given[-4:]
    limit = group.limit * left[group.controls]
    asked = inset(problems(group, prepared, wish[group.controls] / group.limit, limit))
    u, solved = attempted(asked, STEPS_HELD)
    safe = (prepared.lowest[0] >= 0.0) & ~(nearby != control).any(0)
    return [with_own(group, control, u * group.limit), safe[None], solved[None]]


def judge(group: HeldGroup, *given: Tensor) -> list[Tensor]:
    """Whether controls hold the rows themselves, from the tangents there: `Prepared`, controls, and `left`.

    Returns:
        (1, B) bool; active, slack (constraints, B).
    """
    prepared, (answer, left) = Prepared(*given[:-2]), given[-2:]
    u = answer[group.controls] / group.limit
    tangents = problems(group, prepared, u, group.limit * left[group.controls])
    within = total(tangents.a * u, 1) + tangents.b_bare
    hard = torch.full_like(u[0], Status.HARD)
    active, slack = answered(group, tangents, prepared.length, u, hard)
    slack = slack.maximum(shortfall(group, prepared, (left * answer)[group.controls]))
    return [(within.amin(0) >= -TOLERATED)[None], active, slack]


def report(group: HeldGroup, *given: Tensor) -> list[Tensor]:
    """h, uncertainty, tightened and `shortfall` (constraints, B): `Prepared` at desired controls, these, and `left`."""
    prepared, (control, left) = Prepared(*given[:-2]), given[-2:]
    tightening = group.by_constraint(prepared.tightening, partial(torch.amax, dim=0))
    short = shortfall(group, prepared, (left * control)[group.controls])
    return [prepared.h, tightening, group.tightened(tightening), short]


def with_own(group: ActuatorGroup, control: Tensor, own: Tensor) -> Tensor:
    """Controls (6, B) with others (3, B) of the group's own."""
    return torch.cat((own, control[TORQUE]) if group.controls == THRUST else (control[THRUST], own))

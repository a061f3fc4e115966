"""Corrects a desired control minimally (Sec. Run Time Assurance, box Active Set Invariance Filter).

For thrust and for torque, each within its limits,

    minimise |u - u_desired|^2    subject to    a_i u + b_i >= 0 for every row i.

The rows are of one of two kinds (`rta.barrier`), of the rate now or sampled, of a held control; or there are none, and
what is desired, within the limits, is proposed. Where rows conflict,
slack is given class after class of their weights (`rta.qp.programs.stages`). What the programs propose (`rta.propose`)
is applied if it and the backup trajectory after it keep the limits (`rta.backup`).
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Safety
from inspection.fixed import Fixed
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE
from inspection.model.state_checks import is_state
from inspection.model.tensors import check_tensors
from kernels.build import NoCompilerError
from kernels.compiled import Compiled
from kernels.modes import in_full_precision
from rta.backup.commit import Check
from rta.backup.nominal_check import NominalBackup
from rta.backup.robust_check import RobustBackup
from rta.barrier import Rows
from rta.bounds.uncertainty import NO_UNCERTAINTY, Uncertainty
from rta.constraints import vehicle
from rta.constraints.constraint import Constraint, in_order, joined
from rta.constraints.thrust import keep_in_zone, thrust_constraints
from rta.constraints.torque import torque_constraints
from rta.filter_input import FilterInput, compiled_for_one, probe
from rta.parameters import RtaParameters
from rta.printed.batch import BatchFilter, Flights
from rta.propose import Propose
from rta.qp.batched_solver import STEPS_SAMPLED, BatchedSolver, PiqpThenSteps
from rta.qp.programs import Solver, Status, pick, put
from rta.result import FilterResult

SOLVERS: dict[str, type[Solver]] = {"piqp": PiqpThenSteps, "batched": BatchedSolver}


class SafetyFilter(Fixed):
    """The minimally invasive correction of a desired control.

    Call it as a function; `correct` is the same without its checks, for batches in float64. Any thread may call it. A
    copy, or what another process is given, is not compiled.

    Args:
        c: the task's constants; None: the paper's.
        parameters: period, gains, margins and weights for the paper's vehicle, see `rta.constraints.vehicle`; None: the
            defaults.
        solver: of the quadratic programs; None: the one that the parameters name, for `auto` PIQP or, with sampled
            rows, the batched one.
        extra: constraints of your own.
        uncertainty: the bounds of what the model and the measured state may be off by; None: the plant is the model.

    Attributes:
        names: of all constraints: Table 3's, then your own that thrust enforces, then those that torque enforces.
        is_sampled: rows are; is_held: controls are held for longer than the paper's rows see, or the world is not the
            model, so that `correct` takes what the plant tells.
        propose: the programs, and all that comes before the check; groups: their rows of thrust and of torque.
        backup: the check of its controls; None: no backup trajectory is known of this vehicle, or within the bounds.
        compiled: all of it as one C function; None: it is not compiled so.

    Arguments and attributes are fixed; only `compile` changes one, `compiled`.

    Raises:
        ValueError: parameters or constraints that do not fit together.
    """

    FIXED = (
        *("c", "parameters", "solver", "extra", "uncertainty", "is_sampled", "is_held"),
        *("backup", "propose", "groups", "names"),
    )

    @in_full_precision
    def __init__(
        self,
        c: InspectionParameters | None = None,
        parameters: RtaParameters | None = None,
        solver: Solver | None = None,
        extra: Sequence[Constraint] = (),
        uncertainty: Uncertainty | None = None,
    ) -> None:
        c, parameters = c or InspectionParameters(), parameters or RtaParameters()
        if parameters.filter != "checked":
            raise ValueError(
                f'filter = "{parameters.filter}": that is rta.flown_paper.FlownPaperFilter; must be "checked" here'
            )
        uncertainty = uncertainty or NO_UNCERTAINTY
        vehicle.check(c, None if uncertainty.needs_sampled_rows(parameters) else parameters.period)
        uncertainty.check(c, parameters)
        self.c, self.parameters, self.extra, self.uncertainty = c, parameters, tuple(extra), uncertainty
        self.is_held = uncertainty.needs_sampled_rows(parameters)
        self.is_sampled = uncertainty.rows(parameters) == "sampled"
        # as fast as PIQP with sampled rows, of which there are more
        auto = "batched" if self.is_sampled else "piqp"
        self._given_solver = solver
        self.solver = solver or make_solver(parameters.qp_solver.replace("auto", auto), self.is_sampled)
        own = vehicle.scaled(parameters, c)
        of_paper = (thrust_constraints(c, own, uncertainty), torque_constraints(c, own, uncertainty))
        constraints = (*of_paper[0], *of_paper[1], *extra)
        self.backup: Check | None = (
            NominalBackup.of(c, parameters.period)
            if uncertainty.is_zero
            else RobustBackup.of(c, own, uncertainty)
        )
        self.propose = Propose(constraints, c, own, uncertainty, self.checked)
        self.groups = self.propose.groups
        if self.propose.kind == "none" and self.unchecked:
            raise ValueError(
                f'rows = "none": nothing would keep the limits of {" and ".join(self.unchecked)}, of which no backup '
                'trajectory is known with these settings: must be "auto", "paper" or "sampled"'
            )
        thrust, torque = (group.names for group in self.groups)
        self.names = in_order(thrust, torque)
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"constraints {', '.join(self.names)}: each name must be there once")
        is_auto = solver is None and parameters.qp_solver == "auto"
        self._solves_in_c = isinstance(self.solver, BatchedSolver) or is_auto
        self.compiled: BatchFilter | None = None
        self._has_tried = False
        self._is_compiled = False

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.c, self.parameters, self._given_solver, self.extra, self.uncertainty)

    @property
    def period(self) -> float:
        """s between two calls."""
        return self.parameters.period

    @property
    def checked(self) -> tuple[bool, bool]:
        """Whether thrust is checked, and torque."""
        return self.backup.knows if self.backup else (False, False)

    @property
    def unchecked(self) -> list[str]:
        """What is not checked, since no backup trajectory is known: "motion", "attitude", both or nothing."""
        return [
            name
            for name, is_checked in zip(("motion", "attitude"), self.checked, strict=True)
            if not is_checked
        ]

    @in_full_precision
    def values(self, x: Tensor) -> Tensor:
        """Every constraint's h, the 13 exactly as in the paper: (16, B) to (constraints, B)."""
        check_tensors(x=x)
        return joined(*(group.values(x) for group in self.groups))

    @in_full_precision
    def is_in_safe_set(self, x: Tensor) -> Tensor:
        """(B,) bool: every h and every Psi_1 is non-negative."""
        check_tensors(x=x)
        thrust, torque = self.groups
        inside = is_state(x, self.c) & (self.values(x) >= 0.0).all(0)
        inside = inside & thrust.keeps(x, degree=2) & torque.keeps(x, degree=2)
        return narrowed(inside, x, self.is_holdable) if self.is_held else inside

    def is_holdable(self, x: Tensor) -> Tensor:
        """(B,) bool: every psi >= 0 and the hard QP is feasible; torque's rows only count where torque has no check."""
        thrust, torque = self.rows(x)
        certain = (thrust.psi >= 0.0).all(0)
        if not self.checked[1]:
            certain = certain & (torque.psi >= 0.0).all(0)
        return narrowed(certain, x, self._has_control)

    def _has_control(self, x: Tensor) -> Tensor:
        """(B,) bool: a control satisfies every row, of torque only where it is not checked."""
        found = self.correct(x, torch.zeros_like(x[:CONTROL_SIZE]))
        return (found.program_status[0] if self.checked[1] else found.status) < Status.SLACK

    def can_brake(self, x: Tensor) -> Tensor:
        """(B,) bool: in any attitude thrust can keep the zone, see `keep_in_zone`."""
        check_tensors(x=x)
        zone = keep_in_zone(self.c, self.parameters, self.uncertainty)
        return (zone.barrier_at(x)(x) >= 0.0).all(0)

    @in_full_precision
    def is_safe(self, x: Tensor) -> Tensor:
        """Tells which states may start an episode, (B,) bool (docs/reference/proof.md).

        True where a spacecraft can be in the state (`is_state`), every h >= 0, every Psi_1 >= 0 of limits of your own,
        and the backup trajectory keeps the limits.
        For a group without a check: every Psi_1 >= 0 (thrust: also can_brake); with sampled rows also is_holdable.
        """
        check_tensors(x=x)
        kept = is_state(x, self.c) & (self.values(x) >= 0.0).all(0)
        if self.backup:
            self._compile_flights(x)
            kept = narrowed(kept, x, self.backup.has_backup_trajectory)
        if not self.checked[0]:
            kept = kept & self.can_brake(x)
        for group, is_checked in zip(self.groups, self.checked, strict=True):
            kept = kept & group.keeps(x, degree=2, only_own=is_checked)
        return narrowed(kept, x, self.is_holdable) if self.is_held and self.unchecked else kept

    @in_full_precision
    def compile(self, device: torch.device | str, batch: int) -> None:
        """Compiles the filter for tensors on this device and calls of about so many spacecraft.

        On a CPU all of it is one C function, solver included, unless PIQP is asked for; then, and on a GPU, what is
        computed for every spacecraft. Takes some seconds, up to ten with sampled rows, once: what was compiled
        is kept across runs. Raises as `kernels.compiled.Compiled`, and changes nothing then.
        """
        if self._solves_in_c and torch.device(device).type == "cpu":
            self.compiled = BatchFilter(self)
            self._is_compiled = True
            return
        compiled = [
            Compiled(run, *given, batch=batch)
            for run, given in self.propose.batch_functions(*self.probe(device))
        ]
        rows = max(len(group.weights) for group in self.groups)
        counts = [rows, 2 * rows] if self.is_sampled else [rows]  # sampled ones twice
        self.solver.compile(counts, batch, device)
        self.propose.use(compiled)
        self._is_compiled = True

    def probe(self, device: torch.device | str) -> tuple[Tensor, Tensor]:
        """A state (16, 1) and a control (6, 1) to try functions of the batch with."""
        return probe(self.c, device)

    def safety(self, enabled: bool = True) -> Safety:
        """What the environment needs: constraint values, admissible starts and, if enabled, this filter."""
        return Safety(
            names=self.names,
            values=self.values,
            is_safe=self.is_safe,
            correct=self.correct if enabled else None,
            period=self.period,
            takes_plant_data=self.is_held,
        )

    @in_full_precision
    def rows(self, x: Tensor, control: Tensor | None = None) -> tuple[Rows, Rows]:
        """The conditions on thrust and on torque at states (16, B), as tangents at controls (6, B), None: at zero."""
        check_tensors(x=x)
        thrust, torque = self.groups
        return thrust(x, control), torque(x, control)

    @in_full_precision
    def __call__(self, x: Any, desired: Any) -> FilterResult:
        """Filters a desired control: of one spacecraft, or of each of a batch.

        With the paper's rows the first call for one spacecraft compiles the filter, which takes 3 s the first time.

        Args:
            x: state (16,) or states (16, B), components in the order of `inspection.model.state`.
            desired: control (6,) or controls (6, B) in N and N m in the body frame; beyond the actuators' limits, too.

        Both are NumPy arrays, PyTorch tensors or lists, of float64, float32 or integers.

        Returns:
            Everything in the kind (list: NumPy), precision (integers: float64) and shape (one spacecraft: no axis B) of
            `desired`. The control is within the actuators' limits in float32, too.

        Raises:
            ValueError: another type or shape, a number that is not finite, a quaternion that is not of length 1, or a
                temperature below absolute zero.

        Warns where a state looks like one in other units, see `inspection.model.state_checks`.
        """
        call = FilterInput(x, desired, self.c)
        call.warn()
        fit = call.single and call.x.device.type == "cpu" and not self.is_sampled and not self._is_compiled
        return call.answer((self._for_one if fit else self).correct(call.x, call.desired))

    @cached_property
    def _for_one(self) -> "SafetyFilter":
        """This filter for one spacecraft at a time: compiled, where it can be."""
        return compiled_for_one(
            SafetyFilter(self.c, self.parameters, self._given_solver, self.extra, self.uncertainty)
        )

    @in_full_precision
    def correct(
        self, x: Tensor, desired: Tensor, sent: Tensor | None = None, left: Tensor | None = None
    ) -> FilterResult:
        """Filters one control per spacecraft, unchecked.

        A program with NaN or an infinite state in its rows has status UNSOLVED and zero control.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, float64, beyond the actuators' limits, too. Thrust or torque of
                which a number is NaN counts as zero, and is filtered.
            sent: (k, 6, B) the controls held since the states were measured, the oldest first, each for a period; NaN
                where a state is younger. Of more than `latency` (0 without `Uncertainty`) the state is too old: the
                status is UNSOLVED, and the control is not verified.
            left: (6, B) the share that each actuator gives of its command; None: all of it. It counts for a filter
                with `health` in its `Uncertainty`.
        """
        check_tensors(x=x, desired=desired)
        # where a state is younger the first are NaN
        newest = None if sent is None else sent[max(0, len(sent) - self.uncertainty.latency) :]
        if self.compiled is None or x.device.type != "cpu":
            result = self._correct(x, desired, newest, left)
        else:
            answer, unsolved = self.compiled(x, desired, newest, left)
            result = FilterResult(*answer)
            if unsolved:  # PIQP may know an answer
                self._correct_again(result, x, desired, newest, left)
        if sent is None:
            return result
        too_old = (~sent.isnan().any(1)).sum(0) > self.uncertainty.latency
        return replace(
            result,
            verified=result.verified & ~too_old,
            status=torch.where(too_old, Status.UNSOLVED, result.status),
            program_status=torch.where(too_old, Status.UNSOLVED, result.program_status),
        )

    def _correct_again(self, result: FilterResult, x: Tensor, desired: Tensor, *given: Tensor | None) -> None:
        """Puts what `_correct` answers into a result where that has no solution."""
        columns = torch.nonzero(result.status == Status.UNSOLVED).flatten()
        sent, left = (None if part is None else pick(part, columns) for part in given)
        again = self._correct(pick(x, columns), pick(desired, columns), sent, left)
        for field in fields(result):
            whole = getattr(result, field.name)
            if whole.stride(0):  # else there is nothing to say of any constraint
                put(whole, columns, getattr(again, field.name))

    def _compile_flights(self, x: Tensor) -> None:
        """Has the flights of the check from states on a CPU computed in C, once, where there is a compiler.

        A flight has a hundred holds, each of a thousand operations.
        """
        if isinstance(self.backup, NominalBackup) and not self._has_tried and x.device.type == "cpu":
            self._has_tried = True
            with suppress(NoCompilerError):
                self.backup.flights = self.backup.flights or Flights(self)

    @torch.no_grad()
    def _correct(self, x: Tensor, desired: Tensor, sent: Tensor | None, left: Tensor | None) -> FilterResult:
        """`correct` in PyTorch, and by the solver."""
        x = x.masked_fill(x.isinf(), torch.nan)  # infinitely safe is no state either
        x, error_bound, result = self.propose(x, desired, self.solver, sent, left)
        if self.backup is not None:
            self._compile_flights(x)
            of_torque = [name in self.groups[1].names for name in self.names]
            result = self.backup.commit(x, error_bound, desired, result, of_torque)
        return result


def narrowed(chosen: Tensor, x: Tensor, accepts: Callable[[Tensor], Tensor]) -> Tensor:
    """Clears `chosen` (B,) where `accepts` denies it, which is asked of the chosen columns of states (16, B) only."""
    columns = torch.nonzero(chosen).flatten()
    if columns.numel():
        put(chosen, columns, accepts(pick(x, columns)))
    return chosen


def make_solver(name: str, sampled: bool = False) -> Solver:
    """Makes a new solver, of sampled rows or the paper's; raises KeyError for a name that is not in SOLVERS."""
    return BatchedSolver(STEPS_SAMPLED) if sampled and name == "batched" else SOLVERS[name]()

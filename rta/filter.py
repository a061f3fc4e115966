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
from dataclasses import replace
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
from kernels.compiled import Compiled, Kernel
from kernels.control import call, pick, put
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
from rta.printed.batch import batch_filter, flights
from rta.propose import Propose
from rta.qp.active_set import ActiveSet
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import Solver, Status
from rta.result import FilterResult


class SafetyFilter(Fixed):
    """The minimally invasive correction of a desired control.

    Call it as a function; `correct` is the same without its checks, for batches in float64. Any thread may call it. A
    copy, or what another process is given, is not compiled.

    Args:
        c: the task's constants; None: the paper's.
        parameters: period, gains, margins and weights for the paper's vehicle, see `rta.constraints.vehicle`; None: the
            defaults.
        solver: of the quadratic programs; None: PIQP where the parameters name it, else the active-set method.
        extra: constraints of your own.
        uncertainty: the bounds of what the model and the measured state may be off by; None: the plant is the model.

    Attributes:
        names: of all constraints: Table 3's, then your own that thrust enforces, then those that torque enforces.
        is_sampled: rows are; is_held: controls are held for longer than the paper's rows see, or the world is not the
            model, so that `correct` takes what the plant tells.
        propose: the programs, and all that comes before the check; groups: their rows of thrust and of torque.
        backup: the check of its controls; None: no backup trajectory is known of this vehicle, or within the bounds.
        compiled: `answer` as one C function; None: it is not compiled so.

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
        self._given_solver = solver
        own = vehicle.scaled(parameters, c)
        of_paper = (thrust_constraints(c, own, uncertainty), torque_constraints(c, own, uncertainty))
        constraints = (*of_paper[0], *of_paper[1], *extra)
        self.backup: Check | None = (
            NominalBackup.of(c, parameters.period)
            if uncertainty.is_zero
            else RobustBackup.of(c, own, uncertainty)
        )
        piqp = PiqpSolver() if parameters.qp_solver == "piqp" else None
        self.propose = Propose(constraints, c, own, uncertainty, self.checked, solver or piqp)
        self.groups, self.solver = self.propose.groups, self.propose.solver
        if self.propose.kind == "none" and self.unchecked:
            raise ValueError(
                f'rows = "none": nothing would keep the limits of {" and ".join(self.unchecked)}, of which no backup '
                'trajectory is known with these settings: must be "auto", "paper" or "sampled"'
            )
        thrust, torque = (group.names for group in self.groups)
        self.names = in_order(thrust, torque)
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"constraints {', '.join(self.names)}: each name must be there once")
        self._has_bounds = not uncertainty.is_zero
        self.compiled: Kernel | None = None
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
            if x.device.type == "cpu":
                self._compile_flights()
            kept = narrowed(kept, x, self.backup.has_backup_trajectory)
        if not self.checked[0]:
            kept = kept & self.can_brake(x)
        for group, is_checked in zip(self.groups, self.checked, strict=True):
            kept = kept & group.keeps(x, degree=2, only_own=is_checked)
        return narrowed(kept, x, self.is_holdable) if self.is_held and self.unchecked else kept

    @in_full_precision
    def compile(self, device: torch.device | str, batch: int) -> None:
        """Compiles the filter for tensors on this device and calls of about so many spacecraft.

        On a CPU all of it is one C function, unless PIQP solves; then, and on a GPU, what is computed for every
        spacecraft. Takes some seconds, up to ten with sampled rows, once: what was compiled is kept across runs. Raises
        as `kernels.compiled.Compiled`, and changes nothing then.
        """
        if isinstance(self.solver, ActiveSet) and torch.device(device).type == "cpu":
            self.compiled, flying = batch_filter(self)
            if isinstance(self.backup, NominalBackup):
                self.backup.flights = flying
        else:
            functions = self.propose.batch_functions(*self.probe(device))
            self.propose.use([Compiled(run, *given, batch=batch) for run, given in functions])
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
        told = self.told(x, sent, left)
        if self.compiled is not None and x.device.type == "cpu":
            result = FilterResult(*self.compiled(x, desired, *told))
        else:
            if x.device.type == "cpu":
                self._compile_flights()
            with torch.no_grad():
                result = self.answer(x, desired, *told)
        if sent is None:
            return result
        too_old = (~sent.isnan().any(1)).sum(0) > self.uncertainty.latency
        return replace(
            result,
            verified=result.verified & ~too_old,
            status=torch.where(too_old, Status.UNSOLVED, result.status),
            program_status=torch.where(too_old, Status.UNSOLVED, result.program_status),
        )

    def told(self, x: Tensor, sent: Tensor | None, left: Tensor | None) -> tuple[Tensor, ...]:
        """What counts beside states: the newest controls sent (latency, 6, B), and what is left (6, B)."""
        if not self._has_bounds:
            return ()
        count = 0 if sent is None else min(len(sent), self.uncertainty.latency)
        never = x.new_full((self.uncertainty.latency - count, CONTROL_SIZE, x.shape[1]), torch.nan)
        newest = never if sent is None or not count else torch.cat((never, sent[-count:]))
        return newest, x.new_ones(CONTROL_SIZE, x.shape[1]) if left is None else left

    def answer(self, x: Tensor, desired: Tensor, *told: Tensor) -> FilterResult:
        """The order of a call: predict, propose, check and commit. Arguments as of `told`."""
        x = call(known, x)
        sent, left = (list(told[0]), told[1]) if told else ([], None)
        left = left if self.uncertainty.health else None
        x, error_bound = self.propose.now(x, sent, left)
        control, found = self.propose(x, desired, left)
        status, no = torch.stack([each.status for each in found]), torch.zeros_like(x[0], dtype=torch.bool)
        result = FilterResult(
            control=control,
            intervened=(control != desired).any(0),
            verified=no,
            backup=no,
            active=joined(*(each.active for each in found)),
            slack=joined(*(each.slack for each in found)),
            status=status.amax(0),
            program_status=status,
            h=joined(*(each.h for each in found)),
        )
        if self.backup is None:
            return result
        of_torque = [name in self.groups[1].names for name in self.names]
        return self.backup.commit(x, error_bound, desired, result, of_torque)

    def _compile_flights(self) -> None:
        """Has the flights of the check computed in C, once, where there is a compiler.

        A flight has a hundred holds, each of a thousand operations.
        """
        if isinstance(self.backup, NominalBackup) and not (self.backup.flights or self._has_tried):
            self._has_tried = True
            with suppress(NoCompilerError):
                self.backup.flights = flights(self)


def known(x: Tensor) -> Tensor:
    """States (16, B), NaN where they are infinite: infinitely safe is no state either."""
    return x.masked_fill(x.isinf(), torch.nan)


def narrowed(chosen: Tensor, x: Tensor, accepts: Callable[[Tensor], Tensor]) -> Tensor:
    """Clears `chosen` (B,) where `accepts` denies it, which is asked of the chosen columns of states (16, B) only."""
    columns = torch.nonzero(chosen).flatten()
    if columns.numel():
        put(chosen, columns, accepts(pick(x, columns)))
    return chosen

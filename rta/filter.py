"""SafetyFilter: barrier rows, screening, two small programs per spacecraft, report (Sec. ASIF).

Where the rows of a program conflict, slack is given class after class of their weights, see `rta.qp.programs.stages`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Safety
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, P, Q
from kernels import Compiled, NoCompilerError
from kernels.build import say
from rta.backup.check import RATES_ROUNDED, SLACK_ROUNDED, Backup
from rta.bounds.health import slewing
from rta.bounds.uncertainty import NOTHING, Uncertainty
from rta.conditions.held_rows import KINDS, HeldGroup, predicted
from rta.conditions.rows import ActuatorGroup, Rows
from rta.conditions.tangents import (
    Prepared,
    Settling,
    answered,
    prepared_now,
    problems,
    scaled,
    shortfall,
    with_shortfall,
)
from rta.constraints import vehicle
from rta.constraints.constraint import ACTUATORS, CONSTRAINTS, Constraint, in_order, joined
from rta.constraints.thrust import keep_in_zone, thrust_constraints
from rta.constraints.torque import torque_constraints
from rta.given import Given
from rta.parameters import RtaParameters
from rta.printed.batch import BatchFilter
from rta.qp.batched_solver import STEPS_HELD, BatchedSolver
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import ENDLESS, LARGEST_DEMAND, Solver, Status, pick, put

ROW_FIELDS = len(fields(Rows))

SOLVERS: dict[str, type[Solver]] = {"piqp": PiqpSolver, "batched": BatchedSolver}


@dataclass
class FilterResult:
    """What the filter did, per spacecraft; constraints in the order of `SafetyFilter.names`.

    For one spacecraft without the axis B, and in the kind of the desired control, see `SafetyFilter.__call__`.

    Attributes:
        control: (6, B) safe control in N and N m, within the actuators' limits whatever was desired.
        intervened: (B,) bool, another control than the desired one is applied.
        verified: (B,) bool, the control keeps every limit until the next call, and a way to rest begins there on which
            none is violated (`rta.backup`). False where none is known, as of a filter that is told of bounds.
        backup: (B,) bool, another control is applied than the programs' solution, for that reason.
        active: (constraints, B) bool, a row of the constraint binds a corrected control.
        slack: (constraints, B) shortfall of the barrier condition without margin, in h's unit per s (per s^2 where
            the relative degree is two); zero unless a program needed slack, or a broken limit asks for more than the
            actuators give.
        status: (B,) int64, the worse `Status` of the thrust and the torque program; SLACK, at least, where slack is.
        program_status: (2, B) int64, both of them.
        h: (constraints, B) values without margin, exact; that of passive safety by the times of its rows. Where a
            state is predicted, of the state of now.
        uncertainty: (constraints, B) what `Uncertainty` takes off the constraint's condition, in h's unit per s (per
            s^2 where the relative degree is two), at the desired control.
        tightened: (constraints, B) what `uncertainty` is in the unit of the barrier (body rates: rad/s): the value at
            which it is all that the row lets the barrier fall by.
    """

    control: Tensor
    intervened: Tensor
    verified: Tensor
    backup: Tensor
    active: Tensor
    slack: Tensor
    status: Tensor
    program_status: Tensor
    h: Tensor
    uncertainty: Tensor
    tightened: Tensor

    @property
    def violated(self) -> Any:
        """(B,) bool: a limit is broken already, some h is negative, whatever the programs answered."""
        return (self.h < 0.0).any(0)


class SafetyFilter:
    """The minimally invasive correction of a desired control.

    Call it as a function; `correct` is the same without its checks, for batches in float64. Any thread may call it. A
    copy, or what another process is given, is not traced or compiled.

    Args:
        c: the task's constants; None: the paper's.
        parameters: period, gains, margins and weights for the paper's vehicle, see `rta.constraints.vehicle`; None: the
            defaults.
        solver: of the quadratic programs; None: the one that the parameters name, for `auto` PIQP or, where controls
            are held, the batched one.
        extra: constraints of your own.
        known: what is told about the world's bounds; None: the plant is the model.

    Attributes:
        names: of all constraints: Table 3's, then those of your own that thrust holds, then those that torque holds.
        groups: of thrust and of torque.
        backup: the check of its controls; None: there is none for this vehicle, or of what the filter is told.
        compiled: all of it as one C function; None: it is not compiled so.

    Raises:
        ValueError: parameters or constraints that do not fit together.
    """

    def __init__(
        self,
        c: InspectionParameters | None = None,
        parameters: RtaParameters | None = None,
        solver: Solver | None = None,
        extra: Sequence[Constraint] = (),
        known: Uncertainty | None = None,
    ) -> None:
        c, parameters = c or InspectionParameters(), parameters or RtaParameters()
        known = known or NOTHING
        vehicle.check(c, None if known.holds(parameters) else parameters.period)
        known.check(c, parameters)
        self.c, self.parameters, self.extra, self.known = c, parameters, tuple(extra), known
        self.holds = known.holds(parameters)
        knows_way = known.is_nil and Backup.is_there(c)
        self.backup = Backup(c, parameters.period) if knows_way else None
        # as fast as PIQP, which of 213,855 programs of tangents solved one wrongly (0.7.0; of 94,804 0.6.4 left 91)
        auto = "batched" if self.holds else "piqp"
        self.solver = self._own_solver = solver or make_solver(
            parameters.qp_solver.replace("auto", auto), self.holds
        )
        own = vehicle.scaled(parameters, c)
        of_paper = (thrust_constraints(c, own, known), torque_constraints(c, own, known))
        constraints = (*of_paper[0], *of_paper[1], *extra)
        kind = HeldGroup if self.holds else ActuatorGroup
        self.groups = tuple(kind(by, constraints, c, own, known) for by in ACTUATORS)
        thrust, torque = (group.names for group in self.groups)
        self.names = in_order(thrust, torque)
        if len(set(self.names)) < len(self.names):
            raise ValueError(f"constraints {', '.join(self.names)}: each name must be there once")
        self._prepare: Callable[[Tensor, Tensor], list[Tensor]] = self.prepare
        self._prepare_held: Sequence[Callable[..., list[Tensor]]] = self._uncompiled_held()
        self._predict: Callable[..., list[Tensor]] = self.predict
        self._is_auto = solver is None and parameters.qp_solver == "auto"
        self._solves_in_c = isinstance(self.solver, BatchedSolver) or self._is_auto
        self.compiled: BatchFilter | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.c, self.parameters, self._given_solver, self.extra, self.known)

    @property
    def _given_solver(self) -> Solver | None:
        """The solver that was given, or has been put in its place; None where `auto` chose it."""
        return None if self._is_auto and self.solver is self._own_solver else self.solver

    @property
    def held_groups(self) -> list[HeldGroup]:
        """`groups` where controls are held; none where rows are of the rate of now."""
        return [group for group in self.groups if isinstance(group, HeldGroup)]

    @property
    def period(self) -> float:
        """s between two calls."""
        return self.parameters.period

    def values(self, x: Tensor) -> Tensor:
        """Every constraint's h, the 13 exactly as in the paper: (16, B) to (constraints, B)."""
        return joined(*(group.values(x) for group in self.groups))

    def is_in_safe_set(self, x: Tensor) -> Tensor:
        """(B,) bool: every h and every Psi_1 is non-negative."""
        thrust, torque = self.groups
        inside = (self.values(x) >= 0.0).all(0) & thrust.keeps(x, degree=2) & torque.keeps(x, degree=2)
        return narrowed(inside, x, self.is_holdable) if self.holds else inside

    def is_holdable(self, x: Tensor) -> Tensor:
        """(B,) bool: no barrier is negative, however wrong the measurement was, and a control satisfies every row."""
        thrust, torque = self.rows(x)
        certain = (thrust.psi >= 0.0).all(0) & (torque.psi >= 0.0).all(0)
        return narrowed(certain, x, self._has_control)

    def _has_control(self, x: Tensor) -> Tensor:
        """(B,) bool: a control satisfies every row."""
        return self.correct(x, torch.zeros_like(x[:CONTROL_SIZE])).status < Status.SLACK

    def can_brake(self, x: Tensor) -> Tensor:
        """(B,) bool: in any attitude thrust can keep the zone, see `keep_in_zone`."""
        return (keep_in_zone(self.c, self.parameters, self.known).barrier_at(x)(x) >= 0.0).all(0)

    def has_way(self, x: Tensor) -> Tensor:
        """(B,) bool: states (16, B) have a verified way to rest; without a backup, `is_in_safe_set`."""
        if self.backup is None:
            return self.is_in_safe_set(x)
        return narrowed((self.values(x) >= 0.0).all(0), x, self.backup.has_way)

    def is_safe(self, x: Tensor) -> Tensor:
        """(B,) bool: the filter can keep every constraint from here on."""
        return self.is_in_safe_set(x) & self.can_brake(x)

    def compile(self, device: torch.device | str, batch: int) -> None:
        """Compiles the filter for tensors on this device and calls of about so many spacecraft.

        On a CPU all of it is one C function, solver included, unless PIQP is asked for; then, and on a GPU, what is
        computed for every spacecraft. Takes some seconds, up to ten where controls are held, once: what was compiled
        is kept across runs. Raises as `kernels.Compiled`, and changes nothing then.
        """
        if self._solves_in_c and torch.device(device).type == "cpu":
            self.compiled = BatchFilter(self)
            if self.holds:
                self._prepare_held = self.compiled.rows
                self._predict = self.compiled.predict or self.predict
            return
        compiled = self._compiled(device, batch, trace_only=False)
        rows = max(len(group.weights) for group in self.groups)
        self.solver.compile([rows, 2 * rows] if self.holds else [rows], batch, device)  # held ones twice
        self._take(compiled)

    def trace(self, batch: int = 1, device: torch.device | str = "cpu") -> None:
        """Traces `prepare` for tensors on this device and calls of about so many spacecraft.

        Takes some seconds, or 20 where controls are held, and no compiler; calls then take half of their time, or four
        fifths, with the same bits in their results.
        """
        self._take(self._compiled(device, batch, trace_only=True))

    def _compiled(self, device: torch.device | str, batch: int, trace_only: bool) -> list[Compiled]:
        """What is computed for every spacecraft, compiled."""
        x, u = self.probe(device)
        if not self.holds:
            return [Compiled(self.prepare, x, u, batch=batch, trace_only=trace_only)]
        error_bound = torch.zeros_like(x[:KINDS])
        examples: list[tuple[Callable[..., list[Tensor]], tuple[Tensor, ...]]] = [
            (run, (x, u, error_bound, torch.ones_like(u))) for run in self._uncompiled_held()
        ]
        if self.known.latency:
            examples.append((self.predict, (x, error_bound, u)))
        return [Compiled(run, *given, batch=batch, trace_only=trace_only) for run, given in examples]

    def _uncompiled_held(self) -> list[Callable[..., list[Tensor]]]:
        """`prepare_held` of each group."""
        return [partial(self.prepare_held, group) for group in self.held_groups]

    @property
    def _is_compiled(self) -> bool:
        """Whether what is computed for every spacecraft is compiled or traced."""
        return self.compiled is not None or isinstance(
            self._prepare_held[0] if self.holds else self._prepare, Compiled
        )

    def _take(self, compiled: list[Compiled]) -> None:
        """Uses what was compiled from now on."""
        if self.holds:
            self._prepare_held = compiled[: len(self.groups)]
            self._predict = compiled[-1] if self.known.latency else self.predict
        else:
            (self._prepare,) = compiled

    def probe(self, device: torch.device | str) -> tuple[Tensor, Tensor]:
        """A state (16, 1) and a control (6, 1) to try functions of the batch with."""
        x = torch.zeros(SIZE, 1, dtype=torch.float64, device=device)
        x[P.start], x[Q.stop - 1] = self.c.max_distance / 2, 1.0
        return x, torch.zeros_like(x[:CONTROL_SIZE])

    def safety(self, enabled: bool = True) -> Safety:
        """What the environment needs: constraint values, admissible starts and, if enabled, this filter."""
        return Safety(
            names=self.names,
            values=self.values,
            is_safe=self.is_safe,
            correct=self.correct if enabled else None,
            period=self.period,
            informed=self.holds,
        )

    def rows(self, x: Tensor, control: Tensor | None = None) -> tuple[Rows, Rows]:
        """The conditions on thrust and on torque at states (16, B), as tangents at controls (6, B), None: at zero."""
        control = torch.zeros_like(x[:CONTROL_SIZE]) if control is None else control
        if self.holds:
            error_bound, left = torch.zeros_like(x[:KINDS]), torch.ones_like(control)
            thrust, torque = (Prepared(*run(x, control, error_bound, left)) for run in self._prepare_held)
        else:
            thrust, torque = self._prepared(x, control)
        return Rows(*thrust[:ROW_FIELDS]), Rows(*torque[:ROW_FIELDS])

    def prepare(self, x: Tensor, desired: Tensor) -> list[Tensor]:
        """`Prepared` for thrust, then for torque, as one list: (16, B) and (6, B) to fields (..., B)."""
        parts: list[Tensor] = []
        for group in self.groups:
            parts += prepared_now(group, x, desired)
        return parts

    def prepare_held(
        self, group: HeldGroup, x: Tensor, control: Tensor, error_bound: Tensor, left: Tensor
    ) -> list[Tensor]:
        """`Prepared` for one group, of its rows at controls (6, B); see `HeldGroup.conditions_at`.

        Args:
            left: (6, B) the share that each actuator gives of what it is told.
        """
        there = group.limit * left[group.controls]
        return list(
            scaled(
                group.tangents(x, left * control, error_bound, there),
                control[group.controls] / group.limit,
                there,
            )
        )

    def predict(self, x: Tensor, error_bound: Tensor, u: Tensor) -> list[Tensor]:
        """`predicted` by this filter's model, of states (16, B) and (4, B) under controls (6, B)."""
        return list(predicted(x, error_bound, u, self.c, self.parameters, self.known))

    def _prepared(self, x: Tensor, desired: Tensor) -> tuple[Prepared, Prepared]:
        parts = self._prepare(x, desired)
        half = len(parts) // 2
        return Prepared(*parts[:half]), Prepared(*parts[half:])

    def __call__(self, x: Any, desired: Any) -> FilterResult:
        """Filters a desired control: of one spacecraft, or of each of a batch.

        Where no control is held the first call for one spacecraft compiles the filter, which takes 3 s the first time,
        or traces it where there is no compiler.

        Args:
            x: state (16,) or states (16, B), components in the order of `inspection.model.state`.
            desired: control (6,) or controls (6, B) in N and N m in the body frame; beyond the actuators' limits, too.

        Both are NumPy arrays, PyTorch tensors or lists, of float64, float32 or integers.

        Returns:
            Everything in the kind (list: NumPy), precision (integers: float64) and shape (one spacecraft: no axis B) of
            `desired`. The control is within the actuators' limits in float32, too.

        Raises:
            ValueError: another type or shape, a number that is not finite, or a quaternion that is not of length 1.
        """
        given = Given(x, desired)
        fit = given.single and given.x.device.type == "cpu" and not self.holds and not self._is_compiled
        result = (self._for_one if fit else self).correct(given.x, given.desired)
        return FilterResult(*(given.in_kind(getattr(result, field.name)) for field in fields(result)))

    @cached_property
    def _for_one(self) -> "SafetyFilter":
        """This filter, compiled or traced for one spacecraft at a time."""
        other = SafetyFilter(self.c, self.parameters, self._given_solver, self.extra, self.known)
        try:
            other.compile("cpu", 1)
        except (NoCompilerError, NotImplementedError) as error:
            say(f"{error}: the filter is traced instead, which takes seconds")
            other.trace()
        return other

    def correct(
        self, x: Tensor, desired: Tensor, sent: Tensor | None = None, left: Tensor | None = None
    ) -> FilterResult:
        """Filters one control per spacecraft, unchecked.

        A program with NaN or an infinite state in its rows has status UNSOLVED and zero control.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, float64, beyond the actuators' limits, too. Thrust or torque of
                which a number is NaN is read as no wish, zero, and filtered.
            sent: (k, 6, B) the controls held since the states were measured, the oldest first, each for a period; NaN
                where a state is younger. Of more than `latency` the status is UNSOLVED.
            left: (6, B) the share that each actuator gives of what it is told; None: all of it. It counts for a filter
                with `Uncertainty`, as does `sent`.
        """
        too_old = sent is not None and len(sent) > self.known.latency
        elsewhere = x.device.type != "cpu" or self.solver is not self._own_solver
        if self.compiled is None or elsewhere or (self.holds and too_old):
            return self._correct(x, desired, sent, left)
        answer, unsolved = self.compiled(x, desired, sent, left)
        result = FilterResult(*answer)
        if unsolved:  # PIQP may know an answer
            self._correct_again(result, x, desired, sent, left)
        return result

    def _correct_again(self, result: FilterResult, x: Tensor, desired: Tensor, *given: Tensor | None) -> None:
        """Puts what `_correct` answers into a result where that has no solution."""
        columns = torch.nonzero(result.status == Status.UNSOLVED).flatten()
        sent, left = (None if part is None else pick(part, columns) for part in given)
        again = self._correct(pick(x, columns), pick(desired, columns), sent, left)
        for field in fields(result):
            whole = getattr(result, field.name)
            if whole.stride(0):  # else there is nothing to say of any constraint
                put(whole, columns, getattr(again, field.name))

    @torch.no_grad()
    def _correct(self, x: Tensor, desired: Tensor, sent: Tensor | None, left: Tensor | None) -> FilterResult:
        """`correct` in PyTorch, and by the solver."""
        x = x.masked_fill(x.isinf(), torch.nan)  # infinitely safe is no state either
        wish = self.wish(desired)
        control, program_status = self.clip(wish, desired)
        if self.holds:
            return self._commit(
                x, desired, self._correct_held(x, desired, wish, control, program_status, sent, left)
            )
        both = self._prepared(x, control)
        active = [torch.zeros_like(prepared.h, dtype=torch.bool) for prepared in both]
        slack = [torch.zeros_like(prepared.h) for prepared in both]
        for i, (group, prepared) in enumerate(zip(self.groups, both, strict=True)):
            unsafe = torch.nonzero(~(prepared.lowest[0] >= 0.0)).flatten()  # NaN must not pass
            if unsafe.numel():
                wholes = control[group.controls], program_status[i], active[i], slack[i]
                parts = self._solved(group, prepared, wish[group.controls], unsafe)
                for whole, part in zip(wholes, parts, strict=True):
                    put(whole, unsafe, part)
            slack[i] = slack[i].maximum(shortfall(group, prepared, control[group.controls]))
            program_status[i] = with_shortfall(program_status[i], slack[i])
        status = program_status.amax(0)
        h = joined(*(prepared.h for prepared in both))
        nothing = torch.zeros_like(h)
        result = FilterResult(
            control=control,
            intervened=(control != desired).any(0),
            verified=torch.zeros_like(status, dtype=torch.bool),
            backup=torch.zeros_like(status, dtype=torch.bool),
            active=joined(*active),
            slack=joined(*slack),
            status=status,
            program_status=program_status,
            h=h,
            uncertainty=nothing,
            tightened=nothing,
        )
        return self._commit(x, desired, result)

    def _commit(self, x: Tensor, desired: Tensor, result: FilterResult) -> FilterResult:
        """The result with controls that the backup permits at states (16, B), see `rta.backup.check`."""
        if self.backup is None:
            return result
        motion, attitude = result.h[: self.backup.motion], result.h[self.backup.motion : self.backup.limits]
        strange = ~x.isfinite().all(0)  # nothing is known of the way from such a state
        turning = result.h[self.backup.limits : len(CONSTRAINTS)] >= -RATES_ROUNDED
        kept = (motion >= 0.0).all(0), (attitude >= 0.0).all(0) & turning.all(0)
        broken = strange | ~kept[0], strange | ~kept[1]
        control, verified, changed = self.backup.committed(x, result.control, broken)
        status = result.program_status
        status = torch.where(changed, status.clamp(min=Status.HARD), status)
        of_torque = torch.tensor(
            [name in self.groups[1].names for name in self.names], device=x.device
        ).long()
        known = torch.tensor([name in CONSTRAINTS for name in self.names], device=x.device)[:, None]
        slack = result.slack.masked_fill(
            verified[of_torque] & known, 0.0
        )  # limits that are kept do not yield
        yields = torch.stack([(slack * (of_torque == i)[:, None]).amax(0) > SLACK_ROUNDED for i in range(2)])
        status = torch.where(verified & ~yields & (status == Status.SLACK), Status.HARD, status)
        return replace(
            result,
            control=control,
            intervened=(control != desired).any(0),
            verified=verified.all(0),
            backup=changed.any(0),
            slack=slack,
            status=status.amax(0),
            program_status=status,
        )

    def wish(self, desired: Tensor) -> Tensor:
        """What is projected of desired controls (6, B): any size up to LARGEST_DEMAND limits, zero for NaN."""
        wishes = []
        for each in self.groups:
            part = desired[each.controls]
            part = torch.where(part.isnan().any(0), 0.0, part).clamp(-ENDLESS, ENDLESS)
            times = part.abs().amax(0) / each.limit
            wishes.append(part * (LARGEST_DEMAND / times.clamp(min=LARGEST_DEMAND)))
        return torch.cat(wishes)

    def clip(self, wish: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        """Wishes (6, B) clipped to the actuators' limits; (2, B) each group's status: HARD where that is not desired.

        If it satisfies every row this is the projection: none that is permitted is nearer to the wish.
        """
        control = torch.cat([wish[each.controls].clamp(-each.limit, each.limit) for each in self.groups])
        return control, torch.where(self.differ(control, desired), Status.HARD, Status.UNTOUCHED)

    def differ(self, one: Tensor, other: Tensor) -> Tensor:
        """(2, B) bool: the groups of controls (6, B) are not the same."""
        return torch.stack([(one != other)[each.controls].any(0) for each in self.groups])

    def _correct_held(
        self,
        x: Tensor,
        desired: Tensor,
        wish: Tensor,
        control: Tensor,
        program_status: Tensor,
        sent: Tensor | None,
        left: Tensor | None,
    ) -> FilterResult:
        """Torque first, since the body's turn decides where thrust held will act."""
        known, sent = self.known, x.new_zeros(0, *control.shape) if sent is None else sent
        stale = (~sent.isnan().any(1)).sum(0) > known.latency
        left = torch.ones_like(control) if left is None or not known.health else left
        error_bound = torch.zeros_like(x[:KINDS])
        for u in sent:
            x, error_bound = self._predict(x, error_bound, left * u)
        asked = control.clone()
        control[THRUST] = known.given(control[THRUST], self.c.max_thrust)
        if known.health:
            control[TORQUE] = slewing(x, control[TORQUE], left, self.c, self.parameters, known)
        changed = self.differ(control, asked)
        program_status = torch.where(changed, Status.HARD, program_status)
        wish = torch.where(changed.repeat_interleave(3, 0), control, wish)
        parts: dict[int, list[Tensor]] = {}
        for i in (1, 0):
            group, run = self.held_groups[i], self._prepare_held[i]
            near = group.near(x, control)
            prepared = Prepared(*run(x, near, error_bound, left))
            active = torch.zeros_like(prepared.h, dtype=torch.bool)
            slack = shortfall(group, prepared, (left * control)[group.controls])
            unsafe = torch.nonzero(~(prepared.lowest[0] >= 0.0) | (near != control).any(0)).flatten()
            if unsafe.numel():
                given = [pick(part, unsafe) for part in (x, control, error_bound, left)]
                tangents = Prepared(*(pick(part, unsafe) for part in prepared))
                wanted = pick(wish[group.controls], unsafe) / group.limit
                answer = Settling(group, run, self.solver, given, wanted).search(tangents)
                wholes = control[group.controls], program_status[i], active, slack
                for whole, part in zip(wholes, answer, strict=True):
                    put(whole, unsafe, part)
            program_status[i] = with_shortfall(program_status[i], slack)
            tightening = group.by_constraint(prepared.tightening, partial(torch.amax, dim=0))
            parts[i] = [active, slack, prepared.h, tightening]
        program_status = torch.where(stale, Status.UNSOLVED, program_status)
        status = program_status.amax(0)
        ordered = parts[0], parts[1]
        active, slack, h, tightening = (joined(*both) for both in zip(*ordered, strict=True))
        tightened = joined(
            *(group.tightened(own[-1]) for group, own in zip(self.held_groups, ordered, strict=True))
        )
        return FilterResult(
            control,
            (control != desired).any(0),
            torch.zeros_like(stale),
            torch.zeros_like(stale),
            active,
            slack,
            status,
            program_status,
            h,
            tightening,
            tightened,
        )

    def _solved(
        self, group: ActuatorGroup, prepared: Prepared, desired: Tensor, unsafe: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Scales and solves the programs of these columns (M,); returns control, status, active and slack."""
        part = Prepared(*(pick(field, unsafe) for field in prepared))
        asked = problems(group, part, pick(desired, unsafe) / group.limit, group.limit)
        answer = self.solver.solve(asked)
        active, slack = answered(group, asked, part.length, answer.control, answer.status)
        return answer.control * group.limit, answer.status, active, slack


def narrowed(chosen: Tensor, x: Tensor, accepts: Callable[[Tensor], Tensor]) -> Tensor:
    """Clears `chosen` (B,) where `accepts` denies it, which is asked of the chosen columns of states (16, B) only."""
    columns = torch.nonzero(chosen).flatten()
    if columns.numel():
        put(chosen, columns, accepts(pick(x, columns)))
    return chosen


def make_solver(name: str, held: bool = False) -> Solver:
    """A new solver, of rows that are held or not; raises KeyError for a name that is not in SOLVERS."""
    return BatchedSolver(STEPS_HELD) if held and name == "batched" else SOLVERS[name]()

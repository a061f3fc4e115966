"""Proposes controls of both actuator groups that satisfy their rows, or come as near to it as can be.

The state is predicted where it is old, and thrusters are asked for what they give. Torque comes before thrust, since
the attitude decides where thrust acts: thrust's sampled rows are with the torque that was found.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE
from kernels.control import call
from kernels.printer import if_long
from rta.barrier import ActuatorGroup
from rta.bounds.health import slewing
from rta.bounds.prediction import KINDS, predicted
from rta.bounds.uncertainty import Uncertainty
from rta.constraints.constraint import ACTUATORS, Constraint
from rta.parameters import RtaParameters
from rta.qp.active_set import ATTEMPTED, ATTEMPTED_SAMPLED, ActiveSet
from rta.qp.programs import ENDLESS, LARGEST_DEMAND, Problems, Solver, Status
from rta.qp.scaled import Program, ScaledRows, from_qp, scale_rows, shortfall, to_qp, with_shortfall

TORQUE_THEN_THRUST = 1, 0  # of the groups


class Demand(NamedTuple):
    """What is filtered.

    Attributes:
        projected: (6, B) the desired control as it is projected: up to LARGEST_DEMAND limits large, zero for NaN.
        control: (6, B) that clipped to the actuators' limits. If it satisfies every row it is the projection: none
            that is permitted is nearer.
        status: (2, B) of each group: HARD where that is not desired.
    """

    projected: Tensor
    control: Tensor
    status: Tensor


class Found(NamedTuple):
    """What is found for one group.

    Attributes:
        control: (3, B) in N or N m; status: (B,).
        active, slack, h: (constraints, B) of the group's, as in `FilterResult`.
    """

    control: Tensor
    status: Tensor
    active: Tensor
    slack: Tensor
    h: Tensor


# What is computed for every spacecraft, compiled or not: a group's rows at states (16, B) and controls (6, B), and,
# with health, what is left of actuators (6, B); or a prediction.
BatchFunction = Callable[..., list[Tensor]]
ExampleCall = tuple[BatchFunction, tuple[Tensor, ...]]  # with an example of what it is given


class Propose:
    """The order of a call, up to the check of both groups.

    Attributes:
        groups: of thrust and of torque; kind: of their rows, see `Uncertainty.rows`.
        solver: of the quadratic programs.

    Args:
        checked: whether what is proposed of thrust, and of torque, is checked.
        solver: None: the active-set method.
    """

    def __init__(
        self,
        constraints: Sequence[Constraint],
        c: Limits,
        r: RtaParameters,
        uncertainty: Uncertainty,
        checked: tuple[bool, bool],
        solver: Solver | None = None,
    ) -> None:
        self.c, self.r, self.uncertainty, self.kind = c, r, uncertainty, uncertainty.rows(r)
        self.groups = tuple(
            ActuatorGroup(by, constraints, c, r, uncertainty, each)
            for by, each in zip(ACTUATORS, checked, strict=True)
        )
        self.solver = solver or solver_of(self.groups)
        self.long = if_long(len(c.planes))  # of a hull
        self.rows_of: Sequence[Callable[..., Sequence[Tensor]]] = [
            partial(self.rows, group) for group in self.groups
        ]
        self.predictor: BatchFunction = self.predict

    def batch_functions(self, x: Tensor, u: Tensor) -> list[ExampleCall]:
        """Each group's rows and, where a state may be old, `predict`; given a state (16, 1) and a control (6, 1)."""
        left = (torch.ones_like(u),) if self.uncertainty.health else ()
        rows: list[ExampleCall] = [(partial(listed_rows, group), (x, u, *left)) for group in self.groups]
        prediction: list[ExampleCall] = [(self.predict, (x, torch.zeros_like(x[:KINDS]), u))]
        return (rows if self.kind != "none" else []) + (prediction if self.uncertainty.latency else [])

    def use(self, functions: Sequence[BatchFunction]) -> None:
        """Takes the functions of `batch_functions`, compiled, in their place."""
        self.rows_of = functions[:2] if self.kind != "none" else self.rows_of
        self.predictor = functions[-1] if self.uncertainty.latency else self.predictor

    def rows(self, group: ActuatorGroup, *given: Tensor) -> ScaledRows:
        """`scale_rows` of a group, in C a function of the group's name."""
        return call(scale_rows, group, *given, long=self.long, name=f"{group.actuator}_rows")

    def predict(self, x: Tensor, error_bound: Tensor, u: Tensor) -> list[Tensor]:
        """`predicted` by the filter's model, of states (16, B) and (4, B) under controls (6, B)."""
        return list(predicted(x, error_bound, u, self.c, self.r, self.uncertainty))

    def now(self, x: Tensor, sent: Sequence[Tensor], left: Tensor | None) -> tuple[Tensor, Tensor]:
        """States (16, B) of now, and by how much further than measured they may be off (4, B).

        Args:
            sent, left: see `SafetyFilter.correct`.
        """
        error_bound = torch.zeros_like(x[:KINDS])
        for u in sent:
            x, error_bound = call(self.predictor, x, error_bound, u if left is None else left * u)
        return x, error_bound

    def __call__(self, x: Tensor, desired: Tensor, left: Tensor | None) -> tuple[Tensor, list[Found]]:
        """Controls (6, B) at predicted states (16, B), and what is found for each group, thrust first.

        Args:
            left: (6, B) the share that each actuator gives; None: all of it.
        """
        demand = call(self.demand, x, desired, left)
        control, both = demand.control, {}
        for i in TORQUE_THEN_THRUST:
            group, own = self.groups[i], self.groups[i].controls
            if self.kind == "none":
                h = call(group.values, x, long=self.long, name=f"{group.actuator}_values")
                found = zero_if_not_finite(x, as_desired(control[own], demand.status[i], h))
            else:
                more, share = ((), None) if left is None else ((left,), left[own])
                rows = ScaledRows(*self.rows_of[i](x, control, *more))
                found = as_desired(control[own], demand.status[i], rows.h)
                found = self.solved(group, rows, demand.projected[own], found, share)
                if self.uncertainty.is_quantised and own == THRUST:
                    found = found._replace(control=self.uncertainty.quantised(found.control, group.limit))
            control = with_own(control, group, found.control)
            both[i] = found
        return control, [both[0], both[1]]

    def solved(
        self, group: ActuatorGroup, rows: ScaledRows, projected: Tensor, found: Found, share: Tensor | None
    ) -> Found:
        """The solutions of a group's programs, where the control that was found breaks a row.

        Args:
            projected: (3, B) what is projected; share: (3, B) that the group's actuators give, None: all.
        """
        is_broken = ~(rows.lowest >= 0.0)  # NaN must not pass
        asked = call(to_qp, group, rows, projected, share, name=f"{group.actuator}_program")
        answer = self.solver.solve(Problems(*asked, group.weights), is_broken)
        solution = answer.control, answer.status, is_broken
        return call(
            concluded, group, rows, asked, found, *solution, share, name=f"{group.actuator}_concluded"
        )

    def demand(self, x: Tensor, desired: Tensor, left: Tensor | None) -> Demand:
        """What is filtered at states (16, B): what thrusters give, and torque that turns a weak axis away."""
        demand = demanded(desired, self.groups)
        if not self.uncertainty.is_quantised and left is None:
            return demand
        control = demand.control.clone()
        control[THRUST] = self.uncertainty.quantised(control[THRUST], self.c.max_thrust)
        if left is not None:
            control[TORQUE] = slewing(x, control[TORQUE], left, self.c, self.r, self.uncertainty)
        changed = differ(control, demand.control, self.groups)
        projected = torch.where(changed.repeat_interleave(3, 0), control, demand.projected)
        return Demand(projected, control, torch.where(changed, Status.HARD, demand.status))


def listed_rows(group: ActuatorGroup, *given: Tensor) -> list[Tensor]:
    """`scale_rows` as a list, which compiled functions return."""
    return list(scale_rows(group, *given))


def demanded(desired: Tensor, groups: Sequence[ActuatorGroup]) -> Demand:
    """What is filtered where controls (6, B) are desired; thrust or torque of which a number is NaN counts as zero."""
    parts, controls = [], []
    for each in groups:
        part = desired[each.controls]
        part = torch.where(part.isnan().any(0), 0.0, part).clamp(-ENDLESS, ENDLESS)
        times = part.abs().amax(0) / each.limit
        parts.append(part * (LARGEST_DEMAND / times.clamp(min=LARGEST_DEMAND)))
        controls.append(parts[-1].clamp(-each.limit, each.limit))
    control = torch.cat(controls)
    status = torch.where(differ(control, desired, groups), Status.HARD, Status.UNTOUCHED)
    return Demand(torch.cat(parts), control, status)


def differ(one: Tensor, other: Tensor, groups: Sequence[ActuatorGroup]) -> Tensor:
    """(2, B) bool: the groups of controls (6, B) are not the same."""
    return torch.stack([(one != other)[each.controls].any(0) for each in groups])


def with_own(control: Tensor, group: ActuatorGroup, own: Tensor) -> Tensor:
    """Controls (6, B) with others (3, B) of the group's own."""
    return torch.cat((own, control[TORQUE]) if group.controls == THRUST else (control[THRUST], own))


def zero_if_not_finite(x: Tensor, found: Found) -> Found:
    """Replaces controls at states (16, B) that are not finite by zero, UNSOLVED."""
    lost = ~x.isfinite().all(0)
    control, status = (
        torch.where(lost, nothing, part)
        for nothing, part in ((0.0, found.control), (Status.UNSOLVED, found.status))
    )
    return found._replace(control=control, status=status)


def concluded(
    group: ActuatorGroup,
    rows: ScaledRows,
    asked: Program,
    found: Found,
    solution: Tensor,
    status: Tensor,
    is_broken: Tensor,
    share: Tensor | None,
) -> Found:
    """Puts solutions (3, B) in place of controls that break a row, (B,) bool; reports which rows bind, and slack."""
    active, slack = from_qp(group, asked, rows.length, solution, status)
    control = torch.where(is_broken, solution * group.limit, found.control)
    given = control if share is None else share * control
    slack = torch.where(is_broken, slack, 0.0).maximum(shortfall(group, rows, given))
    status = with_shortfall(torch.where(is_broken, status, found.status), slack)
    return Found(control, status, active & is_broken, slack, found.h)


def as_desired(control: Tensor, status: Tensor, h: Tensor) -> Found:
    """A control that is not corrected."""
    return Found(control, status, torch.zeros_like(h, dtype=torch.bool), torch.zeros_like(h), h)


def solver_of(groups: Sequence[ActuatorGroup]) -> ActiveSet:
    """The active-set method for the programs of groups: one function for all."""
    classes = sorted({w for group in groups for w in group.weights if math.isfinite(w)})
    attempted = ATTEMPTED_SAMPLED if groups[0].kind == "sampled" else ATTEMPTED
    return ActiveSet(attempted, max(len(group.weights) for group in groups), classes)

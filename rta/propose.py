"""Proposes controls of both actuator groups that satisfy their rows, or come as near to it as can be.

The state is predicted where it is old, and thrusters are asked for what they give. Torque comes before thrust, since
the attitude decides where thrust acts: thrust's sampled rows are with the torque that was found.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE
from rta.barrier import ActuatorGroup
from rta.bounds.health import slewing
from rta.bounds.prediction import KINDS, predicted
from rta.bounds.uncertainty import Uncertainty
from rta.constraints.constraint import ACTUATORS, Constraint, joined
from rta.parameters import RtaParameters
from rta.qp.programs import ENDLESS, LARGEST_DEMAND, Solver, Status, pick, put
from rta.qp.scaled import ScaledRows, from_qp, scale_rows, shortfall, to_qp, with_shortfall
from rta.result import FilterResult

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

    @classmethod
    def as_desired(cls, control: Tensor, status: Tensor, h: Tensor) -> "Found":
        """A control that is not corrected."""
        return cls(control, status, torch.zeros_like(h, dtype=torch.bool), torch.zeros_like(h), h)


# Of a group, its rows at the desired control, what is projected (3, B), that control, and the share (3, B) that its
# actuators give, or None.
SolveGroup = Callable[[ActuatorGroup, ScaledRows, Tensor, Found, Tensor | None], Found]
# What is computed for every spacecraft, compiled or not: a group's rows at states (16, B) and controls (6, B), and,
# with health, what is left of actuators (6, B); or a prediction.
BatchFunction = Callable[..., list[Tensor]]
ExampleCall = tuple[BatchFunction, tuple[Tensor, ...]]  # with an example of what it is given


class Propose:
    """The order of a call, up to the check of both groups.

    Attributes:
        groups: of thrust and of torque; kind: of their rows, see `Uncertainty.rows`.

    Args:
        checked: whether what is proposed of thrust, and of torque, is checked.
    """

    def __init__(
        self,
        constraints: Sequence[Constraint],
        c: Limits,
        r: RtaParameters,
        uncertainty: Uncertainty,
        checked: tuple[bool, bool],
    ) -> None:
        self.c, self.r, self.uncertainty, self.kind = c, r, uncertainty, uncertainty.rows(r)
        self.groups = tuple(
            ActuatorGroup(by, constraints, c, r, uncertainty, each)
            for by, each in zip(ACTUATORS, checked, strict=True)
        )
        self.rows_of: Sequence[BatchFunction] = [partial(self.rows, group) for group in self.groups]
        self.predictor: BatchFunction = self.predict

    def batch_functions(self, x: Tensor, u: Tensor) -> list[ExampleCall]:
        """Each group's rows and, where a state may be old, `predict`; given a state (16, 1) and a control (6, 1)."""
        left = (torch.ones_like(u),) if self.uncertainty.health else ()
        rows: list[ExampleCall] = [(partial(self.rows, group), (x, u, *left)) for group in self.groups]
        prediction: list[ExampleCall] = [(self.predict, (x, torch.zeros_like(x[:KINDS]), u))]
        return (rows if self.kind != "none" else []) + (prediction if self.uncertainty.latency else [])

    def use(self, functions: Sequence[BatchFunction]) -> None:
        """Takes the functions of `batch_functions`, compiled, in their place."""
        self.rows_of = functions[:2] if self.kind != "none" else self.rows_of
        self.predictor = functions[-1] if self.uncertainty.latency else self.predictor

    @staticmethod
    def rows(group: ActuatorGroup, *given: Tensor) -> list[Tensor]:
        """Computes `scale_rows` as a list, which compiled functions return."""
        return list(scale_rows(group, *given))

    def predict(self, x: Tensor, error_bound: Tensor, u: Tensor) -> list[Tensor]:
        """`predicted` by the filter's model, of states (16, B) and (4, B) under controls (6, B)."""
        return list(predicted(x, error_bound, u, self.c, self.r, self.uncertainty))

    def __call__(
        self, x: Tensor, desired: Tensor, solver: Solver, sent: Tensor | None, left: Tensor | None
    ) -> tuple[Tensor, Tensor, FilterResult]:
        """What is proposed to desired controls; arguments as of `SafetyFilter.correct`.

        Returns:
            The states now, as they are predicted (16, B); by how much further than measured they may be off (4, B);
            what is proposed, not verified.
        """
        left = (torch.ones_like(desired) if left is None else left) if self.uncertainty.health else None
        error_bound = torch.zeros_like(x[:KINDS])
        for u in () if sent is None else sent:
            x, error_bound = self.predictor(x, error_bound, u if left is None else left * u)
        control, found = self.torque_then_thrust(x, desired, left, self.rows_of, partial(solved, solver))
        status, no = torch.stack([each.status for each in found]), torch.zeros_like(x[0], dtype=torch.bool)
        return (
            x,
            error_bound,
            FilterResult(
                control=control,
                intervened=(control != desired).any(0),
                verified=no,
                backup=no,
                active=joined(*(each.active for each in found)),
                slack=joined(*(each.slack for each in found)),
                status=status.amax(0),
                program_status=status,
                h=joined(*(each.h for each in found)),
            ),
        )

    def torque_then_thrust(
        self,
        x: Tensor,
        desired: Tensor,
        left: Tensor | None,
        rows_of: Sequence[BatchFunction],
        solve_group: SolveGroup,
    ) -> tuple[Tensor, list[Found]]:
        """Controls (6, B) at predicted states (16, B), and what is found for each group, thrust first.

        Args:
            left: (6, B) the share that each actuator gives; None: all of it.
            rows_of: computes the rows of each group; solve_group: finds the controls of one.
        """
        demand = self.demand(x, desired, left)
        control, both = demand.control, {}
        for i in TORQUE_THEN_THRUST:
            group, own = self.groups[i], self.groups[i].controls
            if self.kind == "none":
                found = Found.as_desired(control[own], demand.status[i], group.values(x))
                found = zero_if_not_finite(x, found)
            else:
                more, share = ([], None) if left is None else ([left], left[own])
                rows = ScaledRows(*rows_of[i](x, control, *more))
                found = Found.as_desired(control[own], demand.status[i], rows.h)
                found = solve_group(group, rows, demand.projected[own], found, share)
                slack = found.slack.maximum(
                    shortfall(group, rows, found.control if share is None else share * found.control)
                )
                found = found._replace(slack=slack, status=with_shortfall(found.status, slack))
                if self.uncertainty.is_quantised and own == THRUST:
                    found = found._replace(control=self.uncertainty.quantised(found.control, group.limit))
            control = with_own(control, group, found.control)
            both[i] = found
        return control, [both[0], both[1]]

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


def solved(
    solver: Solver,
    group: ActuatorGroup,
    rows: ScaledRows,
    projected: Tensor,
    found: Found,
    share: Tensor | None,
) -> Found:
    """Solves the programs of a group where the desired control breaks a row, as `SolveGroup`."""
    unsafe = torch.nonzero(~(rows.lowest[0] >= 0.0)).flatten()  # NaN must not pass
    if not unsafe.numel():
        return found
    broken = ScaledRows(*(pick(field, unsafe) for field in rows))
    share = None if share is None else pick(share, unsafe)
    asked = to_qp(group, broken, pick(projected, unsafe) / group.limit, share)
    answer = solver.solve(asked)
    active, slack = from_qp(group, asked, broken.length, answer.control, answer.status)
    found = Found(*(part.clone() for part in found))
    for whole, part in (
        (found.control, answer.control * group.limit),
        (found.status, answer.status),
        (found.active, active),
        (found.slack, slack),
    ):
        put(whole, unsafe, part)
    return found

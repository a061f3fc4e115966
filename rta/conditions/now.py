"""The condition of the rate of now: L_f psi + L_g psi u + alpha(psi) >= 0, the paper's (Sec. ASIF)."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from rta.bounds.uncertainty import Uncertainty
from rta.conditions.condition import Demand, Part
from rta.conditions.rows import ActuatorGroup
from rta.conditions.tangents import (
    Prepared,
    answered,
    prepared_now,
    problems,
    shortfall,
    with_shortfall,
)
from rta.constraints.constraint import ACTUATORS, Constraint, joined
from rta.parameters import RtaParameters
from rta.qp.programs import Solver, pick, put
from rta.result import FilterResult


class Now:
    """A `Condition` on the control at the moment of a call."""

    def __init__(
        self, constraints: Sequence[Constraint], c: Limits, r: RtaParameters, known: Uncertainty
    ) -> None:
        self.groups = tuple(ActuatorGroup(by, constraints, c, r, known) for by in ACTUATORS)
        self.run: Callable[..., list[Tensor]] = self.prepare

    def prepare(self, x: Tensor, control: Tensor) -> list[Tensor]:
        """`Prepared` of thrust, then of torque, as one list: (16, B) and (6, B) to fields (..., B)."""
        return [part for group in self.groups for part in prepared_now(group, x, control)]

    def parts(self, x: Tensor, u: Tensor) -> list[Part]:
        """As of `Condition`: both groups at once, which begin alike."""
        return [(self.prepare, (x, u))]

    def use(self, functions: Sequence[Callable[..., list[Tensor]]]) -> None:
        """As of `Condition`."""
        (self.run,) = functions

    def prepared(self, x: Tensor, control: Tensor, error_bound: Tensor | None = None) -> list[Prepared]:
        """As of `Condition`; of the control the rows do not depend."""
        both = self.run(x, control)
        half = len(both) // 2
        return [Prepared(*both[:half]), Prepared(*both[half:])]

    def propose(
        self,
        x: Tensor,
        demand: Demand,
        solver: Solver,
        sent: Tensor | None,
        left: Tensor | None,
        error_bound: Tensor | None = None,
    ) -> FilterResult:
        """As of `Condition`; nothing is told."""
        control, status = demand.control.clone(), demand.status.clone()
        both = self.prepared(x, control)
        active = [torch.zeros_like(prepared.h, dtype=torch.bool) for prepared in both]
        slack = [torch.zeros_like(prepared.h) for prepared in both]
        for i, (group, prepared) in enumerate(zip(self.groups, both, strict=True)):
            unsafe = torch.nonzero(~(prepared.lowest[0] >= 0.0)).flatten()  # NaN must not pass
            if unsafe.numel():
                wholes = control[group.controls], status[i], active[i], slack[i]
                some = Prepared(*(pick(field, unsafe) for field in prepared))
                wish = pick(demand.wish[group.controls], unsafe)
                for whole, part in zip(wholes, solved(group, some, wish, solver), strict=True):
                    put(whole, unsafe, part)
            slack[i] = slack[i].maximum(shortfall(group, prepared, control[group.controls]))
            status[i] = with_shortfall(status[i], slack[i])
        h = joined(*(prepared.h for prepared in both))
        return FilterResult.proposed(control, demand.desired, joined(*active), joined(*slack), status, h)


def solved(
    group: ActuatorGroup, prepared: Prepared, wish: Tensor, solver: Solver
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Solves the programs of rows as prepared; controls (3, M) in N or N m, status, active and slack."""
    asked = problems(group, prepared, wish / group.limit, group.limit)
    answer = solver.solve(asked)
    active, slack = answered(group, asked, prepared.length, answer.control, answer.status)
    return answer.control * group.limit, answer.status, active, slack

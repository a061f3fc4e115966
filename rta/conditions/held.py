"""The condition of a held control: the state is predicted, and rows are of what the control leads to."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE
from rta.backup.check import SLACK_ROUNDED
from rta.backup.homing import Homing
from rta.backup.turn import TurnBackup
from rta.bounds.health import slewing
from rta.bounds.uncertainty import Uncertainty
from rta.conditions.condition import Demand, Part, differ
from rta.conditions.held_rows import KINDS, HeldGroup
from rta.conditions.prediction import predicted
from rta.conditions.tangents import Prepared, Settling, scaled, shortfall, with_shortfall
from rta.constraints.constraint import ACTUATORS, Constraint, joined
from rta.constraints.names import CONSTRAINTS
from rta.parameters import RtaParameters
from rta.qp.programs import Solver, Status, pick, put
from rta.result import FilterResult


class Held:
    """A `Condition` on a control that is held, within bounds that are told; see `rta.conditions.held_rows`."""

    def __init__(
        self, constraints: Sequence[Constraint], c: Limits, r: RtaParameters, known: Uncertainty
    ) -> None:
        self.c, self.r, self.known = c, r, known
        self.groups = tuple(HeldGroup(by, constraints, c, r, known) for by in ACTUATORS)
        self.turn, self.homing = TurnBackup.of(c, r, known), Homing.of(c, r, known)
        self.use([partial(self.prepare, group) for group in self.groups])

    def prepare(
        self, group: HeldGroup, x: Tensor, control: Tensor, error_bound: Tensor, left: Tensor
    ) -> list[Tensor]:
        """`Prepared` for one group, of its rows at controls (6, B); see `HeldGroup.conditions_at`.

        Args:
            left: (6, B) the share that each actuator gives of what it is told.
        """
        there = group.limit * left[group.controls]
        rows = group.tangents(x, left * control, error_bound, there)
        return list(scaled(rows, control[group.controls] / group.limit, there))

    def predict(self, x: Tensor, error_bound: Tensor, u: Tensor) -> list[Tensor]:
        """`predicted` by the filter's model, of states (16, B) and (4, B) under controls (6, B)."""
        return list(predicted(x, error_bound, u, self.c, self.r, self.known))

    def parts(self, x: Tensor, u: Tensor) -> list[Part]:
        """As of `Condition`: each group, and, where a state may be old, `predict`."""
        error_bound = torch.zeros_like(x[:KINDS])
        given = x, u, error_bound, torch.ones_like(u)
        rows: list[Part] = [(partial(self.prepare, group), given) for group in self.groups]
        return [*rows, (self.predict, (x, error_bound, u))] if self.known.latency else rows

    def use(self, functions: Sequence[Callable[..., list[Tensor]]]) -> None:
        """As of `Condition`."""
        self.run, (self.ahead,) = functions[:2], functions[2:] or [self.predict]

    def prepared(self, x: Tensor, control: Tensor, error_bound: Tensor | None = None) -> list[Prepared]:
        """As of `Condition`: the tangents at controls (6, B)."""
        error_bound = torch.zeros_like(x[:KINDS]) if error_bound is None else error_bound
        left = torch.ones_like(control)
        return [Prepared(*run(x, control, error_bound, left)) for run in self.run]

    def propose(
        self,
        x: Tensor,
        demand: Demand,
        solver: Solver,
        sent: Tensor | None,
        left: Tensor | None,
        error_bound: Tensor | None = None,
    ) -> FilterResult:
        """As of `Condition`. Torque first, since the body's turn decides where thrust held will act."""
        sent = x.new_zeros(0, *demand.control.shape) if sent is None else sent
        left = torch.ones_like(demand.control) if left is None or not self.known.health else left
        error_bound = torch.zeros_like(x[:KINDS]) if error_bound is None else error_bound
        for u in sent:
            x, error_bound = self.ahead(x, error_bound, left * u)
        control, wish, status = self.given(x, demand, left)
        parts: dict[int, list[Tensor]] = {}
        backup = torch.zeros_like(x[0], dtype=torch.bool)
        seen = [backup, backup]  # thrust and torque are verified
        for i in (1, 0):
            group = self.groups[i]
            near = group.near(x, control)
            prepared = Prepared(*self.run[i](x, near, error_bound, left))
            active = torch.zeros_like(prepared.h, dtype=torch.bool)
            slack = shortfall(group, prepared, (left * control)[group.controls])
            unsafe = torch.nonzero(~(prepared.lowest[0] >= 0.0) | (near != control).any(0)).flatten()
            if unsafe.numel():
                there = [pick(part, unsafe) for part in (x, control, error_bound, left)]
                tangents = Prepared(*(pick(part, unsafe) for part in prepared))
                wanted = pick(wish[group.controls], unsafe) / group.limit
                answer = Settling(group, self.run[i], solver, there, wanted).search(tangents)
                wholes = control[group.controls], status[i], active, slack
                for whole, part in zip(wholes, answer, strict=True):
                    put(whole, unsafe, part)
            status[i] = with_shortfall(status[i], slack)
            check = (self.homing, self.turn)[i]
            if check:  # of torque before thrust, whose rows depend on the body's turn
                control, seen[i], changed = check.committed(x, control, error_bound)
                slack, status[i] = kept(slack, status[i], seen[i], changed, group)
                backup = backup | changed
            tightening = group.by_constraint(prepared.tightening, partial(torch.amax, dim=0))
            parts[i] = [active, slack, prepared.h, tightening, group.tightened(tightening)]
        active, slack, h, tightening, tightened = (
            joined(*both) for both in zip(parts[0], parts[1], strict=True)
        )
        result = FilterResult.proposed(
            control, demand.desired, active, slack, status, h, tightening, tightened
        )
        return replace(result, backup=backup, verified=seen[0] & seen[1])

    def given(self, x: Tensor, demand: Demand, left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Controls that the thrusters give, and that turn a weak axis away, what is projected, and status (2, B)."""
        control = demand.control.clone()
        control[THRUST] = self.known.given(control[THRUST], self.c.max_thrust)
        if self.known.health:
            control[TORQUE] = slewing(x, control[TORQUE], left, self.c, self.r, self.known)
        changed = differ(control, demand.control, self.groups)
        wish = torch.where(changed.repeat_interleave(3, 0), control, demand.wish)
        return control, wish, torch.where(changed, Status.HARD, demand.status)


def kept(
    slack: Tensor, status: Tensor, verified: Tensor, changed: Tensor, group: HeldGroup
) -> tuple[Tensor, Tensor]:
    """Slack (constraints, B) and statuses (B,) of a group that is checked: a limit that is kept does not yield.

    Args:
        verified, changed: (B,) bool, its controls are, and are others than were proposed.
    """
    own = torch.tensor([name in CONSTRAINTS for name in group.names], device=slack.device)
    slack = slack.masked_fill(own[:, None] & verified, 0.0)
    status = torch.where(changed, status.clamp(min=Status.HARD), status)
    yields = (slack > SLACK_ROUNDED).any(0)
    return slack, torch.where(verified & ~yields & (status == Status.SLACK), Status.HARD, status)

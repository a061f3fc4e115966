"""SafetyFilter: barrier rows, screening, two small programs per spacecraft, report (Sec. ASIF)."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import reduce

import torch
from torch import Tensor

from inspection.environment import Safety
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, SIZE, THRUST, TORQUE, P, Q
from rta import constraints
from rta.batched_solver import BatchedSolver
from rta.compiled import Compiled
from rta.constraints import ATTITUDE, CONSTRAINTS, TRANSLATIONAL
from rta.parameters import RtaParameters
from rta.piqp_solver import PiqpSolver
from rta.qp import FEASIBLE, HOPELESS, REDUNDANT, Problems, Solver, Status, pick, put, total
from rta.rows import Barriers, Row, Rows

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6

ROW_FIELDS = len(fields(Rows))

SOLVERS: dict[str, type[Solver]] = {"piqp": PiqpSolver, "batched": BatchedSolver}


@dataclass
class FilterResult:
    """What the filter did, per spacecraft; constraints in the order of CONSTRAINTS.

    Attributes:
        control: (6, B) safe control in N and N m.
        intervened: (B,) bool, the desired control violated a row and was corrected.
        active: (13, B) bool, a row of the constraint binds a corrected control.
        slack: (13, B) shortfall of the barrier condition without margin, in h's unit per s (per s^2 where
            the relative degree is two).
        status: (B,) int64, the worse `Status` of the thrust and the torque program.
        program_status: (2, B) int64, both of them.
        h: (13, B) constraint values without margin, slopes bounded at their poles.
    """

    control: Tensor
    intervened: Tensor
    active: Tensor
    slack: Tensor
    status: Tensor
    program_status: Tensor
    h: Tensor


class Group:
    """What is fixed about one actuator group.

    Args:
        controls: its place in a control; limit: of each actuator in N or N m.
        rows: of its program; constraints: that these belong to, in the same order.
    """

    def __init__(self, controls: slice, limit: float, rows: list[Row], constraints: tuple[str, ...]) -> None:
        self.controls, self.limit = controls, limit
        self.weights = [row.weight for row in rows]
        self.members = [[i for i, row in enumerate(rows) if row.constraint == name] for name in constraints]

    def by_constraint(self, rows: Tensor, join: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Joins the rows (R, B) of each constraint, to (constraints, B)."""
        return torch.stack([reduce(join, (rows[i] for i in members)) for members in self.members])


class SafetyFilter:
    """The minimally invasive correction of a desired control.

    Args:
        c: the task's constants.
        parameters: gains, margins and weights.
        period: s between calls.
        solver: of the quadratic programs.
    """

    def __init__(
        self,
        c: InspectionParameters,
        parameters: RtaParameters,
        period: float = 1.0,
        solver: Solver | None = None,
    ) -> None:
        self.c, self.period = c, period
        self.solver = solver or PiqpSolver()
        self.barriers = Barriers(c, parameters, period)
        self._prepare: Callable[[Tensor, Tensor], list[Tensor]] = self.prepare
        self.limits = c.control_limit[0], c.control_limit[3]  # N, N m
        self.groups = (
            Group(THRUST, self.limits[0], self.barriers.thrust, TRANSLATIONAL),
            Group(TORQUE, self.limits[1], self.barriers.torque, ATTITUDE),
        )

    def values(self, x: Tensor) -> Tensor:
        """All 13 constraints exactly as in the paper, (16, B) to (13, B)."""
        return constraints.values(x, self.c)

    def compile(self, device: torch.device | str = "cpu") -> None:
        """Compiles the solver and `prepare` for tensors on this device.

        Raises whatever PyTorch raises where there is no working C++ compiler, and changes nothing then.
        """
        probe = torch.zeros(SIZE, 1, dtype=torch.float64, device=device)
        probe[P.start], probe[Q.stop - 1] = self.c.max_distance / 2, 1.0
        compiled = Compiled(self.prepare, probe, torch.zeros_like(probe[:CONTROL_SIZE]))
        self.solver.compile()
        self._prepare = compiled

    def safety(self, enabled: bool = True) -> Safety:
        """What the environment needs: constraint values, admissible starts and, if enabled, this filter."""
        return Safety(
            names=CONSTRAINTS,
            values=lambda x: constraints.values(x, self.c),
            is_safe=self.barriers.is_safe,
            correct=self if enabled else None,
            period=self.period,
        )

    def rows(self, x: Tensor) -> tuple[Rows, Rows]:
        """The conditions on thrust and on torque at states (16, B), as `Barriers` has them."""
        parts = self._prepare(x, torch.zeros_like(x[:CONTROL_SIZE]))
        thrust, torque = (
            Rows(*part[:ROW_FIELDS]) for part in (parts[: len(parts) // 2], parts[len(parts) // 2 :])
        )
        return thrust, torque

    def prepare(self, x: Tensor, desired: Tensor) -> list[Tensor]:
        """All that is computed for every spacecraft, corrected or not: for thrust, then for torque,

        the fields of Rows, the rows' length per actuator limit (R, B), the lowest left-hand side of the scaled
        rows under the desired control (1, B), negative or NaN where it must be corrected, and h by constraint.
        """
        parts = []
        for rows, group in zip(self.barriers(x), self.groups, strict=True):
            a = rows.a * group.limit
            length = total(a * a, 1).sqrt().clamp(min=SHORTEST_ROW)  # thirty times as fast as Tensor.norm
            left = (total(a * (desired[group.controls] / group.limit), 1) + rows.b) / length
            parts += [getattr(rows, field.name) for field in fields(Rows)]
            parts += [
                length,
                reduce(torch.minimum, left.unbind())[None],
                group.by_constraint(rows.h, torch.minimum),
            ]
        return parts

    @torch.no_grad()
    def __call__(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters one control per spacecraft.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, within the actuators' limits.
        """
        parts = self._prepare(x, desired)
        half = len(parts) // 2
        groups = zip(self.groups, (parts[:half], parts[half:]), strict=True)
        control, active, slack, statuses, h = zip(
            *(self._solve(group, part, desired[group.controls]) for group, part in groups), strict=True
        )
        program_status = torch.stack(statuses)
        status = program_status.amax(0)
        return FilterResult(
            control=torch.cat(control),
            intervened=status > Status.UNTOUCHED,
            active=torch.cat(active),
            slack=torch.cat(slack),
            status=status,
            program_status=program_status,
            h=torch.cat(h),
        )

    def _solve(
        self, group: Group, prepared: list[Tensor], desired: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Scales and solves what must be corrected; returns control, active, slack, status and h by constraint."""
        rows = Rows(*prepared[:ROW_FIELDS])
        length, lowest, h = prepared[ROW_FIELDS:]
        control = desired.clone()
        status = torch.zeros_like(lowest[0], dtype=torch.int64)
        active, slack = torch.zeros_like(h, dtype=torch.bool), torch.zeros_like(h)
        unsafe = torch.nonzero(~(lowest[0] >= 0.0)).flatten()  # NaN must not pass
        if unsafe.numel():
            length = pick(length, unsafe)
            a = pick(rows.a, unsafe) * (group.limit / length[:, None])
            b, b_bare = (
                (pick(side, unsafe) / length).clamp(HOPELESS, REDUNDANT) for side in (rows.b, rows.b_bare)
            )
            u = pick(desired, unsafe) / group.limit
            answer = self.solver.solve(Problems(u, a, b, b_bare, u.new_tensor(group.weights)))
            reached = total(a * answer.control, 1)
            short = torch.where(
                answer.status >= Status.SLACK, -(reached + b_bare).clamp(max=0.0) * length, 0.0
            )
            put(control, unsafe, answer.control * group.limit)
            put(status, unsafe, answer.status)
            put(active, unsafe, group.by_constraint(reached + b <= FEASIBLE, torch.logical_or))
            put(slack, unsafe, group.by_constraint(short, torch.maximum))
        return control, active, slack, status, h


def make_solver(name: str) -> Solver:
    """A new solver; raises KeyError for a name that is not in SOLVERS."""
    return SOLVERS[name]()

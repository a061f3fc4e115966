"""SafetyFilter: barrier rows, screening, two small programs per spacecraft, report (Sec. ASIF)."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from inspection.environment import Safety
from inspection.parameters import InspectionParameters
from inspection.state import SIZE, THRUST, TORQUE, P, Q
from rta import constraints
from rta.batched_solver import BatchedSolver
from rta.constraints import ATTITUDE, CONSTRAINTS, TRANSLATIONAL
from rta.parameters import RtaParameters
from rta.piqp_solver import PiqpSolver
from rta.qp import FEASIBLE, HOPELESS, REDUNDANT, Problems, Solver, Status, put, total
from rta.rows import Barriers, Row, Rows

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6
COMPILED_BATCH = 256

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
        self.rows = self.barriers.__call__
        self.limits = c.control_limit[0], c.control_limit[3]  # N, N m

    def values(self, x: Tensor) -> Tensor:
        """All 13 constraints exactly as in the paper, (16, B) to (13, B)."""
        return constraints.values(x, self.c)

    @torch.no_grad()  # a mode that compiled code is specialised to
    def compile(self) -> None:
        """Compiles the solver, and the barrier rows in batches of COMPILED_BATCH: others are cut and filled up.

        torch.compile would otherwise compile anew for every size, each time for about half a minute. Raises
        whatever torch.compile raises where there is no working C++ compiler.
        """
        # dynamic=True, because torch 2.13 generates a CPU kernel that crashes when told that shapes are static
        compiled = torch.compile(self.barriers.__call__, dynamic=True)

        def rows(x: Tensor) -> tuple[Rows, Rows]:
            batch = x.shape[1]
            filled = torch.arange(-(-batch // COMPILED_BATCH) * COMPILED_BATCH, device=x.device) % batch
            parts = [compiled(part.contiguous()) for part in x[:, filled].split(COMPILED_BATCH, 1)]
            thrust, torque = zip(*parts, strict=True)
            return join(thrust, batch), join(torque, batch)

        probe = torch.zeros(SIZE, COMPILED_BATCH, dtype=torch.float64)
        probe[P.start], probe[Q.stop - 1] = self.c.max_distance / 2, 1.0
        compiled(probe)
        self.rows = rows
        self.solver.compile()

    def safety(self, enabled: bool = True) -> Safety:
        """What the environment needs: constraint values, admissible starts and, if enabled, this filter."""
        return Safety(
            names=CONSTRAINTS,
            values=lambda x: constraints.values(x, self.c),
            is_safe=self.barriers.is_safe,
            correct=self if enabled else None,
            period=self.period,
        )

    def __call__(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters one control per spacecraft.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, within the actuators' limits.
        """
        thrust, torque = self.rows(x)
        limit = self.c.control_limit
        parts = (
            self._solve(thrust, self.barriers.thrust, desired[THRUST], limit[0], TRANSLATIONAL),
            self._solve(torque, self.barriers.torque, desired[TORQUE], limit[3], ATTITUDE),
        )
        control, active, slack, statuses, h = zip(*parts, strict=True)
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
        self, rows: Rows, fixed: list[Row], desired: Tensor, limit: float, group: tuple[str, ...]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Scales, screens and solves one group; returns control, active, slack, status and h by constraint."""
        a = rows.a * limit
        length = total(a * a, 1).sqrt().clamp(min=SHORTEST_ROW)  # thirty times as fast as Tensor.norm
        a = a / length[:, None]
        b, b_bare = ((side / length).clamp(HOPELESS, REDUNDANT) for side in (rows.b, rows.b_bare))
        u = desired / limit

        status = torch.zeros(u.shape[1], dtype=torch.int64, device=u.device)
        safe = ((a * u).sum(1) + b).amin(0) >= 0.0  # False for NaN, which must not pass
        unsafe = torch.nonzero(~safe).flatten()
        if unsafe.numel():
            weight = u.new_tensor([row.weight for row in fixed])
            solutions = self.solver.solve(Problems(u, a, b, b_bare, weight)[unsafe])
            u = u.clone()
            put(u, unsafe, solutions.control)
            put(status, unsafe, solutions.status)

        reached = (a * u).sum(1)
        binding = (reached + b <= FEASIBLE) & (status > Status.UNTOUCHED)
        slack = torch.where(status >= Status.SLACK, -(reached + b_bare).clamp(max=0.0) * length, 0.0)
        index = torch.tensor([group.index(row.constraint) for row in fixed], device=u.device)
        return (
            u * limit,
            by_constraint(binding.to(u.dtype), index, len(group), "amax") > 0,
            by_constraint(slack, index, len(group), "amax"),
            status,
            by_constraint(rows.h, index, len(group), "amin"),
        )


def make_solver(name: str) -> Solver:
    """A new solver; raises KeyError for a name that is not in SOLVERS."""
    return SOLVERS[name]()


def join(parts: tuple[Rows, ...], batch: int) -> Rows:
    """The rows of consecutive parts, cut to the first `batch` spacecraft."""
    return Rows(
        *(torch.cat([getattr(part, field.name) for part in parts], -1)[..., :batch] for field in fields(Rows))
    )


def by_constraint(rows: Tensor, index: Tensor, count: int, reduce: str) -> Tensor:
    """Reduces rows (R, B) that share a constraint to (count, B)."""
    out = rows.new_zeros(count, rows.shape[1])
    return out.scatter_reduce_(0, index[:, None].expand_as(rows), rows, reduce, include_self=False)

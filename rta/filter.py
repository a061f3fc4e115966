"""SafetyFilter: barrier rows, screening, two small programs per spacecraft, report (Sec. ASIF)."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from inspection.dynamics import control_matrix, drift
from inspection.environment import Safety
from inspection.parameters import InspectionParameters
from inspection.state import THRUST, TORQUE
from rta import constraints
from rta.barrier import high_order, lie_derivatives
from rta.constraints import ATTITUDE, CONSTRAINTS, TRANSLATIONAL, Smoothing
from rta.parameters import RtaParameters
from rta.piqp_solver import PiqpSolver
from rta.qp import FEASIBLE, HOPELESS, REDUNDANT, Problems, Solver, Status

# Below this length (rate of h per actuator limit, in h's unit per s) a row counts as beyond the actuators'
# influence: it keeps its direction but not its claim to a full unit of slack.
SHORTEST_ROW = 1e-6


@dataclass
class FilterResult:
    """What the filter did, per spacecraft; constraints in the order of CONSTRAINTS.

    Attributes:
        control: (6, B) safe control in N and N m.
        intervened: (B,) bool, the control differs from the desired one.
        active: (13, B) bool, a row of the constraint binds a corrected control.
        slack: (13, B) shortfall of the barrier condition without margin, in h's unit per s.
        status: (B,) int64, the worse `Status` of the thrust and the torque program.
        h: (13, B) constraint values without margin, slopes bounded at their poles.
    """

    control: Tensor
    intervened: Tensor
    active: Tensor
    slack: Tensor
    status: Tensor
    h: Tensor


@dataclass
class Rows:
    """Barrier conditions a u + b >= 0 of one actuator group, u in N or N m.

    Attributes:
        h: (R, B) values; psi: (R, B) Psi_1 where the relative degree is two, else h less its margin.
        a: (R, 3, B); b: (R, B) with margins; margin: (R, 1) what leaving the margin out adds to b.
    """

    h: Tensor
    psi: Tensor
    a: Tensor
    b: Tensor
    margin: Tensor


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
        r = parameters
        if r.passive_safety_segments[-1] != c.passive_safety_horizon:
            raise ValueError(
                f"passive_safety_segments end at {r.passive_safety_segments[-1]} s: "
                f"must be the passive_safety_horizon, {c.passive_safety_horizon} s"
            )
        self.c, self.r, self.period = c, parameters, period
        self.solver = solver or PiqpSolver()
        self.smoothing = Smoothing(r.distance_floor, r.pole_angle)
        passes = len(r.passive_safety_segments) - 1

        # gain, margin and slack weight of each thrust row, then of each torque row
        critical, resource, motion = r.slack_weight_critical, r.slack_weight_resource, r.slack_weight_motion
        self.thrust_rows = [
            (0, r.collision_gain, r.collision_margin, math.inf),
            (1, r.speed_gain, r.speed_margin, motion),
            (2, r.keep_in_gain, r.keep_in_margin, critical),
            *[(3, r.passive_safety_gain, r.passive_safety_margin, critical)] * passes,
            *[(i, r.velocity_gain, r.velocity_margin, motion) for i in (4, 5, 6)],
        ]
        self.first_gain = [r.gain(k1, period) for k1, _ in self._high_order_gains]
        self.high_order_margin = [r.exclusion_margin, r.temperature_margin, r.battery_margin]
        self.torque_rows = [
            *[
                (i, k2, 0.0, weight)
                for i, (_, k2), weight in zip(
                    (0, 1, 2), self._high_order_gains, (critical, resource, resource), strict=True
                )
            ],
            *[(i, r.rate_gain, r.rate_margin, motion) for i in (3, 4, 5)],
        ]

    def compile(self) -> None:
        """Compiles the barrier rows, once for every batch size above one; values stay equal to 1e-12."""
        self.rows = torch.compile(self.rows, dynamic=True)

    @property
    def _high_order_gains(self) -> tuple[tuple[float, float], ...]:
        return self.r.exclusion_gains, self.r.temperature_gains, self.r.battery_gains

    def safety(self, enabled: bool = True) -> Safety:
        """What the environment needs: constraint values, admissible starts and, if enabled, this filter."""
        return Safety(
            names=CONSTRAINTS,
            values=lambda x: constraints.values(x, self.c),
            is_safe=self.is_safe,
            correct=self if enabled else None,
            period=self.period,
        )

    def translational(self, x: Tensor, times: Tensor) -> Tensor:
        """h of the thrust rows, (16, ...) and pass times (segments, ...) to (R, ...)."""
        c, s = self.c, self.smoothing
        speeds = torch.stack(
            (
                constraints.collision(x, c, s),
                constraints.dynamic_speed(x, c),
                constraints.keep_in_zone(x, c, s),
            )
        )
        return torch.cat((speeds, constraints.clearance_at(x, times, c), constraints.velocity(x, c)))

    def orientation(self, x: Tensor) -> Tensor:
        """h of relative degree two, (16, ...) to (3, ...)."""
        c, s = self.c, self.smoothing
        return torch.stack(
            (
                constraints.attitude_exclusion(x, c, s),
                constraints.temperature(x, c, s),
                constraints.battery(x, c, s),
            )
        )

    def first_psi(self, x: Tensor) -> Tensor:
        """Psi_1 of the constraints of relative degree two, (16, ...) to (3, ...)."""

        def alpha(h: Tensor) -> Tensor:
            pairs = zip(self.first_gain, self.high_order_margin, strict=True)
            return torch.stack([gain * (h[i] - margin) for i, (gain, margin) in enumerate(pairs)])

        return high_order(self.orientation, alpha, lambda y: drift(y, self.c))(x)

    def rows(self, x: Tensor) -> tuple[Rows, Rows]:
        """The barrier conditions on thrust and on torque at states (16, B)."""
        c = self.c
        f, g = drift(x, c), control_matrix(x, c)
        times = constraints.closest_times(x, self.r.passive_safety_segments, c)
        in_four = times[:, None].expand(-1, 4, -1)  # one copy for each of f and three controls
        h, lf, lg = lie_derivatives(lambda y: self.translational(y, in_four), x, f, g[:, THRUST])
        thrust = self._condition(h, h, lf, lg, self.thrust_rows, 0.0)

        def psi_and_rates(y: Tensor) -> Tensor:
            return torch.cat((self.first_psi(y), constraints.angular_velocity(y, c)))

        psi, lf, lg = lie_derivatives(psi_and_rates, x, f, g[:, TORQUE])
        h = torch.cat((self.orientation(x), psi[3:]))
        spent = [k * m for k, m in zip(self.first_gain, self.high_order_margin, strict=True)] + [0.0] * 3
        torque = self._condition(h, psi, lf, lg, self.torque_rows, x.new_tensor(spent)[:, None])
        return thrust, torque

    def _condition(
        self,
        h: Tensor,
        psi: Tensor,
        lf: Tensor,
        lg: Tensor,
        rows: list[tuple[int, float, float, float]],
        spent: Tensor | float,
    ) -> Rows:
        """L_f psi + L_g psi u + alpha(psi - margin) >= 0."""
        gain = psi.new_tensor([self.r.gain(k, self.period) for _, k, _, _ in rows])[:, None]
        margin = psi.new_tensor([m for _, _, m, _ in rows])[:, None]
        return Rows(h, psi - margin, lg, lf + gain * (psi - margin), gain * (margin + spent))

    def is_safe(self, x: Tensor) -> Tensor:
        """(B,) bool: every h and every Psi_1 is non-negative, so the filter can keep it so."""
        return (constraints.values(x, self.c) >= 0.0).all(0) & (self.first_psi(x) >= 0.0).all(0)

    def __call__(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters one control per spacecraft.

        Args:
            x: states (16, B), float64.
            desired: controls (6, B) in N and N m, within the actuators' limits.
        """
        thrust, torque = self.rows(x)
        limit = self.c.control_limit
        parts = [
            self._solve(thrust, self.thrust_rows, desired[THRUST], limit[0], len(TRANSLATIONAL)),
            self._solve(torque, self.torque_rows, desired[TORQUE], limit[3], len(ATTITUDE)),
        ]
        control, active, slack, status, h = zip(*parts, strict=True)
        control_all, status_all = torch.cat(control), torch.stack(status).amax(0)
        return FilterResult(
            control=control_all,
            intervened=status_all > Status.UNTOUCHED,
            active=torch.cat(active),
            slack=torch.cat(slack),
            status=status_all,
            h=torch.cat(h),
        )

    def _solve(
        self,
        rows: Rows,
        table: list[tuple[int, float, float, float]],
        desired: Tensor,
        limit: float,
        count: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Scales, screens and solves one group; returns control, active, slack, status and h by constraint."""
        a = rows.a * limit
        length = a.norm(dim=1).clamp(min=SHORTEST_ROW)
        a = a / length[:, None]
        b = (rows.b / length).clamp(HOPELESS, REDUNDANT)
        b_bare = ((rows.b + rows.margin) / length).clamp(HOPELESS, REDUNDANT)
        u = desired / limit

        status = torch.zeros(u.shape[1], dtype=torch.int64, device=u.device)
        unsafe = torch.nonzero(~(((a * u).sum(1) + b).amin(0) >= 0.0)).flatten()
        if unsafe.numel():
            problems = Problems(
                desired=numpy(u[:, unsafe].T),
                a=numpy(a[:, :, unsafe].permute(2, 0, 1)),
                b=numpy(b[:, unsafe].T),
                b_bare=numpy(b_bare[:, unsafe].T),
                weight=np.array([weight for _, _, _, weight in table]),
            )
            solved, outcome = self.solver.solve(problems)
            u = u.clone()
            u[:, unsafe] = torch.from_numpy(solved.T).to(u)
            status[unsafe] = torch.from_numpy(outcome).to(status.device)

        short = (a * u).sum(1)
        binding = (short + b <= FEASIBLE) & (status > Status.UNTOUCHED)
        slack = torch.where(status >= Status.SLACK, -(short + b_bare).clamp(max=0.0) * length, 0.0)
        index = torch.tensor([i for i, _, _, _ in table], device=u.device)
        return (
            u * limit,
            by_constraint(binding.to(u.dtype), index, count, "amax") > 0,
            by_constraint(slack, index, count, "amax"),
            status,
            by_constraint(rows.h, index, count, "amin"),
        )


def numpy(a: Tensor) -> np.ndarray:
    """A contiguous array on the CPU."""
    return a.contiguous().cpu().numpy()


def by_constraint(rows: Tensor, index: Tensor, count: int, reduce: str) -> Tensor:
    """Reduces rows (R, B) that share a constraint to (count, B)."""
    out = rows.new_zeros(count, rows.shape[1])
    return out.scatter_reduce_(0, index[:, None].expand_as(rows), rows, reduce, include_self=False)

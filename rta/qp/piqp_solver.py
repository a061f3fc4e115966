"""The filter's programs solved one at a time by PIQP (Schwan et al. 2023), a proximal interior-point method."""

import threading
from typing import Any

import numpy as np
import piqp
import torch
from numpy import ndarray
from torch import Tensor

from kernels.control import put
from rta.qp.programs import FEASIBLE, Problems, Solutions, Status, kkt_residual, least_violating, stages

UNBOUNDED = 1e30  # PIQP's infinity


class Workspaces(threading.local):
    """PIQP's workspaces by shape, each thread's its own: a program's data and its solution are in the same one."""

    def __init__(self) -> None:
        self.by_shape: dict[tuple[int, int], piqp.DenseSolver] = {}


class PiqpSolver:
    """Each of the `stages` takes what the one before left infeasible.

    PIQP works on the CPU; it keeps its workspace between calls of the same shape, so workspaces are cached.
    """

    def __init__(self) -> None:
        self._workspaces = Workspaces()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()

    def solve(self, problems: Problems, wanted: Tensor | None = None) -> Solutions:
        """See `Solver`."""
        if wanted is not None:
            return self._solve_some(problems, torch.nonzero(wanted).flatten())
        # batch first: PIQP reads one contiguous program after the other
        desired, a = (
            part.movedim(-1, 0).contiguous().cpu().numpy() for part in (problems.desired, problems.a)
        )
        candidates = [desired, np.zeros_like(desired)]
        control, status = desired.copy(), np.full(len(desired), Status.UNSOLVED)
        residual = np.full(len(desired), np.inf)

        # PIQP's workspace would keep a NaN, and spoil every program after it
        finite = problems.finite.cpu().numpy()
        for of_stage, weights, outcome in stages(problems):
            left = np.flatnonzero((status == Status.UNSOLVED) & finite)
            if not left.size:
                break
            side, slack_weight = of_stage.movedim(-1, 0).cpu().numpy(), weights.cpu().numpy()
            hard = np.isinf(slack_weight)
            within_box = np.abs(a[left]).sum(2) + side[left] >= -FEASIBLE  # some control satisfies the row
            left = left[within_box[:, hard].all(1)]
            u, multiplier = self._solve_all(desired[left], a[left], side[left], slack_weight)
            u = np.clip(u, -1.0, 1.0)
            feasible = (lhs(u, a[left], side[left])[:, hard] >= -FEASIBLE).all(1)
            kept = feasible & np.isfinite(u).all(1)
            solved = left[kept]
            control[solved] = u[kept]
            status[solved] = outcome
            programs = desired[solved].T, a[solved].swapaxes(1, 2).T, side[solved].T
            residual[solved] = kkt_residual(
                u[kept].T, multiplier[kept].T, *programs, 1.0 / slack_weight[:, None]
            )
            answers = desired.copy()
            answers[left] = np.where(np.isfinite(u), u, desired[left])
            candidates.append(answers)

        control[~finite] = 0.0
        device = problems.desired.device
        if (unsolved := np.flatnonzero((status == Status.UNSOLVED) & finite)).size:
            controls = [columns(u[unsolved]).to(device) for u in candidates]
            last = least_violating(controls, problems[torch.from_numpy(unsolved).to(device)])
            control[unsolved] = last.movedim(-1, 0).cpu().numpy()
        return Solutions(
            columns(control).contiguous().to(device),
            torch.from_numpy(status).to(device),
            torch.from_numpy(residual).to(device),
        )

    def _solve_some(self, problems: Problems, columns: Tensor) -> Solutions:
        """Solves the programs at these indices (M,)."""
        no = torch.full_like(problems.desired[0], torch.inf)
        whole = Solutions(torch.zeros_like(problems.desired), torch.zeros_like(no, dtype=torch.int64), no)
        some = self.solve(problems[columns])
        for name, part in vars(some).items():
            put(getattr(whole, name), columns, part)
        return whole

    def _solve_all(
        self, desired: ndarray, a: ndarray, b: ndarray, weight: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Controls (N, 3) and multipliers (N, R); NaN where PIQP does not call the program solved."""
        soft = np.isfinite(weight)
        count, rows, slacks = len(desired), len(weight), int(soft.sum())
        c, g, lower = -desired, a, -b
        if slacks:
            c = np.hstack((c, np.zeros((count, slacks))))
            # slack in units of 1 / sqrt(weight) makes the cost the identity
            relief = np.eye(rows)[:, soft] / np.sqrt(weight[soft])
            g = np.concatenate((g, np.broadcast_to(relief, (count, rows, slacks))), 2)
        u, multiplier = np.full((count, 3), np.nan), np.full((count, rows), np.nan)
        solver = self._workspace(rows, slacks)
        # PIQP has no batch call: this loop is the filter's largest cost, so it holds nothing but the solver.
        for i in range(count):
            solver.update(c=c[i], G=g[i], h_l=lower[i])
            if solver.solve() == piqp.PIQP_SOLVED:
                u[i], multiplier[i] = solver.result.x[:3], solver.result.z_l
        return u, multiplier

    def _workspace(self, rows: int, slacks: int) -> piqp.DenseSolver:
        """PIQP for min |x|^2 / 2 + c' x subject to g x >= lower, the first three x in [-1, 1]."""
        workspaces = self._workspaces.by_shape
        if (rows, slacks) not in workspaces:
            solver = piqp.DenseSolver()
            solver.settings.eps_abs = 1e-9
            solver.settings.eps_rel = 1e-9
            # at its default of 1e-8 the gap leaves errors of 3e-5 in the control; below 1e-13 some fail
            solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-13
            solver.settings.max_iter = 60
            if not slacks:
                solver.settings.preconditioner_iter = 0  # rows have unit length already
            # Without slack a program is often infeasible and should be given up early; with it, hardly ever.
            solver.settings.infeasibility_threshold = 0.9 if slacks else 1e-3
            # at its default of 1e-4 a large multiplier of a row that yields is taken for a proof of infeasibility
            solver.settings.eps_primal_inf = 1e-8
            variables = 3 + slacks
            bound = np.full(variables, UNBOUNDED)
            bound[:3] = 1.0
            g, lower = np.ones((rows, variables)), np.zeros(rows)  # shapes only; data comes with update
            infinite = np.full(rows, UNBOUNDED)
            solver.setup(
                np.eye(variables), np.zeros(variables), None, None, g, lower, infinite, -bound, bound
            )
            workspaces[rows, slacks] = solver
        return workspaces[rows, slacks]


def columns(array: ndarray) -> Tensor:
    """(N, ...) as a tensor (..., N)."""
    return torch.from_numpy(array).movedim(0, -1)


def lhs(u: ndarray, a: ndarray, b: ndarray) -> ndarray:
    """a u + b: (..., 3), (..., R, 3), (..., R) to (..., R); negative where a row is violated."""
    return (a @ u[..., None])[..., 0] + b

"""The paper's filter (Sec. Run Time Assurance, box Active Set Invariance Filter).

    u_act = argmin |u_des - u|^2 + sum_i w_i delta_i^2
            s.t.   L_f Psi_i + L_g Psi_i u + alpha(Psi_i) + delta_i >= 0,   |u_j| <= u_max

Psi_i is h_i where controls change the first derivative of h_i. Else it is the last barrier function of the high-order
chain, whose derivative controls change. alpha(z) = k z. The paper writes BC >= delta, the same with -delta. Each
spacecraft has one program of six controls and all slack, solved by PIQP. Nothing is checked, so the filter can fail;
`rta.filter` is verified.
"""

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.dynamics import control_matrix, drift
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE
from rta.lie_derivatives import Function, lie_derivative, lie_derivatives
from rta.limits import PAPER, Limit
from rta.nearest import nearest_points
from rta.result import FilterResult, Status

GIVEN = 1e-7  # slack above this, in the unit of its condition, is more than rounding

Conditions = tuple[Tensor, Tensor, Tensor]  # a (R, 6, B) and b (R, B) of BC = a u + b, and Psi (R, B)


def hocbf(limit: Limit, c: Limits) -> Function:
    """Returns Psi_{d-1} of relative degree d, with Psi_0 = h and Psi_j = dPsi_{j-1}/dt + k_j Psi_{j-1} (Eq. HOCBF)."""

    def psi(x: Tensor, j: int = len(limit.gains) - 1) -> Tensor:
        if j == 0:
            return limit.h(x, c)
        before, rate = lie_derivative(lambda y: psi(y, j - 1), x, drift(x, c))
        return rate + limit.gains[j - 1] * before

    return psi


def barrier_conditions(x: Tensor, c: Limits, limits: dict[str, Limit] = PAPER) -> Conditions:
    """Computes BC = L_f Psi + L_g Psi u + alpha(Psi) at states (16, B), with u in N and N m (Eq. BC, HOCBF)."""
    each_psi = [hocbf(limit, c) for limit in limits.values()]
    f, g = drift(x, c), control_matrix(x, c)
    psi, along_f, along_g = lie_derivatives(lambda y: torch.stack([each(y) for each in each_psi]), x, f, g)
    gain = psi.new_tensor([limit.gains[-1] for limit in limits.values()])[:, None]
    return along_g, along_f + gain * psi, psi


def asif(
    a: ndarray, b: ndarray, desired: ndarray, weights: list[float | None]
) -> tuple[ndarray, ndarray, ndarray]:
    """Returns controls (n, 6), slack (n, R) and `Status` (n,) of n programs; zeros where PIQP finds no solution.

    Controls, a (n, R, 6), b (n, R) and desired (n, 6) are in units of the actuators' limits. A condition of weight None
    or 0 has no slack. The variables are the controls and sqrt(w) delta, so that the cost is a distance. Conditions are
    scaled to length 1, and those that no control within the limits can violate are left out.
    """
    unit = np.array([weight**-0.5 if weight else 0.0 for weight in weights])
    length = np.sqrt((a**2).sum(2) + unit**2).clip(min=1e-30)  # of a row that no variable changes
    rows, low, slack = a / length[..., None], -b / length, np.zeros_like(b)
    control, status = np.zeros_like(desired), np.full(len(b), int(Status.UNSOLVED))
    short = low + np.abs(rows).sum(2)  # shortfall of each row under the worst control
    order, count = short.argsort(1)[:, ::-1], (short > 0.0).sum(1)
    finite = np.isfinite(short.sum(1) + desired.sum(1))
    for k in np.unique(count[finite]):
        own = np.flatnonzero(finite & (count == k))
        kept = own[:, None], order[own, :k]
        g = np.concatenate((rows[kept].swapaxes(1, 2), (unit / length)[kept][:, None] * np.eye(k)), 1)
        wanted = np.concatenate((desired[own], np.zeros((len(own), k))), 1)
        # |u - u_des|^2 + |s|^2 with s = sqrt(w) delta
        z, solved = nearest_points(wanted, g, low[kept], CONTROL_SIZE)
        control[own], slack[kept], status[own[solved]] = z[:, :CONTROL_SIZE], z[:, CONTROL_SIZE:], Status.HARD
    slack = np.where(slack * unit > GIVEN, slack * unit, 0.0)
    status[slack.any(1)] = Status.SLACK
    return control, slack, status


class PaperFilter:
    """Filters controls by the paper's program for a task's constants; `names` are those of the limits."""

    def __init__(self, c: Limits, limits: dict[str, Limit] = PAPER) -> None:
        self.c, self.limits, self.names = c, limits, tuple(limits)

    def values(self, x: Tensor) -> Tensor:
        """Returns every h: states (16, B) to (R, B)."""
        return torch.stack([limit.h(x, self.c) for limit in self.limits.values()])

    def evaluated(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns `barrier_conditions` and `values`."""
        return *barrier_conditions(x, self.c, self.limits), self.values(x)

    @torch.no_grad()
    def correct(self, x: Tensor, desired: Tensor) -> FilterResult:
        """Filters desired controls (6, B) in N and N m at states (16, B), float64.

        The desired control, clipped to the actuators' limits, is the solution where it satisfies every condition.
        """
        *rows, _, h = self.evaluated(x)
        a, b, asked = (part.movedim(-1, 0).cpu().numpy() for part in (*rows, desired))
        limit = np.array(self.c.control_limit)
        a, wanted = a * limit, asked / limit
        control, slack = wanted.clip(-1.0, 1.0), np.zeros_like(b)
        status = np.where((control != wanted).any(1), int(Status.HARD), int(Status.UNTOUCHED))
        broken = ~((a * control[:, None]).sum(2) + b >= 0.0).all(1)
        if broken.any():
            weights = [each.weight for each in self.limits.values()]
            control[broken], slack[broken], status[broken] = asif(
                a[broken], b[broken], wanted[broken], weights
            )
        changed = status > Status.UNTOUCHED
        binding = changed & (status < Status.UNSOLVED)
        active = ((a * control[:, None]).sum(2) + b <= GIVEN) & binding[:, None]
        applied = np.where(changed[:, None], control * limit, asked)
        found = [torch.from_numpy(part.T).to(x.device) for part in (applied, changed, active, slack, status)]
        u, intervened, active_rows, delta, code = found
        no = torch.zeros_like(intervened)
        return FilterResult(u, intervened, no, no, active_rows, delta, code, h)

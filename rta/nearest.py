"""The points closest to given ones under linear conditions, one quadratic program after the other by PIQP."""

import numpy as np
import piqp
from numpy import ndarray

# Tried in this order: with much slack of a large weight, float64 cannot reach the first tolerance.
TOLERANCES = 1e-11, 1e-9


def nearest_points(wanted: ndarray, g: ndarray, low: ndarray, bounded: int) -> tuple[ndarray, ndarray]:
    """Minimises |z - wanted|^2 subject to sum_j g_j z_j >= low, with the first `bounded` of z in [-1, 1].

    Args:
        wanted: (n, size); g: (n, size, rows), of rows of about length 1; low: (n, rows). All are finite: NaN would stay
            in PIQP's memory and spoil the next program.

    Returns:
        z (n, size), zero where PIQP finds no solution, and whether it found one (n,).
    """
    n, size, rows = g.shape
    box = np.where(np.arange(size) < bounded, 1.0, 1e30)  # 1e30 is PIQP's infinity
    solver = piqp.DenseSolver()
    solver.settings.preconditioner_iter = 0  # rows are scaled already
    solver.setup(
        np.eye(size), np.ones(size), None, None, np.ones((rows, size)), np.zeros(rows), None, -box, box
    )
    z, solved, cost = np.zeros((n, size)), np.zeros(n, dtype=bool), -wanted
    for tolerance in TOLERANCES:
        for name in ("abs", "rel", "duality_gap_abs", "duality_gap_rel", "primal_inf"):
            setattr(solver.settings, f"eps_{name}", tolerance)
        for i in np.flatnonzero(~solved):
            solver.update(c=cost[i], G=g[i].T, h_l=low[i])
            if solver.solve() == piqp.PIQP_SOLVED:
                z[i], solved[i] = solver.result.x, True
    z[:, :bounded] = z[:, :bounded].clip(-1.0, 1.0)
    return z, solved

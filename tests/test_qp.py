"""The solver against exact enumeration, optimality certificates and hand-made conflicts of rows."""

import itertools

import numpy as np
from numpy import ndarray
from scipy.optimize import nnls

from rta.qp import Problems, residual

INF = np.inf


def unit_rows(rng: np.random.Generator, *shape: int) -> ndarray:
    a = rng.standard_normal((*shape, 3))
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def problem(
    desired: list[float], rows: list[list[float]], weight: list[float], spare: float = 0.0
) -> Problems:
    """One program; rows are (a1, a2, a3, b), and leaving the margin out adds `spare` to b."""
    table = np.array(rows, dtype=float)[None]
    return Problems(
        np.array([desired], dtype=float),
        table[..., :3],
        table[..., 3],
        table[..., 3] + spare,
        np.array(weight),
    )


def feasible_problems(count: int, rows: int, seed: int) -> Problems:
    """Each has a point inside the box that satisfies every row, some of them with equality."""
    rng = np.random.default_rng(seed)
    a, point = unit_rows(rng, count, rows), rng.uniform(-1, 1, (count, 3))
    spare = rng.exponential(0.3, (count, rows)) * rng.integers(0, 4, (count, rows)).clip(max=1)
    b = spare - (a @ point[..., None])[..., 0]
    return Problems(rng.uniform(-1, 1, (count, 3)), a, b, b + 0.1, np.full(rows, 1e5))


def infeasible_problems(count: int, rows: int, seed: int, weight: ndarray) -> Problems:
    """Each has a pair of soft rows that exclude each other by 0.1 to 1 actuator limits, and random others."""
    rng = np.random.default_rng(seed)
    a, b = unit_rows(rng, count, rows), rng.uniform(-0.2, 1.0, (count, rows))
    a[:, -1] = -a[:, -2]
    b[:, -1] = -b[:, -2] - rng.uniform(0.1, 1.0, count)
    return Problems(rng.uniform(-1, 1, (count, 3)), a, b, b.copy(), weight)


def projection(problems: Problems) -> ndarray:
    """The nearest feasible points (N, 3), by trying every set of up to three active rows and bounds."""
    count = len(problems.desired)
    box = np.concatenate((np.eye(3), -np.eye(3)))[None].repeat(count, 0)
    a = np.concatenate((problems.a, box), 1)
    b = np.concatenate((problems.b, np.ones((count, 6))), 1)
    best, nearest = np.full(count, np.inf), np.full((count, 3), np.nan)
    for size in range(4):
        for active in itertools.combinations(range(a.shape[1]), size):
            normals, short = a[:, active], residual(problems.desired, a[:, active], b[:, active])
            gram = normals @ normals.transpose(0, 2, 1)
            independent = np.abs(np.linalg.det(gram)) > 1e-12
            gram[~independent] = np.eye(size)
            shift = np.linalg.solve(gram, short[..., None])
            u = problems.desired - (normals.transpose(0, 2, 1) @ shift)[..., 0]
            distance = ((u - problems.desired) ** 2).sum(1)
            better = independent & (distance < best) & (residual(u, a, b) >= -1e-10).all(1)
            best[better], nearest[better] = distance[better], u[better]
    return nearest


def least_distance(desired: ndarray, a: ndarray, b: ndarray, weight: ndarray) -> ndarray:
    """The control (3,) of one program with slack, by Lawson and Hanson's reduction to non-negative least squares.

    With z = (u - desired, sqrt(weight) delta) the program is: the shortest z with G z >= h.
    """
    soft = np.isfinite(weight)
    relief = np.eye(len(weight))[:, soft] / np.sqrt(weight[soft])
    box = np.concatenate((np.eye(3), -np.eye(3)))
    g = np.block([[a, relief], [box, np.zeros((6, soft.sum()))]])
    h = -np.concatenate((residual(desired, a, b), 1 + box @ desired))
    e = np.concatenate((g.T, h[None]))
    f = np.append(np.zeros(g.shape[1]), 1.0)
    r = e @ nnls(e, f)[0] - f
    return desired - r[:3] / r[-1]


def reference(problems: Problems) -> ndarray:
    """The controls (N, 3) with slack."""
    triples = zip(problems.desired, problems.a, problems.b, strict=True)
    return np.array([least_distance(*triple, problems.weight) for triple in triples])

"""The control of last resort: the least-violating one that is known."""

import numpy as np

from rta.qp.piqp_solver import least_violating

INF = np.inf


def test_least_violating_satisfies_first_what_must_hold() -> None:
    a, b = np.eye(3)[:2], np.array([-0.5, -0.5])  # u1 >= 0.5 must hold, u2 >= 0.5 is soft
    breaks_soft, breaks_must = np.array([0.4, -1.0, 0.0]), np.array([0.3, 1.0, 0.0])
    chosen = least_violating([breaks_must, breaks_soft], a, b, np.array([INF, 1e5]))
    assert (chosen == breaks_soft).all()


def test_least_violating_weighs_soft_rows() -> None:
    a, b = np.eye(3)[:2], np.array([-0.5, -0.5])
    breaks_light, breaks_heavy = np.array([0.5, 0.0, 0.0]), np.array([0.3, 0.5, 0.0])
    chosen = least_violating([breaks_heavy, breaks_light], a, b, np.array([1e5, 1e3]))
    assert (chosen == breaks_light).all()


def test_least_violating_passes_over_what_is_not_finite() -> None:
    candidates = [np.full(3, np.nan), np.array([2.0, 0.0, 0.0])]
    chosen = least_violating(candidates, np.eye(3)[:1], np.zeros(1), np.array([1e3]))
    assert chosen.tolist() == [1.0, 0.0, 0.0]

"""Both solvers against exact enumeration, optimality certificates and hand-made conflicts of rows."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import nnls

from rta.qp import programs as qp
from rta.qp.piqp_solver import lhs
from rta.qp.programs import FEASIBLE, Solver, Status, least_violating
from tests.oracles import INF, Problems, given_slack, projection, with_slack
from tests.support.solvers import SOLVERS, make_solver


@pytest.fixture(params=SOLVERS)
def solver(request: pytest.FixtureRequest) -> Solver:
    return make_solver(request.param)


def solve(solver: Solver, problems: Problems) -> tuple[ndarray, ndarray]:
    """Controls (N, 3) and statuses (N,)."""
    answer = solver.solve(problems.tensors())
    return answer.control.T.numpy(), answer.status.numpy()


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


WEIGHT = np.array([1e5, 1e5, 1e4, 1e4, 1e3, 1e3, 1e3, 1e3])
ONE_MUST_HOLD = np.array([INF, *WEIGHT[1:]])
SLACK_CASES = {
    "high_weights_agree": WEIGHT,
    "high_weights_conflict": WEIGHT[::-1].copy(),
    "one_must_hold": ONE_MUST_HOLD,
    "one_must_hold_and_high_weights_conflict": np.array([INF, *WEIGHT[:0:-1]]),
}


def slack_problems(weight: ndarray) -> Problems:
    problems = infeasible_problems(300, 8, 1, weight)
    must = np.isinf(weight)
    problems.b[:, must] = problems.b_no_margin[:, must] = np.abs(problems.b[:, must])  # satisfied by u = 0
    return problems


@pytest.fixture(scope="module", params=SLACK_CASES)
def case(request: pytest.FixtureRequest) -> tuple[Problems, ndarray, ndarray]:
    """Programs, the reference's slack weights (N, R) and controls (N, 3)."""
    problems = slack_problems(SLACK_CASES[request.param])
    given = given_slack(problems)
    return problems, given, with_slack(problems, given)


def test_references_agree() -> None:
    problems = dataclasses.replace(feasible_problems(300, 6, 0), weight=np.full(6, INF))
    exact = with_slack(dataclasses.replace(problems, b_no_margin=problems.b))
    np.testing.assert_allclose(exact, projection(problems), rtol=0, atol=1e-11)


@pytest.mark.parametrize("rows", [6, 11])
def test_feasible_program_equals_enumeration(solver: Solver, rows: int) -> None:
    problems = feasible_problems(400, rows, rows)
    expected = projection(problems)
    control, status = solve(solver, problems)
    assert (status == Status.HARD).all()
    assert np.abs(expected - problems.desired).max(1).mean() > 0.1
    np.testing.assert_allclose(control, expected, rtol=0, atol=1e-6)


def test_slack_program_equals_least_distance(solver: Solver, case: tuple[Problems, ndarray, ndarray]) -> None:
    problems, _, expected = case
    control, status = solve(solver, problems)
    assert (status == Status.SLACK).all()
    np.testing.assert_allclose(control, expected, rtol=0, atol=1e-4)


def test_slack_program_satisfies_kkt(solver: Solver, case: tuple[Problems, ndarray, ndarray]) -> None:
    # what is left of u - desired - sum w delta a after non-negative multipliers of the active bounds and rows
    # that are held; a residual that is off by FEASIBLE changes it by FEASIBLE times the weight
    problems, given, _ = case
    control, _ = solve(solver, problems)
    programs = zip(control, problems.desired, problems.a, problems.b_no_margin, given, strict=True)
    for u, desired, a, b, weight in programs:
        soft = np.isfinite(weight)
        rest = lhs(u, a, b)
        force = weight[soft] * np.maximum(0, -rest[soft])
        normals = np.concatenate((a[~soft], np.eye(3), -np.eye(3)))
        active = np.concatenate((rest[~soft], 1 + u, 1 - u)) < 1e-6
        _, left = nnls((normals * active[:, None]).T, u - desired - force @ a[soft])
        assert left <= FEASIBLE * weight[soft].max()


def test_margins_are_spent_before_slack(solver: Solver) -> None:
    # u1 >= 0.5 and u1 <= 0.3 with margins of 0.2: nothing but u1 in [0.3, 0.5] satisfies both without
    problems = problem([0.9, 0.1, 0.0], [[1, 0, 0, -0.5], [-1, 0, 0, 0.3]], [1e3, 1e3], spare=0.2)
    control, status = solve(solver, problems)
    assert status == [Status.HARD]
    np.testing.assert_allclose(control, [[0.5, 0.1, 0.0]], atol=1e-6)


# Rows and weights, and what is left of the desired control (0.2, 0, 0), worked out by hand.
AT_LEAST_HALF, AT_MOST_MINUS_HALF = [1, 0, 0, -0.5], [-1, 0, 0, -0.5]
SECOND_AT_LEAST_HALF, SECOND_AT_MOST_MINUS_HALF = [0, 1, 0, -0.5], [0, -1, 0, -0.5]
PRIORITIES = {
    "the_lower_yields_entirely": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [1e5, 1e3], [0.5, 0, 0]),
    "in_either_order": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [1e3, 1e5], [-0.5, 0, 0]),
    # the minimum of (u1 - 0.2)^2 + w (0.5 - u1)^2 + w (0.5 + u1)^2
    "equals_share": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [1e4, 1e4], [0.2 / (1 + 2e4), 0, 0]),
    "the_lowest_of_three_yields_to_both": (
        [[1, 0, 0, -0.1], AT_LEAST_HALF, AT_MOST_MINUS_HALF],
        [1e5, 1e4, 1e3],
        [0.5, 0, 0],
    ),
    # at most 0.3; the lower two would meet at (0.2 + 0.5e4 - 0.5e3) / (1 + 1e4 + 1e3) = 0.41
    "the_lower_two_of_three_yield": (
        [[-1, 0, 0, 0.3], AT_LEAST_HALF, AT_MOST_MINUS_HALF],
        [1e5, 1e4, 1e3],
        [0.3, 0, 0],
    ),
    # no control in the box has u1 >= 1.5; u2 >= 0.5 is held; u3 >= 0.3, given slack too, costs 1e3 delta^2
    "beyond_the_box_only_it_and_lower_ones_yield": (
        [[1, 0, 0, -1.5], SECOND_AT_LEAST_HALF, SECOND_AT_MOST_MINUS_HALF, [0, 0, 1, -0.3]],
        [1e4, 1e5, 1e3, 1e3],
        [1, 0.5, 0.3e3 / (1 + 1e3)],
    ),
    # with slack for the highest all have it: the lower two meet where their weights decide
    "within_a_stage_weights_decide": (
        [[1, 0, 0, -1.5], SECOND_AT_LEAST_HALF, SECOND_AT_MOST_MINUS_HALF],
        [1e5, 1e4, 1e3],
        [1, (0.5e4 - 0.5e3) / (1 + 1e4 + 1e3), 0],
    ),
}


@pytest.mark.parametrize(("rows", "weight", "expected"), PRIORITIES.values(), ids=PRIORITIES)
def test_lower_weights_yield_first(
    solver: Solver, rows: list[list[float]], weight: list[float], expected: list[float]
) -> None:
    control, status = solve(solver, problem([0.2, 0, 0], rows, weight))
    assert status == [Status.SLACK]
    np.testing.assert_allclose(control, [expected], atol=1e-6)


def test_row_that_yields_far_proves_nothing_of_the_others(solver: Solver) -> None:
    # a program of tangents: three rows leave a corner of 1e-4 (u2 and u3 at most, u1 < 0), and the fourth, 5e-2
    # short of it, pulls with 400; PIQP 0.7.0 takes that for a proof unless it is told to prove more
    rows = [
        [-0.006, 0.697, 0.717, -0.565],
        [0.876, 0.02, -0.481, 0.149],
        [0, -1, 0, 0.443],
        [0, 0, -1, 0.357],
    ]
    control, status = solve(solver, problem([0.82, -0.491, -0.976], rows, [INF, 1e4, INF, INF]))
    assert status == [Status.SLACK]
    least = (0.697 * 0.443 + 0.717 * 0.357 - 0.565) / 0.006  # what the first row leaves u1
    np.testing.assert_allclose(control, [[least, 0.443, 0.357]], atol=1e-6)


UNSOLVABLE = {
    "must_hold_beyond_the_box": [[1, 0, 0, -1.5], [0, 1, 0, 0.5]],
    "nan_row_that_must_hold": [[np.nan, 0, 0, 0.5], [0, 1, 0, 0.5]],
    "nan_soft_row": [[1, 0, 0, 0.5], [0, np.nan, 0, 0.5]],
    "nan_soft_b": [[1, 0, 0, 0.5], [0, 1, 0, np.nan]],
    "nan_b": [[1, 0, 0, np.nan], [0, 1, 0, np.nan]],
}


@pytest.mark.parametrize("rows", UNSOLVABLE.values(), ids=UNSOLVABLE)
def test_unsolvable_program_says_so_and_stays_finite(solver: Solver, rows: list[list[float]]) -> None:
    control, status = solve(solver, problem([0.9, 0.1, 0.0], rows, [INF, 1e3]))
    assert status == [Status.UNSOLVED]
    assert (np.abs(control) <= 1).all()


# u1 + u2 >= 0.4 from the origin with a slack weight of 10: u = lambda (1, 1, 0) and 2 lambda + lambda / 10 = 0.4.
# The second row, 0.5 >= 0, can do nothing.
BEST = 0.4 / 2.1
RESIDUALS = {
    "optimum": ([BEST, BEST, 0.0], [BEST, 0.0], 0.0),
    "not_stationary": ([BEST, BEST, 0.01], [BEST, 0.0], 0.01),
    "row_violated": ([BEST - 0.01, BEST - 0.01, 0.0], [BEST - 0.01, 0.0], 0.021),
    "negative_multiplier": ([BEST, BEST, 0.0], [BEST, -0.3], 0.3),
    "idle_row_has_multiplier": ([BEST, BEST, 0.0], [BEST, 0.2], 0.1),
    "idle_row_has_large_multiplier": ([BEST, BEST, 0.0], [BEST, 7.0], 0.5),
}


def kkt_residual(
    u: list[float],
    multiplier: list[float],
    desired: list[float],
    rows: list[list[float]],
    weight: list[float],
) -> float:
    """Of one program with rows (a1, a2, a3, b)."""
    u, multiplier, desired, table, weight = (
        torch.tensor(x, dtype=torch.float64) for x in (u, multiplier, desired, rows, weight)
    )
    a, b = table[:, :3, None], table[:, 3:]
    return qp.kkt_residual(
        u[:, None], multiplier[:, None], desired[:, None], a, b, 1.0 / weight[:, None]
    ).item()


@pytest.mark.parametrize(("u", "multiplier", "expected"), RESIDUALS.values(), ids=RESIDUALS)
def test_kkt_residual_measures_what_is_wrong(
    u: list[float], multiplier: list[float], expected: float
) -> None:
    found = kkt_residual(u, multiplier, [0, 0, 0], [[1, 1, 0, -0.4], [0, 0, 0, 0.5]], [10, INF])
    assert found == pytest.approx(expected, abs=1e-15)


def last_resort(candidates: list[list[float]], needed: list[float], weight: list[float]) -> list[float]:
    """The least-violating of candidate controls where u_i >= needed_i."""
    a, b = np.eye(3)[None, : len(needed)], -np.array([needed])
    problems = Problems(np.zeros((1, 3)), a, b, b, np.array(weight)).tensors()
    found = least_violating([torch.tensor([u], dtype=torch.float64).T for u in candidates], problems)
    return found[:, 0].tolist()


def test_least_violating_weighs_soft_rows_as_their_slack_costs() -> None:
    """1e5 x 0.05^2 = 250 against 1e3 x 1^2 = 1,000, whatever the squares of the weights say."""
    breaks_heavy, breaks_light = [0.45, 0.5, 0.0], [0.5, -0.5, 0.0]
    assert last_resort([breaks_light, breaks_heavy], [0.5, 0.5], [1e5, 1e3]) == breaks_heavy
    breaks_heavy[0] = 0.3
    assert last_resort([breaks_heavy, breaks_light], [0.5, 0.5], [1e5, 1e3]) == breaks_light

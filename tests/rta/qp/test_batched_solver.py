"""The batched solver against PIQP on recorded problems, enumeration, linear programs and optimality conditions.

Cases that both solvers must pass stand in tests/rta/qp/test_programs.py.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import nnls
from torch import Tensor

from rta.qp import batched_solver
from rta.qp.batched_solver import ACCURATE, BatchedSolver, attempt
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import Problems, Solutions, Status
from tests.oracles import Problems as Arrays
from tests.oracles import feasible, given_slack, projection, tensor, with_slack

FIELDS = ("desired", "a", "b", "b_no_margin")


@pytest.fixture(autouse=True)
def steps_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes the steps for every program, as on a GPU, and leaves PIQP only what they do not solve accurately."""
    monkeypatch.setattr(batched_solver, "PIQP_FIRST", ())


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> BatchedSolver:
    """Counts in `resolved` how many problems PIQP solves again."""
    solver = BatchedSolver()
    solve = solver.fallback.solve
    solver.resolved = 0

    def counting(problems: Problems) -> Solutions:
        solver.resolved += problems.desired.shape[1]
        return solve(problems)

    monkeypatch.setattr(solver.fallback, "solve", counting)
    return solver


def left_hand_sides(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """a u + b, (R, N)."""
    return torch.einsum("rcn,cn->rn", a, u) + b


def arrays(problems: Problems) -> Arrays:
    """Batch first."""
    return Arrays(
        *(getattr(problems, name).movedim(-1, 0).numpy() for name in FIELDS), problems.weight.numpy()
    )


def assert_faulty_program_leaves_its_neighbours_alone(
    solver: BatchedSolver, problems: Problems, field: str, value: float
) -> None:
    faulty = dataclasses.replace(problems, **{field: getattr(problems, field).clone()})
    getattr(faulty, field)[-1, ..., 17] = value
    before, after = solver.solve(problems), solver.solve(faulty)
    others = torch.arange(problems.desired.shape[1]) != 17
    for name in ("control", "status"):
        assert (getattr(before, name)[..., others] == getattr(after, name)[..., others]).all()
    accurate = (each.residual[others] <= ACCURATE for each in (before, after))
    assert torch.equal(*accurate)
    assert after.status[17] == Status.UNSOLVED
    assert (after.control[:, 17] == 0.0).all()
    assert after.residual[17] == math.inf


@pytest.mark.parametrize("value", [math.nan, -math.inf])
@pytest.mark.parametrize("field", FIELDS)
def test_faulty_program_leaves_its_neighbours_alone(field: str, value: float) -> None:
    sample = synthetic(100, 11, seed=7)
    assert_faulty_program_leaves_its_neighbours_alone(BatchedSolver(), sample, field, value)


@pytest.mark.parametrize(
    "limit",
    [{"steps": 0, "MAX_ROUNDS": 1, "ROUND": 1}, {"ACCURATE": -1.0}, {"steps": 0, "PIQP_FIRST": ("cpu",)}],
    ids=["steps", "residual", "cpu"],
)
def test_what_is_not_solved_accurately_is_piqps(
    solver: BatchedSolver, monkeypatch: pytest.MonkeyPatch, limit: dict[str, Any]
) -> None:
    if "steps" in limit:
        solver._attempt = partial(attempt, steps=limit["steps"])
    for name in limit.keys() - {"steps"}:
        monkeypatch.setattr(batched_solver, name, limit[name])
    drawn = synthetic(300, 11, seed=8)
    sample = drawn[torch.nonzero((BatchedSolver().solve(drawn).control != drawn.desired).any(0)).flatten()]
    ours, piqp = solver.solve(sample), PiqpSolver().solve(sample)
    assert solver.resolved == len(sample.desired[0]) > 250
    assert (ours.control == piqp.control).all() and (ours.status == piqp.status).all()
    assert (ours.residual == piqp.residual).all()


def synthetic(count: int, rows: int, seed: int) -> Problems:
    """Random rows, the first of which must hold; in a third of them the last contradicts the one before."""
    rng = np.random.default_rng(seed)
    a, point = rng.standard_normal((rows, 3, count)), rng.uniform(-1, 1, (3, count))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    spare = rng.exponential(0.3, (rows, count)) * rng.integers(0, 4, (rows, count)).clip(max=1)
    b = spare - np.einsum("rcn,cn->rn", a, point)
    third = count // 3
    a[-1, :, :third] = -a[-2, :, :third]
    b[-1, :third] = -b[-2, :third] - rng.uniform(0.2, 1.0, third)
    desired = np.where(rng.random((3, count)) < 0.1, 1.0, rng.uniform(-1, 1, (3, count)))
    weight = torch.tensor([math.inf, *10.0 ** (3 + np.arange(rows - 1) % 3)], dtype=torch.float64)
    return Problems(tensor(desired), tensor(a), tensor(b), tensor(b + 0.1), weight)


def force_left(u: ndarray, desired: ndarray, a: ndarray, b: ndarray, weight: ndarray) -> float:
    """What stationarity leaves of u - desired after slack forces and the best multipliers of what is active."""
    rest, soft = a @ u + b, np.isfinite(weight)
    force = weight[soft] * np.maximum(0.0, -rest[soft])
    normals = np.concatenate((a[~soft], np.eye(3), -np.eye(3)))
    active = np.concatenate((rest[~soft], 1 + u, 1 - u)) < 1e-8
    return nnls((normals * active[:, None]).T, u - desired - force @ a[soft])[1]


@pytest.mark.parametrize("rows", [6, 11])
def test_random_programs_satisfy_kkt(solver: BatchedSolver, rows: int) -> None:
    problems = synthetic(1000, rows, seed=rows)
    answer, programs = solver.solve(problems), arrays(problems)
    slack = answer.status == Status.SLACK
    assert slack.sum() >= 300 and solver.resolved < 10
    assert (answer.control.abs() <= 1.0).all()
    given, with_margins = given_slack(programs), feasible(programs.a, programs.b)
    for i, (u, desired, a, b, b_no_margin) in enumerate(
        zip(
            answer.control.T.numpy(),
            programs.desired,
            programs.a,
            programs.b,
            programs.b_no_margin,
            strict=True,
        )
    ):
        held = np.isinf(given[i])
        assert answer.status[i] == (Status.HARD if held.all() else Status.SLACK)
        side = b if with_margins[i] else b_no_margin
        assert (a @ u + side)[held].min() >= -1e-9
        # a residual that is off by 1e-11 changes the force by that times the weight
        assert force_left(u, desired, a, side, given[i]) <= (1e-8 if held.all() else 1e-11 * 1e5)


def test_unsolvable_programs_are_proved_to_be(solver: BatchedSolver) -> None:
    problems = synthetic(200, 6, seed=1)
    problems.weight[:] = math.inf  # what was soft must hold
    answer, programs = solver.solve(problems), arrays(problems)
    expected = feasible(programs.a, programs.b_no_margin)
    assert ((answer.status == Status.HARD).numpy() == expected).all()
    unsolved = answer.status == Status.UNSOLVED
    assert solver.resolved == unsolved.sum() > 50
    assert (answer.residual[unsolved] == math.inf).all()


def test_zero_row_that_cannot_hold_leaves_the_others_alone(solver: BatchedSolver) -> None:
    problems = synthetic(100, 6, seed=2)
    problems.a[1], problems.b[1], problems.b_no_margin[1] = 0.0, -0.5, -0.5
    answer = solver.solve(problems)
    assert (answer.status == Status.SLACK).all()
    np.testing.assert_allclose(answer.control.T, with_slack(arrays(problems)), rtol=0, atol=1e-7)


# Rows that leave the solution where it is, from programs without slack and their solutions.


def zeros(p: Problems, u: Tensor) -> tuple[Tensor, Tensor]:
    return torch.zeros_like(p.a), torch.zeros_like(p.b)


def duplicates(p: Problems, u: Tensor) -> tuple[Tensor, Tensor]:
    return p.a, p.b


def short_duplicates(p: Problems, u: Tensor) -> tuple[Tensor, Tensor]:
    return 1e-9 * p.a, 1e-9 * p.b


def reversed_where_active(p: Problems, u: Tensor) -> tuple[Tensor, Tensor]:
    """Nothing but a plane is left."""
    return -p.a, torch.where(left_hand_sides(u, p.a, p.b) < 1e-9, -p.b, 2.0)


def tilted(tilt: float) -> Callable[[Problems, Tensor], tuple[Tensor, Tensor]]:
    """As far from the solution as the rows they are nearly parallel to."""

    def rows(p: Problems, u: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn(p.a.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        a = p.a + tilt * noise
        return a, left_hand_sides(u, p.a, p.b) - left_hand_sides(u, a, torch.zeros_like(p.b))

    return rows


ADDED = {
    "zeros": zeros,
    "duplicates": duplicates,
    "short_duplicates": short_duplicates,
    "reversed_where_active": reversed_where_active,
    **{f"tilted_by_{tilt:g}": tilted(tilt) for tilt in (1e-3, 1e-5, 1e-7, 1e-9, 1e-12)},
}


@pytest.mark.parametrize("added", ADDED.values(), ids=ADDED)
def test_degenerate_rows_change_nothing(
    solver: BatchedSolver, added: Callable[[Problems, Tensor], tuple[Tensor, Tensor]]
) -> None:
    problems = synthetic(450, 6, seed=5)[torch.arange(150, 450)]
    expected = torch.from_numpy(projection(arrays(problems)).T)
    a, b = (torch.cat(pair) for pair in zip((problems.a, problems.b), added(problems, expected), strict=True))
    answer = solver.solve(Problems(problems.desired, a, b, b, problems.weight.repeat(2)))
    assert (answer.status == Status.HARD).all()
    assert solver.resolved == 0
    torch.testing.assert_close(answer.control, expected, rtol=0, atol=1e-6)


def test_compiled_solver_gives_the_same_answers() -> None:
    eager, compiled = BatchedSolver(), BatchedSolver()
    compiled.compile([11], 16, "cpu")
    for part in (synthetic(700, rows, seed=rows) for rows in (6, 11)):
        for count in (1, 2, len(part.desired[0])):
            sample = part[torch.arange(count)]
            expected, answer = eager.solve(sample), compiled.solve(sample)
            assert (answer.status == expected.status).all()
            assert (answer.residual <= ACCURATE).all()
            torch.testing.assert_close(answer.control, expected.control, rtol=0, atol=1e-9)
        assert_faulty_program_leaves_its_neighbours_alone(compiled, part, "b", math.nan)

"""The active-set method against enumeration, linear programs and optimality conditions, in PyTorch and in C.

Cases that both solvers must pass stand in tests/rta/qp/test_programs.py.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import nnls
from torch import Tensor

from kernels import compiled
from rta.qp import active_set
from rta.qp.active_set import ACCURATE, ActiveSet
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import Problems, Solutions, Solver, Status, least_violating
from tests.oracles import Problems as Arrays
from tests.oracles import feasible, given_slack, projection, tensor, with_slack

FIELDS = ("desired", "a", "b", "b_no_margin")


def left_hand_sides(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """a u + b, (R, N)."""
    return torch.einsum("rcn,cn->rn", a, u) + b


def arrays(problems: Problems) -> Arrays:
    """Batch first."""
    return Arrays(
        *(getattr(problems, name).movedim(-1, 0).numpy() for name in FIELDS), np.array(problems.weight)
    )


def assert_faulty_program_leaves_its_neighbours_alone(
    solver: Solver, problems: Problems, field: str, value: float
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
    assert_faulty_program_leaves_its_neighbours_alone(ActiveSet(), sample, field, value)


def test_what_no_stage_solves_is_said_and_gets_the_least_violating_control(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Here since it takes too many steps."""
    monkeypatch.setattr(active_set, "MOST_STEPS", 1)
    problems = synthetic(300, 11, seed=8)
    answer = ActiveSet(attempted=0).solve(problems)
    lost = answer.status == Status.UNSOLVED
    assert lost.sum() > 250 and (answer.residual[lost] == math.inf).all()
    candidates = [problems.desired, torch.zeros_like(problems.desired)]
    others = least_violating(candidates, problems)
    violated = [violation(problems, u)[:, lost] for u in (answer.control, others)]
    must, rest = (ours <= theirs for ours, theirs in zip(*violated, strict=True))
    assert (must & (rest | (violated[0][0] < violated[1][0]))).all()


def violation(p: Problems, u: Tensor) -> Tensor:
    """By how much controls violate rows without margin (2, N): those that must hold, and the others by weight."""
    weight = torch.tensor(p.weight)[:, None]
    short = (-left_hand_sides(u, p.a, p.b_no_margin)).clamp(min=0.0) ** 2
    hard = weight.isinf()
    return torch.stack(((short * hard).sum(0), (short * weight.masked_fill(hard, 0.0)).sum(0)))


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
    weight = [math.inf, *(10.0 ** (3 + np.arange(rows - 1) % 3)).tolist()]
    return Problems(tensor(desired), tensor(a), tensor(b), tensor(b + 0.1), weight)


def force_left(u: ndarray, desired: ndarray, a: ndarray, b: ndarray, weight: ndarray) -> float:
    """What stationarity leaves of u - desired after slack forces and the best multipliers of what is active."""
    rest, soft = a @ u + b, np.isfinite(weight)
    force = weight[soft] * np.maximum(0.0, -rest[soft])
    normals = np.concatenate((a[~soft], np.eye(3), -np.eye(3)))
    active = np.concatenate((rest[~soft], 1 + u, 1 - u)) < 1e-8
    return nnls((normals * active[:, None]).T, u - desired - force @ a[soft])[1]


@pytest.mark.parametrize("rows", [6, 11])
def test_random_programs_satisfy_kkt(rows: int) -> None:
    problems = synthetic(1000, rows, seed=rows)
    answer, programs = ActiveSet().solve(problems), arrays(problems)
    slack = answer.status == Status.SLACK
    assert slack.sum() >= 300
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


def test_unsolvable_programs_are_proved_to_be() -> None:
    problems = dataclasses.replace(
        synthetic(200, 6, seed=1), weight=[math.inf] * 6
    )  # what was soft must hold
    answer, programs = ActiveSet().solve(problems), arrays(problems)
    expected = feasible(programs.a, programs.b_no_margin)
    assert ((answer.status == Status.HARD).numpy() == expected).all()
    unsolved = answer.status == Status.UNSOLVED
    assert unsolved.sum() > 50
    assert (answer.residual[unsolved] == math.inf).all()


def test_zero_row_that_cannot_hold_leaves_the_others_alone() -> None:
    problems = synthetic(100, 6, seed=2)
    problems.a[1], problems.b[1], problems.b_no_margin[1] = 0.0, -0.5, -0.5
    answer = ActiveSet().solve(problems)
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
    added: Callable[[Problems, Tensor], tuple[Tensor, Tensor]],
) -> None:
    problems = synthetic(450, 6, seed=5)[torch.arange(150, 450)]
    expected = torch.from_numpy(projection(arrays(problems)).T)
    a, b = (torch.cat(pair) for pair in zip((problems.a, problems.b), added(problems, expected), strict=True))
    answer = ActiveSet().solve(Problems(problems.desired, a, b, b, 2 * list(problems.weight)))
    assert (answer.status == Status.HARD).all()
    torch.testing.assert_close(answer.control, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("copies", [2, 8])
def test_equal_rows_that_yield_weigh_as_much_together(copies: int) -> None:
    """As often as passes repeat them."""
    p = synthetic(300, 22, seed=3)[torch.arange(30)]
    parts = (part.repeat(copies, *(1,) * (part.dim() - 1)) for part in (p.a, p.b, p.b_no_margin))
    once = dataclasses.replace(p, weight=[copies * w for w in p.weight])
    found, expected = (
        ActiveSet().solve(Problems(p.desired, *parts, copies * list(p.weight))),
        ActiveSet().solve(once),
    )
    assert torch.equal(found.status, expected.status) and (found.status == Status.SLACK).sum() > 5
    torch.testing.assert_close(found.control, expected.control, rtol=0, atol=1e-9)


class Compiled:
    """The method in C, for programs of one kind."""

    def __init__(self, problems: Problems) -> None:
        def run(*parts: Tensor) -> list[Tensor]:
            return list(vars(ActiveSet().solve(Problems(*parts, problems.weight))).values())

        self.run = compiled.Compiled(run, *(getattr(problems, name)[..., :1] for name in FIELDS))

    def solve(self, problems: Problems, wanted: Tensor | None = None) -> Solutions:
        return Solutions(*self.run(*(getattr(problems, name).contiguous() for name in FIELDS)))


@pytest.mark.parametrize("rows", [6, 11, 22])
def test_the_method_in_c_gives_the_same_answers(rows: int) -> None:
    part = synthetic(1000, rows, seed=rows)
    in_c = Compiled(part)
    for count in (1, 2, 1000):
        sample = part[torch.arange(count)]
        expected, answer = ActiveSet().solve(sample), in_c.solve(sample)
        assert (answer.status == expected.status).all() and (answer.residual <= ACCURATE).all()
        torch.testing.assert_close(answer.control, expected.control, rtol=0, atol=1e-9)
    assert_faulty_program_leaves_its_neighbours_alone(in_c, part, "b", math.nan)


def test_what_is_not_wanted_costs_nothing() -> None:
    """Of programs that nobody wants nothing is said; the others are as if they were alone."""
    part = synthetic(300, 11, seed=4)
    wanted = torch.arange(300) % 3 == 0
    for solver in (ActiveSet(), PiqpSolver()):
        some, alone = solver.solve(part, wanted), solver.solve(part[torch.nonzero(wanted).flatten()])
        for name in ("control", "status"):
            assert torch.equal(getattr(some, name)[..., wanted], getattr(alone, name))

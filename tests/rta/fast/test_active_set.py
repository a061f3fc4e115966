"""The active-set method against enumeration, linear programs, least distances and optimality, in PyTorch and in C."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import nnls
from torch import Tensor

from kernels.compiled import Compiled
from rta.fast import active_set
from rta.fast.active_set import ACCURATE, kkt_residual, solve
from rta.result import Status
from tests.oracles import Programs, feasible, given_slack, lhs, projection, with_slack

FIELDS = ("desired", "a", "b", "weight")


def solved(programs: Programs, wanted: Tensor | None = None, **more: int) -> tuple[ndarray, ndarray]:
    """Returns controls (N, 3) and statuses (N,)."""
    parts = programs.tensors()
    every = torch.ones_like(parts[0][0], dtype=torch.bool) if wanted is None else wanted
    control, status = solve(*parts, every, **more)
    return control.T.numpy(), status.numpy()


def unit_rows(rng: np.random.Generator, *shape: int) -> ndarray:
    a = rng.standard_normal((*shape, 3))
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def program(desired: list[float], rows: list[list[float]], weight: list[float]) -> Programs:
    """Returns one program; rows are (a1, a2, a3, b)."""
    table = np.array(rows, dtype=float)[None]
    return Programs(
        np.array([desired], dtype=float), table[..., :3], table[..., 3], np.array([weight], dtype=float)
    )


def feasible_programs(count: int, rows: int, seed: int) -> Programs:
    """Returns programs with a point inside the box that satisfies every row, some rows with equality."""
    rng = np.random.default_rng(seed)
    a, point = unit_rows(rng, count, rows), rng.uniform(-1, 1, (count, 3))
    spare = rng.exponential(0.3, (count, rows)) * rng.integers(0, 4, (count, rows)).clip(max=1)
    b = spare - (a @ point[..., None])[..., 0]
    return Programs(rng.uniform(-1, 1, (count, 3)), a, b, np.full((count, rows), 1e5))


def infeasible_programs(count: int, rows: int, seed: int, weight: ndarray) -> Programs:
    """Returns programs with two rows that exclude each other by 0.1 to 1 actuator limits, and random others.

    What must hold is satisfied by u = 0.
    """
    rng = np.random.default_rng(seed)
    a, b = unit_rows(rng, count, rows), rng.uniform(-0.2, 1.0, (count, rows))
    a[:, -1] = -a[:, -2]
    b[:, -1] = -b[:, -2] - rng.uniform(0.1, 1.0, count)
    b[:, weight == 0.0] = np.abs(b[:, weight == 0.0])
    # each program's own, as in a filter, where a row's length is in its weight
    own = weight * rng.uniform(0.5, 2.0, (count, rows))
    return Programs(rng.uniform(-1, 1, (count, 3)), a, b, own)


def synthetic(count: int, rows: int, seed: int) -> Programs:
    """Returns random rows, the first of which must hold; in a third of them the last contradicts the one before."""
    rng = np.random.default_rng(seed)
    a, point = unit_rows(rng, count, rows), rng.uniform(-1, 1, (count, 3))
    spare = rng.exponential(0.3, (count, rows)) * rng.integers(0, 4, (count, rows)).clip(max=1)
    b = spare - lhs(point, a, np.zeros((count, rows)))
    third = count // 3
    a[:third, -1] = -a[:third, -2]
    b[:third, -1] = -b[:third, -2] - rng.uniform(0.2, 1.0, third)
    desired = np.where(rng.random((count, 3)) < 0.1, 1.0, rng.uniform(-1, 1, (count, 3)))
    weight = np.concatenate(([0.0], 10.0 ** (3 + np.arange(rows - 1) % 4)))
    return Programs(desired, a, b, weight * rng.uniform(0.5, 1.0, (count, rows)))


# Against enumeration and other solvers


@pytest.mark.parametrize(("rows", "attempted"), [(6, 3), (11, 0), (11, 1)])
def test_feasible_program_equals_enumeration(rows: int, attempted: int) -> None:
    programs = feasible_programs(400, rows, rows)
    expected = projection(programs)
    control, status = solved(programs, attempted=attempted)
    assert (status == Status.HARD).all()
    assert np.abs(expected - programs.desired).max(1).mean() > 0.1
    np.testing.assert_allclose(control, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gain", [3.0, 1e3])
def test_what_is_desired_beyond_the_bounds_is_what_is_near(gain: float) -> None:
    programs = feasible_programs(400, 6, 3)
    far = Programs(gain * programs.desired, programs.a, programs.b, programs.weight)
    control, status = solved(far)
    assert (status == Status.HARD).all()
    np.testing.assert_allclose(control, projection(far), rtol=0, atol=1e-8)


WEIGHT = np.array([1e5, 1e5, 1e4, 1e4, 1e3, 1e3, 1e3, 1e3])
SLACK_CASES = {
    "high_weights_agree": WEIGHT,
    "high_weights_conflict": WEIGHT[::-1].copy(),
    "one_must_hold": np.array([0.0, *WEIGHT[1:]]),
    "one_must_hold_and_high_weights_conflict": np.array([0.0, *WEIGHT[:0:-1]]),
    "all_weigh_the_most": np.array([0.0, *np.full(7, 5e5)]),
}


@pytest.mark.parametrize("weight", SLACK_CASES.values(), ids=SLACK_CASES)
def test_slack_program_equals_least_distance(weight: ndarray) -> None:
    programs = infeasible_programs(300, 8, 1, weight)
    control, status = solved(programs)
    assert (status == Status.SLACK).all()
    np.testing.assert_allclose(control, with_slack(programs), rtol=0, atol=1e-6)


def force_left(u: ndarray, desired: ndarray, a: ndarray, b: ndarray, weight: ndarray) -> float:
    """Returns what stationarity leaves of u - desired after slack forces and the best multipliers of active rows."""
    rest, soft = a @ u + b, np.isfinite(weight)
    force = weight[soft] * np.maximum(0.0, -rest[soft])
    normals = np.concatenate((a[~soft], np.eye(3), -np.eye(3)))
    active = np.concatenate((rest[~soft], 1 + u, 1 - u)) < 1e-8
    return nnls((normals * active[:, None]).T, u - desired - force @ a[soft])[1]


@pytest.mark.parametrize("rows", [6, 11])
def test_random_programs_satisfy_kkt(rows: int) -> None:
    programs = synthetic(1000, rows, seed=rows)
    control, status = solved(programs)
    assert (np.abs(control) <= 1.0).all()
    can = feasible(programs.a, programs.b)
    unsolved = status == Status.UNSOLVED
    # only the first row must hold, so a program is unsolved exactly if this row alone is infeasible
    assert (unsolved == ~feasible(programs.a[:, :1], programs.b[:, :1])).all() and unsolved.mean() < 0.01
    assert (status[~unsolved] == np.where(can, Status.HARD, Status.SLACK)[~unsolved]).all()
    assert (status == Status.SLACK).sum() >= 300
    given = given_slack(programs)
    for i in np.flatnonzero(~unsolved):
        u, a, b = control[i], programs.a[i], programs.b[i]
        held = np.isinf(given[i])
        assert (a @ u + b)[held].min(initial=0.0) >= -1e-9
        # a residual that is off by 1e-11 changes the force by that times the weight
        most = 1e-8 if held.all() else 1e-11 * 1e6
        assert force_left(u, programs.desired[i], a, b, given[i]) <= most


def test_unsolvable_programs_are_proved_to_be() -> None:
    programs = synthetic(200, 6, seed=1)
    programs = Programs(programs.desired, programs.a, programs.b, 0.0 * programs.weight)  # all must hold
    control, status = solved(programs)
    assert ((status == Status.HARD) == feasible(programs.a, programs.b)).all()
    unsolved = status == Status.UNSOLVED
    assert unsolved.sum() > 50 and (control[unsolved] == 0.0).all()


# Rows and weights, and what is left of the desired control (0.2, 0, 0), worked out by hand.
AT_LEAST_HALF, AT_MOST_MINUS_HALF = [1, 0, 0, -0.5], [-1, 0, 0, -0.5]
BY_HAND = {
    # the minimum of (u1 - 0.2)^2 + w (0.5 - u1)^2 + w (0.5 + u1)^2
    "equals_share": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [1e4, 1e4], [0.2 / (1 + 2e4), 0, 0]),
    "weights_decide": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [3e4, 1e4], [(0.2 + 1e4) / (1 + 4e4), 0, 0]),
    "what_must_hold_holds": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [0.0, 1e4], [0.5, 0, 0]),
    "in_either_order": ([AT_LEAST_HALF, AT_MOST_MINUS_HALF], [1e4, 0.0], [-0.5, 0, 0]),
    # no control in the box has u1 >= 1.5; u3 >= 0.3, given slack too, costs 1e3 delta^2
    "beyond_the_box": ([[1, 0, 0, -1.5], [0, 0, 1, -0.3]], [1e4, 1e3], [1, 0, 0.3e3 / (1 + 1e3)]),
}


@pytest.mark.parametrize(("rows", "weight", "expected"), BY_HAND.values(), ids=BY_HAND)
def test_slack_is_shared_as_by_hand(
    rows: list[list[float]], weight: list[float], expected: list[float]
) -> None:
    control, status = solved(program([0.2, 0, 0], rows, weight))
    assert status == [Status.SLACK]
    np.testing.assert_allclose(control, [expected], rtol=0, atol=1e-9)


UNSOLVABLE = {
    "must_hold_beyond_the_box": [[1, 0, 0, -1.5], [0, 1, 0, 0.5]],
    "nan_soft_row": [[1, 0, 0, 0.5], [0, np.nan, 0, 0.5]],
    "nan_b": [[1, 0, 0, np.nan], [0, 1, 0, np.nan]],
}


@pytest.mark.parametrize("attempted", [0, 3])
@pytest.mark.parametrize("rows", UNSOLVABLE.values(), ids=UNSOLVABLE)
def test_unsolvable_program_says_so_and_is_zero(rows: list[list[float]], attempted: int) -> None:
    control, status = solved(program([0.9, 0.1, 0.0], rows, [0.0, 1e3]), attempted=attempted)
    assert status == [Status.UNSOLVED] and (control == 0.0).all()


# Beyond several limits; the first row, which must hold, asks for a corner of the bounds, so that there is no interior.
WITHOUT_INTERIOR = (
    (0.9499074248880147, -0.0014983893184662977, 0.31252782111689015, -1.2639336353233712),
    (0.8047616097831535, -0.520899211146139, 0.28464497755371954, -1.0),
    (-0.08163156109736867, -0.9965989801763601, 0.011258816289717574, -0.40187052173747473),
    (0.5067756944388433, 0.8536244704562893, 0.12043113785166977, -0.5782960197340102),
    (-0.7611576974496058, 0.5843199393655661, -0.281441233782535, 1.1080745172013977),
)


def test_a_program_without_an_interior_is_solved() -> None:
    """Only a corner of the bounds satisfies what must hold."""
    desired = [-6.318003975758726, -4.388510483327086, -5.022443459685187]
    given = program(desired, [[*row] for row in WITHOUT_INTERIOR], [0.0, 1e3, 1e5, 1e5, 1e5])
    control, status = solved(given)
    assert status == [Status.SLACK]
    np.testing.assert_allclose(control, [[1.0, -1.0, 1.0]], rtol=0, atol=1e-6)


# Rows that leave the solution where it is, from programs without slack and their solutions.


def reversed_where_active(p: Programs, u: ndarray) -> tuple[ndarray, ndarray]:
    """Reverses rows where they are active, so that only a plane is left."""
    return -p.a, np.where(lhs(u, p.a, p.b) < 1e-9, -p.b, 2.0)


def tilted(tilt: float) -> Callable[[Programs, ndarray], tuple[ndarray, ndarray]]:
    """Returns a function that tilts rows and keeps their distance from the solution."""

    def rows(p: Programs, u: ndarray) -> tuple[ndarray, ndarray]:
        a = p.a + tilt * np.random.default_rng(0).standard_normal(p.a.shape)
        return a, lhs(u, p.a, p.b) - lhs(u, a, np.zeros_like(p.b))

    return rows


ADDED = {
    **{f"times_{factor:g}": lambda p, u, f=factor: (f * p.a, f * p.b) for factor in (0.0, 1e-9, 1.0)},
    "reversed_where_active": reversed_where_active,
    **{f"tilted_by_{tilt:g}": tilted(tilt) for tilt in (1e-3, 1e-7, 1e-9, 1e-12)},
}


@pytest.mark.parametrize("added", ADDED.values(), ids=ADDED)
def test_degenerate_rows_change_nothing(
    added: Callable[[Programs, ndarray], tuple[ndarray, ndarray]],
) -> None:
    programs = synthetic(450, 6, seed=5).of(np.arange(150, 450))
    expected = projection(programs)
    pairs = zip((programs.a, programs.b), added(programs, expected), strict=True)
    a, b = (np.concatenate(pair, 1) for pair in pairs)
    control, status = solved(Programs(programs.desired, a, b, np.concatenate(2 * [programs.weight], 1)))
    assert (status == Status.HARD).all()
    np.testing.assert_allclose(control, expected, rtol=0, atol=1e-6)


def test_zero_row_that_cannot_hold_leaves_the_others_alone() -> None:
    programs = synthetic(100, 6, seed=2)
    programs.a[:, 1], programs.b[:, 1] = 0.0, -0.5
    control, status = solved(programs)
    assert (status == Status.SLACK).all()
    np.testing.assert_allclose(control, with_slack(programs), rtol=0, atol=1e-6)


@pytest.mark.parametrize("copies", [2, 8])
def test_equal_rows_that_yield_weigh_as_much_together(copies: int) -> None:
    p = synthetic(300, 22, seed=3).of(np.arange(30))
    p = Programs(p.desired, p.a, p.b, np.minimum(p.weight, 1e4))
    p.weight[:, 0] = 1e3  # a row that must hold weighs nothing
    often = Programs(p.desired, *(np.concatenate(copies * [part], 1) for part in (p.a, p.b, p.weight)))
    once = Programs(p.desired, p.a, p.b, copies * p.weight)
    (found, of_often), (expected, of_once) = solved(often), solved(once)
    assert (of_often == of_once).all() and (of_once == Status.SLACK).sum() > 5
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


# In a batch, and in C


class InC:
    """Runs the method in C, for programs of a given number of rows."""

    def __init__(self, programs: Programs, attempted: int = active_set.ATTEMPTED) -> None:
        def run(*parts: Tensor) -> list[Tensor]:
            return list(solve(*parts, attempted=attempted))

        parts = [part[..., :1].contiguous() for part in programs.tensors()]
        self.run = Compiled(run, *parts, torch.ones(1, dtype=torch.bool))

    def __call__(self, programs: Programs) -> tuple[ndarray, ndarray]:
        control, status = self.run(*programs.tensors(), torch.ones(len(programs.desired), dtype=torch.bool))
        return control.T.numpy(), status.numpy()


def assert_faulty_program_leaves_its_neighbours_alone(
    solver: Callable[[Programs], tuple[ndarray, ndarray]], programs: Programs, field: str, value: float
) -> None:
    parts = {name: getattr(programs, name).copy() for name in FIELDS}
    parts[field][17, ..., -1] = value
    before, after = solver(programs), solver(Programs(**parts))
    others = np.arange(len(programs.desired)) != 17
    for one, other in zip(before, after, strict=True):
        assert (one[others] == other[others]).all()
    assert after[1][17] == Status.UNSOLVED and (after[0][17] == 0.0).all()


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize("field", ["desired", "a", "b"])
def test_faulty_program_leaves_its_neighbours_alone(field: str, value: float) -> None:
    assert_faulty_program_leaves_its_neighbours_alone(solved, synthetic(100, 11, seed=7), field, value)


@pytest.mark.parametrize(("rows", "attempted"), [(11, 0), (22, 3)])
def test_the_method_in_c_gives_the_same_answers(rows: int, attempted: int) -> None:
    part = synthetic(1000, rows, seed=rows)
    in_c = InC(part, attempted)
    for count in (1, 2, 1000):
        sample = part.of(np.arange(count))
        (expected, of_python), (control, of_c) = solved(sample, attempted=attempted), in_c(sample)
        assert (of_python == of_c).all()
        np.testing.assert_allclose(control, expected, rtol=0, atol=1e-9)
    assert_faulty_program_leaves_its_neighbours_alone(in_c, part, "b", np.nan)


def test_what_takes_too_many_steps_is_unsolved_and_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(active_set, "MOST_STEPS", 1)
    control, status = solved(synthetic(300, 11, seed=8), attempted=0)
    lost = status == Status.UNSOLVED
    assert lost.sum() > 200 and (control[lost] == 0.0).all()


def test_of_what_is_not_wanted_nothing_is_said() -> None:
    """The others are as if they were alone."""
    part, wanted = synthetic(300, 11, seed=4), np.arange(300) % 3 == 0
    some, alone = solved(part, torch.from_numpy(wanted)), solved(part.of(wanted))
    for one, other in zip(some, alone, strict=True):
        assert (one[wanted] == other).all()


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


@pytest.mark.parametrize(("u", "multiplier", "expected"), RESIDUALS.values(), ids=RESIDUALS)
def test_kkt_residual_measures_what_is_wrong(
    u: list[float], multiplier: list[float], expected: float
) -> None:
    given = [[*u], [*multiplier], [0, 0, 0], [[1, 1, 0], [0, 0, 0]], [-0.4, 0.5], [0.1, 0.0]]
    parts = [torch.tensor(part, dtype=torch.float64)[..., None] for part in given]
    assert kkt_residual(*parts).item() == pytest.approx(expected, abs=1e-15) and ACCURATE < 0.01

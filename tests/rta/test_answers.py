"""Every answer of the programs, by every solver and in C: what is called solved satisfies every row.

States are in flight and far beyond several limits at once; demands are up to three times the actuators' limits.
"""

import math
from functools import cache

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import unit
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from kernels.build import NoCompilerError, compiler
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.qp.active_set import ActiveSet
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import FEASIBLE, Problems, Status
from rta.qp.scaled import SHORTEST_ROW
from rta.result import FilterResult
from tests import golden
from tests.support.solvers import SOLVERS

C = InspectionParameters()
UNCHECKED = InspectionParameters(
    hill_rotation=True
)  # no backup trajectory is known: answers are the programs'
LIMIT = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
WAYS = (*SOLVERS, "C")

# Found by a search beyond several limits: the row of safe separation, the only one without slack, is relaxed to what
# one corner of the box gives, less the last digit.
AT_A_CORNER = (
    5.961792261560334, 2.420776071811913, 10.777491537179833, -0.04067360815199077, 0.9032787149492831,
    -2.1248603609408696, -0.2905903818264934, 0.9210267934877242, 0.22055702102567587, 0.13646052961912933,
    -0.03490658503988659, -0.03490658503988659, 0.03490658503988659, 4.991607961114055, 5.043783332255021,
    5.284155651694332,
)  # fmt: skip
DESIRED = (
    5.822986070904938, 5.826917697430897, -2.004925070609198,
    0.006180503459317654, 0.0014174160838219395, 0.005341735511732319,
)  # fmt: skip


@cache
def filter_of(way: str, c: InspectionParameters) -> SafetyFilter:
    """The filter with a solver, or all of it in C."""
    made = SafetyFilter(c, RtaParameters(qp_solver="batched" if way == "C" else way))
    assert bool(made.unchecked) == (c is UNCHECKED)
    if way == "C":
        try:
            compiler()
        except NoCompilerError:
            pytest.skip("no C compiler")
        made.compile("cpu", 256)
    return made


def near_and_beyond(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """States (16, count), half of them in flight, half beyond several limits, and desired controls (6, count)."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, count, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, count, generator=generator, dtype=torch.float64)

    beyond = torch.arange(count) % 2 == 0
    x = torch.empty(SIZE, count, dtype=torch.float64)
    x[P] = unit(normal(3)) * torch.where(beyond, 10.0 ** uniform(0.7, 3.0), uniform(16.0, 400.0))
    x[V] = unit(normal(3)) * torch.where(beyond, 10.0 ** uniform(-1.5, 1.0), uniform(0.05, 1.0))
    x[Q] = unit(normal(4))
    rates = torch.where(beyond, 0.03 * normal(3), uniform(-0.03, 0.03, 3))
    at_the_limit = beyond & (uniform(0.0, 1.0, 3) < 0.3)
    x[OMEGA] = torch.where(at_the_limit, C.max_rate * rates.sign(), rates)
    x[T] = torch.where(beyond, uniform(-5.0, 25.0), uniform(-20.0, 9.0))
    x[E] = torch.where(beyond, uniform(0.0, 8.0), uniform(4.0, 8.0))
    x[THETA_S] = uniform(0.0, 6.28)
    return x, 3.0 * LIMIT * normal(6) * torch.where(uniform(0.0, 1.0) < 0.5, 1.0, 0.2)


def left_over(safety: SafetyFilter, x: Tensor, control: Tensor) -> Tensor:
    """(2, B) of thrust and of torque: the least that controls (6, B) leave of a row that is not relaxed.

    In units of what the actuators can do to it.
    """
    parts = []
    for group, rows in zip(safety.groups, safety.rows(x), strict=True):
        own = LIMIT[group.controls]
        size = (rows.a * own).norm(dim=1).clamp(min=SHORTEST_ROW)
        held = (rows.a * control[group.controls]).sum(1) + rows.b_no_margin - rows.relaxation
        parts.append((held / size).amin(0))
    return torch.stack(parts)


def check(safety: SafetyFilter, x: Tensor, desired: Tensor, answer: FilterResult, proven: Tensor) -> None:
    """Asserts what statuses promise of every call that is not `proven` (2, B), group by group."""
    status = answer.program_status
    holds = left_over(safety, x, answer.control) >= -1.001 * FEASIBLE
    would_hold = left_over(safety, x, desired.clamp(-LIMIT, LIMIT)) >= -1.001 * FEASIBLE
    applied = torch.stack([(answer.control[own] == desired[own]).all(0) for own in (slice(3), slice(3, 6))])
    by_programs = ~proven & ~answer.backup
    solved = (status <= Status.HARD) & by_programs
    assert solved.sum() > len(x[0]) // 10
    assert holds[solved].all()
    assert applied[by_programs & (status == Status.UNTOUCHED)].all()
    breaks = ~would_hold & solved
    assert breaks.sum() > len(x[0]) // 50
    assert not applied[breaks].any()
    assert (answer.control.abs() <= LIMIT).all()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("count", [800, pytest.param(100_000, marks=pytest.mark.campaign)])
def test_what_programs_call_solved_satisfies_every_row(way: str, count: int) -> None:
    safety = filter_of(way, UNCHECKED)
    x, desired = near_and_beyond(count, 1)
    answer = safety.correct(x, desired)
    assert not answer.verified.any() and not answer.backup.any()
    check(safety, x, desired, answer, torch.zeros(2, count, dtype=torch.bool))


@pytest.mark.parametrize(
    ("way", "count"),
    [
        *((way, 800) for way in WAYS),
        *(pytest.param(way, 20_000, marks=pytest.mark.campaign) for way in SOLVERS),
        pytest.param("C", 100_000, marks=pytest.mark.campaign),
    ],
)
def test_what_the_filter_calls_solved_satisfies_every_row_or_the_check(way: str, count: int) -> None:
    safety = filter_of(way, C)
    x, desired = near_and_beyond(count, 2)
    answer = safety.correct(x, desired)
    # where the check finds a control safe, its group's status says so of limits, whatever rows had to yield
    check(safety, x, desired, answer, answer.verified.expand(2, -1) | had_slack(safety, x, desired, answer))


def had_slack(safety: SafetyFilter, x: Tensor, desired: Tensor, answer: FilterResult) -> Tensor:
    """(2, B) bool: the programs alone have slack, which the check has taken back."""
    _, found = safety.propose(x, desired, None)
    slack = torch.stack([each.status for each in found]) == Status.SLACK
    return slack & (answer.program_status < Status.SLACK)


@pytest.mark.parametrize("way", WAYS)
def test_every_way_gives_the_same_answer_beyond_several_limits(way: str) -> None:
    x = torch.cat((torch.tensor(AT_A_CORNER, dtype=torch.float64)[:, None], near_and_beyond(400, 3)[0]), 1)
    u = torch.cat((torch.tensor(DESIRED, dtype=torch.float64)[:, None], near_and_beyond(400, 3)[1]), 1)
    ours, theirs = (filter_of(each, C).correct(x, u) for each in (way, "batched"))
    assert torch.equal(ours.program_status, theirs.program_status)
    torch.testing.assert_close(ours.control / LIMIT, theirs.control / LIMIT, rtol=0.0, atol=2e-6)
    assert ours.status[0] == Status.SLACK
    corner = C.max_thrust * torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(ours.control[:3, 0], corner, rtol=0.0, atol=1e-6)


def test_no_state_that_is_finite_is_left_open() -> None:
    x, u = golden.states(3000, 0)
    finite = x.isfinite().all(0)
    assert (filter_of("C", C).correct(x, u).status == Status.UNSOLVED).sum() == (~finite).sum() > 100
    _, found = filter_of("batched", C).propose(x[:, finite], u[:, finite], None)
    assert all((each.status < Status.UNSOLVED).all() for each in found)


# Beyond several limits; the first row, which must hold, asks for a corner of the bounds, so that there is no interior.
# Rows of a and weight, and what each asks for, with its margin and without.
WITHOUT_INTERIOR = (
    (0.9499074248880147, -0.0014983893184662977, 0.31252782111689015, math.inf, *2 * (-1.2639336353233712,)),
    (0.8047616097831535, -0.520899211146139, 0.28464497755371954, 1e3, -1.0, -1.0),
    (-0.08163156109736867, -0.9965989801763601, 0.011258816289717574, 1e5, -0.40361125228311107, -0.40187052173747473),
    (0.5067756944388433, 0.8536244704562893, 0.12043113785166977, 1e5, -0.635168435177102, -0.5782960197340102),
    (-0.7611576974496058, 0.5843199393655661, -0.281441233782535, 1e5, 1.0885197827840936, 1.1080745172013977),
    (-0.795016926040678, 0.5356048255307431, -0.28473770065977166, 1e5, 2.0, 2.0),
    (-0.8156003190858001, 0.5115725647041756, -0.27035093961207746, 1e5, 2.0, 2.0),
    (-0.8339420949714172, 0.49484510065711373, -0.24427220183707946, 1e5, 2.0, 2.0),
    (0.9671025055536298, -0.19831311671230714, 0.15932561467555195, 1e3, 2.0, 2.0),
    (-0.07744620081424915, 0.36705412672846904, 0.9269699855071037, 1e3, 2.0, 2.0),
    (-0.2423114312848872, -0.9088141591059482, 0.33962036817190094, 1e3, 2.0, 2.0),
)  # fmt: skip


def test_a_program_without_an_interior_is_solved() -> None:
    """Only a corner of the bounds satisfies it: the active-set method solves it, PIQP says that it does not."""
    table = torch.tensor(WITHOUT_INTERIOR, dtype=torch.float64)
    desired = torch.tensor(
        [[-6.318003975758726], [-4.388510483327086], [-5.022443459685187]], dtype=torch.float64
    )
    a, weight, b, b_no_margin = table[:, :3, None], table[:, 3].tolist(), table[:, 4:5], table[:, 5:]
    problems = Problems(desired, a, b, b_no_margin, weight)
    answer = ActiveSet().solve(problems)
    assert answer.status == Status.SLACK
    corner = torch.tensor([[1.0], [-1.0], [1.0]], dtype=torch.float64)
    torch.testing.assert_close(answer.control, corner, rtol=0.0, atol=1e-6)
    assert PiqpSolver().solve(problems).status == Status.UNSOLVED

"""The paper's filter: its rows against differences of the paper's functions, its program against another solver."""

import math

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter
from rta.limits import PAPER, WEIGHT
from rta.names import PAPERS
from rta.paper import PaperFilter, asif, barrier_conditions
from rta.parameters import PERIODS, RtaParameters
from rta.result import Status
from study.machine import finds_compiler
from study.verification.starts import safe_set
from tests.oracles import (
    IN_FLIGHT,
    PAPERS_WEIGHTS,
    C,
    by_nnls,
    drift,
    last_psi,
    near,
    push,
    slope,
    tensor,
    turn,
)

LIMIT = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
WEIGHTS = [limit.weight for limit in PAPER.values()]


def flown_every(period: float) -> SafetyFilter:
    """Returns the paper's filter as it is flown, without check and without capped gains."""
    return SafetyFilter(C, RtaParameters(filter="paper", period=period))


@pytest.fixture(scope="module")
def within() -> Tensor:
    """Returns 2,000 states (16, 2000) all over the set within all limits."""
    return safe_set(2000, 5, flown_every(1.0))[0]


def drawn(count: int, seed: int = 0, largest: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return LIMIT * largest * (2 * torch.rand(6, count, generator=generator, dtype=torch.float64) - 1)


# The rows


@pytest.fixture(scope="module")
def differences() -> tuple[ndarray, ndarray]:
    """Returns a (13, 6, B) and b (13, B) in flight, by central differences."""
    x = IN_FLIGHT
    gain = np.array([[limit.gains[-1]] for limit in PAPER.values()])
    b = slope(last_psi, x, drift(x, C), 1e-5) + gain * last_psi(x)
    along = [*(push(x, i) for i in range(3)), *(turn(x, i, C) for i in range(3))]
    return np.stack([slope(last_psi, x, g, 1e-5) for g in along], 1), b


@pytest.mark.parametrize("name", PAPERS)
def test_a_row_is_the_papers_barrier_condition(name: str, differences: tuple[ndarray, ndarray]) -> None:
    a, b, psi = barrier_conditions(tensor(IN_FLIGHT), C)
    i = PAPERS.index(name)
    coarse = name == "passive_safety"  # whose time of the closest pass is refined to some ms
    near(psi[i], last_psi(IN_FLIGHT)[i], 1e-4 if coarse else 1e-9)
    near(a[i], differences[0][i], 1e-2 if coarse else 1e-6)
    near(b[i], differences[1][i], 1e-2 if coarse else 1e-6)


def test_rows_of_all_periods_are_the_same_bits(within: Tensor) -> None:
    """The period is the only thing that a filter called every 1, 5 or 10 s differs in; in C rows are equal, too."""
    first, *others = [flown_every(period).program.evaluated(within) for period in PERIODS]
    for other in others:
        assert all(torch.equal(one, same) for one, same in zip(first, other, strict=True))
    if finds_compiler():
        fast = pytest.importorskip("rta.fast.filter").fast
        compiled = fast(flown_every(1.0), "cpu", 2000).program.evaluated(within)
        for one, other in zip(first, compiled, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


# The program


def test_controls_equal_those_of_another_solver(within: Tensor) -> None:
    """To 1e-6 of a limit, at 2,000 states within all limits."""
    desired = drawn(2000, largest=2.0)
    found = PaperFilter(C).correct(within, desired)
    a, b, _ = barrier_conditions(within, C)
    a, wanted = (a * LIMIT).numpy(), (desired / LIMIT).numpy()
    asked = torch.nonzero((found.status == Status.HARD) | (found.status == Status.SLACK)).flatten().tolist()
    expected = np.stack([by_nnls(a[..., i], b[:, i].numpy(), wanted[:, i], PAPERS_WEIGHTS) for i in asked], 1)
    off = np.abs((found.control / LIMIT).numpy()[:, asked] - expected).max(0)
    assert len(asked) > 1000 and off.max() < 1e-6
    assert (found.status < Status.SLACK).all()


def test_where_slack_is_given_its_cost_is_that_of_another_solver() -> None:
    """States with some Psi_1 < 0. A weight of 1e12 leaves few digits: half agree to 1e-6 of a limit, all to 1e-2."""
    x, desired = safe_set(400, 5, SafetyFilter(C))[0], drawn(400)
    found = PaperFilter(C).correct(x, desired)
    a, b, _ = barrier_conditions(x, C)
    a, wanted = (a * LIMIT).numpy(), (desired / LIMIT).numpy()
    slack = torch.nonzero(found.status == Status.SLACK).flatten().tolist()
    expected = np.stack([by_nnls(a[..., i], b[:, i].numpy(), wanted[:, i], PAPERS_WEIGHTS) for i in slack], 1)

    def cost(u: ndarray) -> ndarray:
        short = np.minimum((a[..., slack] * u).sum(1) + b.numpy()[:, slack], 0.0)[1:]
        return ((u - wanted[:, slack]) ** 2).sum(0) + WEIGHT * (short**2).sum(0)

    u = (found.control / LIMIT).numpy()[:, slack]
    off = np.abs(u - expected).max(0)
    assert len(slack) > 30 and np.median(off) < 1e-6 and off.max() < 1e-2
    assert (cost(u) <= cost(expected) * (1 + 1e-4)).all()


def test_a_row_that_no_control_changes_holds_or_asks_in_vain() -> None:
    """Without slack, as the paper's weight of zero has it: the first may be anything, the second has no solution."""
    a, b = np.zeros((2, 2, 6)), np.array([[1.0, 1.0], [1.0, -1.0]])
    a[:, 0, 0] = 1.0
    control, _, status = asif(a, b, np.full((2, 6), 0.5), [1e12, 0.0])
    np.testing.assert_allclose(control[0], 0.5, rtol=0, atol=1e-9)
    assert status.tolist() == [Status.HARD, Status.UNSOLVED]


def test_slack_is_given_where_rows_conflict_and_by_the_inverse_of_its_weight() -> None:
    """Rows u_1 >= 0.5 and u_1 <= 0.2 of weights w and 4 w: the second gives a quarter of what the first does."""
    a = np.zeros((1, 3, 6))
    a[0, 0, 1], a[0, 1, 0], a[0, 2, 0] = 1.0, 1.0, -1.0
    control, slack, status = asif(a, np.array([[1.0, -0.5, 0.2]]), np.zeros((1, 6)), [None, 1e6, 4e6])
    assert status == Status.SLACK
    np.testing.assert_allclose(slack, [[0.0, 0.24, 0.06]], rtol=0, atol=1e-6)
    assert control[0, 0] == pytest.approx(0.26, abs=1e-6)


def test_a_program_without_a_solution_is_unsolved_and_said() -> None:
    """Safe separation asks for more than there is, and has no slack."""
    a, b = np.zeros((1, 13, 6)), np.ones((1, 13))
    a[..., 0], b[0, 0] = 1.0, -1.5
    control, slack, status = asif(a, b, np.ones((1, 6)), WEIGHTS)
    assert status == Status.UNSOLVED and not control.any() and not slack.any()
    b[0, :2] = 1.0, -1.5  # one that has slack gives it
    control, slack, status = asif(a, b, np.ones((1, 6)), WEIGHTS)
    assert status == Status.SLACK
    assert slack[0, 1] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_number_that_is_not_finite_spoils_its_own_program_alone(within: Tensor, number: float) -> None:
    desired = drawn(40)
    alone = PaperFilter(C).correct(within[:, :40], desired)
    spoilt = within[:, :40].clone()
    spoilt[0, ::2] = number
    found = PaperFilter(C).correct(spoilt, desired)
    assert (found.status[::2] == Status.UNSOLVED).all() and not found.control[:, ::2].any()
    torch.testing.assert_close(
        found.control[:, 1::2] / LIMIT, alone.control[:, 1::2] / LIMIT, rtol=0, atol=1e-7
    )
    assert torch.equal(found.status[1::2], alone.status[1::2])


# In the loop


def test_it_is_the_paper_alone_without_caps_or_a_check(within: Tensor) -> None:
    for period in PERIODS:
        filter_ = flown_every(period)
        assert filter_.limits == PAPER and filter_.check is None and filter_.checked == (False, False)
        assert filter_.parameters.solver == "piqp" and type(filter_.program) is PaperFilter
        found = filter_.correct(within[:, :100], drawn(100))
        assert not found.verified.any() and not found.backup.any()


def test_a_demand_is_answered_as_the_program_answers_it(within: Tensor) -> None:
    """The mean rates of a hold and the limit of its torque belong to the check."""
    desired = drawn(100, seed=5)
    found, expected = (f.correct(within[:, :100], desired) for f in (flown_every(10.0), PaperFilter(C)))
    for name, value in vars(expected).items():
        assert torch.equal(getattr(found, name), value)


def test_it_fails_where_the_checked_filter_does_not() -> None:
    """Called every 10 s under controls that are held throughout, it lets limits break."""
    x = safe_set(64, 0, SafetyFilter(C))[0]
    paper_, checked = flown_every(10.0), SafetyFilter(InspectionParameters())
    y, desired = x.clone(), drawn(64, seed=9)
    lowest = paper_.values(y)
    for _ in range(12):
        u = paper_.correct(y, desired).control
        for _ in range(10):
            y = step(y, u, 1.0, C)
        lowest = torch.minimum(lowest, paper_.values(y))
    assert (checked.values(x) >= 0).all()
    assert (lowest < -1e-3).any(0).float().mean() > 0.2

"""Limits of your own: rows against differences, what is enforced of them beside the paper's, and what is refused."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.attitude import body_axis, dot, norm, unit
from inspection.model.parameters import InspectionParameters, Limits
from inspection.model.state import P, Q
from rta.fast.filter import batched
from rta.fast.program import FastProgram
from rta.filter import SafetyFilter
from rta.limits import Limit
from rta.names import CONSTRAINTS, PAPERS
from rta.paper import PaperFilter, barrier_conditions
from rta.parameters import RtaParameters
from rta.result import FilterResult, Status
from tests.oracles import IN_FLIGHT, drift, length, near, push, slope, tensor, turn
from tests.oracles import body_axis as hill_axis
from tests.rta.test_filter import LIMIT, THRUST, TORQUE, U, X, near_the_limits, quick

C = InspectionParameters()
UNEQUAL = InspectionParameters(inertia=(0.04, 0.06, 0.09))
STATES = tensor(IN_FLIGHT)
SECOND = np.array([[0.0], [2000.0], [0.0]])  # m, where a second spacecraft is


def to_second(x: Tensor) -> Tensor:
    return torch.stack((-x[0], 2000.0 - x[1], -x[2]))


def cone(x: Tensor, c: Limits) -> Tensor:
    """cos 25 deg less the cosine between camera and second spacecraft."""
    return math.cos(math.radians(25)) - dot(torch.stack(body_axis(x[Q], 0)), unit(to_second(x)))


def sphere(x: Tensor, c: Limits) -> Tensor:
    """Returns m outside 50 m around the second spacecraft."""
    return norm(to_second(x)) - 50.0


def over_one_axis(x: Tensor, c: Limits) -> Tensor:
    """Returns `sphere` with a constant that fits states (16, B) only."""
    return (x[P] - tensor(SECOND)).square().sum(0) - 50.0**2


def slow_turn(x: Tensor, c: Limits) -> Tensor:
    """Returns 1e-3 rad^2/s^2 less the squared rate."""
    return 1e-3 - dot(x[10:13], x[10:13])


def numpy_cone(x: ndarray) -> ndarray:
    line = SECOND - x[:3]
    return math.cos(math.radians(25)) - (hill_axis(x[6:10], 0) * line).sum(0) / length(line)


OWN: dict[str, tuple[Limit, Callable[[ndarray], ndarray]]] = {
    "cone": (Limit(cone, (0.05, 0.2), 1e12), numpy_cone),
    "sphere": (Limit(sphere, (0.01, 0.1), None), lambda x: length(SECOND - x[:3]) - 50),
    "slow_turn": (Limit(slow_turn, (0.3,), 1e12), lambda x: 1e-3 - (x[10:13] ** 2).sum(0)),
}
EXTRA = {name: OWN[name][0] for name in ("cone", "sphere")}


def numpy_psi(x: ndarray, name: str, c: InspectionParameters = UNEQUAL) -> ndarray:
    """Returns h or Psi_1, with an exact complex-step derivative of h along f."""
    limit, h = OWN[name]
    *first, _ = limit.gains
    if not first:
        return h(x)
    along = h(x + 1e-30j * drift(x, c)).imag / 1e-30
    return along + first[0] * h(x)


@pytest.mark.parametrize("name", OWN)
def test_rows_equal_finite_differences(name: str) -> None:
    """Also where both groups change a condition, as the cone's."""
    limit, h = OWN[name]
    a, b, psi = barrier_conditions(STATES, UNEQUAL, {name: limit})
    columns = [push(IN_FLIGHT, i) for i in range(3)] + [turn(IN_FLIGHT, i, UNEQUAL) for i in range(3)]
    pushed = np.stack([slope(lambda x: numpy_psi(x, name), IN_FLIGHT, column, 1e-3) for column in columns])
    last = slope(lambda x: numpy_psi(x, name), IN_FLIGHT, drift(IN_FLIGHT, UNEQUAL), 1e-3)
    near(limit.h(STATES, UNEQUAL), h(IN_FLIGHT))
    near(psi[0], numpy_psi(IN_FLIGHT, name))
    near(a[0], pushed)
    near(b[0], last + limit.gains[-1] * numpy_psi(IN_FLIGHT, name))
    both = (np.abs(pushed[THRUST]) > 1e-6).any() and (np.abs(pushed[TORQUE]) > 1e-6).any()
    assert both == (name == "cone")


@cache
def solved(name: str) -> FilterResult:
    """Returns the programs' answers without your own limits ("paper") and with them."""
    limits = SafetyFilter(C, extra={} if name == "paper" else EXTRA).limits
    return FastProgram(C, limits).correct(X, U)


def test_own_limits_come_after_the_papers_and_are_enforced() -> None:
    safety = batched(SafetyFilter(C, extra=EXTRA))
    assert safety.names == safety.safety().names == (*CONSTRAINTS, *EXTRA)
    result, answer = solved("paper"), solved("own")
    h = torch.stack((tensor(numpy_cone(X.numpy())), sphere(X, C)))
    torch.testing.assert_close(answer.h, torch.cat((result.h, h)))
    assert torch.equal(safety.values(X), answer.h) and torch.equal(
        safety.correct(X[:, :20], U[:, :20]).h, answer.h[:, :20]
    )
    a, b, *_ = safety.program.evaluated(X)
    reached, hard = (a[13] * answer.control).sum(0) + b[13], answer.status <= Status.HARD
    assert (reached[hard] >= -1e-6).all()
    binds = hard & answer.active[13]
    assert binds.sum() > 20 and (reached[binds].abs() < 1e-9).all()
    free = hard & ((a[13] * result.control).sum(0) + b[13] > 1e-6)  # the cone would not have mattered
    assert free.sum() > 100
    torch.testing.assert_close(answer.control[:, free], result.control[:, free], rtol=0, atol=1e-6)


def test_a_limit_that_both_groups_change_is_kept_by_the_one_that_changes_it_more() -> None:
    """PIQP's program of both groups is as near to what is desired, or nearer."""
    fast, piqp = FastProgram(C, EXTRA), PaperFilter(C, EXTRA)
    assert fast.coupled and fast.rows == ([1], [0])  # the cone by torque, the sphere by thrust
    one, other = fast.correct(X[:, :200], U[:, :200]), piqp.correct(X[:, :200], U[:, :200])
    solved_by_both = (one.status <= Status.HARD) & (other.status <= Status.HARD)
    assert solved_by_both.sum() > 50

    def off(result: FilterResult) -> Tensor:
        return ((result.control - U[:, :200]) / LIMIT).norm(dim=0)[solved_by_both]

    assert (off(other) <= off(one) + 1e-6).all()


def test_starts_keep_psi_1_of_own_limits_though_the_check_does_not_know_them() -> None:
    own = {"cone": OWN["cone"][0]}
    without, safety = quick(SafetyFilter(C)), quick(SafetyFilter(C, extra=own))
    x = tensor(near_the_limits(3000))
    h, psi_1 = numpy_cone(x.numpy()), numpy_psi(x.numpy(), "cone", C)
    assert without.check and all(safety.checked)
    certain = tensor(np.abs(psi_1) > 1e-6)
    accepted = without.is_safe(x)
    expected = accepted & tensor((h >= 0.0) & (psi_1 >= 0.0))
    assert torch.equal(safety.is_safe(x)[certain], expected[certain])
    assert (accepted & tensor((h >= 0.0) & (psi_1 < 0.0)))[certain].sum() > 3


def test_what_must_hold_is_kept_where_what_has_slack_conflicts() -> None:
    """A speed limit along x that must hold, against another that asks for the opposite by a weight."""
    away = {
        "must": Limit(lambda x, c: x[3] - 1.0, (0.5,), None),
        "slack": Limit(lambda x, c: -1.0 - x[3], (0.5,), 1e6),
        "turn": OWN["slow_turn"][0],
    }
    x = STATES[:, :50].clone()
    x[3:6] = x[10:13] = 0.0
    for program in (FastProgram(C, away), PaperFilter(C, away)):
        a, b, *_ = program.evaluated(x)
        b[0] = b[0].maximum(-0.9 * (a[0].abs() * LIMIT).sum(0))  # needs at most 90 % of the control
        rows = a, b, b, program.values(x)
        program.evaluated = lambda x, rows=rows: rows  # type: ignore[method-assign,misc]
        found = program.correct(x, torch.zeros(6, 50, dtype=torch.float64))
        reached = (a * found.control).sum(1) + b
        assert (found.status == Status.SLACK).all()
        assert (reached[0] >= -1e-7).all() and (found.slack[0] == 0.0).all()
        torch.testing.assert_close(found.slack[1], -reached[1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"gains": (0.1,)}, "no control first enters derivative 1"),
        ({"h": slow_turn}, "no control first enters derivative 2"),
        ({"h": lambda x, c: 1.0 + 0.0 * x[0]}, "no control first enters derivative 2"),
        ({"h": lambda x, c: cone(x, c) - x[0].clamp(min=0.0).sqrt()}, "a derivative of h is not finite"),
        ({"h": lambda x, c: x[0] / (x[0] - x[0])}, "h is not finite: must be at every state, beyond"),
        ({"h": over_one_axis}, "must broadcast over all trailing axes"),
        ({"h": lambda x, c: x[:3]}, r"has shape \(3, 64\): must be \(B,\)"),
        ({"h": lambda x, c: 1.0}, "h is of type float: must be a tensor"),
        ({"h": lambda x, c: x[17]}, "cannot be computed: "),
        ({"h": 3.0}, "must be a function of states"),
        ({"gains": 0.1}, "must be a tuple of one or two positive numbers"),
        ({"gains": (0.1, math.inf)}, "must be a tuple of one or two positive numbers"),
        ({"weight": 0.0}, "weight = 0.0: must be a positive number or None"),
    ],
)
def test_what_does_not_fit_is_refused(given: dict[str, Any], words: str) -> None:
    limit = Limit(**{"h": cone, "gains": (0.05, 0.2), "weight": None} | given)
    with pytest.raises(ValueError, match=f"^mine: .*{words}") as refusal:
        SafetyFilter(UNEQUAL, extra={"mine": limit})
    assert "\n" not in str(refusal.value)


def test_what_is_no_limit_and_a_name_of_the_papers_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^mine: must be a Limit\(h, gains, weight\), not function"):
        SafetyFilter(C, extra={"mine": sphere})  # type: ignore[dict-item]
    for name in PAPERS:
        with pytest.raises(ValueError, match=f"^{name}: is a limit of the paper"):
            SafetyFilter(C, extra={name: OWN["sphere"][0]})


def test_gains_of_own_limits_are_capped_as_the_papers_are() -> None:
    quick = {"quick": OWN["slow_turn"][0]._replace(gains=(3.0,))}
    for period, most in ((1.0, 0.5), (10.0, 0.05)):
        assert SafetyFilter(C, RtaParameters(period=period), quick).limits["quick"].gains == (most,)
    assert SafetyFilter(C, RtaParameters(filter="paper"), quick).limits["quick"].gains == (3.0,)

"""What a call proposes beside its programs: kinds of rows, old states, thrusters that give some values only."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THRUST, P, Q, V
from rta.bounds.uncertainty import Uncertainty
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.qp.programs import Status
from tests.oracles import tensor
from tests.rta.test_filter import LIMIT, commands, near_the_limits
from tests.support.filters import without_check

C = InspectionParameters()


def across(count: int, share: float, distance: float = 60.0) -> Tensor:
    """Spacecraft at rest in attitude that fly across their position at a share of the speed limit."""
    x = torch.zeros(SIZE, count, dtype=torch.float64)
    x[P.start], x[Q.stop - 1], x[13], x[14], x[15] = distance, 1.0, 0.0, 6.0, 3.0
    angle = torch.linspace(0.1, 6.0, count, dtype=torch.float64)
    x[V] = share * limit(x) * torch.stack((0.3 * angle.cos(), angle.cos(), angle.sin()))
    x[V] *= share * limit(x) / x[V].norm(dim=0)
    return x


def limit(x: Tensor) -> Tensor:
    return 0.2 + 7.5 * 0.001027 * x[P].norm(dim=0)


def desired(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    u = torch.zeros(6, count, dtype=torch.float64)
    u[THRUST] = 2 * torch.rand(3, count, generator=generator, dtype=torch.float64) - 1
    return u


@pytest.mark.parametrize(
    ("period", "uncertainty", "rows", "kind"),
    [
        (1.0, Uncertainty(), "auto", "paper"),
        (1.0, Uncertainty(mass=0.1), "auto", "sampled"),
        (5.0, Uncertainty(), "auto", "sampled"),
        (5.0, Uncertainty(), "paper", "paper"),
        (1.0, Uncertainty(), "sampled", "sampled"),
        (1.0, Uncertainty(), "none", "none"),
    ],
)
def test_rows_are_the_papers_at_1_s_without_bounds_unless_others_are_asked_for(
    period: float, uncertainty: Uncertainty, rows: str, kind: str
) -> None:
    assert uncertainty.rows(RtaParameters(period=period, rows=rows)) == kind


def test_without_rows_the_check_alone_changes_what_is_within_the_limits() -> None:
    f = SafetyFilter(C, RtaParameters(rows="none"))
    x, u = tensor(near_the_limits(400, seed=5)), 1.2 * commands(400, seed=5)
    control, found = f.propose(x, u, None)
    assert torch.equal(control, u.clamp(-LIMIT, LIMIT))
    clipped = torch.stack([(u.abs() > LIMIT)[part].any(0) for part in (THRUST, slice(3, 6))])
    assert torch.equal(
        torch.stack([each.status for each in found]), torch.where(clipped, Status.HARD, Status.UNTOUCHED)
    )
    assert not any(each.active.any() or each.slack.any() for each in found)
    answer = f.correct(x, u)
    changed = (answer.control != control).any(0)
    assert torch.equal(changed | answer.backup, answer.backup) and 30 < changed.sum() < 400
    assert (answer.status[answer.backup] == Status.HARD).all() and answer.verified.sum() > 100


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_without_rows_nothing_is_done_in_a_state_that_is_none(number: float) -> None:
    f = SafetyFilter(C, RtaParameters(rows="none"))
    x, u = across(16, 0.5), commands(16)
    x.diagonal().fill_(number)
    answer = f.correct(x, u)
    assert (answer.control == 0.0).all() and (answer.status == Status.UNSOLVED).all()
    assert not answer.verified.any()


@pytest.mark.parametrize(
    ("c", "uncertainty", "unchecked"),
    [
        (C, Uncertainty(health=True), "motion and attitude"),
        (C, Uncertainty(minimum_thrust=0.6), "motion"),
        (dataclasses.replace(C, orbit="two-body", eccentricity=0.1), Uncertainty(), "motion and attitude"),
    ],
)
def test_a_filter_without_a_check_needs_rows(
    c: InspectionParameters, uncertainty: Uncertainty, unchecked: str
) -> None:
    with pytest.raises(ValueError, match=f"would keep the limits of {unchecked}, of which no backup"):
        SafetyFilter(c, RtaParameters(rows="none"), uncertainty=uncertainty)
    assert SafetyFilter(c, uncertainty=uncertainty).unchecked == unchecked.split(" and ")


QUANTISED = [
    {"thrust_quantum": 0.25},
    {"thrust_quantum": 1.0},
    {"minimum_thrust": 0.02},
    {"minimum_thrust": 0.6},
]


@pytest.mark.parametrize("bounds", QUANTISED, ids=str)
def test_quantised_thrusters_are_asked_for_what_they_give(bounds: dict[str, float]) -> None:
    f, fine = (
        SafetyFilter(C, uncertainty=Uncertainty(**bounds)),
        SafetyFilter(C, uncertainty=Uncertainty(mass=1e-9)),
    )
    for each in (f, fine):  # the programs alone
        without_check(each)
    x, u = across(400, 0.9999, distance=20.0), desired(400, seed=3)
    given = f.correct(x, u).control[THRUST]
    torch.testing.assert_close(f.uncertainty.quantised(given, C.max_thrust), given, rtol=0, atol=1e-9)
    rounded = torch.cat((f.uncertainty.quantised(u[THRUST], C.max_thrust), u[3:]))
    answered = fine.correct(x, rounded).control[THRUST]
    near = (f.uncertainty.quantised(answered, C.max_thrust) - given).abs().amax(0) < 1e-6
    assert near.double().mean() > 0.98 and ((given - answered).abs() > 1e-3).any()


def test_a_filter_without_error_bounds_is_the_papers_at_1_s() -> None:
    x, u = across(8, 0.97), desired(8)
    one, other = SafetyFilter(C), SafetyFilter(C, uncertainty=Uncertainty())
    assert not one.is_sampled and not other.is_sampled
    young = torch.full((1, 6, 8), math.nan, dtype=torch.float64)  # no control was sent since
    a, b = one.correct(x, u), other.correct(x, u, sent=young, left=0.5 * u.abs())
    for field in dataclasses.fields(a):
        assert torch.equal(getattr(a, field.name), getattr(b, field.name))
    old = other.correct(x, u, sent=torch.zeros_like(young))  # one was: older than its latency
    assert torch.equal(a.control, old.control) and a.verified.all() and not old.verified.any()
    robust = SafetyFilter(C, uncertainty=Uncertainty(mass=0.1))
    assert robust.is_sampled and not torch.equal(robust.correct(x, u).control, a.control)

"""What a call proposes beside its programs: kinds of rows, old states, thrusters that give some values only."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THRUST, P, Q, V
from kernels.compiled import Compiled
from rta.bounds.uncertainty import Uncertainty
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import Status
from tests.rta.constraints.test_constraints import tensor
from tests.rta.test_filter import LIMIT, commands, near_the_limits

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
    ("period", "known", "rows", "kind"),
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
    period: float, known: Uncertainty, rows: str, kind: str
) -> None:
    assert known.rows(RtaParameters(period=period, rows=rows)) == kind


def test_kinds_of_rows_differ_and_report_the_same_h() -> None:
    x, u = tensor(near_the_limits(200, seed=4)), commands(200, seed=4)
    answers = [
        SafetyFilter(C, RtaParameters(rows=rows)).correct(x, u) for rows in ("paper", "sampled", "none")
    ]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (answers[one].control != answers[other].control).any(0).sum() > 20
    for other in answers[1:]:
        torch.testing.assert_close(answers[0].h, other.h, rtol=1e-6, atol=1e-6)


def test_without_rows_the_check_alone_changes_what_is_within_the_limits() -> None:
    f = SafetyFilter(C, RtaParameters(rows="none"))
    x, u = tensor(near_the_limits(400, seed=5)), 1.2 * commands(400, seed=5)
    _, _, proposed = f.propose(x, u, f.solver, None, None)
    assert torch.equal(proposed.control, u.clamp(-LIMIT, LIMIT))
    clipped = torch.stack([(u.abs() > LIMIT)[part].any(0) for part in (THRUST, slice(3, 6))])
    assert torch.equal(proposed.program_status, torch.where(clipped, Status.HARD, Status.UNTOUCHED))
    assert not proposed.active.any() and not proposed.slack.any()
    answer = f.correct(x, u)
    changed = (answer.control != proposed.control).any(0)
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
    ("c", "known", "unchecked"),
    [
        (C, Uncertainty(health=True), "motion and attitude"),
        (C, Uncertainty(minimum_thrust=0.6), "motion"),
        (dataclasses.replace(C, orbit="two-body", eccentricity=0.1), Uncertainty(), "motion and attitude"),
    ],
)
def test_a_filter_without_a_check_needs_rows(
    c: InspectionParameters, known: Uncertainty, unchecked: str
) -> None:
    with pytest.raises(ValueError, match=f"would keep the limits of {unchecked}, of which no way"):
        SafetyFilter(c, RtaParameters(rows="none"), known=known)
    assert SafetyFilter(c, known=known).unchecked == unchecked.split(" and ")


COARSE = [
    {"thrust_quantum": 0.25},
    {"thrust_quantum": 1.0},
    {"minimum_thrust": 0.02},
    {"minimum_thrust": 0.6},
]


@pytest.mark.parametrize("told", COARSE, ids=str)
def test_coarse_thrusters_are_asked_for_what_they_give(told: dict[str, float]) -> None:
    f, fine = SafetyFilter(C, known=Uncertainty(**told)), SafetyFilter(C, known=Uncertainty(mass=1e-9))
    for each in (f, fine):  # the programs alone
        each.backup = None
    x, u = across(400, 0.9999, distance=20.0), desired(400, seed=3)
    given = f.correct(x, u).control[THRUST]
    torch.testing.assert_close(f.known.given(given, C.max_thrust), given, rtol=0, atol=1e-9)
    rounded = torch.cat((f.known.given(u[THRUST], C.max_thrust), u[3:]))
    answered = fine.correct(x, rounded).control[THRUST]
    near = (f.known.given(answered, C.max_thrust) - given).abs().amax(0) < 1e-6
    assert near.double().mean() > 0.98 and ((given - answered).abs() > 1e-3).any()


def test_coarse_thrusters_give_nothing_where_the_state_is_not_finite() -> None:
    f = SafetyFilter(C, known=Uncertainty(thrust_quantum=0.25))
    x, u = across(3, 0.5), desired(3)
    x[P.start, 1] = math.nan
    result = f.correct(x, u)
    assert (result.status == Status.UNSOLVED).tolist() == [False, True, False]
    assert (result.control[THRUST, 1] == 0.0).all()


def test_a_filter_that_is_told_of_nothing_is_the_papers_at_1_s() -> None:
    x, u = across(8, 0.97), desired(8)
    one, other = SafetyFilter(C), SafetyFilter(C, known=Uncertainty())
    assert not one.holds and not other.holds
    young = torch.full((1, 6, 8), math.nan, dtype=torch.float64)  # no control was sent since
    a, b = one.correct(x, u), other.correct(x, u, sent=young, left=0.5 * u.abs())
    for field in dataclasses.fields(a):
        assert torch.equal(getattr(a, field.name), getattr(b, field.name))
    old = other.correct(x, u, sent=torch.zeros_like(young))  # one was: older than it is told
    assert torch.equal(a.control, old.control) and a.verified.all() and not old.verified.any()
    told = SafetyFilter(C, known=Uncertainty(mass=0.1))
    assert told.holds and not torch.equal(told.correct(x, u).control, a.control)


def test_a_state_older_than_told_is_counted_unsolved() -> None:
    f = SafetyFilter(C, known=Uncertainty(latency=1))
    x, u = across(3, 0.5), desired(3)
    sent = torch.zeros(2, 6, 3, dtype=torch.float64)
    sent[0, :, 1:] = math.nan
    sent[1, :, 2] = math.nan  # two calls old, one, and of now
    result = f.correct(x, u, sent=sent)
    assert (result.status == Status.UNSOLVED).tolist() == [True, False, False]
    assert result.control.isfinite().all()


def test_a_late_state_is_predicted_by_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[int] = []

    def compiled(
        run: Callable[..., list[Tensor]], *examples: Tensor, **_: object
    ) -> Callable[..., list[Tensor]]:
        if len(examples) < 3:  # rows
            return run
        made = Compiled(run, *examples, batch=4)
        return lambda *given: called.append(len(given)) or made(*given)

    known = Uncertainty(latency=2, mass=0.1, velocity=0.002)
    f, other = (SafetyFilter(C, known=known, solver=PiqpSolver()) for _ in range(2))
    monkeypatch.setattr("rta.filter.Compiled", compiled)
    other.compile("cpu", 4)
    x, u = across(4, 0.9), desired(4)
    sent = desired(8).reshape(6, 2, 4).transpose(0, 1).contiguous()
    sent[0, :, 2:] = math.nan
    for given, calls in ((sent, 2), (sent[1:], 1), (None, 0)):  # two calls old or one, one, of now
        called.clear()
        one, again = (each.correct(x, u, sent=given) for each in (f, other))
        for field in dataclasses.fields(one):
            assert torch.equal(getattr(one, field.name), getattr(again, field.name)), field.name
        assert len(called) == calls
    assert not torch.equal(f.correct(x, u, sent=sent).h, f.correct(x, u).h)


# 97 m from the chief at 0.93 m/s, 0.02 m/s below the limit, towards it and turning: 0.05 N brake enough. Found by
# `verify` with nine calls missed in a row.
TURNING = torch.tensor(
    [
        *(-65.5195201, -39.3610741, -59.3528800, 0.378531991, 0.840424413, 0.0966872104),
        *(0.7786201411199444, 0.5837226656883223, 0.22654490810875963, 0.04118167085088406),
        *(0.0290029333, 0.0313726085, 0.0302276959, 6.28434896, 4.47284321, 4.44547437),
    ],
    dtype=torch.float64,
)


# 40 m from the chief at 0.5 m/s, 0.012 m/s below the limit, under full thrust that would be held for 10 s. Found by the
# adversary in `verify`.
NEAR_THE_CHIEF = torch.tensor(
    [
        *(30.8977993, -17.3466949, -18.7340552, -0.463251466, -0.158662667, -0.083345558),
        *(0.122128606, -0.536937505, 0.828067118, -0.105297521),
        *(0.00139988585, -0.0062494905, -0.0337690613, 6.73731716, 3.72051394, 0.180183711),
    ],
    dtype=torch.float64,
)


@pytest.mark.parametrize(
    ("x", "desired", "period", "known"),
    [
        (NEAR_THE_CHIEF, (1.0, 0.322367, -0.118815, 0.0, 0.0, -0.001), 10.0, Uncertainty()),
        (
            TURNING,
            (0.6919, -0.19017, 0.65326, 0.000145, 0.000986, 0.000931),
            1.0,
            Uncertainty(longest_hold=10.0),
        ),
    ],
)
def test_near_a_limit_a_hold_of_10_s_keeps_all_of_them(
    x: Tensor, desired: tuple[float, ...], period: float, known: Uncertainty
) -> None:
    safety = SafetyFilter(C, RtaParameters(period=period), known=known)
    x, u = x[:, None], torch.tensor(desired, dtype=torch.float64)[:, None]
    answer = safety.correct(x, u)
    assert answer.status == Status.HARD
    for _ in range(10):
        x = step(x, answer.control, 1.0, C)
        assert (safety.values(x) >= 0.0).all()

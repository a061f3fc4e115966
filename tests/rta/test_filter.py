"""The filter: untouched and corrected controls, conflicts, reports, faulty states and the closed loop."""

import dataclasses
import json
import math
import pickle
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy, deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.optimize import linprog
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import InspectionParameters
from rta.barrier import Rows
from rta.constraints.constraint import Constraint
from rta.constraints.names import CONSTRAINTS
from rta.constraints.thrust import sqrt_floor
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, RtaParameters
from rta.qp.programs import FEASIBLE, Status
from rta.result import FilterResult
from tests.oracles import (
    K1,
    PSM_TOLERANCE,
    at_the_edge,
    cosines,
    drift,
    enforced,
    entries,
    first_psi,
    keep_in_curve,
    length,
    paper,
    states,
    tensor,
    thrust_fall,
)
from tests.rta import test_actuator_groups as own
from tests.support.filters import without_check
from tests.support.solvers import SOLVERS, make_solver

C = InspectionParameters()
R = RtaParameters()
MAX_TORQUE = 0.0573 * 0.017453  # N m, below D times the wheels' 181.3 rad/s^2
LIMIT = torch.tensor([[1.0]] * 3 + [[MAX_TORQUE]] * 3, dtype=torch.float64)
THRUST, TORQUE = slice(0, 3), slice(3, 6)
# Slack weights, safe separation has none; 1e3 for velocity and rate limits and dynamic speed, which yield first.
PRIORITY = {
    "collision": math.inf,
    **dict.fromkeys(("keep_in_zone", "passive_safety", "attitude_exclusion"), 1e5),
    **dict.fromkeys(("temperature", "battery"), 1e4),
}
# Calls out of verification campaigns: random controls 0, 2, 50, 58 and 71, adversarial ones 0, 42, 49, 55 and 58.
CONFLICTS = json.loads(Path(__file__).with_name("conflicts.json").read_text())


def near_the_limits(count: int, seed: int = 0) -> ndarray:
    """(16, count) states within some limits and beyond others, at up to 1.1 times the dynamic speed limit."""
    rng = np.random.default_rng(seed)
    p, v, q = rng.standard_normal((3, 4, count))
    p = p[:3] / length(p[:3]) * rng.choice((18.0, 50.0, 200.0, 790.0), count) * rng.uniform(1, 1.01, count)
    v = v[:3] / length(v[:3]) * rng.uniform(0, 1.1, count) * (0.2 + 7.5 * 0.001027 * length(p))
    omega = rng.uniform(-1, 1, (3, count)) * math.radians(2)
    rest = rng.uniform(3, 10, count), rng.uniform(1, 5, count), rng.uniform(0, 2 * np.pi, count)
    return np.vstack((p, v, q / length(q), omega, *rest))


def commands(count: int, seed: int = 0) -> Tensor:
    """(6, count) uniform within the actuators' limits."""
    return tensor(np.random.default_rng(seed).uniform(-1, 1, (6, count))) * LIMIT


X = tensor(near_the_limits(1000))
U = commands(1000)


@pytest.fixture(scope="module")
def safety() -> SafetyFilter:
    return SafetyFilter(C, R)


@pytest.fixture(scope="module")
def result(safety: SafetyFilter) -> FilterResult:
    return safety.correct(X, U)


@pytest.fixture(scope="module")
def programs() -> SafetyFilter:
    """The filter without the check of its controls, `rta.backup`: what its programs answer."""
    alone = SafetyFilter(C, R)
    without_check(alone)
    return alone


@pytest.fixture(scope="module")
def solution(programs: SafetyFilter) -> FilterResult:
    return programs.correct(X, U)


@pytest.fixture(scope="module")
def conditions(safety: SafetyFilter) -> tuple[Rows, Rows]:
    """The rows that tests/rta/test_lie_derivatives.py checks against finite differences."""
    return safety.rows(X)


def left_hand_sides(conditions: tuple[Rows, Rows], u: Tensor) -> Tensor:
    """a u + b of all rows with margins, over the length of the row per actuator limit, (17, B)."""
    parts = []
    for rows, group in zip(conditions, (THRUST, TORQUE), strict=True):
        length_of_row = (rows.a * LIMIT[group]).norm(dim=1)
        parts.append(((rows.a * u[group]).sum(1) + rows.b) / length_of_row)
    return torch.cat(parts)


def test_safe_control_is_returned_untouched(conditions: tuple[Rows, Rows], solution: FilterResult) -> None:
    weakened = torch.cat([rows.relaxation > 0.0 for rows in conditions]).any(
        0
    )  # which is slack, however little is asked
    safe = (left_hand_sides(conditions, U) > 1e-9).all(0) & ~weakened
    assert safe.sum() > 20
    assert (solution.control[:, safe] == U[:, safe]).all()
    assert (solution.status[safe] == Status.UNTOUCHED).all()
    assert not solution.intervened[safe].any()


def test_corrected_control_satisfies_every_row(conditions: tuple[Rows, Rows], solution: FilterResult) -> None:
    for rows, group in zip(conditions, (THRUST, TORQUE), strict=True):
        bare = (rows.a * solution.control[group]).sum(1) + rows.b_no_margin
        assert (bare >= -FEASIBLE * (rows.a * LIMIT[group]).norm(dim=1))[
            :, solution.status <= Status.HARD
        ].all()


GAINS = (1.0, 5.0, 50.0, 1e300, math.inf)


def best(weights: ndarray, a: ndarray, b: ndarray) -> float:
    """The most that weights (3,) times a control gives within the limits and rows (R, 3), (R,): a linear program."""
    answer = linprog(-weights, -a, b, bounds=[(-1, 1)] * 3, options={"primal_feasibility_tolerance": 1e-10})
    assert answer.success
    return float(-answer.fun)


@pytest.mark.parametrize("solver", [*SOLVERS, "C"])
@pytest.mark.parametrize("gain", [1.5, 20.0, 900.0])
def test_the_nearest_control_is_nearest_to_what_is_desired_itself(
    conditions: tuple[Rows, Rows], solver: str, gain: float
) -> None:
    """u is the projection of d exactly where no control v that is permitted has (d - u) . (v - u) > 0."""
    safety = SafetyFilter(C, R, None if solver == "C" else make_solver(solver))
    without_check(safety)
    if solver == "C":
        safety.compile("cpu", len(X[0]))
    answer, clipped = safety.correct(X, gain * U), safety.correct(X, (gain * U).clamp(-LIMIT, LIMIT))
    nearer = 0
    for i, (rows, group) in enumerate(zip(conditions, (THRUST, TORQUE), strict=True)):
        a = rows.a * LIMIT[group]
        u, d = (part[group] / LIMIT[group] for part in (answer.control, gain * U))
        at_all = ((a * u).sum(1) + rows.b >= -1e-7 * a.norm(dim=1)).all(0)
        corrected = (answer.program_status[i] == Status.HARD) & at_all
        for n in torch.nonzero(corrected).flatten()[:60].tolist():
            away = (d - u)[:, n].numpy()
            length = float(np.linalg.norm(away))
            more = best(away, a[..., n].numpy(), rows.b[:, n].numpy()) - float(away @ u[:, n].numpy())
            assert more <= 1e-5 * length
        was = clipped.control[group] / LIMIT[group]
        nearer += int(((was - d).norm(dim=0) - (u - d).norm(dim=0) > 1e-3)[corrected].sum())
    assert nearer > 20  # than the projection of what is left within the limits


@pytest.mark.parametrize("solver", [*SOLVERS, "C"])
def test_a_demand_that_is_no_number_is_no_wish_and_filtered(solver: str) -> None:
    """The programs read demands, so that the check has no part in this."""
    safety = SafetyFilter(C, R, None if solver == "C" else make_solver(solver))
    without_check(safety)
    if solver == "C":
        safety.compile("cpu", len(X[0]))
    for group in (THRUST, TORQUE):
        nothing = U.clone()
        nothing[group] = 0.0
        expected = safety.correct(X, nothing)
        for component in range(6)[group]:
            for others in (nothing, U):  # what the group's other numbers are does not matter
                wish = others.index_put((torch.tensor([component]),), nothing.new_tensor(math.nan))
                answer = safety.correct(X, wish)
                assert (answer.control == expected.control).all() and answer.intervened.all()
                assert (answer.status == expected.status.clamp(min=Status.HARD)).all()


@pytest.mark.parametrize("compiled", [False, True])
def test_a_limit_that_is_broken_is_said_whatever_the_programs_answered(compiled: bool) -> None:
    safety = SafetyFilter(C, R)
    if compiled:
        safety.compile("cpu", len(X[0]))
    answer = safety.correct(X, U)
    assert (answer.violated.numpy() == (paper(X.numpy()) < -PSM_TOLERANCE).any(0)).all()
    assert {*answer.status[answer.violated].tolist()} >= {Status.HARD, Status.SLACK}
    assert not answer.violated.all()
    one = safety(X[:, 3].tolist(), U[:, 3].tolist())
    assert one.violated == answer.violated[3].item()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_never_leaves_the_filter(solver: str, value: float) -> None:
    """Each component of state and desired control in turn."""
    x, u = X[:, :22].clone(), U[:, :22].clone()
    for i in range(22):
        (x if i < 16 else u)[i % 16, i] = value
    answer = SafetyFilter(C, R, make_solver(solver)).correct(x, u)
    assert (answer.control.abs() <= LIMIT).all()
    assert answer.intervened.all()
    assert (answer.status[:16] == Status.UNSOLVED).all()
    assert (answer.status[16:] < Status.UNSOLVED).all()


def turned_about_z(sun: ndarray) -> ndarray:
    """(16, B) states whose camera is so many rad off the Sun, whose panels and -n_y side are pi and pi / 2 further."""
    x = states(len(sun), seed=6)
    x[:3] *= 100 / length(x[:3])
    half = np.linspace(-1.5, 1.5, len(sun))
    x[6:10], x[15] = np.stack((0 * half, 0 * half, np.sin(half), np.cos(half))), 2 * half + sun
    x[13], x[14] = 5.0, 6.0  # a broken limit is not smoothed where it is worst
    return x


SMOOTHED = {  # where the filter's derivatives stray from the paper's constraints, and the first that they miss
    "panels_near_the_sun": (turned_about_z(np.pi + np.linspace(-0.19, 0.19, 100)), "battery"),
    "surface_near_the_sun": (turned_about_z(-np.pi / 2 + np.linspace(-0.19, 0.19, 100)), "temperature"),
    "terminator": (turned_about_z(np.linspace(-0.29, 0.29, 100)), "temperature"),
    "edge_of_the_zone": (at_the_edge(100, 800.0, R.distance_floor), "keep_in_zone"),
    "edge_of_the_chief": (at_the_edge(100, 15.0, R.distance_floor), "collision"),
}


@pytest.mark.parametrize(("x", "missed"), SMOOTHED.values(), ids=SMOOTHED)
def test_reported_values_are_exact_where_slopes_are_bounded(
    safety: SafetyFilter, x: ndarray, missed: str
) -> None:
    """Bit for bit, that of passive safety but for the times of its rows."""
    h, exact = safety.correct(tensor(x), commands(x.shape[1])).h, safety.values(tensor(x))
    others = [i for i, name in enumerate(safety.names) if name != "passive_safety"]
    assert (h[others] == exact[others]).all()
    np.testing.assert_allclose(h, exact, rtol=0, atol=PSM_TOLERANCE)
    np.testing.assert_allclose(h, paper(x), rtol=0, atol=PSM_TOLERANCE)
    gap = np.abs(enforced(entries()[missed], x)[0] - exact[CONSTRAINTS.index(missed)].numpy())
    assert (gap > 1e-5).mean() > 0.8  # what is enforced there would not have done


def test_slack_is_the_shortfall_of_the_bare_condition(programs: SafetyFilter, solution: FilterResult) -> None:
    """Of the condition itself, whatever a row beyond its limit asks for."""
    expected = torch.zeros(13, X.shape[1], dtype=torch.float64)
    for group in programs.groups:
        rows = group.continuous_rows(X, group.constraints, coupled=False)
        short = -((rows.a * solution.control[group.controls]).sum(1) + rows.b_no_margin)
        for k, each in enumerate(group.of_row):
            i = CONSTRAINTS.index(each.name)
            expected[i] = torch.maximum(expected[i], short[k])
    slack = solution.status == Status.SLACK
    torch.testing.assert_close(solution.slack[:, slack], expected[:, slack], rtol=1e-6, atol=1e-6)
    assert (solution.slack[:, ~slack] == 0).all()


def test_what_a_row_waives_beyond_its_limit_is_said(
    safety: SafetyFilter, conditions: tuple[Rows, Rows], result: FilterResult
) -> None:
    """Where every row is satisfied, but not the condition, the status is not HARD."""
    said = 0
    for rows, group, status in zip(conditions, safety.groups, result.program_status, strict=True):
        a, u = rows.a * group.limit, result.control[group.controls] / group.limit
        length, reached = a.norm(dim=1), (a * u).sum(1) + rows.b_no_margin
        satisfied = (reached >= -FEASIBLE * length).all(0)
        relaxation = ((rows.relaxation > 0.0) & (reached - rows.relaxation < -2 * FEASIBLE * length)).any(0)
        assert (status[relaxation] >= Status.SLACK).all()
        said += int((satisfied & relaxation).sum())
    assert said > 50


def least_shortfall(a: ndarray, b: ndarray, must: ndarray) -> float:
    """The smallest t with a u + b >= -t, where it must hold >= 0, for some u in the box, by linear programming."""
    rows = np.column_stack((-a, must - 1.0))
    return linprog([0, 0, 0, 1], rows, b, bounds=[(-1, 1)] * 3 + [(0, None)]).fun


@pytest.mark.parametrize("solver", SOLVERS)
def test_rows_yield_only_where_no_control_holds_their_class(solver: str) -> None:
    """In recorded conflicts; shortfalls are in units of what full control moves a row by."""
    x, u = (tensor(np.array([call[key] for call in CONFLICTS]).T) for key in ("state", "control_desired"))
    safety = SafetyFilter(C, R, solver=make_solver(solver))
    control = safety.correct(x, u).control
    held, yielded = set(), set()
    for rows, entry, group in zip(safety.rows(x), safety.groups, (THRUST, TORQUE), strict=True):
        weight = np.array([PRIORITY.get(each.name, 1e3) for each in entry.of_row])
        authority = (rows.a * LIMIT[group]).abs().sum(1)
        authority[authority == 0.0] = 1.0
        a = (rows.a * LIMIT[group] / authority[:, None]).numpy()
        b = (rows.b_no_margin / authority).numpy()
        for k in range(x.shape[1]):
            reached = a[..., k] @ (control[group] / LIMIT[group])[:, k].numpy() + b[:, k]
            for lowest in (1e3, 1e4, 1e5):
                above = weight >= lowest
                least = least_shortfall(a[above, :, k], b[above, k], np.isinf(weight[above]))
                if least <= 1e-9:
                    assert reached[above].min() >= -1e-6
                elif lowest == 1e5:
                    assert -reached[above].min() <= least + 1e-3
                (held if least <= 1e-9 else yielded).add(lowest)
    assert held == yielded == {1e3, 1e4, 1e5}


def hovering_outward() -> Tensor:
    """One state 100 m out that flies away at 0.95 m/s, spins about n_x and has the Sun behind it."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[0], x[3], x[9], x[10], x[13], x[14], x[15] = 100.0, 0.95, 1.0, 0.99 * math.radians(2), 5.0, 6.0, math.pi
    return x


def test_corrections_equal_the_closed_form(safety: SafetyFilter) -> None:
    # -(3 n^2 x + F / m) + 7.5 n v + k h - fall = 0 and -2 w tau / J + k (w_max^2 - w^2) = 0
    n, w_max = 0.001027, math.radians(2)
    h = 0.2 + 7.5 * n * 100 - 0.95
    fall = thrust_fall(hovering_outward().numpy())[1, 0]
    thrust = 12 * (7.5 * n * 0.95 + R.speed_gain * h - fall - 3 * n**2 * 100)
    torque = 0.0573 * R.rate_gain * w_max**2 * (1 - 0.99**2) / (2 * 0.99 * w_max)
    control = safety.correct(hovering_outward(), LIMIT * tensor(np.array([[1, 0, 0, 1, 0, 0.0]]).T)).control
    np.testing.assert_allclose(control.T, [[thrust, 0, 0, torque, 0, 0]], atol=1e-6 * MAX_TORQUE)


@pytest.mark.parametrize("component", [0, 6, 13])
def test_nan_state_is_unsolved_and_leaves_its_neighbours_alone(
    safety: SafetyFilter, result: FilterResult, component: int
) -> None:
    x = X.clone()
    x[component, 500] = math.nan
    faulty = safety.correct(x, U)
    others = torch.arange(X.shape[1]) != 500
    assert faulty.status[500] == Status.UNSOLVED
    assert (faulty.control[:3, 500] == 0.0).all() or (faulty.control[3:, 500] == 0.0).all()
    assert (faulty.control[:, 500].abs() <= LIMIT[:, 0]).all()
    for field in dataclasses.fields(FilterResult):
        assert (getattr(faulty, field.name)[..., others] == getattr(result, field.name)[..., others]).all()


def test_a_state_is_in_the_safe_set_exactly_where_every_h_and_psi_is() -> None:
    x = near_the_limits(5000, seed=1)
    spent = [[R.exclusion_margin], [R.temperature_margin], [R.battery_margin]]
    lowest = np.concatenate((paper(x), first_psi(x, C) - K1[:, None] * np.array(spent))).min(0)
    clear = (np.abs(cosines(x)) < math.cos(R.pole_angle)).all(0) & (np.abs(lowest) > 1e-4)
    inside = SafetyFilter(C, RtaParameters(incidence_rounding=0.0)).is_in_safe_set(tensor(x)).numpy()
    assert 0.1 < inside.mean() < 0.9
    assert (inside[clear] == (lowest[clear] >= 0)).all()


@pytest.mark.parametrize(
    "period", [1.0, *(pytest.param(period, marks=pytest.mark.campaign) for period in PERIODS[1:])]
)
def test_start_can_brake_where_thrust_can_keep_the_zone(period: float) -> None:
    count = 5000 if period == 1.0 else 250  # a held control is searched for at each
    x, safety = near_the_limits(count, seed=3), SafetyFilter(C, RtaParameters(period=period))
    curve = keep_in_curve(x, sqrt_floor(C, safety.parameters))
    can_brake = safety.can_brake(tensor(x))
    assert 0.5 < can_brake.double().mean() < 1.0
    assert (can_brake.numpy() == (curve >= 0)).all()
    without_check(safety)
    inside = safety.is_in_safe_set(tensor(x))
    assert (safety.is_safe(tensor(x)) == (inside & can_brake)).all()
    # where rows are of a held control, no barrier of the safe set is negative, the zone's neither
    assert (inside & ~can_brake).any() == (period == 1.0)


def test_own_constraints_come_after_the_papers(programs: SafetyFilter, solution: FilterResult) -> None:
    papers, result, (cone, _), (ball, _) = programs, solution, own.OWN["cone"], own.OWN["sphere"]
    safety = SafetyFilter(C, R, extra=(cone, ball))
    without_check(safety)
    assert safety.safety().names == (*CONSTRAINTS, "sphere", "cone")
    answer = safety.correct(X, U)
    h = torch.stack((own.sphere(X), tensor(own.numpy_cone(X.numpy()))))
    torch.testing.assert_close(answer.h, torch.cat((result.h, h)))
    torch.testing.assert_close(safety.values(X), torch.cat((papers.values(X), h)))
    assert (safety.is_in_safe_set(X) <= (papers.is_in_safe_set(X) & (h >= 0).all(0))).all()
    torque, hard = safety.rows(X)[1], answer.status <= Status.HARD
    reached = (torque.a[-1] * answer.control[TORQUE]).sum(0)
    sides = torch.stack((reached + torque.b[-1], reached + torque.b_no_margin[-1]))
    assert (sides[1, hard] >= -1e-9).all()
    binds = hard & answer.active[-1]
    assert binds.sum() > 20
    assert (sides[:, binds].abs().amin(0) < 1e-9).all()
    alone = sides[0] > 1e-6  # the cone would not have mattered
    assert alone.sum() > 200
    torch.testing.assert_close(answer.control[:, alone], result.control[:, alone], rtol=0, atol=1e-6)


def test_starts_keep_psi_1_of_own_limits_though_the_check_does_not_know_them() -> None:
    cone, _ = own.OWN["cone"]
    without, safety = SafetyFilter(C, R), SafetyFilter(C, R, extra=(cone,))
    x, step = tensor(near_the_limits(3000)), 1e-4
    f = drift(x.numpy(), C)
    h, before, after = (own.numpy_cone(x.numpy() + shift * f) for shift in (0.0, -step, step))
    psi_1 = (after - before) / (2 * step) + R.gain(cone.gains[0]) * (h - cone.margin)
    assert without.backup and all(safety.checked)
    certain = tensor(np.abs(psi_1) > 1e-6)
    expected = without.is_safe(x) & tensor((h >= 0.0) & (psi_1 >= 0.0))
    assert torch.equal(safety.is_safe(x)[certain], expected[certain])
    assert (without.is_safe(x) & tensor((h >= 0.0) & (psi_1 < 0.0)))[certain].sum() > 3


def with_a_ball(solver: str | None = None) -> SafetyFilter:
    """A filter of another mass with a constraint of its own."""
    ball = Constraint("ball", clear_of_a_ball, "thrust", (0.05, 0.2), 1.0)
    own = make_solver(solver) if solver else None
    return SafetyFilter(dataclasses.replace(C, mass=14.0), solver=own, extra=[ball])


@pytest.fixture
def restless() -> Iterator[None]:
    """Threads take turns in the middle of everything."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures("restless")
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    ("is_compiled", "calls"), [pytest.param(False, 2, marks=pytest.mark.campaign), (True, 20)]
)
def test_threads_may_share_a_filter(solver: str, is_compiled: bool, calls: int) -> None:
    shared, other = (with_a_ball(solver) for _ in range(2))
    if is_compiled:  # many calls of what keeps tensors between them; the check keeps none
        without_check(shared)
        without_check(other)
        shared.compile("cpu", 16)
    blocks = [slice(start, start + 16) for start in range(0, 64, 16)]
    expected = shared.correct(X[:, :64], U[:, :64]).control
    alone = other.correct(X[:, :64], U[:, :64]).control
    torch.testing.assert_close(expected, alone, rtol=0, atol=1e-6)

    def answers(block: slice) -> list[Tensor]:
        return [shared.correct(X[:, block], U[:, block]).control for _ in range(calls)]

    with ThreadPoolExecutor(len(blocks)) as threads:
        for block, controls in zip(blocks, threads.map(answers, blocks), strict=True):
            for control in controls:
                torch.testing.assert_close(control, expected[:, block], rtol=0, atol=1e-9)


@pytest.mark.parametrize("solver", ["piqp", pytest.param("batched", marks=pytest.mark.campaign)])
def test_a_copy_is_the_same_filter(solver: str) -> None:
    safety = with_a_ball(solver)
    x, u = X[:, :100], U[:, :100]
    expected = safety.correct(x, u)
    for other in (copy(safety), deepcopy(safety), pickle.loads(pickle.dumps(safety))):
        assert other.names == safety.names and type(other.solver) is type(safety.solver)
        assert torch.equal(other.correct(x, u).control, expected.control)


@pytest.mark.parametrize("name", SafetyFilter.FIXED)
def test_what_a_filter_is_made_of_is_fixed(safety: SafetyFilter, name: str) -> None:
    """Its compiled copy for one spacecraft would go on with the former value."""
    before = getattr(safety, name)
    for change in (lambda: setattr(safety, name, None), lambda: delattr(safety, name)):
        with pytest.raises(
            AttributeError, match=f"SafetyFilter.{name} cannot be changed: .* make a new SafetyFilter"
        ):
            change()
    assert getattr(safety, name) is before


def clear_of_a_ball(x: Tensor) -> Tensor:
    """m outside 70 m around a place where episodes start."""
    return norm(torch.stack((x[0], x[1] - 80.0, x[2]))) - 70.0


def test_the_same_name_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="battery: each name must be there once"):
        SafetyFilter(C, R, extra=[Constraint("battery", own.sphere, "thrust", (0.1, 0.1))])

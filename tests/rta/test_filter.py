"""The filter: untouched and corrected controls, conflicts, reports, faulty states, and what a hold may do to the rates.

A filter is called in three ways: as it is written, its programs solved by PIQP; with programs of a whole batch; in C.
"""

import dataclasses
import json
import math
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import copy, deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters, Limits
from inspection.model.state import OMEGA, E, T
from inspection.world.uncertainty import Uncertainty
from kernels.compiled import Compiled
from rta.check.nominal import NominalCheck
from rta.demand import ENDLESS, LARGEST_DEMAND, demanded, in_mid_hold, within_rates
from rta.fast.filter import batched, fast
from rta.fast.program import FEASIBLE, FastProgram
from rta.filter import SafetyFilter
from rta.limits import Limit
from rta.names import CONSTRAINTS
from rta.parameters import PERIODS, RtaParameters
from rta.result import Status
from rta.robust.filter import RobustFilter
from study.machine import finds_compiler
from study.verification.starts import safe_set
from tests.oracles import PSM_TOLERANCE, at_the_edge, by_nnls, last_psi, moved, paper, tensor
from tests.support.filters import Unproposed, without_check
from tests.support.flights import commands, near_the_limits, way
from tests.support.states import at_rest, impossible

C = InspectionParameters()
R = RtaParameters()
MAX_TORQUE = 0.0573 * 0.017453  # N m, below D times the wheels' 181.3 rad/s^2
LIMIT = torch.tensor([[1.0]] * 3 + [[MAX_TORQUE]] * 3, dtype=torch.float64)
THRUST, TORQUE = slice(0, 3), slice(3, 6)
WAYS = ("piqp", "batched", "C")
# Calls out of verification campaigns: random controls 0, 2, 50, 58 and 71, adversarial ones 0, 42, 49, 55 and 58.
CONFLICTS = json.loads(Path(__file__).with_name("conflicts.json").read_text())


X = tensor(near_the_limits(1000))
U = commands(1000)


def quick(safety_filter: SafetyFilter) -> SafetyFilter:
    """Returns the filter in C if there is a compiler, because PyTorch takes a minute to check a thousand states."""
    return fast(safety_filter, "cpu", 64) if finds_compiler() else batched(safety_filter)


@pytest.fixture(scope="module")
def safety() -> SafetyFilter:
    return way("C" if finds_compiler() else "batched")


# The program


def test_slack_is_the_shortfall_of_the_condition() -> None:
    program = way("batched", checked=False)
    solution, (a, b, *_) = program.correct(X, U), program.program.evaluated(X)
    a = a * LIMIT
    short = -((a * (solution.control / LIMIT)).sum(1) + b)
    slack = solution.status == Status.SLACK
    rounding = FEASIBLE * a.norm(dim=1)
    expected = torch.where(short > rounding, short, 0.0)
    torch.testing.assert_close(solution.slack[:, slack], expected[:, slack], rtol=1e-6, atol=1e-6)
    assert (solution.slack[:, slack] > 0.0).any(0).all() and (solution.slack[:, ~slack] == 0).all()


def test_a_condition_that_no_control_changes_is_said_to_be_broken_by_every_way() -> None:
    """Inside the chief's sphere and leaving it slowly: passive safety is broken, and no control changes that now."""
    x = at_rest()
    x[0], x[3] = C.collision_radius - 1.0, 0.001
    for name in WAYS:
        found = way(name, checked=False).correct(x, torch.zeros(6, 1, dtype=torch.float64))
        assert found.status == Status.SLACK and found.slack[3] == pytest.approx(0.03 - 0.001, rel=1e-3)


def test_the_fast_program_equals_another_solver() -> None:
    """To 1e-8 of a limit, where every condition can hold."""
    filter_ = SafetyFilter(C, R)
    x, desired = safe_set(500, 4, filter_)[0], 2.0 * commands(500, seed=4)
    program = FastProgram(C, filter_.limits)
    found, (a, b) = program.correct(x, desired), program.conditions(x)
    wanted = (desired / LIMIT).numpy()
    hard = torch.nonzero(found.status == Status.HARD).flatten().tolist()
    expected = np.stack(
        [by_nnls(a[..., i].numpy(), b[:, i].numpy(), wanted[:, i], np.full(13, math.inf)) for i in hard], 1
    )
    assert len(hard) > 300
    np.testing.assert_allclose((found.control / LIMIT)[:, hard].numpy(), expected, rtol=0, atol=1e-8)


def test_recorded_conflicts_are_answered_by_every_way() -> None:
    x, u = (tensor(np.array([call[key] for call in CONFLICTS]).T) for key in ("state", "control_desired"))
    expected = way("piqp", checked=False).correct(x, u)
    assert (expected.status < Status.UNSOLVED).all()
    for name in WAYS[1:]:
        found = way(name, checked=False).correct(x, u)
        assert torch.equal(found.status, expected.status)
        same = found.status <= Status.HARD
        torch.testing.assert_close(
            found.control[:, same] / LIMIT, expected.control[:, same] / LIMIT, rtol=0, atol=1e-4
        )


def test_corrections_equal_the_closed_form() -> None:
    # -(3 n^2 x + F / m) + 7.5 n v + k h = 0 and -2 w tau / J + k (w_max^2 - w^2) = 0
    n, w_max, v, k = 0.001027, math.radians(2), 0.95, 0.5
    x = at_rest()
    x[3], x[10], x[15] = v, 0.99 * w_max, math.pi  # it flies away and spins about n_x, the Sun behind it
    thrust = 12 * (7.5 * n * v + k * (0.2 + 7.5 * n * 100 - v) - 3 * n**2 * 100)
    torque = 0.0573 * k * w_max**2 * (1 - 0.99**2) / (2 * 0.99 * w_max)
    desired = LIMIT * tensor(np.array([[1, 0, 0, 1, 0, 0.0]]).T)
    for name in WAYS:
        control = way(name, checked=False).correct(x, desired).control
        np.testing.assert_allclose(control.T, [[thrust, 0, 0, torque, 0, 0]], atol=1e-6 * MAX_TORQUE)


# What is given, and what is said


@pytest.mark.parametrize(("name", "checked"), [("piqp", False), ("batched", False), ("C", True)])
def test_a_demand_that_is_no_number_is_no_wish_and_filtered(name: str, checked: bool) -> None:
    x, u, f = X[:, :100], U[:, :100], way(name, checked)
    for group in (THRUST, TORQUE):
        nothing = u.clone()
        nothing[group] = 0.0
        expected = f.correct(x, nothing)
        for component in (group.start, group.stop - 1):
            for others in (nothing, u):  # the group's other numbers must not matter
                wish = others.index_put((torch.tensor([component]),), nothing.new_tensor(math.nan))
                answer = f.correct(x, wish)
                assert (answer.control == expected.control).all() and answer.intervened.all()
                assert (answer.status == expected.status.clamp(min=Status.HARD)).all()


def test_what_is_demanded_is_shortened_along_its_direction() -> None:
    limit = list(C.control_limit)
    u = torch.zeros(6, 5, dtype=torch.float64)
    u[:3, 0] = torch.tensor([0.2, -1.5, 7.0])  # not shortened
    u[:3, 1] = torch.tensor([4e3, -2e3, 1e3])
    u[3, 1], u[4, 2], u[5, 2] = 4e3 * MAX_TORQUE, math.inf, -math.inf
    u[:, 3] = torch.tensor([math.nan, 1.0, 1.0, MAX_TORQUE, 0.0, 0.0])
    u[4, 4], u[0, 4] = math.nan, 0.5
    found = demanded(u, limit)
    assert torch.equal(found[:, 0], u[:, 0])
    torch.testing.assert_close(found[:3, 1], LARGEST_DEMAND * torch.tensor([1.0, -0.5, 0.25]).double())
    torch.testing.assert_close(
        found[3:, 1:3] / MAX_TORQUE, LARGEST_DEMAND * tensor([[1.0, 0], [0, 1], [0, -1]])
    )
    assert torch.equal(found[:3, 3], torch.zeros(3).double()) and torch.equal(found[3:, 3], u[3:, 3])
    assert found[0, 4] == 0.5 and (found[3:, 4] == 0.0).all() and ENDLESS > 1e20


@pytest.mark.parametrize("name", WAYS)
def test_a_limit_that_is_broken_is_said_whatever_the_programs_answered(name: str) -> None:
    few = slice(0, 1000 if name == "C" else 30)
    f, x, u = way(name), X[:, few], U[:, few]
    answer = f.correct(x, u)
    assert (answer.violated.numpy() == (paper(x.numpy()) < -PSM_TOLERANCE).any(0)).all()
    assert {*answer.status[answer.violated].tolist()} >= {Status.HARD, Status.SLACK}
    assert not answer.violated.all()
    one = f(x[:, 3].tolist(), u[:, 3].tolist())
    assert one.violated == answer.violated[3].item()


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_never_leaves_the_filter(name: str, value: float) -> None:
    """Each component of state and desired control in turn."""
    x, u = X[:, :22].clone(), U[:, :22].clone()
    for i in range(22):
        (x if i < 16 else u)[i % 16, i] = value
    answer = way(name).correct(x, u)
    assert (answer.control.abs() <= LIMIT).all()
    assert answer.intervened.all()
    assert (answer.status[:16] == Status.UNSOLVED).all() and not answer.verified[:16].any()
    assert (answer.status[16:] < Status.UNSOLVED).all()
    assert (answer.control[:, :16] == 0.0).all() or not math.isnan(value)


@pytest.mark.parametrize("kind", ["piqp", "C", "torque is not checked"])
def test_the_control_is_within_the_actuators_limits_where_nothing_can_be_checked(kind: str) -> None:
    """Of a body that turns at three times its limits, in a state that none can have, or where torque is not checked."""
    bounds = Uncertainty(torque_gain=0.5, rate=0.05)
    if kind == "torque is not checked":
        f, x = RobustFilter(C, RtaParameters(unverified=True), uncertainty=bounds), at_rest().repeat(1, 50)
    else:
        f, x = way(kind), impossible("T = -1e150").repeat(1, 50)
        x[T] = -300.0
    x[OMEGA] = 3.0 * C.max_rate * (2 * torch.rand(3, 50, generator=torch.Generator().manual_seed(0)) - 1)
    answer = f.correct(x, commands(50, seed=2))
    assert not answer.verified.any()
    assert (answer.control.abs() <= LIMIT * (1 + 1e-12)).all(), (answer.control / LIMIT).abs().amax(1)


@pytest.mark.parametrize("edge", [C.max_distance, C.collision_radius])
def test_reported_values_are_exact(safety: SafetyFilter, edge: float) -> None:
    """Of the state itself, not of the one in mid-hold that conditions are of; uncompiled bit for bit."""
    few = at_the_edge(10, edge, 0.05)
    assert torch.equal(way("batched").correct(tensor(few), commands(10)).h, safety.values(tensor(few)))
    for x in (at_the_edge(100, edge, 0.05), X.numpy()):
        h = safety.correct(tensor(x), commands(x.shape[1])).h
        torch.testing.assert_close(h, safety.values(tensor(x)), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(h, paper(x), rtol=0, atol=PSM_TOLERANCE)


# What a hold does


@pytest.mark.parametrize("hold", PERIODS)
def test_torque_within_rates_brings_no_rate_beyond_after_a_hold(hold: float) -> None:
    """Of unequal moments: but for what is of second order, the largest |omega''| times T^2 / 2."""
    c = dataclasses.replace(C, inertia=(0.04, 0.06, 0.09), saturate_rates=False)
    rate, count, steps = 0.99 * C.max_rate, 500, 200
    generator = torch.Generator().manual_seed(int(hold))
    x = at_rest().repeat(1, count)
    x[OMEGA] = rate * (2 * torch.rand(3, count, generator=generator, dtype=torch.float64) - 1)
    u = torch.randn(6, count, generator=generator, dtype=torch.float64)
    u[TORQUE] *= 2.0 * tensor(np.array(c.inertia))[:, None] * rate / hold
    found = within_rates(x, u, hold, c.inertia, rate)
    assert torch.equal(found[THRUST], u[THRUST])
    path = [x]
    for _ in range(steps):
        path.append(moved(path[-1], found, hold / steps, c))
    rates = torch.stack([y[OMEGA] for y in path])
    bent = rates.diff(n=2, dim=0).abs().amax((0, 1)) * (steps / hold) ** 2
    second_order = 1.02 * bent * hold**2 / 2 + 1e-12
    assert (rates[-1].abs().amax(0) - rate <= second_order).all()
    same = found[TORQUE] == u[TORQUE]
    assert same.any(1).all() and not same.all(1).any()
    # a changed torque ends at the limit, and an unchanged one was within it
    assert ((rates[-1].abs() - rate).abs() <= second_order.expand(3, -1))[~same].all()


def test_the_condition_counts_with_the_mean_rate_of_a_hold() -> None:
    x, u = X[:, :50], U[:, :50]
    found = in_mid_hold(x, u, 10.0, C.inertia)
    mean = x[OMEGA] + 5.0 * u[TORQUE] / tensor(np.array(C.inertia))[:, None]
    torch.testing.assert_close(found[OMEGA], mean, rtol=1e-14, atol=0)
    others = [i for i in range(16) if i not in range(*OMEGA.indices(16))]
    assert torch.equal(found[others], x[others])


def test_a_verified_control_never_meets_the_plants_clamp() -> None:
    """The same bits in a plant that holds the rates and in one that does not, and the answers of both models."""
    period = 10.0
    free, held = (dataclasses.replace(C, saturate_rates=saturates) for saturates in (False, True))
    one, other = (quick(SafetyFilter(c, RtaParameters(period=period))) for c in (free, held))
    x = safe_set(60, 2, one)[0]
    x[OMEGA, ::2] *= 0.999 * C.max_rate / x[OMEGA, ::2].abs().amax(0)
    fastest, calls = 0.0, round(20 / period)
    for call in range(calls):
        desired = 2.0 * LIMIT * commands(60, seed=call).sign()
        answer, same = one.correct(x, desired), other.correct(x, desired)
        assert torch.equal(answer.control, same.control) and torch.equal(answer.verified, same.verified)
        y, z = x, x
        for _ in range(round(period)):
            y, z = step(y, answer.control, 1.0, free), step(z, answer.control, 1.0, held)
        verified = answer.verified
        assert verified.sum() > 20 and torch.equal(y[:, verified], z[:, verified])
        fastest = max(fastest, y[OMEGA].abs().max().item())
        x = y[:, :]
    assert fastest > 0.9 * C.max_rate


# What may start, what is known


def test_a_state_may_start_where_every_h_is_kept_and_the_laws_keep_them(safety: SafetyFilter) -> None:
    x = tensor(near_the_limits(2000, seed=1))
    lowest = paper(x.numpy()).min(0)
    found = safety.is_safe(x).numpy()
    certain = np.abs(lowest) > PSM_TOLERANCE
    assert 0.1 < found.mean() < 0.9
    kept = lowest >= 0.0
    check = NominalCheck(C, 1.0)
    flown = Compiled(lambda y: [check.has_backup_trajectory(y)], x[:, :1])(x)[0].numpy()
    assert (found == (kept & flown))[certain].all() and (kept & ~flown)[certain].any()


@pytest.mark.parametrize("filter_", ["paper", "checked"])
def test_without_a_check_a_state_may_start_where_every_psi_is_kept(filter_: str) -> None:
    """Gains of Psi_1 are the paper's: none is capped at 1 s."""
    x = near_the_limits(3000, seed=2)
    c = C if filter_ == "paper" else dataclasses.replace(C, hill_rotation=True)
    safety = SafetyFilter(c, RtaParameters(filter=filter_, unverified=True))
    assert safety.check is None
    lowest = np.concatenate((paper(x), last_psi(x))).min(0)
    if filter_ == "checked":  # the rates are relative to a frame that turns
        lowest = torch.cat((safety.values(tensor(x)), safety.program.evaluated(tensor(x))[2])).amin(0).numpy()
    certain = np.abs(lowest) > PSM_TOLERANCE
    found = safety.is_safe(tensor(x)).numpy()
    assert 0.1 < found.mean() < 0.9 and (found == (lowest >= 0.0))[certain].all()


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"hill_rotation": True}, "the turning of Hill's frame must be left out"),
        ({"solar_panel_axis": "+x"}, "there is no attitude of rest: panels must be on -x"),
        ({"thermal_axis": "-x"}, "there is no attitude of rest"),
        ({"max_distance": 60.0, "max_speed": 0.3}, "zone"),
    ],
)
def test_a_filter_without_a_known_check_is_refused_unless_that_is_asked_for(
    changed: dict[str, object], reason: str
) -> None:
    c = dataclasses.replace(C, **changed)  # type: ignore[arg-type]
    with pytest.raises(ValueError) as refusal:
        SafetyFilter(c)
    said = str(refusal.value)
    assert said.startswith("no check is known: ") and reason in said and "unverified = true" in said
    assert "\n" not in said
    alone = batched(SafetyFilter(c, RtaParameters(unverified=True)))
    assert alone.check is None and alone.checked == (False, False)
    answer = alone.correct(X[:, :50], U[:, :50])
    assert not answer.verified.any() and not answer.backup.any()
    assert SafetyFilter(c, RtaParameters(filter="paper")).check is None


@pytest.mark.parametrize(
    ("bounds", "missing"),
    [({"minimum_thrust": 0.6}, "motion"), ({"torque_gain": 0.5, "rate": 0.05}, "attitude")],
)
def test_what_error_bounds_leave_unchecked_is_said(bounds: dict[str, float], missing: str) -> None:
    with pytest.raises(ValueError, match=f"^no check is known of {missing}: .+; .*unverified = true"):
        RobustFilter(C, uncertainty=Uncertainty(**bounds))
    found = RobustFilter(C, RtaParameters(unverified=True), uncertainty=Uncertainty(**bounds))
    assert found.checked == (missing != "motion", missing != "attitude")
    with pytest.raises(ValueError, match=r"^no check is known: .+; \[rta\] unverified = true"):
        RobustFilter(C, uncertainty=Uncertainty(minimum_thrust=0.6, rate=1.0))


def test_states_that_are_not_finite_are_never_verified() -> None:
    """Also where there is no program, of which a number that is none would show it."""
    f = Unproposed(C)
    x = safe_set(16, 0, f)[0]
    u, far = torch.zeros(6, 16, dtype=torch.float64), torch.arange(0, 16, 2)
    x[E, far], x[T, far[::2]] = math.inf, -math.inf
    found = f.correct(x, u)
    assert not found.verified[far].any() and found.verified[1::2].all()


# Copies and threads


def with_a_ball() -> SafetyFilter:
    """Returns a filter for another mass with a limit of its own."""
    ball = {"ball": Limit(clear_of_a_ball, (0.05, 0.2), 1e12)}
    return SafetyFilter(dataclasses.replace(C, mass=14.0), extra=ball)


def clear_of_a_ball(x: Tensor, c: Limits) -> Tensor:
    """Returns m outside 70 m around a place where episodes start."""
    return norm(torch.stack((x[0], x[1] - 80.0, x[2]))) - 70.0


def test_threads_may_share_a_compiled_filter() -> None:
    """In many calls of what keeps tensors between them, while threads take turns in the middle of everything."""
    shared, other = (without_check(with_a_ball()) for _ in range(2))  # the check keeps nothing
    shared, other = fast(shared, "cpu", 16), batched(other)
    blocks = [slice(start, start + 16) for start in range(0, 64, 16)]
    expected = other.correct(X[:, :64], U[:, :64])

    def answers(block: slice) -> list[Tensor]:
        return [shared.correct(X[:, block], U[:, block]).control for _ in range(20)]

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(len(blocks)) as threads:
            found = [*threads.map(answers, blocks)]
    finally:
        sys.setswitchinterval(interval)
    for block, controls in zip(blocks, found, strict=True):
        for control in controls:
            torch.testing.assert_close(control, expected.control[:, block], rtol=0, atol=1e-9)


def test_a_copy_is_the_same_filter() -> None:
    safety = with_a_ball()
    expected = safety.correct(X[:, :3], U[:, :3])
    for other in (copy(safety), deepcopy(safety), pickle.loads(pickle.dumps(safety))):
        assert other.names == safety.names == (*CONSTRAINTS, "ball")
        assert torch.equal(other.correct(X[:, :3], U[:, :3]).control, expected.control)


def test_a_copy_with_other_parts_answers_by_them(safety: SafetyFilter) -> None:
    compiled = way("C")
    other = compiled.with_parts(FastProgram(C, compiled.limits), None)
    assert not other.correct(X, U).verified.any() and compiled.correct(X, U).verified.any()
    assert torch.equal(compiled.is_safe(X), safety.is_safe(X))
    assert (other.is_safe(X) & ~safety.is_safe(X)).any()


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

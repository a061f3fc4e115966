"""Rows built entry by entry, of the paper's constraints and of one's own, and what is refused.

In any order, of several rows, with losses, doubling gains and coupled controls.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.guidance import natural_motion
from inspection.initial_state import sample_initial_state
from inspection.model.attitude import body_axis, dot, norm, unit
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P, Q
from rta.barrier import ActuatorGroup, Rows
from rta.constraints.constraint import ACTUATORS, Constraint
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.qp.programs import Status
from study.flight.fly import Starts
from study.flight.simulation import simulate
from tests.rta.constraints import test_constraints as reference
from tests.rta.constraints.test_constraints import MEAN_MOTION, entries, length, paper, tensor
from tests.rta.test_lie_derivatives import (
    PSM,
    PSM_DRIFT_TOLERANCE,
    PSM_PUSH_TOLERANCE,
    ROWS_OF_THRUST,
    ROWS_OF_TORQUE,
    THRUST,
    TORQUE,
    R,
    X,
    attainable,
    drift,
    held,
    near,
    push,
    slope,
    thrust_barriers,
    thrust_fall,
    thrust_gain,
    thrust_values,
    torque_barriers,
    torque_fall,
    torque_values,
    turn,
)

C = InspectionParameters()
UNEQUAL = InspectionParameters(inertia=(0.04, 0.06, 0.09))
PAPERS = entries(C, R)
STATES = tensor(X)
SECOND = np.array([[0.0], [2000.0], [0.0]])  # m, where a second spacecraft is
LIMIT = np.array([1.0] * 3 + [UNEQUAL.max_torque] * 3)


def to_second(x: Tensor) -> Tensor:
    return torch.stack((-x[0], 2000.0 - x[1], -x[2]))


def cone(x: Tensor) -> Tensor:
    """cos 25 deg less the cosine between camera and second spacecraft."""
    return math.cos(math.radians(25)) - dot(torch.stack(body_axis(x[Q], 0)), unit(to_second(x)))


def sphere(x: Tensor) -> Tensor:
    """m outside 50 m around the second spacecraft."""
    return norm(to_second(x)) - 50.0


def over_one_axis(x: Tensor) -> Tensor:
    """`sphere` with a constant that fits states (16, B) only."""
    return (x[P] - tensor(SECOND)).square().sum(0) - 50.0**2


def slow_turn(x: Tensor) -> Tensor:
    """1e-3 rad^2/s^2 less the squared rate."""
    return 1e-3 - dot(x[10:13], x[10:13])


def numpy_cone(x: ndarray) -> ndarray:
    line = SECOND - x[:3]
    return math.cos(math.radians(25)) - (reference.body_axis(x[6:10], 0) * line).sum(0) / length(line)


OWN: dict[str, tuple[Constraint, Callable[[ndarray], ndarray]]] = {
    "cone": (Constraint("cone", cone, "torque", (0.05, 0.2), 0.02), numpy_cone),
    "sphere": (
        Constraint("sphere", sphere, "thrust", (0.01, 0.1), 1.0),
        lambda x: length(SECOND - x[:3]) - 50,
    ),
    "slow_turn": (
        Constraint("slow_turn", slow_turn, "torque", (0.3,), 1e-5),
        lambda x: 1e-3 - (x[10:13] ** 2).sum(0),
    ),
}
CONE, SPHERE = OWN["cone"][0], OWN["sphere"][0]


def group(*constraints: Constraint, c: InspectionParameters = C, r: RtaParameters = R) -> ActuatorGroup:
    """The group of the first one's actuators."""
    return ActuatorGroup(constraints[0].held_by, constraints, c, r)


def numpy_psi(x: ndarray, constraint: Constraint, h: Callable[[ndarray], ndarray]) -> ndarray:
    """h or Psi_1, with an exact complex-step derivative of h along f."""
    *first, _ = constraint.gains
    if not first:
        return h(x)
    along = h(x + 1e-30j * drift(x, UNEQUAL)).imag / 1e-30
    return along + first[0] * (h(x) - constraint.margin)


def names_in(names: tuple[str, ...], order: list[int]) -> tuple[str, ...]:
    return tuple(names[i] for i in order)


def assert_equal(rows: Rows, expected: Rows) -> None:
    for name, value in vars(expected).items():
        torch.testing.assert_close(getattr(rows, name), value, rtol=1e-12, atol=1e-12)


def joined(*parts: Rows) -> Rows:
    return Rows(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def test_uncoupled_entries_come_first_each_kind_in_the_order_given() -> None:
    own = replace(SPHERE, name="uncoupled", coupled=False), replace(SPHERE, name="ball")
    given = SPHERE, PAPERS["velocity_y"], own[0], PAPERS["passive_safety"], own[1], PAPERS["collision"], CONE
    thrust = group(*given)
    assert thrust.names == ("velocity_y", "uncoupled", "passive_safety", "collision", "sphere", "ball")
    assert [each.name for each in thrust.of_row] == [
        "velocity_y", "uncoupled", *["passive_safety"] * 5, "collision", "sphere", "ball",
    ]  # fmt: skip
    assert thrust.weights == [1e3, 1e5, *[1e5] * 5, math.inf, 1e5, 1e5]
    assert thrust.limit == 1.0 and thrust.controls == slice(0, 3)
    rows = thrust(STATES)
    assert rows.h.shape == (6, X.shape[1]) and rows.b.shape == (10, X.shape[1])
    assert_equal(rows, joined(*(group(each)(STATES) for each in thrust.constraints)))
    torch.testing.assert_close(rows.h[[0, 1, 3, 4, 5]], thrust.values(STATES)[[0, 1, 3, 4, 5]])


def test_thrust_rows_in_another_order_equal_finite_differences() -> None:
    names = ("velocity_z", "passive_safety", "dynamic_speed", "collision")
    order = [10, *range(11)[PSM], 1, 0]
    rows, is_psm = group(*(PAPERS[name] for name in names))(STATES), slice(1, 6)

    def psi(x: ndarray) -> ndarray:
        return thrust_barriers(x)[order]

    def near_rows(actual: Tensor, expected: ndarray, tolerance: float) -> None:
        near(actual[is_psm], expected[is_psm], tolerance)
        expected[is_psm] = actual[is_psm]
        near(actual, expected)

    for axis in range(3):
        near_rows(rows.a[:, axis], slope(psi, X, push(held(X), axis), 1e-3), PSM_PUSH_TOLERANCE)
    alpha = thrust_gain(thrust_barriers(X)) * (thrust_barriers(X) - THRUST[1])
    asked = slope(psi, X, drift(X, C), 3e-4) + (alpha - thrust_fall(X))[order]
    of_row = names_in(ROWS_OF_THRUST, order)
    expected = attainable(asked, rows.a.numpy(), thrust_values(X)[order], of_row, 1.0)
    near_rows(rows.b, expected, PSM_DRIFT_TOLERANCE)
    near_rows(rows.psi, psi(X), 1e-4)
    np.testing.assert_allclose(rows.h, paper(X)[[6, 3, 1, 0]], rtol=0, atol=1e-4)


def test_torque_rows_of_both_degrees_in_another_order_equal_finite_differences() -> None:
    names, order = ("angular_velocity_y", "battery", "angular_velocity_x", "attitude_exclusion"), [4, 2, 3, 0]
    own = replace(CONE, coupled=False)  # whose a does not hold what thrust can do
    rows = group(CONE, *(PAPERS[name] for name in names))(STATES)

    def psi(x: ndarray) -> ndarray:
        return torque_barriers(x, C)[order]

    for axis in range(3):
        near(rows.a[:4, axis], slope(psi, X, turn(X, axis, C), 1e-4))
    gain, margin = TORQUE[:, order]
    asked = slope(psi, X, drift(X, C), 1e-3) + gain * (psi(X) - margin) - torque_fall(X, C)[order]
    h, of_row = torque_values(X, C)[order], names_in(ROWS_OF_TORQUE, order)
    near(rows.b[:4], attainable(asked, rows.a[:4].numpy(), h, of_row, C.max_torque))
    near(rows.psi[:4], psi(X) - margin)
    near(rows.h[:4], paper(X)[[11, 9, 10, 7]])
    near(rows.h[4], numpy_cone(X))
    alone = group(own)(STATES)
    assert torch.equal(alone.a, rows.a[4:])
    assert (alone.b[0] > rows.b[4]).any() and (alone.b[0] >= rows.b[4]).all()


def walls(x: Tensor) -> Tensor:
    """m that two walls are away, (2, ...)."""
    return torch.stack((900.0 - x[0], 850.0 + x[1]))


def speeds(x: Tensor) -> Tensor:
    """m^2/s^2 below two limits, (2, ...)."""
    return torch.stack((30.0 - x[3] ** 2, 28.0 - x[4] ** 2))


@pytest.mark.parametrize(("both", "gains"), [(walls, (0.05, 0.2)), (speeds, (0.1,))], ids=["walls", "speeds"])
@pytest.mark.parametrize("coupled", [False, True])
def test_entry_with_several_rows_has_those_of_several_entries(both, gains, coupled: bool) -> None:
    several = Constraint(
        "both", lambda x: both(x).amin(0), "thrust", gains, 2.0, 7.0, lambda x: both, rows=2, coupled=coupled
    )
    single = [
        Constraint(f"{i}", lambda x, i=i: both(x)[i], "thrust", gains, 2.0, 7.0, coupled=coupled)
        for i in range(2)
    ]
    one, two = group(PAPERS["collision"], several), group(PAPERS["collision"], *single)
    rows, expected = one(STATES), two(STATES)
    assert one.names == ("collision", "both") and one.weights == two.weights == [math.inf, 7.0, 7.0]
    for name in ("psi", "a", "b", "b_bare"):
        torch.testing.assert_close(getattr(rows, name), getattr(expected, name), rtol=1e-13, atol=1e-13)
    assert (both(STATES).argmin(0) == 0).any() and (both(STATES).argmin(0) == 1).any()
    assert torch.equal(rows.h[1], both(STATES).amin(0)) and torch.equal(rows.h, one.values(STATES))


def test_result_joins_the_rows_of_an_entry() -> None:
    """Of a limit of 0.05 m/s per axis, which most states exceed."""

    def slow(x: Tensor) -> Tensor:
        return 0.05**2 - x[3:6] ** 2

    creeping = Constraint(
        "creeping",
        lambda x: slow(x).amin(0),
        "thrust",
        (0.2,),
        0.0,
        1.0,
        lambda x: slow,
        rows=3,
        coupled=False,
    )
    safety = SafetyFilter(C, R, extra=[creeping])
    answer, rows = safety.correct(STATES, torch.zeros_like(STATES[:6])), safety.rows(STATES)[0]
    assert answer.h.shape == answer.active.shape == answer.slack.shape == (14, X.shape[1])
    assert torch.equal(answer.h[13], slow(STATES).amin(0))
    reached = (rows.a * answer.control[:3]).sum(1) + rows.b_bare
    slack = (answer.program_status[0] >= Status.SLACK) & ~answer.backup  # of what the rows propose
    assert slack.sum() > 20
    expected = (rows.waived - reached)[-3:].clamp(min=0.0).amax(0)
    torch.testing.assert_close(answer.slack[13, slack], expected[slack], rtol=1e-6, atol=1e-6)
    assert (answer.slack[13, answer.program_status[0] < Status.SLACK] == 0.0).all()


@pytest.mark.parametrize("loss", [0.03, lambda x: 0.001 * x[0].abs()], ids=["number", "function"])
@pytest.mark.parametrize("name", ["collision", "passive_safety", "sphere", "battery"])
def test_loss_is_taken_off_both_sides(name: str, loss) -> None:
    """Within the limit; beyond it rows are held to what the actuators give."""
    entry = replace((PAPERS | {"sphere": SPHERE})[name], loss=0.0)
    h = length(SECOND - X[:3]) - 50 if name == "sphere" else paper(X)[CONSTRAINTS.index(name)]
    x = STATES[:, torch.from_numpy(h >= 0)]
    assert x.shape[1] >= 90
    bare, rows = group(entry)(x), group(replace(entry, loss=loss))(x)
    lost = loss(x) if callable(loss) else torch.full_like(x[0], loss)
    assert (lost > 0).all()
    assert_equal(rows, replace(bare, b=bare.b - lost, b_bare=bare.b_bare - lost))


def test_gain_doubles_where_the_entry_says_so() -> None:
    entry = replace(PAPERS["velocity_x"], doubling=math.inf, loss=0.0)
    plain, rising = group(entry)(STATES), group(replace(entry, doubling=30.0))(STATES)
    gain = (0.2 * (1 + (plain.psi / 30.0) ** 2)).clamp(max=0.5)
    assert (gain > 0.3).any() and (gain < 0.5).any()
    assert_equal(rising, replace(plain, b=plain.b + (gain - 0.2) * plain.psi, b_bare=rising.b))


def test_barrier_takes_the_place_of_h_in_the_rows_alone() -> None:
    half = replace(PAPERS["velocity_x"], barrier=lambda x: lambda y: 0.5 * PAPERS["velocity_x"].h(y)[None])
    whole, rows = group(PAPERS["velocity_x"])(STATES), group(half)(STATES)
    assert torch.equal(rows.h, whole.h)
    torch.testing.assert_close(rows.psi, 0.5 * whole.psi)
    torch.testing.assert_close(rows.a, 0.5 * whole.a)


def test_psi_of_a_slab_is_its_closed_form() -> None:
    # h = 1e4 - z^2 m^2 with z'' = -n^2 z + F_z / 12, less 50 m^2: Psi_1 = -2 z z' + k1 (h - 50)
    k1, k2, margin = 0.05, 0.2, 50.0
    slab = Constraint("slab", lambda x: 1e4 - x[2] ** 2, "thrust", (k1, k2), margin, coupled=False)
    rows = group(slab)(STATES)
    z, rate = X[2], X[5]
    h, fall = 1e4 - z**2, -2 * z * rate
    psi = fall + k1 * (h - margin)
    near(rows.h[0], h)
    near(rows.psi[0], psi)
    a = np.stack([-2 * z * push(held(X), i)[5] for i in range(3)])
    near(rows.a[0], a)
    asked = -2 * rate**2 + 2 * MEAN_MOTION**2 * z**2 + k1 * fall + k2 * psi
    for b, actual in ((asked, rows.b), (asked + k1 * k2 * margin, rows.b_bare)):
        near(actual, attainable(b[None], a[None], h[None], ("slab",), 1.0))


@pytest.mark.parametrize("name", OWN)
def test_rows_equal_finite_differences(name: str) -> None:
    constraint, h = OWN[name]
    *first, last = constraint.gains

    def psi(x: ndarray) -> ndarray:
        return numpy_psi(x, constraint, h)

    rows = group(constraint, c=UNEQUAL)(STATES)
    columns = [push(held(X), i) for i in range(3)] + [turn(X, i, UNEQUAL) for i in range(3)]
    pushed = np.stack([slope(psi, X, column, 1e-3) for column in columns])
    own = ACTUATORS[constraint.held_by]
    others = [i for i in range(6) if i not in range(6)[own]]
    worst = (np.abs(pushed[others]) * LIMIT[others, None]).sum(0)
    margin = 0.0 if first else constraint.margin
    near(rows.h[0], h(X))
    near(rows.psi[0], psi(X))
    near(rows.a[0], pushed[own])
    near(rows.b[0], slope(psi, X, drift(X, UNEQUAL), 1e-3) + last * (psi(X) - margin) - worst)
    near((rows.b_bare - rows.b)[0], np.full(X.shape[1], np.prod(constraint.gains) * constraint.margin))
    assert (worst > 1e-6).any() == (name == "cone")


def test_gains_are_capped_as_the_papers() -> None:
    slow, rapid = (
        group(Constraint("mine", cone, "torque", gains), c=UNEQUAL, r=RtaParameters(period=5.0))
        for gains in ((0.1, 0.1), (3.0, 4.0))
    )
    for field, expected in vars(slow(STATES)).items():
        torch.testing.assert_close(getattr(rapid(STATES), field), expected)


def test_safe_is_where_h_and_psi_are_not_negative() -> None:
    constraint, h = OWN["cone"]
    mine = group(constraint, c=UNEQUAL)
    safe = ((mine.values(STATES) >= 0).all(0) & mine.keeps(STATES, degree=2)).numpy()
    fulfilled, holds = h(X) >= 0, numpy_psi(X, constraint, h) >= 0
    assert 0.5 < safe.mean() < 1.0
    assert (fulfilled != holds).any()
    assert (safe == (fulfilled & holds)).all()
    papers = SafetyFilter(UNEQUAL, R).is_in_safe_set(STATES).numpy()
    assert (
        SafetyFilter(UNEQUAL, R, extra=[constraint]).is_in_safe_set(STATES).numpy() == (papers & safe)
    ).all()


def test_weight_is_the_filters_own_unless_given() -> None:
    mine = (
        Constraint("mine", cone, "torque", (0.05, 0.2), weight=weight) for weight in (None, 7.0, math.inf)
    )
    weights = group(*mine, c=UNEQUAL, r=RtaParameters(slack_weight_critical=2e5)).weights
    assert weights == [2e5, 7.0, math.inf]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"held_by": "wheels"}, "held_by = 'wheels': must be thrust or torque"),
        ({"gains": ()}, "one or two positive"),
        ({"gains": (0.1, -0.1)}, "one or two positive"),
        ({"margin": math.nan}, "margin"),
        ({"weight": 0.0}, "weight"),
        ({"gains": (0.1,)}, "torque does not first enter derivative 1"),
        ({"h": slow_turn}, "torque does not first enter derivative 2"),
        ({"h": sphere}, "torque does not first enter derivative 2"),
        ({"h": lambda x: x[P]}, r"shape \(3, 64\)"),
        ({"h": lambda x: cone(x) - (x[0] - 1e4).sqrt()}, "h is not finite"),
        ({"h": lambda x: cone(x) - x[0].clamp(min=0.0).sqrt()}, "a derivative of h is not finite"),
        ({"h": over_one_axis}, "must broadcast over all trailing axes"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict, words: str) -> None:
    given = {"name": "mine", "h": cone, "held_by": "torque", "gains": (0.05, 0.2)}
    with pytest.raises(ValueError, match=f"^mine: .*{words}"):
        group(Constraint(**given | arguments), c=UNEQUAL)


def test_simulation_of_one_spacecraft_returns_every_h() -> None:
    safety = SafetyFilter(UNEQUAL, R, extra=[constraint for constraint, _ in OWN.values()])
    generator = torch.Generator().manual_seed(0)
    env = InspectionEnv(1, UNEQUAL, [generator], safety.safety(enabled=False))
    flight = simulate(
        env, natural_motion(UNEQUAL), Starts(*sample_initial_state(1, generator, UNEQUAL)), duration=20.0
    )
    components = ("position", "velocity", "quaternion", "angular_velocity")
    x = np.concatenate([flight[name] for name in components], 1).T
    for name, (_, h) in OWN.items():
        np.testing.assert_allclose(flight[f"h_{name}"], h(x), rtol=1e-9, atol=1e-12)
    assert sum(name.startswith("h_") for name in flight) == len(safety.names)

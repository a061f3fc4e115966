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

from inspection.model.attitude import body_axis, dot, norm, unit
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P, Q
from rta.barrier import ActuatorGroup, Rows
from rta.constraints.constraint import ACTUATORS, Constraint
from rta.constraints.names import CONSTRAINTS
from rta.parameters import RtaParameters
from tests.oracles import EXACT as R
from tests.oracles import IN_FLIGHT as X
from tests.oracles import body_axis as hill_axis
from tests.oracles import drift, entries, held, length, near, paper, push, slope, tensor, turn

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
    return math.cos(math.radians(25)) - (hill_axis(x[6:10], 0) * line).sum(0) / length(line)


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
    return ActuatorGroup(constraints[0].actuator, constraints, c, r)


def numpy_psi(x: ndarray, constraint: Constraint, h: Callable[[ndarray], ndarray]) -> ndarray:
    """h or Psi_1, with an exact complex-step derivative of h along f."""
    *first, _ = constraint.gains
    if not first:
        return h(x)
    along = h(x + 1e-30j * drift(x, UNEQUAL)).imag / 1e-30
    return along + first[0] * (h(x) - constraint.margin)


def assert_equal(rows: Rows, expected: Rows) -> None:
    for name, value in vars(expected).items():
        torch.testing.assert_close(getattr(rows, name), value, rtol=1e-12, atol=1e-12)


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
    for name in ("psi", "a", "b", "b_no_margin"):
        torch.testing.assert_close(getattr(rows, name), getattr(expected, name), rtol=1e-13, atol=1e-13)
    assert (both(STATES).argmin(0) == 0).any() and (both(STATES).argmin(0) == 1).any()
    assert torch.equal(rows.h[1], both(STATES).amin(0)) and torch.equal(rows.h, one.values(STATES))


@pytest.mark.parametrize("intersample_drop", [0.03, lambda x: 0.001 * x[0].abs()], ids=["number", "function"])
@pytest.mark.parametrize("name", ["collision", "passive_safety", "sphere", "battery"])
def test_the_intersample_drop_is_taken_off_both_sides(name: str, intersample_drop) -> None:
    """Within the limit; beyond it rows are held to what the actuators give."""
    entry = replace((PAPERS | {"sphere": SPHERE})[name], intersample_drop=0.0)
    h = length(SECOND - X[:3]) - 50 if name == "sphere" else paper(X)[CONSTRAINTS.index(name)]
    x = STATES[:, torch.from_numpy(h >= 0)]
    assert x.shape[1] >= 90
    bare, rows = group(entry)(x), group(replace(entry, intersample_drop=intersample_drop))(x)
    lost = intersample_drop(x) if callable(intersample_drop) else torch.full_like(x[0], intersample_drop)
    assert (lost > 0).all()
    assert_equal(rows, replace(bare, b=bare.b - lost, b_no_margin=bare.b_no_margin - lost))


def test_gain_doubles_where_the_entry_says_so() -> None:
    entry = replace(PAPERS["velocity_x"], doubling=math.inf, intersample_drop=0.0)
    plain, rising = group(entry)(STATES), group(replace(entry, doubling=30.0))(STATES)
    gain = (0.2 * (1 + (plain.psi / 30.0) ** 2)).clamp(max=0.5)
    assert (gain > 0.3).any() and (gain < 0.5).any()
    assert_equal(rising, replace(plain, b=plain.b + (gain - 0.2) * plain.psi, b_no_margin=rising.b))


@pytest.mark.parametrize("name", OWN)
def test_rows_equal_finite_differences(name: str) -> None:
    constraint, h = OWN[name]
    *first, last = constraint.gains

    def psi(x: ndarray) -> ndarray:
        return numpy_psi(x, constraint, h)

    rows = group(constraint, c=UNEQUAL)(STATES)
    columns = [push(held(X), i) for i in range(3)] + [turn(X, i, UNEQUAL) for i in range(3)]
    pushed = np.stack([slope(psi, X, column, 1e-3) for column in columns])
    own = ACTUATORS[constraint.actuator]
    others = [i for i in range(6) if i not in range(6)[own]]
    worst = (np.abs(pushed[others]) * LIMIT[others, None]).sum(0)
    margin = 0.0 if first else constraint.margin
    near(rows.h[0], h(X))
    near(rows.psi[0], psi(X))
    near(rows.a[0], pushed[own])
    near(rows.b[0], slope(psi, X, drift(X, UNEQUAL), 1e-3) + last * (psi(X) - margin) - worst)
    near((rows.b_no_margin - rows.b)[0], np.full(X.shape[1], np.prod(constraint.gains) * constraint.margin))
    assert (worst > 1e-6).any() == (name == "cone")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"gains": (0.1,)}, "torque does not first enter derivative 1"),
        ({"h": slow_turn}, "torque does not first enter derivative 2"),
        ({"h": sphere}, "torque does not first enter derivative 2"),
        ({"h": lambda x: cone(x) - x[0].clamp(min=0.0).sqrt()}, "a derivative of h is not finite"),
        ({"h": over_one_axis}, "must broadcast over all trailing axes"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict, words: str) -> None:
    given = {"name": "mine", "h": cone, "actuator": "torque", "gains": (0.05, 0.2)}
    with pytest.raises(ValueError, match=f"^mine: .*{words}"):
        group(Constraint(**given | arguments), c=UNEQUAL)

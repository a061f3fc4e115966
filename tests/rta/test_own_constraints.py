"""Constraints of one's own: their rows against finite differences along an independent f and g, and what is refused."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.attitude import body_axis, dot, norm, unit
from inspection.environment import InspectionEnv
from inspection.guidance import natural_motion
from inspection.initial_state import sample_initial_state
from inspection.parameters import InspectionParameters
from inspection.state import P, Q
from rta.constraints import ACTUATORS, Constraint
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.rows import ActuatorGroup
from study.flight.simulation import simulate
from tests.rta import test_constraints as reference
from tests.rta.test_constraints import length, tensor
from tests.rta.test_lie_derivatives import X, drift, held, near, push, slope, turn

C = InspectionParameters(inertia=(0.04, 0.06, 0.09))
R = RtaParameters()
SECOND = np.array([[0.0], [2000.0], [0.0]])  # m, where a second spacecraft is
LIMIT = np.array([1.0] * 3 + [C.max_torque] * 3)


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


CONSTRAINTS: dict[str, tuple[Constraint, Callable[[ndarray], ndarray]]] = {
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


def group_of(*constraints: Constraint, r: RtaParameters = R) -> ActuatorGroup:
    """The group of the first one's actuators."""
    return ActuatorGroup(constraints[0].held_by, constraints, C, r)


def numpy_psi(x: ndarray, constraint: Constraint, h: Callable[[ndarray], ndarray]) -> ndarray:
    """h or Psi_1, with an exact complex-step derivative of h along f."""
    *first, _ = constraint.gains
    if not first:
        return h(x)
    along = h(x + 1e-30j * drift(x, C)).imag / 1e-30
    return along + first[0] * (h(x) - constraint.margin)


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_rows_equal_finite_differences(name: str) -> None:
    constraint, h = CONSTRAINTS[name]
    *first, last = constraint.gains

    def psi(x: ndarray) -> ndarray:
        return numpy_psi(x, constraint, h)

    rows = group_of(constraint)(tensor(X))
    columns = [push(held(X), i) for i in range(3)] + [turn(X, i, C) for i in range(3)]
    pushed = np.stack([slope(psi, X, column, 1e-3) for column in columns])
    own = ACTUATORS[constraint.held_by]
    others = [i for i in range(6) if i not in range(6)[own]]
    worst = (np.abs(pushed[others]) * LIMIT[others, None]).sum(0)
    margin = 0.0 if first else constraint.margin
    near(rows.h[0], h(X))
    near(rows.psi[0], psi(X))
    near(rows.a[0], pushed[own])
    near(rows.b[0], slope(psi, X, drift(X, C), 1e-3) + last * (psi(X) - margin) - worst)
    near((rows.b_bare - rows.b)[0], np.full(X.shape[1], np.prod(constraint.gains) * constraint.margin))
    assert (worst > 1e-6).any() == (name == "cone")


def test_gains_are_capped_as_the_papers() -> None:
    slow, rapid = (
        group_of(Constraint("mine", cone, "torque", gains), r=RtaParameters(period=5.0))
        for gains in ((0.1, 0.1), (3.0, 4.0))
    )
    x = tensor(X)
    for field, expected in vars(slow(x)).items():
        torch.testing.assert_close(getattr(rapid(x), field), expected)


def test_safe_is_where_h_and_psi_are_not_negative() -> None:
    constraint, h = CONSTRAINTS["cone"]
    group = group_of(constraint)
    safe = ((group.values(tensor(X)) >= 0).all(0) & group.holds(tensor(X), degree=2)).numpy()
    fulfilled, holds = h(X) >= 0, numpy_psi(X, constraint, h) >= 0
    assert 0.5 < safe.mean() < 1.0
    assert (fulfilled != holds).any()
    assert (safe == (fulfilled & holds)).all()
    papers = SafetyFilter(C, R).is_safe(tensor(X)).numpy()
    assert (SafetyFilter(C, R, extra=[constraint]).is_safe(tensor(X)).numpy() == (papers & safe)).all()


def test_weight_is_the_filters_own_unless_given() -> None:
    mine = (
        Constraint("mine", cone, "torque", (0.05, 0.2), weight=weight) for weight in (None, 7.0, math.inf)
    )
    group = group_of(*mine, r=RtaParameters(slack_weight_critical=2e5))
    assert group.weights == [2e5, 7.0, math.inf]


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
        group_of(Constraint(**given | arguments))


def test_simulation_of_one_spacecraft_returns_every_h() -> None:
    safety = SafetyFilter(C, R, extra=[constraint for constraint, _ in CONSTRAINTS.values()])
    generator = torch.Generator().manual_seed(0)
    env = InspectionEnv(1, C, [generator], safety.safety(enabled=False))
    flight = simulate(env, natural_motion(C), *sample_initial_state(1, generator, C), duration=20.0)
    components = ("position", "velocity", "quaternion", "angular_velocity")
    x = np.concatenate([flight[name] for name in components], 1).T
    for name, (_, h) in CONSTRAINTS.items():
        np.testing.assert_allclose(flight[f"h_{name}"], h(x), rtol=1e-9, atol=1e-12)
    assert sum(name.startswith("h_") for name in flight) == len(safety.names)

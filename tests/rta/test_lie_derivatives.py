"""Every barrier row against central finite differences of the paper's constraints along an independent f and g.

Rows of relative degree two difference Psi_1, whose own L_f h is an exact complex-step derivative.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from rta.barrier import Rows
from rta.constraints.vehicle import scaled
from rta.filter import SafetyFilter
from rta.lie_derivatives import lie_derivative, lie_derivatives
from rta.parameters import RtaParameters
from tests.oracles import EXACT as R
from tests.oracles import (
    IN_FLIGHT as X,
)
from tests.oracles import (
    PSM,
    ROWS_OF_THRUST,
    ROWS_OF_TORQUE,
    attainable,
    drift,
    flying,
    held,
    length,
    near,
    push,
    slope,
    tensor,
    thrust_barriers,
    thrust_fall,
    thrust_gain,
    thrust_values,
    torque_barriers,
    torque_fall,
    torque_values,
    turn,
)
from tests.oracles import THRUST_ROWS as THRUST
from tests.oracles import TORQUE_ROWS as TORQUE

SPACECRAFT = {
    "paper": InspectionParameters(),
    "unequal_moments": InspectionParameters(inertia=(0.04, 0.06, 0.09), solar_panel_axis="+x"),
}


def before_scaling(c: InspectionParameters) -> RtaParameters:
    """Parameters that a filter scales to R for its vehicle."""
    own = vars(scaled(R, c))
    given = {name: divided(getattr(R, name), own[name]) for name in own if own[name] != getattr(R, name)}
    if "pole_angle" in given:
        given["pole_angle"] = math.atan(math.tan(R.pole_angle) ** 2 / math.tan(own["pole_angle"]))
    return replace(R, **given)


def divided(ours: float | tuple[float, ...], own: float | tuple[float, ...]) -> float | tuple[float, ...]:
    """ours^2 / own."""
    if isinstance(ours, tuple):
        return tuple(divided(*pair) for pair in zip(ours, own, strict=True))
    return ours**2 / own


PSM_PUSH_TOLERANCE, PSM_DRIFT_TOLERANCE = 1e-2, 1e-3


def beyond_the_limits() -> ndarray:
    """(16, 100) states in flight, outside the zone, many too fast, too hot, too low or turning too fast."""
    rng, x, count = np.random.default_rng(2), flying(), 100
    x[:3] *= (800 + rng.uniform(1, 20, count)) / length(x[:3])
    x[3:6] *= rng.uniform(1, 8, count) / length(x[3:6])
    x[10:13] *= rng.uniform(0.5, 2, count)
    x[13], x[14] = rng.uniform(9, 12, count), rng.uniform(0.5, 1.5, count)
    return x


BEYOND = beyond_the_limits()


@pytest.fixture(scope="module", params=SPACECRAFT)
def case(request: pytest.FixtureRequest) -> tuple[InspectionParameters, Rows, Rows]:
    c = SPACECRAFT[request.param]
    return c, *(group(tensor(X)) for group in SafetyFilter(c, before_scaling(c)).groups)


@pytest.mark.parametrize("axis", range(3))
def test_thrust_rows_equal_finite_differences(case: tuple, axis: int) -> None:
    expected = slope(thrust_barriers, X, push(held(X), axis), 1e-3)
    near(case[1].a[PSM, axis], expected[PSM], PSM_PUSH_TOLERANCE)
    expected[PSM] = case[1].a[PSM, axis]
    near(case[1].a[:, axis], expected)


@pytest.mark.parametrize("axis", range(3))
def test_torque_rows_equal_finite_differences(case: tuple, axis: int) -> None:
    c, _, torque = case
    near(torque.a[:, axis], slope(lambda x: torque_barriers(x, c), X, turn(X, axis, c), 1e-4))


def test_thrust_rows_without_control_equal_finite_differences(case: tuple) -> None:
    c, thrust, _ = case
    psi = thrust_barriers(X)
    alpha = thrust_gain(psi) * (psi - THRUST[1])
    asked = slope(thrust_barriers, X, drift(X, c), 3e-4) + alpha - thrust_fall(X)
    expected = attainable(asked, thrust.a.numpy(), thrust_values(X), ROWS_OF_THRUST, 1.0)
    assert ((expected > asked).sum(1) > 0)[[0, 1]].all()
    near(thrust.b[PSM], expected[PSM], PSM_DRIFT_TOLERANCE)
    expected[PSM] = thrust.b[PSM]
    near(thrust.b, expected)


def test_torque_rows_without_control_equal_finite_differences(case: tuple) -> None:
    c, _, torque = case
    gain, margin = TORQUE
    along = slope(lambda x: torque_barriers(x, c), X, drift(X, c), 1e-3)
    asked = along + gain * (torque_barriers(X, c) - margin) - torque_fall(X, c)
    near(torque.b, attainable(asked, torque.a.numpy(), torque_values(X, c), ROWS_OF_TORQUE, c.max_torque))


@pytest.mark.parametrize("name", SPACECRAFT)
def test_thrust_rows_beyond_the_limits_equal_finite_differences(name: str) -> None:
    c, x = SPACECRAFT[name], BEYOND
    h, psi, margin = thrust_values(x), thrust_barriers(x), THRUST[1]
    gain = thrust_gain(psi)
    asked = slope(thrust_barriers, x, drift(x, c), 3e-4) + gain * (psi - margin) - thrust_fall(x)
    a = np.stack([slope(thrust_barriers, x, push(held(x), i), 1e-3) for i in range(3)], 1)
    assert_rows_beyond(
        SafetyFilter(c, before_scaling(c)).groups[0](tensor(x)), h, a, asked, gain * margin, 1.0
    )


@pytest.mark.parametrize("name", SPACECRAFT)
def test_torque_rows_beyond_the_limits_equal_finite_differences(name: str) -> None:
    c, x, (gain, margin) = SPACECRAFT[name], BEYOND, TORQUE
    barriers, h = partial(torque_barriers, c=c), torque_values(x, c)
    asked = slope(barriers, x, drift(x, c), 3e-4) + gain * (barriers(x) - margin) - torque_fall(x, c)
    a = np.stack([slope(barriers, x, turn(x, i, c), 1e-4) for i in range(3)], 1)
    assert_rows_beyond(
        SafetyFilter(c, before_scaling(c)).groups[1](tensor(x)), h, a, asked, gain * margin, c.max_torque
    )


def assert_rows_beyond(
    rows: Rows, h: ndarray, a: ndarray, asked: ndarray, margin: ndarray, limit: float
) -> None:
    """All but those of the chief and of passive safety, which are fulfilled out there."""
    names = ROWS_OF_THRUST if len(h) == len(ROWS_OF_THRUST) else ROWS_OF_TORQUE
    chosen = [i for i, name in enumerate(names) if name not in ("collision", "passive_safety")]
    assert ((h < 0).sum(1) >= 5)[chosen].all()
    near(rows.a[chosen], a[chosen])
    near(rows.b[chosen], attainable(asked, a, h, names, limit)[chosen])
    near(rows.b_no_margin[chosen], attainable(asked + margin, a, h, names, limit)[chosen])


def test_first_psi_has_its_margin_spent(case: tuple) -> None:
    c, _, torque = case
    near(torque.psi, torque_barriers(X, c) - TORQUE[1])


def double_integrator(y: Tensor) -> Tensor:
    return torch.stack((y[1], torch.zeros_like(y[0])))


def high_order(y: Tensor) -> Tensor:
    """Psi_1 = dh/dt + 3 h of h = 1 - p^2 along p' = v."""
    h, rate = lie_derivative(lambda z: 1 - z[:1] ** 2, y, double_integrator(y))
    return rate + 3 * h


def test_lie_derivatives_of_a_high_order_barrier() -> None:
    # L_f Psi_1 = (-2 v - 6 p) v and L_g Psi_1 = -2 p for v' = u
    p, v = y = torch.randn(2, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    g = torch.stack((torch.zeros_like(p), torch.ones_like(p)))[:, None]
    _, along_f, along_g = lie_derivatives(high_order, y, double_integrator(y), g)
    torch.testing.assert_close(along_f, ((-2 * v - 6 * p) * v)[None])
    torch.testing.assert_close(along_g, (-2 * p)[None, None])


@pytest.mark.parametrize("number", [float, torch.tensor])
def test_every_operation_of_what_does_not_depend_is_differentiated(
    number: Callable[[float], float | Tensor],
) -> None:
    def function(y: Tensor) -> Tensor:
        one, two, three, four = (number(each) for each in (1.0, 2.0, 3.0, 4.0))
        return three - (two * y - one) / four + (one + y) * 5 - 7

    y, along = torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5])
    value, slope = lie_derivative(function, y, along)
    torch.testing.assert_close((value, slope), (3.0 - (2.0 * y - 1.0) / 4.0 + 5.0 * y - 2.0, 4.5 * along))

"""The state of now, from one that is some calls old: against worlds flown and scipy's flight of the paper's equations.

The worlds are `inspection.world.plant`'s, whose tests are tests/inspection/world/test_plant.py.
"""

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.integrate import solve_ivp
from torch import Tensor

from inspection.model.attitude import norm, rotation_matrix
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, P, Q, V
from inspection.world.parameters import PlantParameters
from inspection.world.plant import Plant
from inspection.world.uncertainty import Uncertainty
from rta.robust.prediction import KINDS, predicted
from tests.inspection.model.test_dynamics import paper_rate
from tests.inspection.world.test_plant import begun, moments
from tests.oracles import tensor
from tests.rta.test_filter import commands, near_the_limits

C = InspectionParameters()
WORLDS = 600
U1 = {
    "mass": 0.1,
    "inertia": 0.15,
    "acceleration": 1e-5,
    "hill_rotation": True,
    "thrust_gain": 0.05,
    "torque_gain": 0.05,
    "thrust_misalignment": 1.0,
    "position": 0.6,
    "velocity": 0.006,
    "attitude": 0.3,
    "rate": 0.03,
}


def flown(x: ndarray, u: ndarray, seconds: float) -> ndarray:
    """Returns the paper's equations of motion of each column by DOP853, without saturation."""
    ends = [
        solve_ivp(
            lambda _, y, u=u[:, i]: paper_rate(y, u, C.inertia), (0, seconds), x[:, i], "DOP853", rtol=1e-11
        )
        for i in range(x.shape[1])
    ]
    assert all(end.success for end in ends)
    return np.stack([end.y[:, -1] for end in ends], 1)


def some_states(count: int, seed: int = 0) -> ndarray:
    x = near_the_limits(count, seed)
    x[3:6] *= 0.8
    return x


def some_controls(count: int, seed: int = 0) -> ndarray:
    """Returns controls whose torque keeps a body's turn over 10 s close to one step of the model."""
    u = commands(count, seed).numpy()
    u[3:] *= 0.1
    return u


def world(bounds: dict[str, Any]) -> PlantParameters:
    """Returns a world within these bounds."""
    given: dict[str, Any] = {"saturate_rates": False, "noise_bound": 1.0}
    for name, value in bounds.items():
        if name in ("mass", "inertia", "thrust_gain", "torque_gain"):
            given[name if name.endswith("gain") else f"{name}_factor"] = (1 - value, 1 + value)
        elif name in ("position", "velocity", "attitude", "rate"):
            given[f"{name}_noise"] = value  # most of it at one sigma, where it is clipped
        elif name in ("thrust_misalignment", "acceleration", "hill_rotation"):
            given[name] = value
    return PlantParameters(**given)


def relative(plant: Plant, x: Tensor) -> Tensor:
    """Returns states with the rates relative to Hill's frame, as the filter wants them."""
    if not plant.parameters.hill_rotation:
        return x
    turning = rotation_matrix(x[Q])[2] * C.mean_motion
    return torch.cat((x[: OMEGA.start], x[OMEGA] - turning, x[OMEGA.stop :]))


def now_of(x: Tensor, sent: Tensor, period: float, uncertainty: Uncertainty) -> tuple[Tensor, Tensor]:
    """Returns the states of now and their error_bound from states that are as many calls old as controls were sent."""
    error_bound = torch.zeros_like(x[:KINDS])
    for u in sent:
        x, error_bound = predicted(x, error_bound, u, C, period, uncertainty)
    return x, error_bound


def escaped(bounds: dict[str, Any], period: float, calls: int) -> list[float]:
    """Returns the largest excess of position, velocity, attitude and rate errors over `predicted`."""
    plant = begun(world(bounds), WORLDS, seed=6, c=C)
    x = tensor(some_states(WORLDS, seed=6))
    x[OMEGA] *= 0.3
    sent = torch.stack([tensor(some_controls(WORLDS, seed=7 + i)) for i in range(calls)])
    seen = plant.sense(moments(WORLDS), x)
    for u in sent:
        x = plant.integrate(x, plant.actuate(moments(WORLDS), u), plant.body, 0.5, round(2 * period))
    now = relative(plant, x)
    uncertainty = Uncertainty(latency=calls, **bounds)
    there, error_bound = now_of(seen, sent, period, uncertainty)

    def beyond(off: Tensor, measured: float) -> Tensor:
        return norm((off.abs() - measured).clamp(min=0.0))

    turned = 2 * torch.linalg.vecdot(now[Q].T, there[Q].T).abs().clamp(max=1.0).arccos()
    off = (
        beyond(now[P] - there[P], uncertainty.position),
        beyond(now[V] - there[V], uncertainty.velocity),
        turned - math.sqrt(3) * math.radians(uncertainty.attitude),
        beyond(now[OMEGA] - there[OMEGA], math.radians(uncertainty.rate)),
    )
    return [(each - bound).max().item() for each, bound in zip(off, error_bound, strict=True)]


ROUNDING = (5e-3, 5e-4, 2e-4, 1e-9)  # m, m/s, rad, rad/s: of one step of 10 s


@pytest.mark.parametrize(
    ("bounds", "kinds"),
    [
        ({"mass": 0.1, "thrust_gain": 0.05}, (0, 1)),
        ({"acceleration": 1e-3}, (0, 1)),
        ({"velocity": 0.006}, (0,)),
        ({"inertia": 0.15, "torque_gain": 0.05}, (2, 3)),
        ({"rate": 0.03}, (2,)),
        (U1, (0, 1)),
    ],
    ids=lambda value: str([*value]),
)
@pytest.mark.parametrize(("period", "calls"), [(1.0, 1), (1.0, 3), (10.0, 1)])
def test_the_truth_is_within_what_is_said_of_a_predicted_state(
    bounds: dict[str, Any], kinds: tuple[int, ...], period: float, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = escaped(bounds, period, calls)
    assert all(found[kind] <= ROUNDING[kind] for kind in kinds)
    # without what is said beyond the measurement's error it is not
    monkeypatch.setattr("tests.rta.robust.test_prediction.predicted", lambda *given: without_bound(*given))
    found = escaped(bounds, period, calls)
    assert all(found[kind] > 0.0 for kind in kinds)


def without_bound(*given: Any) -> tuple[Tensor, Tensor]:
    there, error_bound = predict(*given)
    return there, torch.zeros_like(error_bound)


predict = predicted


def test_a_predicted_velocity_is_off_by_what_thrust_does_in_another_attitude() -> None:
    """By hand: a body at rest, turned by the largest error across its thrust, F / m 2 sin(angle / 2) T."""
    x, u = torch.zeros(16, 1, dtype=torch.float64), torch.zeros(6, 1, dtype=torch.float64)
    x[P.start], x[Q.stop - 1], u[0] = 100.0, 1.0, C.max_thrust
    angle = math.sqrt(3.0) * math.radians(3.0)
    _, bound = predicted(x, torch.zeros(KINDS, 1).double(), u, C, 1.0, Uncertainty(attitude=3.0))
    off = C.max_thrust / C.mass * 2.0 * math.sin(angle / 2.0)
    assert off <= bound[1].item() <= 1.01 * off


def test_a_younger_state_is_not_predicted_on() -> None:
    x, u = tensor(some_states(3)), tensor(some_controls(3))
    sent = torch.stack((u, u))
    sent[0, :, 1:] = math.nan
    sent[1, :, 2] = math.nan
    uncertainty = Uncertainty(latency=2, mass=0.1)
    there, error_bound = now_of(x, sent, 1.0, uncertainty)
    for column, calls in ((0, 2), (1, 1), (2, 0)):
        own = [part[:, column : column + 1] for part in (x, u)]
        alone = now_of(own[0], own[1].expand(calls, -1, -1), 1.0, uncertainty)
        assert torch.equal(there[:, column : column + 1], alone[0])
        assert torch.equal(error_bound[:, column : column + 1], alone[1])
    expected = flown(x.numpy()[:, :1], u.numpy()[:, :1], 2.0)
    np.testing.assert_allclose(there[:, :1].numpy(), expected, rtol=0, atol=1e-5)
    assert (error_bound[:, 2] == 0.0).all() and (error_bound[:2, 0] > error_bound[:2, 1]).all()

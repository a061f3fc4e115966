"""The filter follows the turning of Hill's frame of its model."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import drift, step
from inspection.model.orbit import closest_times, free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, P, Q, V
from rta.filter import SafetyFilter
from rta.lie_derivatives import lie_derivative
from rta.limits import PARTS
from rta.paper import hocbf
from rta.parameters import RtaParameters

C = InspectionParameters(hill_rotation=True)
DT = 0.02  # s


def later(x: Tensor, seconds: float) -> Tensor:
    """Returns states (16, B) with the body turned in an inertial frame; all else by the model."""
    after = step(x, torch.zeros_like(x[:CONTROL_SIZE]), seconds, C)
    sun = Rotation.from_euler("z", (after[THETA_S] - x[THETA_S])[:, None])
    turned = sun * Rotation.from_quat(x[Q].T) * Rotation.from_rotvec(seconds * x[OMEGA].T)
    after[Q] = torch.from_numpy(turned.as_quat().T)
    return after


def test_every_h_changes_as_its_lie_derivative_says(random_states) -> None:
    """Of relative degree one, and the Psi_1 of the others; passive safety at the times of its closest passes."""
    safety, x = SafetyFilter(C, RtaParameters(filter="paper")), random_states(12)
    x[V] *= 3.0
    edges = tuple(C.passive_safety_horizon * i / PARTS for i in range(PARTS + 1))
    times = closest_times(x, edges, C)

    def barriers(y: Tensor) -> Tensor:
        found = [hocbf(limit, C)(y) for name, limit in safety.limits.items() if name != "passive_safety"]
        return torch.stack([*found, norm(free_flight(y[P], y[V], times, C.mean_motion)).amin(0)])

    _, rate = lie_derivative(barriers, x, drift(x, C))
    before, after = (barriers(later(x, side * DT)) for side in (-1, 1))
    np.testing.assert_allclose(rate, (after - before) / (2 * DT), rtol=2e-5, atol=2e-7)
    paper = InspectionParameters()
    assert (rate - lie_derivative(barriers, x, drift(x, paper))[1]).abs().max() > 1e-5  # the omitted part

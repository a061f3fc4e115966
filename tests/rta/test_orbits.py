"""The filter follows the orbit and the turning of Hill's frame of its model."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import drift, step
from inspection.model.orbit import closest_times, coast
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, THETA_S, P, Q, V
from rta.fast.filter import batched
from rta.filter import SafetyFilter
from rta.lie_derivatives import lie_derivative
from rta.limits import PARTS
from rta.paper import hocbf
from rta.parameters import RtaParameters
from study.verification.adversaries import adversarial
from study.verification.starts import safe_set
from tests.inspection.model.test_orbit import flown

ORBITS = [
    InspectionParameters(hill_rotation=True),
    InspectionParameters(orbit="two-body", hill_rotation=True),
    InspectionParameters(orbit="two-body", eccentricity=0.2, sun_from_perigee=2.0, hill_rotation=True),
]
DT = 0.02  # s


def later(x: Tensor, c: InspectionParameters, seconds: float) -> Tensor:
    """States (16, B) by gravity in an inertial frame and the body turned there; temperature and energy by the model."""
    after = step(x, torch.zeros_like(x[:CONTROL_SIZE]), seconds, c)
    if c.orbit == "clohessy-wiltshire":
        return after
    for i in range(x.shape[1]):
        one = x[:, i].numpy()
        p, v, sun = flown(one, c, seconds)
        turned = (
            Rotation.from_euler("z", sun)
            * Rotation.from_euler("z", -one[THETA_S])
            * Rotation.from_quat(one[Q])
            * Rotation.from_rotvec(seconds * one[OMEGA])
        )
        after[P, i], after[V, i] = torch.from_numpy(p), torch.from_numpy(v)
        after[Q, i], after[THETA_S, i] = torch.from_numpy(turned.as_quat()), sun
    return after


@pytest.mark.parametrize("c", ORBITS, ids=["turning", "two-body", "eccentric"])
def test_every_h_changes_as_its_lie_derivative_says(c: InspectionParameters, random_states) -> None:
    """Of relative degree one, and the Psi_1 of the others; passive safety at the times of its closest passes."""
    safety, x = SafetyFilter(c, RtaParameters(filter="paper")), random_states(12)
    x[V] *= 3.0
    edges = tuple(c.passive_safety_horizon * i / PARTS for i in range(PARTS + 1))
    times = closest_times(x, edges, c)

    def barriers(y: Tensor) -> Tensor:
        found = [hocbf(limit, c)(y) for name, limit in safety.limits.items() if name != "passive_safety"]
        return torch.stack([*found, norm(coast(y, times, c)).amin(0)])

    _, rate = lie_derivative(barriers, x, drift(x, c))
    before, after = (barriers(later(x, c, side * DT)) for side in (-1, 1))
    np.testing.assert_allclose(rate, (after - before) / (2 * DT), rtol=2e-5, atol=2e-7)
    paper = InspectionParameters()
    assert (rate - lie_derivative(barriers, x, drift(x, paper))[1]).abs().max() > 1e-5  # what it leaves out


@pytest.mark.campaign
@pytest.mark.parametrize("c", ORBITS, ids=["turning", "two-body", "eccentric"])
def test_proposals_alone_hardly_break_a_limit_in_half_a_minute(
    c: InspectionParameters,
) -> None:
    """No check is known of these orbits: what a hold of 1 s does between two calls is all that breaks one."""
    safety = batched(SafetyFilter(c, RtaParameters(unverified=True)))
    x, _, _ = safe_set(48, 1, safety)
    adversary, random = adversarial(safety), torch.Generator().manual_seed(0)
    limit = x.new_tensor(c.control_limit)[:, None]
    desired = torch.zeros_like(x[:CONTROL_SIZE])
    smallest = math.inf
    for t in range(30):
        if t % 5 == 0:
            desired = limit * (2.0 * torch.rand(desired.shape, generator=random, dtype=x.dtype) - 1.0)
            desired[:, ::2] = adversary(float(t), x)[:, ::2]
        x = step(x, safety.correct(x, desired).control, 1.0, c)
        smallest = min(smallest, safety.values(x).min().item())
    assert smallest >= -0.02

"""Worlds at their corners: at which ends the errors are, for how long, and that whoever chooses them is obeyed."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from inspection.model.state import OMEGA, THRUST, TORQUE, Q
from inspection.world.corners import CORNER, ERRORS, GAINS, LONGEST_END, MISSED, Recorded
from inspection.world.parameters import PlantParameters
from tests.inspection.model.test_dynamics import MASS, UNEQUAL, N
from tests.inspection.world.test_plant import begun, error_of, moments, states

NOISY = {
    "position_noise": (0.1, 0.2),
    "position_bias": 0.5,
    "velocity_noise": 0.002,
    "attitude_noise": 0.1,
    "attitude_bias": (0.0, 0.2),
    "rate_noise": 0.01,
    "noise_bound": 2.0,
}
BOUNDS = np.repeat([0.9, 0.004, math.radians(0.4), math.radians(0.02)], 3)  # the largest bias + 2 sigma


def test_a_steady_error_is_at_a_corner_of_its_bounds_for_the_whole_episode() -> None:
    plant, (x, _) = begun(PlantParameters(errors="steady", **NOISY), 400), states(400)
    first = error_of(plant, x, 0.0)
    np.testing.assert_allclose(np.abs(first), np.repeat(BOUNDS[:, None], 400, 1), rtol=1e-9)
    for time in (1.0, 7.0, 1999.0):
        np.testing.assert_allclose(error_of(plant, x, time), first, rtol=1e-9)
    signs = np.sign(first)
    assert np.abs(signs.mean(1)).max() < 0.2  # each end as often
    assert np.abs(np.corrcoef(signs) - np.eye(12)).max() < 0.2  # whatever the others are at


def test_the_error_of_a_gyros_rate_is_of_the_rate_that_is_seen_and_no_larger() -> None:
    plant, (x, _) = begun(PlantParameters(errors="steady", hill_rotation=True, **NOISY), 50), states(50)
    seen = plant.sense(moments(50), x)
    frame = Rotation.from_quat(x[Q].T.numpy()).inv().apply([0.0, 0.0, N]).T
    np.testing.assert_allclose(np.abs(seen[OMEGA].numpy() - (x[OMEGA].numpy() - frame)), BOUNDS[9], rtol=1e-9)


@pytest.mark.parametrize("errors", ["steady", "worst"])
def test_an_episodes_body_is_at_a_corner_and_so_are_its_gains(errors: str) -> None:
    parameters = PlantParameters(
        errors=errors,
        mass_factor=(0.9, 1.1),
        inertia_factor=(0.9, 1.1),
        acceleration=(0.0, 1e-3),
        thrust_gain=(0.8, 1.3),
        torque_gain=(0.5, 1.5),
        thrust_misalignment=(0.0, 2.0),
        latency=(1, 4),
    )
    plant, (x, _) = begun(parameters, 200), states(200)
    body = plant.body.numpy()
    for row, model in enumerate((MASS, *UNEQUAL)):
        ends, counts = np.unique((body[row] / model).round(12), return_counts=True)
        assert ends.tolist() == [0.9, 1.1] and counts.min() > 70
    np.testing.assert_allclose(np.linalg.norm(body[4:], axis=0), 1e-3, rtol=1e-12)
    assert set(plant.drawn.latency.tolist()) == {1, 4}
    gains = []
    for time in range(0, 200, 10):
        plant.sense(moments(200, float(time)), x.clone())
        acting = plant.actuate(moments(200, float(time)), torch.ones(6, 200, dtype=torch.float64))
        gains.append(acting[TORQUE].numpy())
        alone = torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=torch.float64)[:, None].expand(-1, 200)
        thrust = plant.actuate(moments(200, float(time)), alone)[THRUST]
        assert set(thrust.norm(dim=0).numpy().round(12)) == {0.8, 1.3}
        np.testing.assert_allclose(thrust[0] / thrust.norm(dim=0), math.cos(math.radians(2.0)))
    assert set(np.unique(np.round(gains, 12))) == {0.5, 1.5}
    assert (np.ptp(gains, axis=0) > 0).any() == (errors == "worst")


def test_the_worst_by_chance_is_at_corners_that_last_up_to_a_minute() -> None:
    plant, (x, _) = begun(PlantParameters(errors="worst", **NOISY), 60), states(60)
    signs = np.stack([np.sign(error_of(plant, x, float(t))) for t in range(300)])
    np.testing.assert_allclose(
        np.abs(error_of(plant, x, 300.0)), np.repeat(BOUNDS[:, None], 60, 1), rtol=1e-9
    )
    assert np.abs(signs.mean(0)).max() <= 1.0 and np.abs(signs.mean()) < 0.05
    changes = (np.diff(signs, axis=0) != 0).sum(0).ravel()  # half of the times that an end is drawn anew
    assert 0.5 * 300 / LONGEST_END < np.median(changes) < 2.5 * 300 / LONGEST_END


def test_who_chooses_the_corner_is_obeyed_and_a_call_is_missed_where_the_world_may_miss_it() -> None:
    parameters = PlantParameters(
        errors="worst",
        position_noise=0.2,
        thrust_gain=(0.5, 1.5),
        torque_gain=(0.8, 1.2),
        missed_calls=0.01,
        missed_in_a_row=2,
    )
    plant, (x, _) = begun(parameters, 30), states(30)
    corners = torch.rand(8, CORNER, 30, generator=torch.Generator().manual_seed(1)) < 0.5
    corners[:, MISSED] = True
    plant.adversary = Recorded(corners, 1.0)
    for call, corner in enumerate(corners):
        time, u = moments(30, float(call)), torch.full((6, 30), call + 1.0, dtype=torch.float64)
        error = error_of(plant, x, float(call))[:3]
        np.testing.assert_allclose(error, np.where(corner[ERRORS][:3], 0.6, -0.6), rtol=1e-9)
        held, missed = plant.hold(time, u)
        assert missed.all() == missed.any() == (call % 3 != 0)  # the first is made, and every third
        assert (held == 3 * (call // 3) + 1).all()
        upper = np.repeat([1.5, 1.2], 3)[:, None], np.repeat([0.5, 0.8], 3)[:, None]
        np.testing.assert_allclose(plant.actuate(time, held), held.numpy() * np.where(corner[GAINS], *upper))
    never = begun(PlantParameters(errors="worst", mass_factor=1.1), 30)
    never.adversary = Recorded(corners, 1.0)
    for call in range(8):
        never.sense(moments(30, float(call)), x.clone())
        assert not never.hold(moments(30, float(call)), u)[1].any()

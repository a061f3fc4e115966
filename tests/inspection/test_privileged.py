"""What the critic alone is shown: sums worked out point by point, and an agent that does not depend on it."""

import math

import pytest
import torch

from inspection.environment import InspectionEnv
from inspection.model.attitude import rotate
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import THETA_S
from inspection.privileged import HARMONICS, PRIVILEGED, privileged
from ppo.network import Policy

C = InspectionParameters()


def environment(chief: ChiefParameters | None = None, shown: bool = True) -> InspectionEnv:
    """Returns four episodes that have flown a while."""
    env = InspectionEnv(4, C, [torch.Generator().manual_seed(5)], target=chief, privileged=shown)
    env.reset()
    for _ in range(20):
        env.step(torch.full((4, 6), 0.2))
    return env


@pytest.mark.parametrize("turns", [False, True])
def test_moments_are_sums_over_the_points_left_in_a_frame_that_faces_the_sun(turns: bool) -> None:
    env = environment(ChiefParameters(rate=(1.0, 2.0, 0.5)) if turns else None)
    shown = privileged(env.x, *env.sight.left(), env.time, C)
    assert shown.shape == (PRIVILEGED, 4)
    for column in range(4):
        theta, left = env.x[THETA_S, column].item(), [0.0] * (3 + 2 * HARMONICS)
        for n in range(C.num_points):
            if env.sight.inspected[n, column]:
                continue
            point = env.sight.surface.points[:, n : n + 1]
            if env.sight.tumbling:
                point = rotate(env.sight.tumbling.attitude[:, column : column + 1], point)
            x, y, z = point.flatten().tolist()
            w, phi = env.sight.weights[n, column].item(), math.atan2(y, x) - theta
            height = z / math.hypot(x, y, z)
            waves = [w * wave(k * phi) for wave in (math.cos, math.sin) for k in range(1, HARMONICS + 1)]
            left = [a + b for a, b in zip(left, [w, *waves, w * height, w * height**2], strict=True)]
        assert shown[: len(left), column].tolist() == pytest.approx(left, abs=1e-12)
        assert left[0] == pytest.approx(1.0 - env.sight.score()[column].item())
    env.time += 10.0 * torch.arange(4.0)
    whole = env.observation()
    assert torch.equal(env.observation(columns=torch.tensor([2, 0])), whole[[2, 0]])
    assert whole[:, -3].tolist() == pytest.approx([(200.0 + 10.0 * k) / C.max_time for k in range(4)])


def test_the_critic_is_shown_the_true_state_where_sensors_err() -> None:
    env = environment()
    true, sensed = env.observation(), env.observation(seen=env.x + 0.1)
    assert torch.equal(true[:, -PRIVILEGED:], sensed[:, -PRIVILEGED:])
    assert not torch.allclose(true[:, :-PRIVILEGED], sensed[:, :-PRIVILEGED])


def test_it_follows_the_observation_and_the_agent_does_not_see_it() -> None:
    without, shown = environment(shown=False).observation(), environment().observation()
    size = without.shape[1]
    assert torch.equal(shown[:, :size], without) and shown.shape[1] == size + PRIVILEGED
    policy = Policy(size, 6, [torch.Generator().manual_seed(0)], (8,))
    other = torch.cat((without, torch.randn(4, PRIVILEGED)), 1)
    assert torch.equal(policy.mean_action(shown[None]), policy.mean_action(other[None]))
    assert torch.equal(policy.mean_action(shown[None]), policy.mean_action(without[None]))

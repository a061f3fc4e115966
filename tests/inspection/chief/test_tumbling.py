"""A chief that turns: against closed forms, an adaptive integrator, and what must stay."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from inspection.chief.tumbling import ATTITUDE, RATE, Tumbling
from inspection.environment import InspectionEnv
from inspection.model.attitude import rotate
from inspection.model.parameters import OBSERVABLE, OBSERVED, ChiefParameters, InspectionParameters
from inspection.model.state import SIZE, THETA_S, P, Q

C = InspectionParameters()
TRIAXIAL = ChiefParameters(rate=(0.3, 2.0, 0.1), moments=(1.0, 0.8, 0.5), attitude=(0.1, 0.2, 0.3, 0.9))


def started(chief: ChiefParameters, c: InspectionParameters = C, batch: int = 1) -> Tumbling:
    tumbling = Tumbling(chief, c, batch)
    number = torch.arange(batch).double() / max(1, batch)
    tumbling.begin(torch.arange(batch), number)
    return tumbling


@pytest.mark.parametrize("hill_rotation", [False, True])
def test_a_chief_tumbles_as_an_adaptive_integrator_has_it(hill_rotation: bool) -> None:
    c = InspectionParameters(hill_rotation=hill_rotation)
    tumbling = started(TRIAXIAL, c)
    for seconds in range(10, 510, 10):
        tumbling.at(torch.full((1,), seconds, dtype=torch.float64))
    motion = tumbling.motion[:, 0]
    moments, turning = np.array(TRIAXIAL.moments), c.mean_motion if hill_rotation else 0.0

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        q, w = y[:4] / np.linalg.norm(y[:4]), y[4:]
        relative = w - Rotation.from_quat(q).inv().apply([0.0, 0.0, turning])
        return np.concatenate(
            (product(q, np.array([*relative, 0.0])) / 2, np.cross(moments * w, w) / moments)
        )

    q0 = np.array(TRIAXIAL.attitude) / np.linalg.norm(TRIAXIAL.attitude)
    start = np.concatenate((q0, np.radians(TRIAXIAL.rate)))
    end = solve_ivp(rate, (0.0, 500.0), start, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    apart = Rotation.from_quat(motion[ATTITUDE].numpy()) * Rotation.from_quat(end[:4]).inv()
    assert apart.magnitude() < 1e-5  # rad
    np.testing.assert_allclose(motion[RATE], end[4:], atol=1e-8)


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton's, scalar last."""
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.array([*vector, p[3] * q[3] - p[:3] @ q[:3]])


def test_episodes_draw_their_own_chiefs_again_the_same() -> None:
    chief = ChiefParameters(random_attitude=True, largest_rate=2.0)
    motion = started(chief, batch=4000).motion
    assert torch.equal(motion, started(chief, batch=4000).motion)
    size = motion[RATE].norm(dim=0).rad2deg()
    assert size.min() > 0.0 and size.max() < 2.0 and abs(size.mean() - 1.0) < 0.05
    assert motion[ATTITUDE].norm(dim=0).allclose(torch.ones(4000).double())
    assert rotate(motion[ATTITUDE], torch.eye(3).double()[:, :1].expand(3, 4000)).mean(1).abs().max() < 0.05


def looking(
    chief: ChiefParameters, c: InspectionParameters = C, batch: int = 8, seed: int = 1
) -> InspectionEnv:
    env = InspectionEnv(batch, c, [torch.Generator().manual_seed(seed)], target=chief)
    env.reset()
    return env


def test_turning_the_whole_scene_changes_nothing_that_is_seen() -> None:
    """A chief turned by an attitude is seen from p as one that is not is seen from where p is in its frame."""
    about_z = ChiefParameters(attitude=(0.0, 0.0, math.sin(0.4), math.cos(0.4)))
    env, plain = looking(about_z), looking(ChiefParameters(attitude=(0.0, 0.0, 0.0, 2.0)))
    x = env.x.clone()
    back = torch.tensor([0.0, 0.0, -math.sin(0.4), math.cos(0.4)]).double()[:, None].expand(4, 8)
    x[P], x[THETA_S] = rotate(back, x[P]), x[THETA_S] - 0.8
    x[Q] = torch.stack([torch.from_numpy(product(back[:, i].numpy(), x[Q, i].numpy())) for i in range(8)], 1)
    plain.start(x, env.sight.priority)
    assert torch.equal(env.sight.inspected, plain.sight.inspected)
    torch.testing.assert_close(rotate(back, env.sight.uninspected), plain.sight.uninspected)
    torch.testing.assert_close(env.sight.score(), plain.sight.score())


def test_what_turns_past_the_camera_comes_to_be_inspected() -> None:
    """From a fixed place, in light from behind, a sphere that turns once shows nearly all; a fixed one half."""
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    x[0], x[9], x[14] = -60.0, 1.0, 6.0  # looks along +x from -60 m
    x[THETA_S] = math.pi
    seen = {}
    for name, rate in (("fixed", 0.0), ("turning", 1.0)):
        c = InspectionParameters(mean_motion=1e-9, max_time=400.0, success_score=1.0, substep=5.0)
        env = InspectionEnv(
            1,
            c,
            [torch.Generator().manual_seed(0)],
            target=ChiefParameters(rate=(0.0, 0.0, rate), attitude=(0.0, 0.0, 0.1, 1.0)),
        )
        env.start(x, torch.tensor([[1.0], [0.0], [0.0]]).double())
        for _ in range(38):
            transition = env.step(torch.zeros(1, 6))
        seen[name] = transition.inspected.float().mean().item()
    assert seen["fixed"] < 0.55 and seen["turning"] > 0.8


def test_the_agent_may_observe_how_the_chief_turns() -> None:
    """Its x and y axes and its rate, as the deputy's body has them."""
    chief = ChiefParameters(rate=(0.3, -0.5, 1.0), attitude=(0.1, 0.2, 0.5, 0.7))
    own = looking(chief, InspectionParameters(observed=(*OBSERVED, "chief")))
    assert own.observation().shape == (8, 26 + 9)
    to_hill = Rotation.from_quat(chief.attitude)
    rate = np.radians(chief.rate) / 0.035
    for i in range(8):
        to_body = Rotation.from_quat(own.x[Q, i].numpy()).inv() * to_hill
        expected = [to_body.apply(each) for each in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], rate)]
        np.testing.assert_allclose(own.observation()[i, 26:], np.concatenate(expected), atol=1e-6)
    assert "chief" in OBSERVABLE and own.step(torch.zeros(8, 6)).observation.shape == (8, 35)


def test_a_run_with_a_turning_chief_goes_on_bit_for_bit() -> None:
    chief = ChiefParameters(random_attitude=True, largest_rate=1.0)
    env, other = looking(chief), looking(chief, seed=7)
    for _ in range(3):
        env.step(torch.zeros(8, 6))
    assert not torch.equal(env.sight.tumbling.motion, other.sight.tumbling.motion)
    other.load_state_dict(env.state_dict())
    other.starts[0].generator.set_state(env.starts[0].generator.get_state())
    one, two = (each.step(torch.ones(8, 6)) for each in (env, other))
    assert torch.equal(one.observation, two.observation) and torch.equal(one.inspected, two.inspected)

"""The filter as a wrapper: its reports against direct calls, its flight against the simulator's."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

from inspection.environment import InspectionEnv
from interfaces.safety import RunTimeAssurance, VectorRunTimeAssurance
from rta.fast.filter import batched
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from settings import InputError
from study.config import Config

ID = "interfaces:Inspection6DoF-v0"
EPISODES, STEPS, SEED = 4, 6, 5
REPORTS = {"u_des", "u_safe", "intervened", "backup", "verified", "active", "status"}


@pytest.fixture
def short(c):
    """Episodes of 3 s in steps of 1 s, so that some steps are the last; a filter of 10 s unless told otherwise."""
    return Config(inspection=replace(c, action_period=1.0, max_time=3.0), rta=RtaParameters(period=10.0))


pytestmark = pytest.mark.usefixtures("small_pools")


def actions(*shape):
    return torch.rand(STEPS, *shape, generator=torch.Generator().manual_seed(2)) * 2.4 - 1.2


def direct_filter(config, period):
    return batched(SafetyFilter(config.inspection, replace(config.rta, period=period)))


def test_every_call_is_reported_as_the_filter_answers_it(c):
    config = Config(inspection=c)
    env = VectorRunTimeAssurance(gymnasium.make_vec(ID, num_envs=EPISODES, config=config), period=5.0)
    safety_filter, native = direct_filter(config, 5.0), env.unwrapped.simulator
    env.reset(seed=SEED)
    intervened = []
    for action in actions(EPISODES, 6)[:3]:
        action[2:] *= 0.01  # hardly a reason to intervene
        x = native.x
        *_, info = env.step(action)
        u = action.T.double().clamp(-1.0, 1.0) * native.limit
        for call in range(2):
            expected = safety_filter.correct(x, u)
            torch.testing.assert_close(info["u_des"][:, call], u.T, rtol=0.0, atol=0.0)
            torch.testing.assert_close(info["u_safe"][:, call], expected.control.T, rtol=0.0, atol=0.0)
            for name in ("intervened", "backup", "verified", "active", "status"):
                assert torch.equal(info[name][:, call], getattr(expected, name).movedim(-1, 0)), name
            u = expected.control
            x = native.integrate(x, u, 5)
        intervened.append(info["intervened"])
    seen = torch.stack(intervened)
    assert seen.any() and not seen.all()


@pytest.mark.parametrize("tensors", [pytest.param(False, marks=pytest.mark.campaign), True])
def test_the_flight_is_that_of_the_simulator_with_the_filter_in_its_loop(short, tensors):
    generator = torch.Generator().manual_seed(SEED)
    native = InspectionEnv(EPISODES, short.inspection, [generator], direct_filter(short, 1.0).safety())
    env = VectorRunTimeAssurance(gymnasium.make_vec(ID, num_envs=EPISODES, config=short), period=1.0)
    env.reset(seed=SEED)
    native.reset()
    ended = 0
    for action in actions(EPISODES, 6):
        expected = native.step(action)
        observation, reward, _, truncated, info = env.step(action if tensors else action.numpy())
        np.testing.assert_array_equal(observation, expected.observation)
        np.testing.assert_array_equal(reward, expected.reward)
        np.testing.assert_array_equal(info["u_safe"][:, 0], expected.corrections[0].control.T)
        assert set(info) >= REPORTS and isinstance(info["active"], torch.Tensor if tensors else np.ndarray)
        assert ("final_info" in info) == bool(truncated.any())
        if truncated.any():
            ended += 1
            np.testing.assert_array_equal(info["final_info"]["u_safe"], info["u_safe"])
    assert ended == 2


def test_the_single_form_reports_without_the_batchs_axis():
    env = RunTimeAssurance(gymnasium.make(ID))  # at 1 s, as the configuration has it
    observation, _ = env.reset(seed=SEED)
    assert observation.shape == (26,)
    action = actions(6)[0].numpy()
    *_, info = env.step(action)
    assert info["u_des"].shape == info["u_safe"].shape == (10, 6)
    assert info["active"].shape == (10, len(CONSTRAINTS))
    for name in ("intervened", "backup", "verified", "status"):
        assert info[name].shape == (10,)
    again = gymnasium.make(env.spec)
    again.reset(seed=SEED)
    *_, repeated = again.step(action)
    np.testing.assert_array_equal(repeated["u_safe"], info["u_safe"])


def test_what_cannot_be_filtered_is_refused():
    env = gymnasium.make_vec(ID)
    with pytest.raises(InputError, match=r"\[rta\] period = 2.0: must be 1, 5 or 10 \(s"):
        VectorRunTimeAssurance(env, period=2.0)
    env.reset()
    filtered = VectorRunTimeAssurance(env)
    with pytest.raises(gymnasium.error.ResetNeeded):
        filtered.step(np.zeros((1, 6)))
    with pytest.raises(ValueError, match="behind a filter already"):
        VectorRunTimeAssurance(filtered)
    with pytest.raises(TypeError, match="CartPoleVectorEnv: must be a VectorInspection6DoF"):
        VectorRunTimeAssurance(gymnasium.make_vec("CartPole-v1"))
    with pytest.raises(TypeError, match="CartPoleEnv: must be an Inspection6DoF"):
        RunTimeAssurance(gymnasium.make("CartPole-v1"))

"""Stable-Baselines3's PPO trains on the vector environment."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip(
    "stable_baselines3",
    reason="Stable-Baselines3 is not installed: python -m pip install -r requirements-optional.txt",
)

from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from interfaces import RunTimeAssurance, VectorRunTimeAssurance
from interfaces.stable_baselines import StableBaselinesEnv
from settings import InputError
from study.config import Config

ID = "interfaces:Inspection6DoF-v0"


@pytest.mark.campaign
def test_ppo_trains_for_20000_steps():
    env = StableBaselinesEnv(gymnasium.make_vec(ID, num_envs=200))
    learner = PPO("MlpPolicy", env, n_steps=20, batch_size=1000, n_epochs=5, seed=0, device="cpu")
    before = [weight.clone() for weight in learner.policy.parameters()]
    learner.learn(20_000)
    assert learner.num_timesteps == 20_000
    after = list(learner.policy.parameters())
    assert all(weight.isfinite().all() for weight in after)
    assert not any(torch.equal(*pair) for pair in zip(before, after, strict=True))
    episodes = learner.ep_info_buffer
    assert len(episodes) == 100 and all(np.isfinite(episode["r"]) for episode in episodes)


def test_ends_are_told_as_stable_baselines_wants_them(c):
    config = Config(inspection=replace(c, max_time=30.0, success_score=0.05))
    env, ours = (gymnasium.make_vec(ID, num_envs=20, config=config) for _ in range(2))
    theirs = StableBaselinesEnv(env)
    theirs.seed(3)
    np.testing.assert_array_equal(theirs.reset(), ours.reset(seed=3)[0])
    ended = set()
    for _ in range(3):
        actions = ours.action_space.sample()
        observation, reward, done, infos = theirs.step(actions)
        expected, expected_reward, terminated, truncated, info = ours.step(actions)
        np.testing.assert_array_equal(observation, expected)
        np.testing.assert_array_equal(reward, expected_reward)
        np.testing.assert_array_equal(done, terminated | truncated)
        assert ["terminal_observation" in info for info in infos] == done.tolist()
        assert ["episode" in info for info in infos] == done.tolist()
        for i, own in enumerate(infos):
            assert own["cost"] == info["cost"][i] and own["outcome"] == info["outcome"][i]
            assert own["h"] == {name: values[i] for name, values in info["h"].items()}
            np.testing.assert_array_equal(own["violated"], info["violated"][i])
            assert not any("final_" in name for name in own)
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
            assert infos[i]["episode"]["r"] == info["final_info"]["episode"]["r"][i]
            ended.add(bool(truncated[i]))
    assert ended == {False, True}


@pytest.fixture
def env():
    """Returns four episodes of three steps with the filter, in a wrapper."""
    batch = VectorRunTimeAssurance(gymnasium.make_vec(ID, num_envs=4, max_episode_steps=3), period=10.0)
    return StableBaselinesEnv(RecordEpisodeStatistics(batch))


def test_the_filters_reports_reach_every_info(env):
    env.reset()
    *_, infos = env.step(np.ones((4, 6)))
    for info in infos:
        assert info["u_safe"].shape == (1, 6)
        for name in ("intervened", "backup", "verified"):
            assert info[name].shape == (1,) and info[name].dtype == bool


def start(env, seed):
    """Returns states (4, 16) and priority vectors (4, 3)."""
    env.env.reset(seed=seed)
    simulator = env.env.unwrapped.simulator
    return simulator.x.T.numpy().copy(), simulator.sight.priority.T.numpy().copy()


def test_options_are_the_starts_of_the_next_reset(env):
    x, priority = start(env, 1)
    simulator = env.env.unwrapped.simulator
    env.set_options([{"state": own, "priority": other} for own, other in zip(x, priority, strict=True)])
    env.reset()
    np.testing.assert_allclose(simulator.x.T, x, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(simulator.sight.priority.T, priority, rtol=0.0, atol=1e-15)
    env.reset()
    assert not np.isclose(simulator.x.T, x).all(1).any()
    env.set_options({"state": x[2]})
    env.reset()
    np.testing.assert_allclose(simulator.x.T, x[[2] * 4], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([{}] * 3, "set_options: 3 of them: must be one, or 4"),
        ({"reset_mask": np.ones(4, dtype=bool)}, "unknown 'reset_mask'; allowed are state, priority"),
        ({"state": np.zeros((4, 16))}, r"state of episode 0 has shape \(4, 16\): must be \(16,\)"),
        ([{}, {}, {"state": np.full(16, np.nan)}, {}], "state in row 2: must be finite"),
    ],
)
def test_wrong_options_are_refused(env, options, message):
    env.set_options(options)
    with pytest.raises(InputError, match=message):
        env.reset()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("behind_filter", [False, True])
def test_stable_baselines_finds_nothing_to_complain_about(behind_filter):
    single = gymnasium.make(ID)
    check_env(RunTimeAssurance(single, period=10.0) if behind_filter else single)


def test_only_an_episode_that_ends_has_an_episode_in_its_info() -> None:
    """Behind Gymnasium's statistics, too, whose entries are masked: SB3 would count the others as ended with 0."""
    inner = gymnasium.make_vec(ID, num_envs=2, max_episode_steps=2)
    env = StableBaselinesEnv(gymnasium.wrappers.vector.RecordEpisodeStatistics(inner))
    env.reset()
    actions = np.zeros((2, 6), dtype=np.float32)
    env.step(actions)
    inner.reset(options={"reset_mask": np.array([True, False])})  # the other one ends first
    _, _, done, infos = env.step(actions)
    assert done.tolist() == [False, True]
    assert ["episode" in info for info in infos] == [False, True]
    assert not any(name.startswith("_") for info in infos for name in info)

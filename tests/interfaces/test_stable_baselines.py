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

from stable_baselines3 import PPO

from interfaces.stable_baselines import StableBaselinesEnv
from study.config import Config

ID = "interfaces:Inspection6DoF-v0"


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
        assert [bool(info) for info in infos] == done.tolist()
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])
            assert infos[i]["TimeLimit.truncated"] == truncated[i]
            assert infos[i]["episode"]["r"] == info["final_info"]["episode"]["r"][i]
            ended.add(bool(truncated[i]))
    assert ended == {False, True}


def test_an_environment_of_tensors_is_refused():
    with pytest.raises(ValueError, match="tensors=True"):
        StableBaselinesEnv(gymnasium.make_vec(ID, num_envs=2, tensors=True))

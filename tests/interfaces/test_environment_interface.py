"""Inspection6DoF-v0: Gymnasium's own check, and the same numbers as the simulator's, step by step."""

import math
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import interfaces
from inspection.environment import InspectionEnv
from inspection.reward import REWARDS
from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from settings import InputError
from study.config import Config

gymnasium.register_envs(interfaces)
ID = "interfaces:Inspection6DoF-v0"
EPISODES, STEPS, SEED = 5, 12, 7
pytestmark = pytest.mark.usefixtures("small_pools")


@pytest.fixture
def short(c):
    """Episodes of 50 s, which succeed as soon as a few points were seen."""
    return Config(inspection=replace(c, max_time=50.0, success_score=0.05))


def simulator(config, episodes):
    """Returns the simulator that the interface should agree with."""
    safety = SafetyFilter(config.inspection, config.rta).safety(enabled=False)
    return InspectionEnv(episodes, config.inspection, [torch.Generator().manual_seed(SEED)], safety)


def actions(*shape):
    return torch.rand(STEPS, *shape, generator=torch.Generator().manual_seed(1)) * 2.0 - 1.0


def leaves(value):
    """Returns every array of a nested dictionary."""
    return [leaf for part in value.values() for leaf in leaves(part)] if isinstance(value, dict) else [value]


def test_gymnasium_finds_nothing_to_complain_about():
    env = gymnasium.make(ID)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert [str(warning.message) for warning in caught] == []


@pytest.mark.parametrize("tensors", [False, True])
def test_the_vector_form_has_the_simulators_numbers_in_the_kind_of_the_actions(short, tensors):
    native = simulator(short, EPISODES)
    env = gymnasium.make_vec(ID, num_envs=EPISODES, config=short, tensors=tensors)
    kind, ended, costs = torch.Tensor if tensors else np.ndarray, set(), set()
    safety = SafetyFilter(short.inspection, short.rta).safety(enabled=False)

    def check(found, expected):
        assert isinstance(found, kind)
        np.testing.assert_array_equal(found, expected)

    check(env.reset(seed=SEED)[0], native.reset())
    for action in actions(EPISODES, 6):
        expected = native.step(action)
        observation, reward, terminated, truncated, info = env.step(action if tensors else action.numpy())
        check(observation, expected.observation)
        check(reward, expected.reward)
        check(terminated, expected.terminated)
        check(truncated, expected.truncated)
        check(info["violated"], expected.violated.T)
        check(info["cost"], expected.violated.any(0))
        assert info["cost"].dtype in (torch.float32, np.float32)
        values = safety.values(expected.state)
        assert tuple(info["h"]) == CONSTRAINTS
        for i, name in enumerate(CONSTRAINTS):
            check(info["h"][name], values[i])
        costs |= set(info["cost"].tolist())
        check(info["outcome"], expected.outcome)
        for i, name in enumerate(METRICS):
            check(info["metrics"][name], expected.metrics[i])
        for name in REWARDS:
            check(info["reward_terms"][name], expected.reward_terms[name])
        assert ("final_obs" in info) == ("final_info" in info) == bool(expected.done.any())
        if expected.done.any():
            check(info["final_obs"], expected.final_observation)
            check(info["_final_obs"], expected.done)
            check(info["_final_info"], expected.done)
            check(info["final_info"]["outcome"], expected.outcome)
            check(info["final_info"]["cost"], expected.violated.any(0))
            check(info["final_info"]["episode"]["r"], expected.metrics[1])
            check(info["final_info"]["episode"]["l"], expected.steps)
            assert not np.array_equal(info["final_obs"], observation)
        assert all(isinstance(leaf, kind) for leaf in leaves(info))
        ended |= {OUTCOMES[i] for i in expected.outcome.tolist() if i >= 0}
    assert ended == {"success", "timeout"} and costs == {0.0, 1.0}


def test_the_single_form_has_the_simulators_numbers(short):
    native, env, lengths = simulator(short, 1), gymnasium.make(ID, config=short), []
    np.testing.assert_array_equal(env.reset(seed=SEED)[0], native.reset()[0])
    for action in actions(1, 6):
        expected = native.step(action)
        observation, reward, terminated, truncated, info = env.step(action[0].numpy())
        np.testing.assert_array_equal(observation, expected.final_observation[0])
        assert (reward, terminated, truncated) == (expected.reward, expected.terminated, expected.truncated)
        assert info["metrics"] == dict(zip(METRICS, expected.metrics[:, 0].tolist(), strict=True))
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)
        assert info["violated"].shape == (13,) and "final_obs" not in info
        assert info["h"] == dict(zip(CONSTRAINTS, expected.h[:, 0].tolist(), strict=True))
        assert info["cost"] == float(min(info["h"].values()) < 0.0) and info["cost"].dtype == np.float32
        if terminated or truncated:
            lengths.append(expected.steps.item())
            assert OUTCOMES[info["outcome"]] == ("timeout" if truncated else "success")
            np.testing.assert_array_equal(env.reset()[0], native.reset()[0])
    assert 5 in lengths


def test_every_form_is_truncated_alike():
    options = {"num_envs": 2, "max_episode_steps": 3}
    forms = [gymnasium.make_vec(ID, **options), gymnasium.make_vec(ID, vectorization_mode="sync", **options)]
    for env in forms:
        env.reset(seed=SEED)
        assert [env.step(np.zeros((2, 6)))[3].tolist() for _ in range(2)] == [[False] * 2] * 2
        *_, truncated, info = env.step(np.zeros((2, 6)))
        assert truncated.all() and info["metrics"]["episode_length_s"].tolist() == [30.0, 30.0]
    env = gymnasium.make(ID, max_episode_steps=3)
    env.reset(seed=SEED)
    assert [env.step(np.zeros(6))[3] for _ in range(3)] == [False, False, True]
    again = gymnasium.make_vec(forms[0].spec)  # as Gymnasium recorded it
    assert again.num_envs == 2 and again.config == forms[0].config


def test_a_seed_decides_the_draws_and_without_one_they_differ():
    one, other = (gymnasium.make_vec(ID, num_envs=2) for _ in range(2))
    assert not np.array_equal(one.reset()[0], other.reset()[0])
    draws = [[env.reset(seed=3)[0], env.reset()[0], env.reset(seed=3)[0]] for env in (one, other)]
    np.testing.assert_array_equal(draws[0], draws[1])
    np.testing.assert_array_equal(draws[0][0], draws[0][2])
    assert not np.array_equal(draws[0][0], draws[0][1])
    one.action_space.seed(4), other.action_space.seed(4)
    np.testing.assert_array_equal(one.action_space.sample(), other.action_space.sample())


def test_gymnasiums_statistics_and_lists_agree_with_the_info(short):
    env = RecordEpisodeStatistics(gymnasium.make_vec(ID, num_envs=EPISODES, config=short))
    env.reset(seed=SEED)
    for action in actions(EPISODES, 6):
        *_, info = env.step(action.numpy())
        if "_episode" in info:
            own = info["final_info"]["episode"]
            done = info["_episode"]
            np.testing.assert_array_equal(info["episode"]["l"][done], own["l"][done])
            np.testing.assert_allclose(info["episode"]["r"][done], own["r"][done], rtol=1e-12)
    listed = DictInfoToList(gymnasium.make_vec(ID, num_envs=2, config=short))
    listed.reset(seed=SEED)
    *_, infos = listed.step(np.zeros((2, 6)))
    assert [set(info["metrics"]) for info in infos] == [set(METRICS)] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs = 0: must be an integer, positive and at most"),
        ({"device": "gpu"}, "device = 'gpu': must be auto, cpu or cuda"),
        ({"compile": "on"}, "compile = 'on': must be true or false"),
        ({"config": "no/such.toml"}, "no/such.toml: cannot read the configuration"),
        ({"max_episode_steps": -2}, "max_episode_steps = -2: must be positive, or -1 for no limit"),
        ({"max_episode_steps": 2.5}, "max_episode_steps = 2.5: must be an integer"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(InputError, match=message):
        gymnasium.make_vec(ID, **options)


def test_wrong_actions_and_the_wrong_order_are_refused(short):
    env = gymnasium.make_vec(ID, num_envs=2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 6)))
    env.reset()
    with pytest.raises(ValueError, match=r"shape \(2, 5\): must be \(2, 6\)"):
        env.step(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="NaN or infinity"):
        env.step(np.full((2, 6), math.nan))
    single = gymnasium.make(ID, config=short).unwrapped
    single.reset()
    while single.running:
        single.step(np.zeros(6))
    with pytest.raises(gymnasium.error.ResetNeeded):
        single.step(np.zeros(6))

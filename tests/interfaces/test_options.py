"""The options of `reset`: whom they reach, what they leave alone, and what is refused."""

import math

import gymnasium
import numpy as np
import pytest
import torch

from inspection.model.state import Q, V
from interfaces import RunTimeAssurance, VectorRunTimeAssurance
from settings import InputError, load
from study.config import Config
from study.files import ROOT
from tests.support.states import at_rest

ID = "interfaces:Inspection6DoF-v0"
EPISODES, SEED = 3, 11
MIDDLE = np.array([False, True, False])
OTHERS = [0, 2]

pytestmark = pytest.mark.usefixtures("small_pools")


def start(count=EPISODES):
    """Returns states (count, 16) and priority unit vectors (count, 3) within every limit, no two alike."""
    x = at_rest().T.repeat(count, 1).numpy()
    x[:, 0] -= 5.0 * np.arange(count)
    return x, np.eye(3)[:count]


def made(behind_filter=False, **options):
    env = gymnasium.make_vec(ID, num_envs=EPISODES, **options)
    return VectorRunTimeAssurance(env, period=10.0) if behind_filter else env


def flown(env, steps=2):
    return [env.step(np.full((EPISODES, 6), 0.1))[0] for _ in range(steps)]


@pytest.mark.parametrize(
    ("behind_filter", "config"), [(False, None), (True, None), (False, "configs/plants/typical.toml")]
)
def test_only_the_episodes_of_the_mask_begin_anew(behind_filter, config):
    env, untouched = (made(behind_filter, config=config and str(ROOT / config)) for _ in range(2))
    for each in (env, untouched):
        each.reset(seed=SEED)
        before = flown(each)[-1]
    options = {"reset_mask": MIDDLE}
    after, info = env.reset(options=options)
    assert options == {"reset_mask": MIDDLE} and info == {}
    assert not np.array_equal(after[1], before[1])
    np.testing.assert_array_equal(after[OTHERS], before[OTHERS])
    for ours, theirs in zip(flown(env), flown(untouched), strict=True):
        assert not np.array_equal(ours[1], theirs[1])
        np.testing.assert_array_equal(ours[OTHERS], theirs[OTHERS])
    simulator, other = env.unwrapped.simulator, untouched.unwrapped.simulator
    assert simulator.time.tolist() == [40.0, 20.0, 40.0] and simulator.steps.tolist() == [4, 2, 4]
    for name in simulator.sight.STATE:
        ours, theirs = getattr(simulator.sight, name), getattr(other.sight, name)
        assert torch.equal(ours[..., OTHERS], theirs[..., OTHERS]), name


@pytest.mark.parametrize("behind_filter", [False, True])
def test_given_starts_are_flown_from(behind_filter):
    x, priority = start()
    env = made(behind_filter)
    one = {"state": torch.from_numpy(x[0]), "priority": priority[0].tolist()}
    for options, rows in (({"state": x, "priority": 3.0 * priority}, [0, 1, 2]), (one, [0, 0, 0])):
        env.reset(options=options)
        simulator = env.unwrapped.simulator
        np.testing.assert_allclose(simulator.x.T, x[rows], rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(simulator.sight.priority.T, priority[rows], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("name", ["state", "priority"])
def test_what_is_not_given_is_drawn_as_ever(name):
    config = load(ROOT / "configs/plants/typical.toml", Config())
    x, priority = start()
    env, drawn = made(config=config), made(config=config)
    env.reset(seed=SEED, options={name: {"state": x, "priority": priority}[name]})
    drawn.reset(seed=SEED)
    ours, theirs = env.unwrapped.simulator, drawn.unwrapped.simulator
    assert torch.equal(ours.x, theirs.x) == (name != "state")
    assert torch.equal(ours.sight.priority, theirs.sight.priority) == (name != "priority")
    assert torch.equal(ours.plant.body, theirs.plant.body)
    np.testing.assert_array_equal(env.reset()[0], drawn.reset()[0])


def test_the_single_form_takes_a_start_behind_the_filter_too():
    x, priority = start(1)
    for env in (gymnasium.make(ID), RunTimeAssurance(gymnasium.make(ID), period=10.0)):
        env.reset(options={"state": x[0], "priority": priority[0]})
        simulator = env.unwrapped.batch.unwrapped.simulator
        np.testing.assert_allclose(simulator.x[:, 0], x[0], rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(simulator.sight.priority[:, 0], priority[0], rtol=0.0, atol=1e-15)
        with pytest.raises(InputError, match="unknown 'reset_mask'; allowed are state, priority"):
            env.reset(options={"reset_mask": np.array([True])})


def test_gymnasiums_own_vector_forms_pass_them_on():
    x, _ = start(1)
    x[:, V] = 0.0
    env = gymnasium.make_vec(ID, num_envs=EPISODES, vectorization_mode="async")
    alike = env.reset(seed=SEED, options={"state": x[0]})[0]
    before = flown(env, 1)[0]
    after = env.reset(options={"state": x[0], "reset_mask": MIDDLE})[0]
    np.testing.assert_array_equal(after[OTHERS], before[OTHERS])
    state = [i for i in range(26) if (alike[:, i] == alike[0, i]).all()]  # the rest is the priority vector's
    assert len(state) > 15
    np.testing.assert_array_equal(after[1, state], alike[0, state])
    env.close()


def test_a_start_that_the_filter_does_not_accept_is_flown_unverified():
    x, _ = start()
    x[0, V] = [5.0, 0.0, 0.0]  # beyond the speed limit
    env = made(behind_filter=True)
    safety = env.unwrapped.experiment.safety
    assert safety.is_safe(torch.from_numpy(x.T)).tolist() == [False, True, True]
    env.reset(options={"state": x})
    assert env.unwrapped.simulator.x[V.start].tolist() == x[:, V.start].tolist()
    *_, info = env.step(np.zeros((EPISODES, 6)))
    assert info["violated"].any(1).tolist() == [True, False, False]


def spoilt(part, value, row=1):
    x, _ = start()
    x[row, part] = value
    return x


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], r"options = \[\]: must be a dictionary of reset_mask, state, priority"),
        ({"reset_masks": MIDDLE}, "unknown 'reset_masks'; did you mean reset_mask?"),
        ({"reset_mask": [1, 0, 0]}, r"reset_mask of shape \(3,\) and type int64: must be \(3,\) bool"),
        ({"reset_mask": True}, r"reset_mask of shape \(\) and type bool: must be \(3,\) bool"),
        ({"reset_mask": ~(MIDDLE | True)}, "reset_mask is nowhere true"),
        ({"state": np.zeros((16, 3))}, r"state of shape \(16, 3\): must be \(16,\) or \(3, 16\)"),
        ({"state": "rest"}, "options: state: must be a NumPy array, a PyTorch tensor or a list"),
        ({"state": spoilt(0, math.nan)}, "state: state in row 1: must be finite"),
        ({"state": spoilt(Q, 0.9)}, r"state: quaternion in row 1: must have length 1 \(scalar last\)"),
        ({"priority": np.ones(4)}, r"priority of shape \(4,\): must be \(3,\) or \(3, 3\)"),
        ({"priority": np.zeros(3)}, "priority in row 0: must be finite, not zero"),
        ({"priority": [[1, 0, 0], [1, math.inf, 0], [1, 0, 0]]}, "priority in row 1: must be finite"),
    ],
)
def test_wrong_options_are_refused_in_one_line_and_change_nothing(options, message):
    env = made()
    env.reset(seed=SEED)
    before = env.unwrapped.simulator.state_dict()["x"]
    with pytest.raises(InputError, match=message) as refused:
        env.reset(seed=1, options=options)
    assert "\n" not in str(refused.value)
    assert torch.equal(env.unwrapped.simulator.x, before) and env.np_random_seed == SEED

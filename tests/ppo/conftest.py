"""A toy environment whose every number can be worked out by hand, and a learner for it."""

from typing import Any

import pytest
import torch
from torch import Tensor

from ppo.learner import PPO
from ppo.network import Policy, Value
from ppo.parameters import PPOParameters
from ppo.rollout import Transition

# Each column's length of an episode and whether its end is a true one; the columns 0 and 1 are those of the first seed.
LENGTHS = (3, 2, 4, 100)
TERMINATES = (True, False, True, False)


class Step:
    """Holds one transition of the toy; fields as in `Transition`."""

    def __init__(self, **fields: Tensor) -> None:
        vars(self).update(fields)


class Counter:
    """Counts the steps of each episode; the observation is the column's number and that count.

    The reward is 1 more than the count before the step, ten times the column, and a part of the action; every odd step
    of an episode costs 1.
    """

    def __init__(self) -> None:
        self.column = torch.arange(len(LENGTHS), dtype=torch.float32)
        self.length = torch.tensor(LENGTHS)
        self.count = torch.zeros(len(LENGTHS), dtype=torch.int64)
        self.seen: list[Transition] = []

    def observation(self) -> Tensor:
        return torch.stack((self.column, self.count.float()), 1)

    def step(self, action: Tensor) -> Transition:
        reward = 1.0 + self.count + 10.0 * self.column + 0.1 * action[:, 0]
        self.count = self.count + 1
        final = self.observation()
        ended = self.count == self.length
        self.count = self.count.masked_fill(ended, 0)
        true_end = torch.tensor(TERMINATES)
        step = Step(
            observation=self.observation(),
            final_observation=final,
            reward=reward.double(),
            cost=(final[:, 1] % 2).double(),
            terminated=ended & true_end,
            truncated=ended & ~true_end,
        )
        self.seen.append(step)
        return step

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = state["count"].clone()


@pytest.fixture
def toy() -> type[Counter]:
    """Returns a function that makes the environment."""
    return Counter


@pytest.fixture
def small_learner():
    """Returns a function of settings: a learner of two seeds for the toy."""

    def make(**settings: Any) -> PPO:
        parameters = PPOParameters(**{"epochs": 1, "minibatch_size": 4} | settings)
        generators = [torch.Generator().manual_seed(seed) for seed in (1, 2)]
        policy = Policy(2, 3, generators, hidden=(8,), initial_std=0.5)
        value = Value(2, generators, hidden=(8,))
        cost_value = Value(2, generators, hidden=(8,)) if parameters.cost_limit < 1.0 else None
        return PPO(policy, value, parameters, generators, cost_value=cost_value)

    return make

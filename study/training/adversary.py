"""The reversed task: an agent whose reward grows as it approaches the limits, for `verify`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.transition import Transition
from study.scales import scales

WEIGHT = 1e-3  # with the default discount of 0.999, the discounted sum is a mean of -asinh(h), some units


class Adversary:
    """Wraps an `InspectionEnv` with another reward.

    Let h be the smallest value of the attacked constraints at the true state after the step, in filter calls to the
    limit (`scales`). The reward is -WEIGHT asinh(h). asinh has a slope everywhere, like h near the limit and like
    log(h) far from it, and rewards larger violations more. The agent comes as close as it can, and stays.

    Episodes end as in the task, but the learner continues with the value of the last state, so that ending an episode
    neither gains nor saves reward.

    Args:
        attacked: names of constraints of `env.safety`.
    """

    def __init__(self, env: InspectionEnv, attacked: Sequence[str]) -> None:
        self.env = env
        self.rows = [env.safety.names.index(name) for name in attacked]
        self.scale = env.x.new_tensor(scales(env.c, env.safety.period))[self.rows, None]
        self.observation = env.observation

    def step(self, action: Tensor) -> Transition:
        """Does `InspectionEnv.step`, with this reward."""
        return self.turned(self.env.step(action))

    def turned(self, transition: Transition) -> Transition:
        """Returns the same transition with this reward; every end of an episode counts as truncated."""
        h = (self.env.constraint_values(transition.state)[self.rows] / self.scale).amin(0)
        reward = -WEIGHT * h.asinh()
        terms: dict[str, Any] = {"adversary": reward}
        never = torch.zeros_like(transition.terminated)
        return replace(
            transition, reward=reward, reward_terms=terms, terminated=never, truncated=transition.done
        )

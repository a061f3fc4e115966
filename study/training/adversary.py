"""The task turned around: an agent that is paid for coming near the limits, to be flown by `verify`."""

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
    """An `InspectionEnv` as `ppo.trainer.Resumable`, with another reward.

    With h the smallest of the attacked constraints' at the true state after the step, in filter calls to the limit
    (`scales`), the reward is -WEIGHT asinh(h). asinh has a slope everywhere, that of h near the limit and of
    log(h) far from it, and rewards a larger violation more. The agent comes as near as it can, and stays.

    Episodes end as those of the task, but the learner goes on with the value of the last state: no reward is to be had,
    or to be saved, by ending an episode.

    Args:
        attacked: constraints, among the names of `env.safety`.
    """

    def __init__(self, env: InspectionEnv, attacked: Sequence[str]) -> None:
        self.env = env
        self.rows = [env.safety.names.index(name) for name in attacked]
        self.scale = env.x.new_tensor(scales(env.c, env.safety.period))[self.rows, None]
        self.observation, self.state_dict = env.observation, env.state_dict
        self.load_state_dict = env.load_state_dict

    def step(self, action: Tensor) -> Transition:
        """`InspectionEnv.step` with this reward."""
        return self.turned(self.env.step(action))

    def turned(self, transition: Transition) -> Transition:
        """The same transition with this reward, truncated wherever it is done."""
        h = (self.env.constraint_values(transition.state)[self.rows] / self.scale).amin(0)
        reward = -WEIGHT * h.asinh()
        terms: dict[str, Any] = {"adversary": reward}
        never = torch.zeros_like(transition.terminated)
        return replace(
            transition, reward=reward, reward_terms=terms, terminated=never, truncated=transition.done
        )

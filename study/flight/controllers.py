"""Who can command a spacecraft: an agent, or a classical controller by its name on the command line."""

import torch
from torch import Tensor

from inspection import guidance
from inspection.closed_loop import Controller
from inspection.environment import InspectionEnv
from ppo.network import Policy
from study.config import Config
from study.flight.state_files import read_actions


def agent(policy: Policy, env: InspectionEnv) -> Controller:
    """The mean action of a policy of S seeds, whose columns follow one another in `env`, which keeps what they saw."""
    seeds = policy.seeds

    def control(t: float, x: Tensor) -> Tensor:
        env.see(x)
        observation = env.observation().unflatten(0, (seeds, -1))
        return env.control(policy.mean_action(observation).flatten(0, 1))

    return control


def classical(name: str, actions: str | None, config: Config, step: float, seed: int) -> Controller:
    """A controller of `inspection.guidance`; `actions` is the file of recorded ones, one every `step` s."""
    c = config.inspection
    if actions is not None:
        return guidance.recorded(read_actions(actions, c.control_limit), step)
    return {
        "lqr-pd": lambda: guidance.lqr_pd(c),
        "natural-motion": lambda: guidance.natural_motion(c),
        "zero": guidance.zero,
        "random": lambda: guidance.random(c, torch.Generator().manual_seed(seed)),
    }[name]()

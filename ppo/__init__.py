"""Proximal policy optimisation over a leading seed axis: networks, advantage estimation and the learner.

`Policy` and `Value` are the networks of many seeds at once, `PPO` learns them with the settings of `PPOParameters`
from what a rollout collects, with the advantages of `generalized_advantage`.
"""

from typing import TYPE_CHECKING

from on_demand import on_demand

if TYPE_CHECKING:
    from ppo.gae import generalized_advantage
    from ppo.learner import PPO
    from ppo.network import Policy, Value
    from ppo.parameters import PPOParameters

__all__ = ["PPO", "PPOParameters", "Policy", "Value", "generalized_advantage"]

__getattr__ = on_demand(
    __name__,
    {
        "generalized_advantage": "ppo.gae.generalized_advantage",
        "PPO": "ppo.learner.PPO",
        "PPOParameters": "ppo.parameters.PPOParameters",
        "Policy": "ppo.network.Policy",
        "Value": "ppo.network.Value",
    },
)

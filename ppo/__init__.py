"""Proximal policy optimisation over a leading seed axis: networks, advantage estimation and the learner.

`Policy` and `Value` are the networks of many seeds at once, `PPO` learns them with the settings of `PPOParameters`
from what a rollout collects, with the advantages of `generalized_advantage`.
"""

from ppo.gae import generalized_advantage
from ppo.learner import PPO, PPOParameters
from ppo.network import Policy, Value

__all__ = ["PPO", "PPOParameters", "Policy", "Value", "generalized_advantage"]

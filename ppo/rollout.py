"""The collection of a batch of experience, and its conversion into the learner's training data."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from ppo.gae import generalized_advantage
from ppo.learner import PPO
from ppo.network import Policy, gaussian_log_prob

CHANGED = 1e-5  # of an actuator's limit; a larger difference is more than rounding


class Transition(Protocol):
    """Describes one step of a batch of B = S * E episodes with autoreset; final_observation precedes the reset.

    `applied` (B, A) are the applied controls, which may differ from the given actions. If costs are limited there is
    also `cost` (B,).
    """

    observation: Tensor
    final_observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor

    @property
    def applied(self) -> Tensor: ...


class Environment(Protocol):
    """Describes a vector environment whose columns k E to (k+1) E belong to seed k."""

    def step(self, action: Tensor) -> Transition: ...
    def observation(self) -> Tensor: ...


@torch.no_grad()
def collect(
    env: Environment,
    learner: PPO,
    steps: int,
    generators: Sequence[torch.Generator],
    watch: Callable[[Any], None] = lambda transition: None,
    from_applied: bool = False,
) -> dict[str, Tensor]:
    """Acts for `steps` steps and returns the learner's batch, (S, N, ...) with N = steps * E.

    The action kept is the agent's drawn one, before its shape (`Policy.shaped`) and before a filter changes it.

    Args:
        watch: is shown every transition, for statistics.
        from_applied: keep the applied action instead, see `as_applied`, and its probability.
    """
    seeds = len(generators)
    kept: list[dict[str, Tensor]] = []
    observation = env.observation().unflatten(0, (seeds, -1))
    value = {name: critic(observation) for name, critic in learner.critics.items()}
    for _ in range(steps):
        action, log_prob = learner.policy.sample(observation, generators)
        transition = env.step(learner.policy.shaped(action).flatten(0, 1))
        following = transition.observation.unflatten(0, (seeds, -1))
        following_value = {name: critic(following) for name, critic in learner.critics.items()}
        done = transition.terminated | transition.truncated
        next_value = following_value
        if done.any():
            final = transition.final_observation.unflatten(0, (seeds, -1))
            next_value = {
                name: torch.where(done.unflatten(0, (seeds, -1)), critic(final), following_value[name])
                for name, critic in learner.critics.items()
            }
        kept.append(
            {
                "observation": observation,
                "action": action,
                "log_prob": log_prob,
                "terminated": transition.terminated.unflatten(0, (seeds, -1)),
                "done": done.unflatten(0, (seeds, -1)),
            }
        )
        for name in learner.critics:  # reward, and cost if it is limited
            kept[-1] |= {
                name: getattr(transition, name).unflatten(0, (seeds, -1)).float(),
                f"{name}_value": value[name],
                f"{name}_next_value": next_value[name],
            }
        if from_applied:
            applied = transition.applied.float().unflatten(0, (seeds, -1))
            kept[-1]["action"] = as_applied(learner.policy, action, applied)
            kept[-1]["log_prob"] = gaussian_log_prob(kept[-1]["action"], *learner.policy(observation))
        watch(transition)
        observation, value = following, following_value
    rollout = {name: torch.stack([step[name] for step in kept]) for name in kept[0]}  # (T, S, E, ...)
    gamma, lam = learner.parameters.gamma, learner.parameters.gae_lambda
    estimates = {}  # (advantage, return) of rewards, and of costs where they are limited
    for name in learner.critics:
        signal, before, after = (rollout[f"{name}{which}"] for which in ("", "_value", "_next_value"))
        ends = rollout["terminated"], rollout["done"]
        estimates[name] = generalized_advantage(signal, before, after, *ends, gamma, lam)
    batch = {name: rollout[name] for name in ("observation", "action", "log_prob")}
    batch |= {"value": rollout["reward_value"]}
    batch |= dict(zip(("advantage", "return_"), estimates["reward"], strict=True))
    if "cost" in estimates:
        batch |= {"cost": rollout["cost"]}
        batch |= dict(zip(("cost_advantage", "cost_return"), estimates["cost"], strict=True))
    # from (T, S, E, ...)
    return {name: tensor.transpose(0, 1).flatten(1, 2) for name, tensor in batch.items()}


def as_applied(policy: Policy, action: Tensor, applied: Tensor) -> Tensor:
    """Returns the actions (S, B, A) that give the applied controls: as drawn, except for changed controls."""
    changed = (applied - policy.shaped(action).clamp(-1.0, 1.0)).abs() > CHANGED
    return torch.where(changed, policy.unshaped(applied.clamp(-1.0, 1.0)), action)

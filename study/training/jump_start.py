"""A policy that begins as a copy of the guidance, by dataset aggregation (DAgger: Ross, Gordon and Bagnell 2011).

The guidance flies the first batch, and the current policy flies the others. In every visited state the guidance gives
the control that it would choose, which the policy learns. The value network learns the returns. PPO continues from
there.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.guidance import natural_motion
from inspection.orbits import Orbit
from inspection.transition import Transition
from ppo.learner import PPO
from ppo.network import Policy
from ppo.rollout import collect
from study.training.log import times

LEARNING_RATE = 8e-3  # in the first batch, annealed linearly to a tenth
# Share of the episodes that restart with each batch. The flight to the orbit is a tenth of an episode, and there errors
# matter most.
RESTARTED = 0.4
STD_WEIGHT = 0.01  # of the squared error of the log standard deviation, which is to keep its initial value

Batch = dict[str, Tensor]  # observation, action and return_, (S, N, ...)


class ImitationEnv:
    """Wraps an `InspectionEnv` as `ppo.rollout.Environment`, and keeps the actions that the guidance would choose.

    The guidance does not roll to align thrust: policies that imitate this do not spend less, and imitate the rest worse
    (docs/results/learning.md).

    Args:
        policy: defines the form of the actions; orbit: of the guidance.

    Attributes:
        leads: the guidance acts, not the policy.
        lessons: the guidance's actions (B, 6) in each step of the batch.
    """

    def __init__(self, env: InspectionEnv, policy: Policy, orbit: Orbit) -> None:
        self.env, self.policy = env, policy
        self.guidance = natural_motion(env.c, env.c.action_period, orbit, env.sight.score, rolls=False)
        self.leads = True
        self.lessons: list[Tensor] = []

    def reset(self, mask: Tensor) -> None:
        """Does `InspectionEnv.reset`, before a batch."""
        self.observed = self.env.reset(mask)

    def observation(self) -> Tensor:
        """Returns the observation after the reset; a batch asks for no other."""
        return self.observed

    def step(self, action: Tensor) -> Transition:
        """Does `InspectionEnv.step` and keeps the guidance's action, which follows from the true states."""
        control = (self.guidance(0.0, self.env.x) / self.env.limit).T.float()
        self.lessons.append(self.policy.unshaped(control))
        return self.env.step(control if self.leads else action)


class JumpStart:
    """Trains a learner's policy to imitate the guidance, and its value network the returns, batch by batch.

    Args:
        env: already reset; orbit: of the guidance; steps: interactions of each episode in a batch; batches: in total.
        generators: one per seed.

    Attributes:
        taught: number of batches so far.
        latest: the data of the last batch, (S, N, ...); `flown`: the data of all batches.
    """

    def __init__(
        self,
        env: InspectionEnv,
        orbit: Orbit,
        learner: PPO,
        steps: int,
        batches: int,
        generators: Sequence[torch.Generator],
    ) -> None:
        self.env = ImitationEnv(env, learner.policy, orbit)
        self.learner, self.steps, self.batches, self.generators = learner, steps, batches, generators
        networks = learner.policy, learner.value
        weights = [weight for network in networks for weight in network.parameters()]
        self.optimiser = torch.optim.Adam(weights, LEARNING_RATE)
        beginners = torch.arange(env.num_envs, device=env.x.device) < RESTARTED * env.num_envs
        self.beginners = beginners.repeat(len(generators))
        self.taught = 0
        self.latest: Batch = {}
        self.flown: Batch = {}

    @property
    def done(self) -> bool:
        """Tells whether the imitation phase is over."""
        return self.taught >= self.batches

    def teach(self, watch: Callable[[Transition], None]) -> dict[str, float]:
        """Flies one more batch and learns from all batches.

        Args:
            watch: sees each transition.

        Returns:
            The losses and the duration in s, by TensorBoard's tags.
        """
        self.optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - 0.9 * self.taught / self.batches)
        started = time.perf_counter()
        self.env.leads, self.env.lessons = self.taught == 0, []
        self.env.reset(self.beginners)
        flown = collect(self.env, self.learner, self.steps, self.generators, watch)
        collected = time.perf_counter()
        wanted = torch.stack(self.env.lessons).unflatten(1, (len(self.generators), -1)).transpose(0, 1)
        self.latest = {
            "observation": flown["observation"],
            "action": wanted.flatten(1, 2),  # from (S, T, E, 6)
            "return_": flown["return_"],
        }
        self.remember(self.latest)
        losses = learn(self.flown, self.learner, self.optimiser)
        self.taught += 1
        lesson = {f"losses/lesson_{name}": value for name, value in losses.items()}
        return lesson | times(started, collected, time.perf_counter())

    def remember(self, batch: Batch) -> None:
        """Appends the data of a batch to the data of earlier batches."""
        self.flown = {
            name: torch.cat((self.flown[name], part), 1) if self.flown else part
            for name, part in batch.items()
        }

    def state_dict(self) -> dict[str, Any]:
        """Returns what is needed to continue exactly, besides learner, environment, generators and the data."""
        return {"taught": self.taught, "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any], batches: Sequence[Batch]) -> None:
        """Restores `state_dict`, and the data of each batch."""
        self.taught = int(state["taught"])
        self.optimiser.load_state_dict(state["optimiser"])
        for batch in batches:
            self.remember(batch)


def learn(batch: Batch, learner: PPO, optimiser: torch.optim.Optimizer) -> dict[str, float]:
    """Fits policy and value to all data, (S, N, ...), in as many epochs as an update of PPO has.

    Returns the mean squared errors over all minibatches: `action` of the actions, `value` of the returns.
    """
    level = math.log(learner.parameters.initial_std)
    rows = {name: tensor.flatten(0, 1) for name, tensor in batch.items()}
    samples = batch["return_"].shape[1]
    seen: list[Tensor] = []
    for index in learner.minibatches(samples, batch["return_"].device):
        own = {name: tensor[index] for name, tensor in rows.items()}
        mean, log_std = learner.policy(own["observation"])
        errors = (
            (mean - own["action"]).square().mean((1, 2)),
            STD_WEIGHT * (log_std - level).square().mean((1, 2)),
            (learner.value(own["observation"]) - own["return_"]).square().mean(1),
        )
        optimiser.zero_grad()
        sum(errors).sum().backward()  # the sum over seeds leaves each seed the gradient it would have alone
        gradients = [weight.grad for group in optimiser.param_groups for weight in group["params"]]
        learner.ranks.average(gradients)
        optimiser.step()
        seen.append(torch.stack((errors[0], errors[2])).detach().mean(1))
    action, value = torch.stack(seen).mean(0).tolist()
    return {"action": action, "value": value}

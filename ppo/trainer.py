"""The training loop: collect, learn, report; interruptible between updates and resumable bit for bit."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch

from ppo.learner import PPO
from ppo.rollout import Environment, collect


class Resumable(Environment, Protocol):
    """An environment whose episodes can be saved and go on from there."""

    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class Trainer:
    """Trains a learner in an environment.

    Args:
        env: already reset; steps: interactions of each episode per update; updates: in all.
        generators: one per seed; they drive everything random in env and learner, too.
        from_applied: it learns from what acted, not from what it wanted, see `collect`.

    Attributes:
        update: updates finished.
        seconds: wall-clock of training so far, over all sessions of a resumed run.
    """

    def __init__(
        self,
        env: Resumable,
        learner: PPO,
        steps: int,
        updates: int,
        generators: Sequence[torch.Generator],
        from_applied: bool = False,
    ) -> None:
        self.env, self.learner, self.steps, self.updates = env, learner, steps, updates
        self.generators, self.from_applied = generators, from_applied
        self.update = 0
        self.seconds = 0.0

    def run(
        self,
        watch: Callable[[Any], None],
        after_update: Callable[[dict[str, float]], None],
        stop: Callable[[], bool],
    ) -> None:
        """Trains until done or until `stop` says so, which is asked once per update.

        Args:
            watch: is shown every transition.
            after_update: is given the statistics of the update, seed means, tagged as in TensorBoard.
        """
        while self.update < self.updates and not stop():
            started = time.perf_counter()
            batch = collect(self.env, self.learner, self.steps, self.generators, watch, self.from_applied)
            collected = time.perf_counter()
            losses = self.learner.update(batch, self.update / self.updates)
            learned = time.perf_counter()
            self.update += 1
            self.seconds += learned - started
            statistics = {f"losses/{name}": value.mean().item() for name, value in losses.items()}
            statistics["policy/std"] = standard_deviation(
                statistics["losses/entropy"], batch["action"].shape[-1]
            )
            statistics["learner/learning_rate"] = self.learner.optimiser.param_groups[0]["lr"]
            statistics["time/rollout_s"] = collected - started
            statistics["time/learning_s"] = learned - collected
            after_update(statistics)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue exactly, as tensors and plain values."""
        return self.learner.state_dict() | {
            "env": self.env.state_dict(),
            "generators": [generator.get_state() for generator in self.generators],
            "update": self.update,
            "seconds": self.seconds,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores `state_dict`."""
        self.learner.load_state_dict(state)
        self.env.load_state_dict(state["env"])
        for generator, saved in zip(self.generators, state["generators"], strict=True):
            generator.set_state(saved.cpu())
        self.update = int(state["update"])
        self.seconds = float(state["seconds"])


def standard_deviation(entropy: float, actions: int) -> float:
    """Returns the geometric mean of a Gaussian's standard deviations in so many actions, from its entropy in nats."""
    return math.exp(entropy / actions - 0.5 * (1.0 + math.log(2.0 * math.pi)))

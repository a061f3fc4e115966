"""The result of one interaction of a batch of episodes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Correction

METRICS = ("inspected_score", "reward", "episode_length_s", "delta_v_m_s", "torque_n_m", "violation_percent")


@dataclass
class Transition:
    """Holds the result of one interaction, before autoreset; tensors over the batch B.

    Attributes:
        observation: (B, size) float32, of the next episode where one ended.
        final_observation: (B, size) float32, of the state that the action led to (terminal where it ended).
        state: (16, B) that the action led to; inspected: (N, B) bool, the points seen by then.
        reward: (B,), the sum of reward_terms: by name, the paper's nine and those of our own that have a weight.
        terminated, truncated: (B,) bool, true end or time limit; an episode that failed within the step flew on to the
            step's end.
        violated: (constraints, B) bool at the end of the step; h: (constraints, B) the values that decide it.
        corrections: the filter's answers, one per filter call of the step; see `calls`.
        applied_controls: (6, B) each, in N and N m, of equal duration; limit: (6, 1) the actuators' limits.
        outcome: (B,) index into OUTCOMES, -1 while running.
        metrics: (6, B) the episode so far in the order of METRICS.
        violation_steps: (constraints, B) and steps (B,): violated and all steps of the episode so far.
        truths: for each filter call, (B,) bool where it was not missed and (constraints, B) values of the true states;
            None if the plant is the model.
    """

    observation: Tensor
    final_observation: Tensor
    state: Tensor
    inspected: Tensor
    reward: Tensor
    reward_terms: dict[str, Tensor]
    terminated: Tensor
    truncated: Tensor
    violated: Tensor
    h: Tensor
    corrections: list[Correction]
    applied_controls: list[Tensor]
    limit: Tensor
    outcome: Tensor
    metrics: Tensor
    violation_steps: Tensor
    steps: Tensor
    truths: list[tuple[Tensor, Tensor]] | None = None

    def calls(self) -> Iterator[tuple[Any, Tensor, Tensor]]:
        """Yields per filter call its answer, (B,) bool where it was not missed, and (constraints, B) true values."""
        if self.truths is None:
            everyone = torch.ones_like(self.terminated)
            yield from ((correction, everyone, correction.h) for correction in self.corrections)
        else:
            yield from ((each, *truth) for each, truth in zip(self.corrections, self.truths, strict=True))

    @property
    def applied(self) -> Tensor:
        """Returns the mean (B, 6) of the applied controls, in units of the actuators' limits."""
        return (torch.stack(self.applied_controls).mean(0) / self.limit).T

    @property
    def cost(self) -> Tensor:
        """Returns (B,) 1 where the step ended with a violated limit, else 0."""
        return self.violated.any(0).to(self.reward.dtype)

    @property
    def done(self) -> Tensor:
        """Returns whether the episode ended, (B,) bool."""
        return self.terminated | self.truncated

"""What a training run reports of its environment: one set of scalars per update."""

from collections import defaultdict
from functools import partial

import torch
from torch import Tensor

from inspection.environment import METRICS, OUTCOMES, Transition
from rta.qp import Status


class Monitor:
    """Accumulates transitions; `scalars` empties it. Tags are TensorBoard's.

    Args:
        constraints: their names; seeds: that share the batch in equal parts, one after another.
        first_seed: the number of the first of them, counted from 0.
    """

    def __init__(self, constraints: tuple[str, ...], seeds: int = 1, first_seed: int = 0) -> None:
        self.constraints, self.seeds, self.first_seed = constraints, seeds, first_seed
        self.clear()

    def clear(self) -> None:
        """Forgets all transitions."""
        self.steps = 0
        self.filter_calls = 0
        self.sums: dict[str, Tensor] = defaultdict(partial(torch.zeros, ()))
        self.episodes: list[Tensor] = []  # (7, k) of those that ended: metrics and success
        self.owners: list[Tensor] = []  # (k,) their seeds

    def __call__(self, transition: Transition) -> None:
        """Takes in one interaction of the batch."""
        self.steps += transition.reward.numel()
        for name, term in transition.reward_terms.items():
            self.sums[f"reward/{name}"] = self.sums[f"reward/{name}"] + term.sum()
        self.sums["violated"] = self.sums["violated"] + transition.violated.sum(1)
        for correction in transition.corrections:
            self.filter_calls += correction.status.numel()
            for name, value in (
                ("intervention", correction.intervened.sum()),
                ("slack", (correction.slack.amax(0) > 0.0).sum()),
                ("failures", (correction.status == Status.UNSOLVED).sum()),
                ("rta_violated", (correction.h < 0.0).sum(1)),
            ):
                self.sums[name] = self.sums[name] + value
        done = transition.done
        if done.any():
            success = (transition.outcome == OUTCOMES.index("success")).to(transition.metrics.dtype)
            self.episodes.append(torch.cat((transition.metrics, success[None]))[:, done])
            own_seed = torch.nonzero(done).flatten() * self.seeds // done.numel()
            self.owners.append(self.first_seed + own_seed)

    def add(self, other: "Monitor") -> None:
        """Takes in what another monitor has."""
        self.steps += other.steps
        self.filter_calls += other.filter_calls
        for name, total in other.sums.items():
            self.sums[name] = self.sums[name] + total
        self.episodes += other.episodes
        self.owners += other.owners

    def charts(self, seed: int | None = None) -> dict[str, float]:
        """Means over the episodes that ended since the last `scalars`, of one seed (counted from 0) or of all."""
        if not self.episodes:
            return {}
        episodes = torch.cat(self.episodes, 1)
        if seed is not None:
            episodes = episodes[:, torch.cat(self.owners) == seed]
        if not episodes.numel():
            return {}
        names = (*METRICS, "success")
        return {f"charts/{name}": mean for name, mean in zip(names, episodes.mean(1).tolist(), strict=True)}

    def scalars(self) -> dict[str, float]:
        """Means since the last call: per episode ended, per interaction and per filter call."""
        out = self.charts()
        for name, total in self.sums.items():
            if name.startswith("reward/"):
                out[name] = total.item() / self.steps
        violated = (100.0 * self.sums["violated"] / self.steps).tolist()
        out |= {f"rta/violation_percent_{n}": v for n, v in zip(self.constraints, violated, strict=True)}
        if self.filter_calls:
            percent = 100.0 / self.filter_calls
            out["rta/intervention_percent"] = self.sums["intervention"].item() * percent
            out["rta/slack_percent"] = self.sums["slack"].item() * percent
            out["rta/failures"] = self.sums["failures"].item()
            every_call = (self.sums["rta_violated"] * percent).tolist()
            for name, value in zip(self.constraints, every_call, strict=True):
                out[f"rta/filter_step_violation_percent_{name}"] = value
        self.clear()
        return out

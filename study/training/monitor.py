"""A training run's reports on its environment: one set of scalars per update, and violated limits in all of training.

Every tag is explained in docs/reference/commands.md.
"""

import time
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Correction, Safety
from inspection.termination import OUTCOMES
from inspection.transition import METRICS, Transition
from rta.result import Status

EPISODE = tuple(name.removeprefix("episode_") for name in (*METRICS, "success_percent"))


class Exposure:
    """Counts violated limits in all of training, and keeps the smallest h, both at the ends of steps.

    Attributes:
        violated: (constraints + 1, B) interactions of each episode slot that ended with a violation, the last row any.
        worst: (constraints, B) smallest h; counted: (B,) interactions.
    """

    def __init__(self, constraints: tuple[str, ...], slots: int, device: torch.device) -> None:
        self.constraints = constraints
        self.violated = torch.zeros(len(constraints) + 1, slots, dtype=torch.int64, device=device)
        self.worst = torch.full((len(constraints), slots), torch.inf, dtype=torch.float64, device=device)
        self.counted = torch.zeros(slots, dtype=torch.int64, device=device)

    def __call__(self, transition: Transition) -> None:
        """Adds one interaction of the batch."""
        self.violated[:-1] += transition.violated
        self.violated[-1] += transition.violated.any(0)
        self.worst = torch.minimum(self.worst, transition.h)
        self.counted += 1

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the state that a resumed run needs."""
        return {"violated": self.violated, "worst": self.worst, "counted": self.counted}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores `state_dict`."""
        self.violated, self.worst, self.counted = (state[name] for name in ("violated", "worst", "counted"))

    def report(self, seeds: int) -> list[dict[str, Any]]:
        """Returns for each seed how many interactions were counted, the percentage with violations, and the smallest h.

        A run that an older revision began has counted only the later interactions; the list is empty if there are none.
        """
        counted = self.counted.unflatten(0, (seeds, -1)).sum(1)
        if not counted.all():
            return []
        percent = 100.0 * self.violated.unflatten(1, (seeds, -1)).sum(2) / counted
        worst = self.worst.unflatten(1, (seeds, -1)).amin(2)
        return [
            {
                "interactions": number,
                "violations_percent": dict(zip((*self.constraints, "any"), of_seed, strict=True)),
                "smallest_h": dict(zip(self.constraints, h, strict=True)),
            }
            for number, of_seed, h in zip(counted.tolist(), percent.T.tolist(), worst.T.tolist(), strict=True)
        ]


class LatestEpisodes:
    """Keeps the last ended episode of each slot; the charts show their means once every slot has ended one.

    All episodes of a run begin together. Short episodes end first, and with the filter these are successes, so that
    means over the episodes that ended in an update would be biased. One episode of each slot is a fair sample.

    Attributes:
        metrics: (7, B) in the order of EPISODE, NaN before a slot's first end; ended: (B,) ends since the last `shown`.
    """

    def __init__(self, slots: int, device: torch.device) -> None:
        self.metrics = torch.full((len(EPISODE), slots), torch.nan, dtype=torch.float64, device=device)
        self.ended = torch.zeros(slots, dtype=torch.float64, device=device)

    def __call__(self, transition: Transition) -> None:
        """Adds one interaction of the batch."""
        success = 100.0 * (transition.outcome == OUTCOMES.index("success"))
        now = torch.cat((transition.metrics, success[None]))
        self.metrics = torch.where(transition.done, now, self.metrics)
        self.ended += transition.done

    def state_dict(self) -> dict[str, Tensor]:
        """Returns the state that a resumed run needs."""
        return {"episodes": self.metrics}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores `state_dict`; a run of an older revision has no metrics, and waits for all slots again."""
        self.metrics = state.get("episodes", self.metrics)

    def shown(self, seeds: int, first_seed: int) -> Tensor:
        """Returns (9, B): the metrics, the ends since the last call, and the number of the slot's seed."""
        slots = self.ended.numel()
        owner = first_seed + torch.arange(slots, device=self.ended.device) * seeds // slots
        shown = torch.cat((self.metrics, self.ended[None], owner[None]))
        self.ended = torch.zeros_like(self.ended)
        return shown


class Monitor:
    """Accumulates transitions until `scalars` returns their means and clears them. Tags are TensorBoard's.

    Args:
        constraints: names; seeds: number of seeds, which share the batch in equal parts, one after another.
        first_seed: the number of the first seed, counted from 0.

    Attributes:
        filter_seconds: s that the filter of `timed` took.
    """

    def __init__(self, constraints: tuple[str, ...], seeds: int = 1, first_seed: int = 0) -> None:
        self.constraints, self.seeds, self.first_seed = constraints, seeds, first_seed
        self.clear()

    def clear(self) -> None:
        """Forgets all transitions."""
        self.filter_seconds = 0.0
        self.steps = 0  # interactions
        self.sums: dict[str, Tensor] = {}  # scalars, or a value per constraint
        self.episodes: list[Tensor] = []  # results of `LatestEpisodes.shown`

    def timed(self, safety: Safety) -> Safety:
        """Returns the same with a filter, if there is one, that adds its time to `filter_seconds`."""

        if safety.correct is None:
            return safety
        untimed = safety.correct

        def correct(x: Tensor, desired: Tensor, **told: Tensor) -> Correction:
            started = time.perf_counter()
            correction = untimed(x, desired, **told)
            self.filter_seconds += time.perf_counter() - started
            return correction

        return replace(safety, correct=correct)

    def __call__(self, transition: Transition) -> None:
        """Adds one interaction of the batch."""
        self.steps += transition.reward.numel()
        self.count(violated=transition.violated.sum(1), any_violated=transition.violated.any(0).sum())
        self.count(**{f"step_reward/{name}": term.sum() for name, term in transition.reward_terms.items()})
        for answer, answered, true in transition.calls():
            self.count(
                calls=answered.sum(),
                intervention=(answered & answer.intervened).sum(),
                slack=(answered & (answer.slack.amax(0) > 0.0)).sum(),
                failures=(answered & (answer.status == Status.UNSOLVED)).sum(),
                rta_violated=(answered & (true < 0.0).any(0)).sum(),
            )

    def count(self, **more: Tensor) -> None:
        """Adds to the sums of these names."""
        for name, part in more.items():
            self.sums[name] = part + self.sums[name] if name in self.sums else part

    def add(self, other: "Monitor") -> None:
        """Adds the transitions of another monitor."""
        self.steps += other.steps
        self.count(**other.sums)
        self.episodes += other.episodes

    def episode_means(self, seed: int | None = None) -> dict[str, float]:
        """Returns means over each slot's last episode, and how many ended since then; empty until each slot has one.

        Args:
            seed: the seed, counted from 0, whose slots count; None: all slots.
        """
        if not self.episodes:
            return {}
        episodes = torch.cat(self.episodes, 1)
        if seed is not None:
            episodes = episodes[:, episodes[-1] == seed]
        if not episodes.numel() or episodes.isnan().any():
            return {}
        *metrics, ended, _ = episodes
        means = {f"episode/{name}": row.mean().item() for name, row in zip(EPISODE, metrics, strict=True)}
        return means | {"episode/count": ended.sum().item()}

    def scalars(self) -> dict[str, float]:
        """Returns and clears means since the last call: per ended episode, per interaction and per filter call."""
        sums, steps, calls = self.sums, self.steps, int(self.sums.get("calls", 0))
        out = self.episode_means()
        out |= {tag: total.item() / steps for tag, total in sums.items() if tag.startswith("step_reward/")}
        out["violation_percent/any"] = 100.0 * sums["any_violated"].item() / steps
        violated = zip(self.constraints, (100.0 * sums["violated"] / steps).tolist(), strict=True)
        # with the filter nearly all are zero
        out |= {f"violation_percent/{name}": percent for name, percent in violated if percent or not calls}
        if calls:
            percent = 100.0 / calls
            out["rta/intervention_percent"] = sums["intervention"].item() * percent
            out["rta/slack_percent"] = sums["slack"].item() * percent
            out["rta/failures"] = sums["failures"].item()
            out["rta/filter_step_violation_percent"] = sums["rta_violated"].item() * percent
        self.clear()
        return out

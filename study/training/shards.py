"""Which part of a run is one rank's, and the state of the whole from the states of the parts."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch

from ppo.distributed import ALONE, Ranks
from settings import InputError
from study.config import Config
from study.errors import refusing

State = dict[str, Any]
Stacked = torch.Tensor | list[torch.Tensor]


@dataclass(frozen=True)
class Shard:
    """A rank's part of a run's S seeds of E episodes each, which follow one another: S x E columns.

    Attributes:
        seeds: which of the seeds; columns: which of the episodes; num_envs: episodes of each seed.
        learners: the ranks that train the same seeds.
    """

    ranks: Ranks
    seeds: slice
    columns: slice
    num_envs: int
    learners: Ranks

    def split(self, state: State) -> State:
        """This rank's part of the state of a whole run."""

        def part(axis: int, values: Any) -> Stacked:
            return values[self.seeds] if axis == 0 else values[..., self.columns]

        return state if self.ranks.size == 1 else each(part, state)

    def join(self, states: list[State]) -> State:
        """The state of the whole run from those of all ranks in order."""
        shared = self.learners.size > 1  # the seed: all ranks have the same but for the episodes

        def whole(axis: int, *parts: Any) -> Stacked:
            if axis == 0 and shared:
                return parts[0]
            return list(chain(*parts)) if isinstance(parts[0], list) else torch.cat(parts, axis)

        if len(states) == 1:
            return states[0]
        # the other ranks waited for the slowest
        return each(whole, *states) | {"seconds": max(state["seconds"] for state in states)}


def each(function: Callable[..., Stacked], *states: Any, axis: int = 0) -> Any:
    """A function of all that has a place per seed or per episode in nested states; of the rest what the first has.

    Args:
        function: of the axis, 0 for seeds or -1 for the episodes of the environment, and what each state has there.
    """
    first, *_ = states
    if isinstance(first, dict):
        axes = {"env": -1}
        return {key: each(function, *(s[key] for s in states), axis=axes.get(key, axis)) for key in first}
    if isinstance(first, list) and all(isinstance(item, torch.Tensor) for item in first):
        return function(0, *states)
    return function(axis, *states) if isinstance(first, torch.Tensor) and first.dim() > 0 else first


def shard_of_episodes(config: Config, ranks: Ranks) -> Shard:
    """A rank's part of the episodes of the one seed that all ranks train."""
    num_envs = config.train.num_envs
    if num_envs % ranks.size:
        raise InputError(f"[train] num_envs = {num_envs}: must be a multiple of the {ranks.size} ranks")
    with refusing(f"[ppo] minibatch_size = {config.ppo.minibatch_size}", ValueError):
        ranks.share(config.ppo.minibatch_size)
    return Shard(ranks, slice(0, 1), ranks.share(num_envs), num_envs // ranks.size, ranks)


def shard_of_seeds(config: Config, ranks: Ranks, count: int) -> Shard:
    """A rank's part of so many seeds, which it trains by itself."""
    num_envs = config.train.num_envs
    with refusing(f"[study] seeds = {count}", ValueError):
        seeds = ranks.share(count)
    return Shard(ranks, seeds, slice(seeds.start * num_envs, seeds.stop * num_envs), num_envs, ALONE)

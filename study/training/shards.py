"""Which part of a run is one rank's, and the state of the whole from the states of the parts."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch

from ppo.distributed import ALONE, Ranks
from study.config import Config
from study.errors import InputError, refusing

State = dict[str, Any]


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
        if self.ranks.size == 1:
            return state
        columns, others = parted(state)
        own = each(lambda values: values[self.seeds], others)
        own["env"] |= {name: values[..., self.columns] for name, values in columns.items()}
        return own

    def join(self, states: list[State]) -> State:
        """The state of the whole run from those of all ranks in order."""
        if len(states) == 1:
            return states[0]
        columns, others = zip(*map(parted, states), strict=True)
        shared = self.learners.size > 1  # the seed: all ranks have the same but for the episodes
        whole = each(concatenated, *(others[:1] if shared else others))
        whole["env"] |= {name: torch.cat([part[name] for part in columns], -1) for name in columns[0]}
        whole["seconds"] = max(state["seconds"] for state in states)  # the others waited
        return whole


def parted(state: State) -> tuple[dict[str, torch.Tensor], State]:
    """What has a column per episode, and the rest, of which a part has a place per seed."""
    env = state["env"]
    columns = {name: values for name, values in env.items() if isinstance(values, torch.Tensor)}
    return columns, state | {"env": {name: env[name] for name in env.keys() - columns.keys()}}


def each(function: Callable[..., Any], *states: Any) -> Any:
    """`function` of what has a seed axis, tensors and lists of tensors, in nested states; else what the first has."""
    first, *_ = states
    if isinstance(first, dict):
        return {key: each(function, *(state[key] for state in states)) for key in first}
    stacked = isinstance(first, torch.Tensor) and first.dim() > 0
    listed = isinstance(first, list) and all(isinstance(item, torch.Tensor) for item in first)
    return function(*states) if stacked or listed else first


def concatenated(*parts: Any) -> Any:
    """Tensors or lists, one after another along the seed axis, which comes first."""
    return list(chain(*parts)) if isinstance(parts[0], list) else torch.cat(parts)


def of_episodes(config: Config, ranks: Ranks) -> Shard:
    """A rank's part of the episodes of the one seed that all ranks train."""
    num_envs = config.train.num_envs
    if num_envs % ranks.size:
        raise InputError(f"[train] num_envs = {num_envs}: must be a multiple of the {ranks.size} ranks")
    with refusing(f"[ppo] minibatch_size = {config.ppo.minibatch_size}", ValueError):
        ranks.share(config.ppo.minibatch_size)
    return Shard(ranks, slice(0, 1), ranks.share(num_envs), num_envs // ranks.size, ranks)


def of_seeds(config: Config, ranks: Ranks, count: int) -> Shard:
    """A rank's part of so many seeds, which it trains by itself."""
    num_envs = config.train.num_envs
    with refusing(f"[study] seeds = {count}", ValueError):
        seeds = ranks.share(count)
    return Shard(ranks, seeds, slice(seeds.start * num_envs, seeds.stop * num_envs), num_envs, ALONE)

"""The processes that torchrun started, called ranks: their exchanges, and each rank's part of a run.

Only this file uses torch.distributed. A process that runs alone is rank 0 of 1: its exchanges return their arguments
and cost no time.
"""

import functools
import io
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from itertools import chain
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ppo.errors import RankLostError

PATIENCE = timedelta(hours=1)  # the other ranks wait this long while the first rank evaluates


def is_launched() -> bool:
    """Checks whether torchrun started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def is_first() -> bool:
    """Checks whether this process is rank 0, without contacting the other ranks."""
    return not is_launched() or os.environ["RANK"] == "0"


def local_rank() -> int:
    """Returns the number of this process on its machine, from 0."""
    return int(os.environ.get("LOCAL_RANK", 0))


@contextmanager
def counting_on_others() -> Iterator[None]:
    """Turns the failure of an exchange into a RankLostError."""
    try:
        yield
    except torch.OutOfMemoryError:  # also a RuntimeError, but an error of this rank
        raise
    except RuntimeError as error:  # every backend raises it if a connection closes or stays silent
        said = str(error).splitlines()[0]
        # leave out the place in the source and the advice
        reason = (said.partition("] ")[2] or said).partition(". ")[0]
        raise RankLostError(f"another rank ended ({reason[:120]})") from None


class Ranks:
    """Describes this process among all ranks, and exchanges data with them.

    Attributes:
        rank: its number, from 0; size: the number of ranks.
    """

    def __init__(self, rank: int = 0, size: int = 1, store: dist.Store | None = None) -> None:
        self.rank, self.size, self.store = rank, size, store

    @property
    def first(self) -> bool:
        """Checks whether this is rank 0, which writes and prints for all."""
        return self.rank == 0

    def share(self, count: int) -> slice:
        """Returns which of `count` things in a row are this rank's; the ranks' shares differ by at most one.

        Raises ValueError if there are fewer things than ranks.
        """
        if count < self.size:
            raise ValueError(f"{count} cannot be shared by {self.size} ranks")
        return slice(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def own(self, tensor: Tensor, dim: int) -> Tensor:
        """Returns this rank's share of a tensor that every rank has, along an axis."""
        if self.size == 1:
            return tensor
        share = self.share(tensor.shape[dim])
        return tensor.narrow(dim, share.start, share.stop - share.start)

    def whole(self, tensor: Tensor, dim: int) -> Tensor:
        """Returns the ranks' tensors, of one shape, concatenated along an axis; the same on every rank."""
        if self.size == 1:
            return tensor
        parts = [torch.empty_like(tensor, memory_format=torch.contiguous_format) for _ in range(self.size)]
        own = tensor.contiguous()
        with counting_on_others():
            dist.all_gather(parts, own)
        return torch.cat(parts, dim)

    def average(self, tensors: Sequence[Tensor], samples: int) -> None:
        """Replaces each rank's means over its share of `samples` by the means over all samples, in one exchange."""
        if self.size == 1:
            return
        share = self.share(samples)
        flat = torch.cat([tensor.flatten() for tensor in tensors]) * ((share.stop - share.start) / samples)
        with counting_on_others():
            dist.all_reduce(flat)
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))

    def offset_and_total(self, count: int) -> tuple[int, int]:
        """Returns how many things the ranks before this one take if it takes `count`, and how many all take."""
        if self.size == 1:
            return 0, count
        counts = [torch.zeros(1, dtype=torch.int64) for _ in range(self.size)]
        with counting_on_others():
            dist.all_gather(counts, torch.tensor([count]))
        taken = torch.cat(counts).tolist()
        return sum(taken[: self.rank]), sum(taken)

    def most(self, number: float) -> float:
        """Returns the largest of the ranks' numbers."""
        if self.size == 1:
            return number
        largest = torch.tensor(number, dtype=torch.float64)
        with counting_on_others():
            dist.all_reduce(largest, dist.ReduceOp.MAX)
        return largest.item()

    def any(self, flag: bool) -> bool:
        """Checks whether any rank's flag is set."""
        return bool(self.most(flag))

    def collect(self, thing: Any, device: torch.device) -> list[Any]:
        """Returns on the first rank every rank's thing, with its tensors on `device`; elsewhere an empty list."""
        if self.size == 1:
            return [thing]
        buffer = io.BytesIO()
        torch.save(thing, buffer)
        sent: list[Any] | None = [None] * self.size if self.first else None
        with counting_on_others():
            dist.gather_object(buffer.getvalue(), sent)
        return [torch.load(io.BytesIO(each), device, weights_only=False) for each in sent or ()]

    def agree(self, thing: Any) -> Any:
        """Returns the first rank's thing."""
        if self.size == 1:
            return thing
        things = [thing]
        with counting_on_others():
            dist.broadcast_object_list(things)
        return things[0]

    def first_does(self, deed: Callable[[], None]) -> None:
        """Calls `deed` on the first rank while the others wait; an exception is raised on all ranks."""
        refusal = None
        if self.first:
            try:
                deed()
            except Exception as error:
                refusal = error
        if refusal := self.agree(refusal):
            raise refusal

    def first_to_say(self, what: str) -> bool:
        """Checks whether this is the first rank to say `what`; torchrun keeps the record, which outlives all ranks."""
        try:
            return self.store is None or self.store.add(what, 1) == 1
        except RuntimeError:  # torchrun itself has ended
            return True


ALONE = Ranks()


@functools.cache
def ranks() -> Ranks:
    """Returns the ranks of this job; the first call connects to the others."""
    if not is_launched() or os.environ["WORLD_SIZE"] == "1":
        return ALONE
    store, rank, size = next(dist.rendezvous("env://", timeout=PATIENCE))
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=PATIENCE)
    return Ranks(rank, size, store)


State = dict[str, Any]
Stacked = Tensor | list[Tensor]


@dataclass(frozen=True)
class Shard:
    """Describes a rank's part of a run's S seeds of E episodes each, which follow one another: S x E columns.

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
        """Returns this rank's part of the state of a whole run."""

        def part(axis: int, values: Any) -> Stacked:
            return values[self.seeds] if axis == 0 else values[..., self.columns]

        return state if self.ranks.size == 1 else each(part, state)

    def join(self, states: list[State]) -> State:
        """Returns the state of the whole run from the states of all ranks in order."""
        shared = self.learners.size > 1  # all ranks train one seed; their states differ only in episodes

        def whole(axis: int, *parts: Any) -> Stacked:
            if axis == 0 and shared:
                return parts[0]
            return list(chain(*parts)) if isinstance(parts[0], list) else torch.cat(parts, axis)

        if len(states) == 1:
            return states[0]
        # the other ranks waited for the slowest
        return each(whole, *states) | {"seconds": max(state["seconds"] for state in states)}


def each(function: Callable[..., Stacked], *states: Any, axis: int = 0) -> Any:
    """Applies a function to all parts of nested states that have a place per seed or per episode.

    Other parts are those of the first state.

    Args:
        function: of the axis, 0 for seeds or -1 for slots of episodes, and the part of each state.
    """
    first, *_ = states
    if isinstance(first, dict):
        axes = {"env": -1, "training": -1}
        return {key: each(function, *(s[key] for s in states), axis=axes.get(key, axis)) for key in first}
    if isinstance(first, list) and all(isinstance(item, Tensor) for item in first):
        return function(0, *states)
    return function(axis, *states) if isinstance(first, Tensor) and first.dim() > 0 else first


def shard_of_episodes(num_envs: int, minibatch_size: int, ranks: Ranks) -> Shard:
    """Returns a rank's part of the episodes of one seed that all ranks train; raises ValueError if they do not fit."""
    if num_envs % ranks.size:
        raise ValueError(f"[train] num_envs = {num_envs}: must be a multiple of the {ranks.size} ranks")
    if minibatch_size < ranks.size:
        raise ValueError(f"[ppo] minibatch_size = {minibatch_size}: cannot be shared by {ranks.size} ranks")
    return Shard(ranks, slice(0, 1), ranks.share(num_envs), num_envs // ranks.size, ranks)


def shard_of_seeds(num_envs: int, count: int, ranks: Ranks) -> Shard:
    """Returns a rank's part of `count` seeds, each trained by one rank; raises ValueError if there are too few."""
    if count < ranks.size:
        raise ValueError(f"[study] seeds = {count}: cannot be shared by {ranks.size} ranks")
    seeds = ranks.share(count)
    return Shard(ranks, seeds, slice(seeds.start * num_envs, seeds.stop * num_envs), num_envs, ALONE)

"""The processes that torchrun started, called ranks, and what they exchange. Only this file uses torch.distributed.

A process that runs alone is rank 0 of 1: its exchanges return their arguments.
"""

import functools
import io
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ppo.errors import RankLostError

LAUNCHED = "TORCHELASTIC_RUN_ID"  # is in the environment of what torchrun started
PATIENCE = timedelta(hours=1)  # the other ranks wait this long while the first rank evaluates


def is_first() -> bool:
    """Checks whether this process is rank 0, without contacting the other ranks."""
    return LAUNCHED not in os.environ or os.environ["RANK"] == "0"


@contextmanager
def exchange() -> Iterator[None]:
    """Turns the failure of an exchange into a RankLostError."""
    try:
        yield
    except torch.OutOfMemoryError:  # also a RuntimeError, but an error of this rank
        raise
    except RuntimeError as error:  # every backend raises it if a connection closes or stays silent
        said = str(error).splitlines()[0]
        reason = (said.partition("] ")[2] or said).partition(". ")[0]  # without source line and advice
        raise RankLostError(f"another rank ended ({reason[:120]})") from None


@dataclass(frozen=True)
class Ranks:
    """Describes this process among all ranks, and exchanges data with them; `rank` counts from 0."""

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Checks whether this is rank 0, which writes and prints for all."""
        return self.rank == 0

    def share(self, count: int) -> slice:
        """Returns which of `count` things in a row are this rank's; raises ValueError if there are too few."""
        if count < self.size:
            raise ValueError(f"{count} cannot be shared by {self.size} ranks")
        return slice(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replaces each tensor by its mean over the ranks, in one exchange."""
        if self.size == 1:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors]) / self.size
        with exchange():
            dist.all_reduce(flat)
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))

    def most(self, number: float) -> float:
        """Returns the largest of the ranks' numbers."""
        largest = torch.tensor(number, dtype=torch.float64)
        if self.size > 1:
            with exchange():
                dist.all_reduce(largest, dist.ReduceOp.MAX)
        return largest.item()

    def collect(self, thing: Any, device: torch.device) -> list[Any]:
        """Returns on the first rank every rank's thing, with its tensors on `device`; elsewhere an empty list."""
        if self.size == 1:
            return [thing]
        buffer = io.BytesIO()  # a pickled tensor would stay on its rank's device
        torch.save(thing, buffer)
        sent: list[Any] | None = [None] * self.size if self.first else None
        with exchange():
            dist.gather_object(buffer.getvalue(), sent)
        return [torch.load(io.BytesIO(each), device, weights_only=False) for each in sent or ()]

    def agree(self, thing: Any) -> Any:
        """Returns the first rank's thing."""
        things = [thing]
        if self.size > 1:
            with exchange():
                dist.broadcast_object_list(things)
        return things[0]

    def first_does(self, deed: Callable[[], None]) -> None:
        """Calls `deed` on the first rank while the others wait; all ranks raise its exception."""
        refusal = None
        if self.first:
            try:
                deed()
            except Exception as error:
                refusal = error
        if refusal := self.agree(refusal):
            raise refusal


ALONE = Ranks()


@functools.cache
def ranks() -> Ranks:
    """Returns the ranks of this job; the first call connects to the others."""
    if LAUNCHED not in os.environ or os.environ["WORLD_SIZE"] == "1":
        return ALONE
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=PATIENCE)
    return Ranks(dist.get_rank(), dist.get_world_size())

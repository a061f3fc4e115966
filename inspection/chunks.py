"""Batches cut into chunks: what torch.compile is given, and what fits into the caches of a CPU."""

from collections.abc import Callable

import torch
from torch import Tensor


def in_chunks(function: Callable[..., Tensor], size: int, *tensors: Tensor, filled: bool = False) -> Tensor:
    """function(*tensors) by chunks of `size` along the last axis, the batch.

    Args:
        filled: whether the last chunk is filled up with copies, so that all are alike: torch.compile would
            compile anew for every other size, and faster code for a fixed one.
    """
    batch = tensors[0].shape[-1]
    parts = []
    for start in range(0, batch, size):
        chunk = [tensor[..., start : start + size] for tensor in tensors]
        if filled and batch - start < size:
            columns = torch.arange(size, device=tensors[0].device) % (batch - start)
            chunk = [tensor[..., columns] for tensor in chunk]
        parts.append(function(*(tensor.contiguous() for tensor in chunk)))
    return torch.cat(parts, -1)[..., :batch] if len(parts) > 1 else parts[0][..., :batch]

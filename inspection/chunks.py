"""Batches cut into chunks: what torch.compile is given, and what fits into the caches of a CPU."""

from collections.abc import Callable

import torch
from torch import Tensor

CHUNK = 512


def in_chunks(function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """function(*tensors) by chunks of exactly CHUNK along the last axis, the batch, the last one filled up.

    torch.compile would compile anew for every size of the batch, and faster code for a fixed one.
    """
    batch = tensors[0].shape[-1]
    parts = []
    for start in range(0, batch, CHUNK):
        chunk = [tensor[..., start : start + CHUNK] for tensor in tensors]
        if batch - start < CHUNK:
            filled = torch.arange(CHUNK, device=tensors[0].device) % (batch - start)
            chunk = [tensor[..., filled] for tensor in chunk]
        parts.append(function(*(tensor.contiguous() for tensor in chunk)))
    return torch.cat(parts, -1)[..., :batch] if len(parts) > 1 else parts[0][..., :batch]

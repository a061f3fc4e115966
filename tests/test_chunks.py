"""Chunks against the function of the whole batch."""

import pytest
import torch

from inspection.chunks import in_chunks


@pytest.mark.parametrize("batch", [1, 3, 4, 8, 11])
@pytest.mark.parametrize("filled", [False, True])
def test_chunks_join_to_the_whole(batch, filled):
    x, y = torch.randn(3, 2, batch), torch.randn(2, batch)
    sizes = []

    def function(x, y):
        sizes.append(x.shape[-1])
        return (x * y).sum(0)

    assert torch.equal(in_chunks(function, 4, x, y, filled=filled), (x * y).sum(0))
    assert set(sizes) == {4} if filled else sum(sizes) == batch

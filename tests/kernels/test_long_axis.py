"""An axis that is looped over gives what it gives written out, or is refused."""

import pytest
import torch
from torch import Tensor

from columns import if_long
from kernels.printer import printed
from tests.kernels.test_operations import Function, assert_same, uniform, written

LONG = 100  # points


def table() -> Tensor:
    return torch.sin(torch.arange(3.0 * LONG, dtype=torch.float64)).reshape(3, LONG)


def settled(per_point: Tensor) -> Tensor:
    """Returns three reductions, each of the last one's result: a mean, distances from it, and values within them."""
    mean = per_point.mean(0)
    distance = (per_point - mean).abs()
    within = distance <= distance.mean(0)
    return torch.where(within, per_point, 0.0).sum(0) / within.sum(0)


OVER_POINTS: dict[str, Function] = {
    "sum": lambda x, w: (table().T @ x).sum(0),
    "mean": lambda x, w: (table().T @ x).mean(0, keepdim=True),
    "amin": lambda x, w: (table().T @ x).amin(0),
    "amax": lambda x, w: (table().T @ x * w).amax(0),
    "min": lambda x, w: torch.cat((w.min(0, keepdim=True)[0], (table().T @ x).min(0, keepdim=True)[0])),
    "argmin": lambda x, w: torch.stack((w.argmin(0), (table().T @ x).argmin(0), (w > 0.0).to(w.dtype).argmin(0))),
    "argmax": lambda x, w: torch.stack((w.argmax(0), (table().T @ x).argmax(0), (w > 0.0).to(w.dtype).argmax(0))),
    "the entry at an index": lambda x, w: table()[:, (table().T @ x).argmax(0)] * w.sum(0),
    "the entry at a gathered index": lambda x, w: table()[:1].T.expand(-1, w.shape[-1]).gather(
        0, w.argmin(0, keepdim=True)
    ),
    "any": lambda x, w: (table().T @ x > 1.5).any(0),
    "all": lambda x, w: (table().T @ x > -1.5).all(0),
    "norm": lambda x, w: (table().T @ x).norm(dim=0),
    "logsumexp": lambda x, w: w.logsumexp(0),
    "count": lambda x, w: (w > 0.0).sum(0),
    "count_nonzero": lambda x, w: (w > 0.0).count_nonzero(0),
    "mm over it": lambda x, w: table() @ w,
    "mm of a mask": lambda x, w: table() @ (w > 0.2).to(w.dtype),
    "addmm over it": lambda x, w: torch.addmm(x, table(), w),
    "einsum over it": lambda x, w: torch.einsum("in,nb->ib", table(), w),
    "outputs along it": lambda x, w: table().T @ x + w,
    "masks along it": lambda x, w: torch.stack((w > 0.0, table().T @ x > 0.0)),
    "outputs of a sum along it": lambda x, w: w / w.abs().sum(0),
    "several stages": lambda x, w: settled(table().T @ x + w),
    "axes beside it": lambda x, w: (table().T[:, :, None] * x).transpose(0, 1).amax(1),
    "a view that keeps it": lambda x, w: w[:, None].expand(-1, 2, -1).permute(1, 0, 2)[1].unsqueeze(0).squeeze(0),
    "a view that joins it to what is before": lambda x, w: torch.stack((w, 2.0 * w)).reshape(2 * LONG, -1) + 1.0,
    "two of them": lambda x, w: torch.cat((w, 2.0 * w)),
    "joined and split": lambda x, w: torch.stack((w, 2.0 * w)).flatten(0, 1).unflatten(0, (2, LONG)).sum(1),
    "what does not vary": lambda x, w: x.new_ones(LONG, 1).sum(0) * x[0] + torch.zeros_like(w).sum(0),
    "what varies, of constants": lambda x, w: (table()[0] * table()[1] + 1.0)[:, None] * x[2],
    "written in place": lambda x, w: written(lambda a, b: a.mul_(2.0).masked_fill_(a > 0.5, 0.5))(w, x),
}  # fmt: skip


@pytest.mark.parametrize("batch", [1, 9])
def test_over_points(batch: int) -> None:
    assert_same(
        OVER_POINTS, uniform(-1.0, 1.0, 3, batch), uniform(-1.0, 1.0, LONG, batch), long=LONG, atol=1e-14
    )


def test_over_points_in_single_precision() -> None:
    functions = {
        "seen": lambda x, w: table().float().T @ x.float() > 0.1,
        "sum": lambda x, w: (table().float().T @ x.float()).sum(0),
    }
    assert_same(functions, uniform(-1.0, 1.0, 3, 9), uniform(-1.0, 1.0, LONG, 9), long=LONG, atol=1e-5)


def test_an_axis_that_is_looped_over_is_not_written_out() -> None:
    x, w = uniform(-1.0, 1.0, 3, 1), uniform(-1.0, 1.0, LONG, 1)
    texts = [printed(lambda x, w: [(table().T @ x + w).sum(0)], x, w, long=long).text for long in (0, LONG)]
    assert texts[1].count(";") < 20 < LONG < texts[0].count(";")


def test_a_short_axis_is_written_out_as_another_may_be_as_long() -> None:
    x = uniform(-1.0, 1.0, 16, 3)
    assert_same({"a part": lambda x: x[:3] * x.new_ones(16, 1).sum(0)}, x, long=if_long(16))


@pytest.mark.parametrize(
    ("name", "function"),
    {
        "a slice": lambda w: w[1:],
        "an entry": lambda w: w[0],
        "a list": lambda w: w[[0, 2]],
        "flip": lambda w: w.flip(0),
        "unbind": lambda w: torch.stack(w.unbind(0)[:3]),
        "an entry of an argument": lambda w: w.gather(0, w.argmax(0, keepdim=True)),
        "index_fill": lambda w: w.index_fill(0, torch.tensor([0]), 1.0),
        "a view that joins it to what is behind": lambda w: (
            w[:, None].expand(-1, 2, -1).reshape(2 * LONG, -1)
        ),
        "a sum over it and another": lambda w: torch.stack((w, w)).flatten(0, 1).sum(0),
        "it twice": lambda w: w[:, None] - w[None],
    }.items(),
)
def test_what_an_axis_that_is_looped_over_cannot_do_is_refused(name: str, function: Function) -> None:
    with pytest.raises(NotImplementedError, match="cannot be printed as C"):
        printed(lambda w: [function(w)], uniform(-1.0, 1.0, LONG, 1), long=LONG)

"""Control flow of a batch whose columns differ: `loop`, `when` and `call`.

Called with tensors they compute: a loop's body runs on the columns that still want it, and on no others. While a
function is recorded (`kernels.recorder`) they become loops and functions of C, which give the same bits. There a vector
of columns goes round a loop as long as one of them wants to, and what is computed for the others is dropped. A loop
that `waits` wastes no lane so: a column leaves it at once when its own loop has ended, and another one takes its place
(`kernels.waiting`).

A body is given all tensors that it computes with, alone or in tuples and lists: what it finds around itself has other
columns. What it is given beside them is the same for all columns.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from kernels import calls
from kernels.parts import mapped

R = TypeVar("R", bound=Tensor | Sequence[Tensor])


def loop(
    body: Callable[..., tuple[Sequence[Tensor], Tensor]],
    state: Sequence[Tensor],
    *given: Any,
    alive: Tensor,
    most: int,
    waits: bool = False,
    long: int = 0,
) -> list[Tensor]:
    """Returns what becomes of a state (..., B): of each column, `body(*state, *given)` again and again.

    Args:
        body: returns the next state, and in which columns to go on, (B,) bool.
        given: tensors (..., B) or anything else, the same each time.
        alive: (B,) bool, the columns to begin with; most: times at most.
        waits: in C other columns take the place of those that have ended, see `kernels.waiting`. It counts in a
        function
            that is compiled, and in the bodies of such loops; in a function that these `call` it does not.
        long: of the body, see `kernels.printer.printed`.
    """
    if recorder := calls.active():
        return calls.loop(recorder, body, state, given, alive, most, waits, long)
    state, columns = [x.clone() for x in state], torch.nonzero(alive).flatten()
    parts, own = [pick(x, columns) for x in state], picked(given, columns)
    for _ in range(most):
        if not columns.numel():
            break
        following, goes_on = body(*parts, *own)
        for whole, part in zip(state, following, strict=True):
            put(whole, columns, part)
        kept = torch.nonzero(goes_on).flatten()
        columns, parts, own = columns[kept], [pick(x, kept) for x in following], picked(own, kept)
    return state


def when(
    condition: Tensor,
    function: Callable[..., Sequence[Tensor]],
    otherwise: Sequence[Tensor],
    *given: Any,
    waits: bool = False,
    long: int = 0,
    name: str = "",
) -> list[Tensor]:
    """Returns `function(*given)` in the columns where a condition (B,) holds, else `otherwise` (..., B).

    Arguments as of `loop`; name: in C, "": the function's.
    """
    if recorder := calls.active():
        return calls.when(recorder, condition, function, otherwise, given, waits, long, name)
    results, columns = [x.clone() for x in otherwise], torch.nonzero(condition).flatten()
    if columns.numel():
        for whole, part in zip(results, function(*picked(given, columns)), strict=True):
            put(whole, columns, part)
    return results


def call(function: Callable[..., R], *given: Any, long: int = 0, name: str = "") -> R:
    """Returns `function(*given)`; in C it is a function of that name, printed once. Arguments as of `when`."""
    if recorder := calls.active():
        return calls.call(recorder, function, given, long, name)
    return function(*given)


def picked(given: Sequence[Any], columns: Tensor) -> list[Any]:
    """What is given, of tensors these columns."""
    return mapped(lambda x: pick(x, columns), list(given))


def pick(x: Tensor, columns: Tensor) -> Tensor:
    """x[..., columns], up to twenty times as fast as index_select along the last dimension."""
    return x.gather(-1, columns.expand(*x.shape[:-1], -1))


def put(x: Tensor, columns: Tensor, values: Tensor) -> None:
    """x[..., columns] = values, the counterpart of `pick`."""
    x.scatter_(-1, columns.expand_as(values), values)

"""Control flow of a batch whose columns differ: `loop`, `when` and `call`.

Called with tensors, they compute: a loop's body runs only on the columns that still go on. While a function is recorded
(`kernels.recorder`), they become loops and functions of C that give the same bits. In C a vector of columns goes round
a loop until all its columns have ended; results of columns that ended earlier are dropped. A loop with `waits=True`
keeps its lanes full: a column leaves when its own loop ends, and another column takes its lane (`kernels.waiting`).

A body must receive every tensor that it computes with as an argument, alone or in tuples and lists: tensors of the
function around it have other columns. Other arguments are the same for all columns.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

R = TypeVar("R", bound=Tensor | Sequence[Tensor])
LEAST_LONG = 64  # a shorter axis may be as long as another one


class Recorders(threading.local):
    """Holds the recorders of this thread's functions, the innermost last; each has methods like the functions below."""

    def __init__(self) -> None:
        self.all: list[Any] = []


ACTIVE = Recorders()


def loop(
    body: Callable[..., tuple[Sequence[Tensor], Tensor]],
    state: Sequence[Tensor],
    *given: Any,
    alive: Tensor,
    most: int,
    waits: bool = False,
    long: int = 0,
) -> list[Tensor]:
    """Calls `body(*state, *given)` repeatedly in each column, and returns the last state (..., B).

    Args:
        body: returns the next state, and in which columns to go on, (B,) bool.
        given: tensors (..., B) or anything else, the same each time.
        alive: (B,) bool, the columns to begin with; most: the largest number of calls.
        waits: in C, other columns take the lanes of columns that have ended, see `kernels.waiting`. It counts only in
            the compiled function and in the bodies of its waiting loops; functions that they `call` ignore it.
        long: length of an axis that the body loops over, see `kernels.printer.printed`.
    """
    if ACTIVE.all:
        return ACTIVE.all[-1].loop(body, state, given, alive, most, waits, long)
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

    The other arguments are those of `loop`. name: of the function in C; "": its Python name.
    """
    if ACTIVE.all:
        return ACTIVE.all[-1].when(condition, function, otherwise, given, waits, long, name)
    results, columns = [x.clone() for x in otherwise], torch.nonzero(condition).flatten()
    if columns.numel():
        for whole, part in zip(results, function(*picked(given, columns)), strict=True):
            put(whole, columns, part)
    return results


def call(function: Callable[..., R], *given: Any, long: int = 0, name: str = "") -> R:
    """Returns `function(*given)`; in C it is a function of this name, printed once. Arguments as in `when`."""
    if ACTIVE.all:
        return ACTIVE.all[-1].call(function, given, long, name)
    return function(*given)


def picked(given: Sequence[Any], columns: Tensor) -> list[Any]:
    """Picks columns of all tensors among arguments; returns other arguments as they are."""
    return mapped(lambda x: pick(x, columns), list(given))


def pick(x: Tensor, columns: Tensor) -> Tensor:
    """Returns x[..., columns], up to twenty times faster than index_select along the last dimension."""
    return x.gather(-1, columns.expand(*x.shape[:-1], -1))


def put(x: Tensor, columns: Tensor, values: Tensor) -> None:
    """Sets x[..., columns] = values, the counterpart of `pick`."""
    x.scatter_(-1, columns.expand_as(values), values)


def mapped(function: Callable[[Tensor], Any], given: Any) -> Any:
    """Replaces every tensor in nested tuples and lists by the function's result."""
    if isinstance(given, Tensor):
        return function(given)
    if not isinstance(given, list | tuple) or not tensors_in(given):
        return given
    found = [mapped(function, each) for each in given]
    return type(given)._make(found) if hasattr(given, "_make") else type(given)(found)


def tensors_in(given: Any) -> list[Tensor]:
    """Returns the tensors in nested tuples and lists, in order."""
    if isinstance(given, Tensor):
        return [given]
    return [x for each in given for x in tensors_in(each)] if isinstance(given, list | tuple) else []


def if_long(length: int) -> int:
    """Returns `long` for an axis: its length, or 0, so that it is written out, if another one may be as long."""
    return length if length >= LEAST_LONG else 0

"""PyTorch's operations that move values and compute nothing, on NumPy object arrays; the names are PyTorch's.

An array has its tensor's shape, except for the long axis, if there is one: its length there is one, and its entry
stands for all entries along this axis.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from kernels.operations.expressions import MASK, Expression, Program, Value, kind_of


class Axes:
    """Describes which axes of tensors are written out, and which one is looped over.

    Args:
        long: length of the axis that is looped over; 0: none is.

    Attributes:
        given: the shapes of the operands of the present operation.
    """

    def __init__(self, long: int = 0) -> None:
        self.long = long
        self.given: list[tuple[int, ...]] = []

    @property
    def lengths(self) -> tuple[int, ...]:
        """Returns the shape of the first tensor."""
        return self.given[0]

    def short(self, shape: Sequence[int]) -> tuple[int, ...]:
        """Returns the shape of a tensor's array; an axis that the long one was joined to is long, too."""
        if not self.long:
            return tuple(shape)
        self.tail(shape)
        return tuple(size // self.long if self.holds_long(size) else size for size in shape)

    def holds_long(self, size: int) -> bool:
        """Checks whether an axis of this length is the long one, or one that the long one was joined to."""
        return bool(self.long) and size > 0 and size % self.long == 0

    def tail(self, shape: Sequence[int]) -> int:
        """Returns how many numbers of a tensor lie between two neighbours along the long axis."""
        found = [i for i, size in enumerate(shape) if self.holds_long(size)]
        if len(found) > 1:
            raise NotImplementedError("more than one axis that is looped over")
        return math.prod(shape[found[0] + 1 :]) if found else 0

    def is_long(self, axis: int) -> bool:
        """Checks whether an axis of the first tensor is the long one."""
        return bool(self.long) and self.lengths[axis] == self.long

    def written(self, dim: int) -> int:
        """Returns the index from 0 of an axis of the first tensor; the axis must not be the long one."""
        if self.holds_long(self.lengths[dim]):
            raise NotImplementedError("along an axis that is looped over")
        return dim % len(self.lengths)


class Shapes:
    """Provides the operations that move values.

    Attributes:
        views: operations whose result shares memory with its operand, in PyTorch and in NumPy.
        others: the rest.
    """

    def __init__(self, program: Program, axes: Axes) -> None:
        self.program, self.axes = program, axes
        self.views: dict[str, Callable[..., Any]] = {
            **{name: lambda x: x for name in ("alias", "detach", "real")},
            "t": lambda x: x.T,
            "transpose": np.swapaxes,
            "permute": lambda x, dims: x.transpose(dims),
            "unsqueeze": np.expand_dims,
            "squeeze": self.squeeze,
            "view": self.view,
            "expand": self.expand,
            "select": self.select,
            "slice": self.slice,
            "unbind": self.unbind,
            "split": self.split,
            "split_with_sizes": self.split,
        }
        self.others: dict[str, Callable[..., Any]] = {
            **{name: lambda x, *_, **__: x.copy() for name in ("_to_copy", "to", "clone")},
            **{name: self.views["view"] for name in ("_unsafe_view", "reshape")},
            "cat": lambda parts, dim=0: np.concatenate([part for part in parts if part.shape != (0,)], dim),
            "stack": lambda parts, dim=0: np.stack(parts, dim),
            "flip": lambda x, dims: np.flip(x, [axes.written(dim) for dim in dims]),
            "repeat": lambda x, times: np.tile(x, times),
            "copy": lambda x, other, *_: np.broadcast_to(other, x.shape),
            "fill": lambda x, value: np.full(x.shape, value, dtype=object),
            "zero": lambda x: np.full(x.shape, 0.0, dtype=object),
            "index": self.index,
            "index_select": lambda x, dim, index: x.take(whole(index), axes.written(dim)),
            "index_put": self.index_put,
            "gather": self.gather,
        }

    # views

    def view(self, x: ndarray, shape: Sequence[int]) -> ndarray:
        """Returns x in another shape; the long axis may be joined to those before it."""
        if -1 in shape:
            rest = math.prod(self.axes.lengths) // -math.prod(shape)
            shape = [rest if size == -1 else size for size in shape]
        if self.axes.tail(shape) != self.axes.tail(self.axes.lengths):
            raise NotImplementedError("along an axis that is looped over")
        return x.reshape(self.axes.short(shape))

    def squeeze(self, x: ndarray, dim: int | Sequence[int] | None = None) -> ndarray:
        """Returns x without axes of length one: all of them, or the named ones."""
        named = range(x.ndim) if dim is None else [dim] if isinstance(dim, int) else dim
        return x.squeeze(tuple(i % x.ndim for i in named if self.axes.lengths[i] == 1))

    def expand(self, x: ndarray, shape: Sequence[int], **_: Any) -> ndarray:
        """Returns x broadcast; -1 keeps a length."""
        kept = (1,) * (len(shape) - x.ndim) + x.shape
        wanted = zip(self.axes.short(shape), kept, strict=True)
        return np.broadcast_to(x, [old if size == -1 else size for size, old in wanted])

    def select(self, x: ndarray, dim: int, index: int) -> ndarray:
        """Returns x[index] along an axis."""
        axis = self.axes.written(dim)
        return x[(*[slice(None)] * axis, slice(index, index + 1 or None))].squeeze(axis)

    def slice(
        self, x: ndarray, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
    ) -> ndarray:
        """Returns x[start:end:step] along an axis; of the long axis only all of it."""
        axis, length = dim % x.ndim, self.axes.lengths[dim]
        wanted = slice(start, end, step)
        if wanted.indices(length) == (0, length, 1):
            return x[:]
        return x[(*[slice(None)] * self.axes.written(axis), wanted)]

    def unbind(self, x: ndarray, dim: int = 0) -> list[ndarray]:
        """Returns all x[i] along an axis."""
        return [self.select(x, dim, i) for i in range(self.axes.lengths[dim])]

    def split(self, x: ndarray, sizes: int | Sequence[int], dim: int = 0) -> list[ndarray]:
        """Returns x in parts along an axis, of these sizes."""
        axis = self.axes.written(dim)
        if isinstance(sizes, int):
            return np.split(x, range(sizes, x.shape[axis], sizes), axis)
        return np.split(x, np.cumsum(sizes)[:-1], axis)

    # others

    def index(self, x: ndarray, indices: Sequence[Any]) -> ndarray:
        """Returns x[indices], one per axis from the first one on; None: all along that axis.

        Indices and masks are known, or one index is computed.
        """
        computed = [axis for axis, index in enumerate(indices) if depends(index)]
        if not computed:
            return x[self.known(indices)]
        (axis,), (index,) = computed, [each for each in indices if each is not None]
        entries = np.moveaxis(x, axis, 0)
        if any(kind_of(each) == MASK for each in index.flat):
            raise NotImplementedError("with a mask that is computed, instead of torch.where,")
        p, count = self.program, float(self.axes.lengths[axis])
        index = filled([p.select(p.lt(i, 0.0), p.add(i, count), i) for i in index.flat], index.shape)
        found = np.empty((*index.shape, *entries.shape[1:]), dtype=object)
        for place in np.ndindex(index.shape):
            for other in np.ndindex(entries.shape[1:]):
                column = entries[(slice(None), *other)]
                found[place + other] = self.entry(column, index[place], self.axes.is_long(axis))
        return np.moveaxis(found, range(index.ndim), range(axis, axis + index.ndim))

    def known(self, indices: Sequence[Any]) -> tuple[Any, ...]:
        """Returns indices as NumPy takes them."""
        found, axis = [], 0
        for index in indices:
            if index is None:
                found.append(slice(None))
                axis += 1
                continue
            found.append(whole(index))
            for _ in range(found[-1].ndim if found[-1].dtype == bool else 1):
                axis = self.axes.written(axis) + 1
        return tuple(found)

    def index_put(self, x: ndarray, indices: Sequence[Any], value: ndarray) -> ndarray:
        """Returns x with x[indices] replaced, for known indices, or by one number where a computed mask is true."""
        if len(indices) == 1 and depends(indices[0]) and value.size == 1:
            mask = indices[0].reshape(*indices[0].shape, *[1] * (x.ndim - indices[0].ndim))
            pairs = zip(np.broadcast_to(mask, x.shape).flat, x.flat, strict=True)
            return filled([self.program.select(each, value.item(), old) for each, old in pairs], x.shape)
        x = x.copy()
        x[self.known(indices)] = value
        return x

    def gather(self, x: ndarray, dim: int, index: ndarray, **_: Any) -> ndarray:
        """Returns x[index] along an axis; for a computed index, one entry after the other is compared."""
        axis = dim % x.ndim
        entries = np.moveaxis(x, axis, 0)
        found = np.empty(index.shape, dtype=object)
        for place in np.ndindex(index.shape):
            column = entries[(slice(None), *place[:axis], *place[axis + 1 :])]
            found[place] = self.entry(column, index[place], self.axes.is_long(axis))
        return found

    def entry(self, entries: ndarray, wanted: Value, along_long: bool) -> Value:
        """Returns entries[wanted], along the axis that is looped over or another one."""
        if along_long:
            return self.program.lookup(entries[0], wanted)
        if not isinstance(wanted, Expression):
            return entries[int(wanted)]
        return self.program.entry(list(entries), wanted)


def objects(value: Any) -> ndarray:
    """Returns a number, a truth value or an expression as an object array; arrays as they are."""
    if isinstance(value, ndarray):
        return value
    array = np.empty((), dtype=object)
    array[()] = float(value) if isinstance(value, int | float) and not isinstance(value, bool) else value
    return array


def depends(values: Any) -> bool:
    """Checks whether any of these values, or of those in lists, is an expression."""
    if isinstance(values, list | tuple):
        return any(map(depends, values))
    if isinstance(values, ndarray):
        return any(isinstance(value, Expression) for value in values.flat)
    return isinstance(values, Expression)


def whole(index: ndarray) -> ndarray:
    """Returns known indices or masks as integers or truth values."""
    if depends(index):
        raise NotImplementedError("with an index that is computed")
    is_mask = bool(index.size) and all(isinstance(each, bool) for each in index.flat)
    return index.astype(bool if is_mask else int)


def filled(values: Sequence[Value], shape: tuple[int, ...]) -> ndarray:
    """Returns an object array of this shape with these values."""
    return np.fromiter(values, object, len(values)).reshape(shape)

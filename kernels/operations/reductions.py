"""PyTorch's operations along axes, as operations on values: sums, extremes and products of matrices."""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
from numpy import ndarray

from kernels.operations.expressions import Program, Value
from kernels.operations.shapes import Axes, depends, objects

Dims = int | Sequence[int] | None


class Reductions:
    """Provides the reductions of one program.

    Args:
        call: applies an operation on elements, by its name, to arrays.

    Attributes:
        by_name: all of these operations.
    """

    def __init__(self, program: Program, axes: Axes, call: Callable[..., ndarray]) -> None:
        self.program, self.axes, self.call = program, axes, call
        self.sum = partial(self.joined, "add", "sum", 0.0)
        self.least = partial(self.joined, "minimum", "least", math.inf)
        self.most = partial(self.joined, "maximum", "most", -math.inf)
        self.any = partial(self.joined, "logical_or", "any", False)
        self.by_name: dict[str, Callable[..., Any]] = {
            "sum": lambda x, *given, **kept: self.sum(self.call("positive", x), *given, **kept),
            "mean": self.mean,
            "amin": self.least,
            "amax": self.most,
            "any": self.any,
            "all": lambda x, *given: self.call("logical_not", self.any(self.call("logical_not", x), *given)),
            "min": partial(self.first, "least"),
            "max": partial(self.first, "most"),
            "argmin": lambda *given: self.first("least", *given)[1],
            "argmax": lambda *given: self.first("most", *given)[1],
            "linalg_vector_norm": self.norm,
            **{name: self.product for name in ("mm", "bmm")},
            **{name: self.added_product for name in ("addmm", "baddbmm")},
        }  # fmt: skip

    def joined(
        self, join: str, along: str, start: Value, x: ndarray, dim: Dims = None, keepdim: bool = False
    ) -> ndarray:
        """Joins x along one or several axes, in order; `along`: the reduction over the long axis."""
        dims = [dim] if isinstance(dim, int) else dim
        if not dims:
            if depends(x):
                raise NotImplementedError("over all axes, so also over the columns; name an axis (dim)")
            dims = range(x.ndim)
        for axis in sorted((dim % x.ndim for dim in dims), reverse=True):
            if self.axes.is_long(axis):
                x = self.over_long(along, x.squeeze(axis))
            else:
                parts = list(np.moveaxis(x, self.axes.written(axis), 0))
                nothing = np.full(x.shape[:axis] + x.shape[axis + 1 :], start, dtype=object)
                x = reduce(partial(self.call, join), parts) if parts else nothing
            x = np.expand_dims(objects(x), axis) if keepdim else objects(x)
        return x

    def over_long(self, along: str, x: ndarray) -> ndarray:
        """Joins values that vary along the long axis over this axis."""
        found = np.empty(x.shape, dtype=object)
        for place in np.ndindex(x.shape):
            found[place] = self.program.reduce(along, x[place], self.axes.long)
        return found

    def mean(self, x: ndarray, dim: Dims = None, keepdim: bool = False) -> ndarray:
        """Returns the mean of the entries along axes."""
        dims = [dim] if isinstance(dim, int) else dim or range(len(self.axes.lengths))
        count = float(math.prod(self.axes.lengths[i] for i in dims))
        return self.call("div", self.by_name["sum"](x, dim, keepdim), count)

    def norm(self, x: ndarray, order: float = 2, dim: Dims = None, keepdim: bool = False) -> ndarray:
        """Returns the norm of vectors along axes: (sum |x|^order)^(1 / order), and its limits."""
        size = self.call("abs", x)
        if math.isinf(order):
            return (self.most if order > 0.0 else self.least)(size, dim, keepdim)
        if order == 0.0:
            return self.sum(self.call("positive", self.call("ne", x, 0.0)), dim, keepdim)
        if order == 2.0:
            return self.call("sqrt", self.sum(self.call("mul", x, x), dim, keepdim))
        return self.call("pow", self.sum(self.call("pow", size, order), dim, keepdim), 1.0 / order)

    def first(self, kind: str, x: ndarray, dim: int, keepdim: bool = False) -> tuple[ndarray, ...]:
        """Returns the first least or most entry along an axis, and its index; NaN comes before all other entries."""
        p = self.program
        if dim is None:
            raise NotImplementedError("over all axes, so also over the columns; name an axis (dim)")
        if self.axes.is_long(dim):
            found = [self.over_long(each, x.squeeze(dim)) for each in (kind, f"{kind}_at")]
            return tuple(np.expand_dims(each, dim) if keepdim else each for each in found)
        entries = np.moveaxis(x, self.axes.written(dim), 0)
        best, index = np.empty(entries.shape[1:], object), np.empty(entries.shape[1:], object)
        for place in np.ndindex(entries.shape[1:]):
            value, at = entries[(0, *place)], 0.0
            for i, other in enumerate(entries[(slice(1, None), *place)], 1):
                # false if one of them is NaN
                stays = p.le(value, other) if kind == "least" else p.le(other, value)
                better = p.and_(p.not_(stays), p.eq(value, value))
                value, at = p.select(better, other, value), p.select(better, float(i), at)
            best[place], index[place] = value, at
        if keepdim:
            return np.expand_dims(best, dim), np.expand_dims(index, dim)
        return best, index

    def product(self, a: ndarray, b: ndarray) -> ndarray:
        """Returns a @ b (..., M, K) and (..., K, N), each inner product added up in order, or over the long axis."""
        return self.sum(self.call("mul", a[..., None], b[..., None, :, :]), a.ndim - 1)

    def added_product(self, x: ndarray, a: ndarray, b: ndarray, beta: float = 1, alpha: float = 1) -> ndarray:
        """Returns beta x + alpha a @ b."""
        self.axes.given = self.axes.given[1:]
        scaled = self.call("mul", self.product(a, b), float(alpha))
        return self.call("add", self.call("mul", x, float(beta)), scaled)

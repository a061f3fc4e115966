"""What PyTorch's operations do to arrays of scalar values: elementwise arithmetic is written out, views cost nothing.

A tensor is a NumPy object array of its shape, the batch being its last axis of length one. Along the long axis, if
there is one, an array has length one, too, and its entries stand for all that lie along it.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from kernels.expressions import Expression, Program, Value

aten = torch.ops.aten


class Operations:
    """The operations of one program.

    Args:
        program: takes the expressions.
        long: length of the axis that is looped over instead of written out; 0: none is.

    Attributes:
        lengths: the shape of the tensor that the next operation is of first, with the long axis as long as it is.
        by_name: each operation by its name in PyTorch ("add", "where"), of arrays and plain arguments.
    """

    def __init__(self, program: Program, long: int = 0) -> None:
        self.program, self.long = program, long
        self.lengths: tuple[int, ...] = ()
        p = program
        unary = {
            "neg": p.neg,
            "abs": partial(p.call, "fabs"),
            "reciprocal": partial(p.div, 1.0),
            "rsqrt": lambda a: p.div(1.0, p.call("sqrt", a)),
            "relu": lambda a: p.max(a, 0.0),
            "sign": self.sign,
            "sgn": self.sign,
            "round": partial(p.call, "rint"),
            "deg2rad": lambda a: p.mul(a, math.pi / 180.0),
            "square": lambda a: p.mul(a, a),
            "bitwise_not": p.not_,
            "logical_not": p.not_,
            "isnan": lambda a: p.not_(p.eq(a, a)),
            "isinf": lambda a: p.eq(p.call("fabs", a), math.inf),
            "isfinite": lambda a: p.lt(p.call("fabs", a), math.inf),
            "erf": partial(p.call, "erf"),
        }
        unary |= {name: partial(p.call, name) for name in FUNCTIONS}
        binary = {
            "add": self.plus,
            "sub": lambda a, b, alpha=1: self.plus(a, b, -alpha),
            "rsub": lambda a, b, alpha=1: self.plus(b, a, -alpha),
            "mul": p.mul,
            "div": self.divided,
            "pow": self.raised,
            "minimum": p.min,
            "maximum": p.max,
            "atan2": partial(p.call, "atan2"),
            "lt": p.lt,
            "le": p.le,
            "gt": lambda a, b: p.lt(b, a),
            "ge": lambda a, b: p.le(b, a),
            "eq": p.eq,
            "ne": lambda a, b: p.not_(p.eq(a, b)),
            "bitwise_and": p.and_,
            "bitwise_or": p.or_,
            "logical_and": p.and_,
            "logical_or": p.or_,
        }
        self.by_name: dict[str, Callable[..., Any]] = {
            **{name: self.elementwise(function) for name, function in (unary | binary).items()},
            "where": self.elementwise(p.select),
            "masked_fill": lambda x, mask, value: self.elementwise(p.select)(mask, value, x),
            "clamp": self.clamp,
            "clamp_min": lambda x, low: self.elementwise(p.max)(x, low),
            "clamp_max": lambda x, high: self.elementwise(p.min)(x, high),
            "nan_to_num": self.nan_to_num,
            **{name: lambda x, *_, **__: x.copy() for name in COPIES},
            "addcmul": lambda x, a, b, value=1: self.call("add", x, self.call("mul", a, b), alpha=value),
            "lerp": lambda a, b, t: self.call("add", a, self.call("mul", t, self.call("sub", b, a))),
            **VIEWS,
            **JOINS,
            **{name: partial(self.filled, value) for name, value in FILLED.items()},
            "new_full": lambda x, shape, value, **_: self.full(shape, value),
            "full": lambda shape, value, **_: self.full(shape, value),
            "new_zeros": lambda x, shape, **_: self.full(shape, 0.0),
            "new_ones": lambda x, shape, **_: self.full(shape, 1.0),
            "zeros": lambda shape, **_: self.full(shape, 0.0),
            "_efficientzerotensor": lambda shape, **_: self.full(shape, 0.0),
            "ones": lambda shape, **_: self.full(shape, 1.0),
            "_new_zeros_with_same_feature_meta": lambda x, other, **_: self.full(other.shape, 0.0),
            "scalar_tensor": lambda value, **_: objects(value),
            "full_like": lambda x, value, **_: self.full(x.shape, value),
            "fill": lambda x, value: self.full(x.shape, value),
            "zero": lambda x: self.full(x.shape, 0.0),
            "eye": lambda n, m=None, **_: objects(np.eye(n, m)),
            "arange": lambda *bounds, **_: objects(np.arange(*bounds)),
            "copy": lambda x, other, *_: np.broadcast_to(other, x.shape).copy(),
            "expand": self.expand,
            "view": self.view,
            "_unsafe_view": self.view,
            "reshape": self.view,
            "repeat": self.repeat,
            "select_scatter": self.select_scatter,
            "slice_scatter": self.slice_scatter,
            "index_fill": self.index_fill,
            "gather": self.gather,
            "sum": partial(self.reduced, p.add, "sum"),
            "amin": partial(self.reduced, p.min, "least"),
            "amax": partial(self.reduced, p.max, "most"),
            "any": partial(self.reduced, p.or_, "any"),
            "all": self.all,
            "min": partial(self.extreme, p.lt),
            "max": partial(self.extreme, lambda a, b: p.lt(b, a)),
            "argmin": lambda x, dim, keepdim=False: self.extreme(p.lt, x, dim, keepdim)[1],
            "argmax": lambda x, dim, keepdim=False: self.extreme(lambda a, b: p.lt(b, a), x, dim, keepdim)[1],
            "linalg_vector_norm": lambda x, order=2, dim=None, keepdim=False: self.call(
                "sqrt", self.call("sum", self.call("mul", x, x), dim, keepdim)
            ),
            "mm": self.product,
            "dot": lambda a, b: self.product(a[None], b[:, None])[0, 0],
        }

    def call(self, name: str, *arguments: Any, **options: Any) -> Any:
        """An operation; NotImplementedError names one that is not there."""
        if name not in self.by_name:
            raise NotImplementedError(f"{name} cannot be printed as C")
        return self.by_name[name](*arguments, **options)

    # scalars

    def elementwise(self, function: Callable[..., Value]) -> Callable[..., ndarray]:
        """A function of scalars as one of arrays, which broadcast."""

        def run(*arrays: Any, **options: Any) -> ndarray:
            parts = np.broadcast_arrays(*(objects(a) for a in arrays))
            found = [function(*each, **options) for each in zip(*(part.flat for part in parts), strict=True)]
            result = np.empty(len(found), dtype=object)
            result[:] = found
            return result.reshape(parts[0].shape)

        return run

    def plus(self, a: Value, b: Value, alpha: float = 1) -> Value:
        """a + alpha b."""
        if alpha == -1:
            return self.program.sub(a, b)
        return self.program.add(a, self.program.mul(float(alpha), b))

    def divided(self, a: Value, b: Value, rounding_mode: str | None = None) -> Value:
        """a / b, rounded towards zero ("trunc") or down ("floor") if wanted."""
        share = self.program.div(a, b)
        return self.program.call(rounding_mode, share) if rounding_mode else share

    def raised(self, a: Value, b: Value) -> Value:
        """a ** b."""
        p = self.program
        return p.call("pow", a, b) if isinstance(b, Expression) else p.power(a, float(b))

    def sign(self, a: Value) -> Value:
        """-1, 0 or 1."""
        p = self.program
        return p.sub(p.number(p.lt(0.0, a)), p.number(p.lt(a, 0.0)))

    def clamp(self, x: ndarray, low: Any = None, high: Any = None) -> ndarray:
        """Of NaN it is NaN; where the bounds cross, the upper one."""
        if low is not None:
            x = self.by_name["maximum"](x, low)
        return x if high is None else self.by_name["minimum"](x, high)

    def nan_to_num(
        self, x: ndarray, nan: float = 0.0, above: float | None = None, below: float | None = None
    ):
        """Numbers for NaN and infinity."""
        most = torch.finfo(torch.float64).max
        x = self.call("where", self.call("isnan", x), nan or 0.0, x)
        x = self.call("where", self.call("eq", x, math.inf), most if above is None else above, x)
        return self.call("where", self.call("eq", x, -math.inf), -most if below is None else below, x)

    # shapes

    def short(self, shape: Sequence[int]) -> tuple[int, ...]:
        """A shape with one for the long axis."""
        return tuple(1 if self.long and size == self.long else size for size in shape)

    def full(self, shape: Sequence[int], value: Value) -> ndarray:
        """A constant."""
        return np.full(self.short(shape), objects(value), dtype=object)

    def filled(self, value: Value, x: ndarray, **_: Any) -> ndarray:
        """A constant of the shape of x."""
        return np.full(x.shape, value, dtype=object)

    def expand(self, x: ndarray, shape: Sequence[int], **_: Any) -> ndarray:
        """x broadcast; -1 keeps a length."""
        missing = len(shape) - x.ndim
        kept = [x.shape[i - missing] if size == -1 else size for i, size in enumerate(self.short(shape))]
        return np.broadcast_to(x, kept)

    def view(self, x: ndarray, shape: Sequence[int]) -> ndarray:
        """x in another shape."""
        return x.reshape(self.short(shape))

    def repeat(self, x: ndarray, times: Sequence[int]) -> ndarray:
        """x, several times along each axis."""
        return np.tile(x, self.short(times))

    def select_scatter(self, x: ndarray, part: ndarray, dim: int, index: int) -> ndarray:
        """x with a part replaced."""
        x = x.copy()
        np.moveaxis(x, dim, 0)[index] = part
        return x

    def slice_scatter(
        self, x: ndarray, part: ndarray, dim: int = 0, start: int = 0, end: int | None = None, step: int = 1
    ) -> ndarray:
        """x with a slice replaced."""
        x = x.copy()
        np.moveaxis(x, dim, 0)[start : None if end is None else min(end, x.shape[dim]) : step] = np.moveaxis(
            part, dim, 0
        )
        return x

    def index_fill(self, x: ndarray, dim: int, index: ndarray, value: Any) -> ndarray:
        """x with entries at known indices replaced."""
        x = x.copy()
        np.moveaxis(x, dim, 0)[[int(i) for i in index.flat]] = value
        return x

    def gather(self, x: ndarray, dim: int, index: ndarray) -> ndarray:
        """x[index] along an axis, with computed indices: one after the other is looked for."""
        entries = np.moveaxis(x, dim, 0)
        found = np.empty(index.shape, dtype=object)
        for place in np.ndindex(index.shape):
            wanted, rest = index[place], list(place)
            del rest[dim if dim >= 0 else index.ndim + dim]
            found[place] = self.entry(entries[(slice(None), *rest)], wanted)
        return found

    def entry(self, entries: ndarray, wanted: Value) -> Value:
        """entries[wanted]."""
        if not isinstance(wanted, Expression):
            return entries[int(wanted)]
        result = entries[-1]
        for i in reversed(range(len(entries) - 1)):
            result = self.program.select(self.program.eq(wanted, float(i)), entries[i], result)
        return result

    # along axes

    def reduced(
        self, join: Callable[[Value, Value], Value], long: str, x: ndarray, dim: Any = None,
        keepdim: bool = False, **_: Any,
    ) -> ndarray:  # fmt: skip
        """x joined along one or several axes, in order."""
        axes = range(x.ndim) if dim is None else [dim] if isinstance(dim, int) else list(dim)
        axes = sorted(axis % x.ndim for axis in axes)
        for axis in reversed(axes):
            parts = list(np.moveaxis(x, axis, 0))
            if self.is_long(axis):
                x = self.elementwise(lambda a: self.program.reduce(long, a, self.long))(parts[0])
            else:
                if long == "sum":
                    parts = [self.elementwise(self.program.number)(part) for part in parts]
                x = reduce(self.elementwise(join), parts) if parts else np.full(x.shape[:axis], 0.0, object)
            x = np.expand_dims(objects(x), axis) if keepdim else objects(x)
        return x

    def all(self, x: ndarray, dim: Any = None, keepdim: bool = False) -> ndarray:
        """Whether all along an axis are true."""
        return self.call("bitwise_not", self.call("any", self.call("bitwise_not", x), dim, keepdim))

    def extreme(
        self, before: Callable[[Value, Value], Value], x: ndarray, dim: int, keepdim: bool = False
    ) -> tuple[ndarray, ndarray]:
        """The first least (or most) entry along an axis, and its index; NaN comes before all else."""
        p = self.program
        entries = np.moveaxis(x, dim, 0)
        best, index = np.empty(entries.shape[1:], object), np.empty(entries.shape[1:], object)
        for place in np.ndindex(entries.shape[1:]):
            value, at = entries[(0, *place)], 0.0
            for i, other in enumerate(entries[(slice(1, None), *place)], 1):
                better = p.or_(before(other, value), p.and_(p.not_(p.eq(other, other)), p.eq(value, value)))
                value, at = p.select(better, other, value), p.select(better, float(i), at)
            best[place], index[place] = value, at
        if keepdim:
            return np.expand_dims(best, dim), np.expand_dims(index, dim)
        return best, index

    def product(self, a: ndarray, b: ndarray) -> ndarray:
        """a @ b, each inner product added up in order, or over the long axis."""
        times = self.call("mul", a[:, :, None], b[None])
        return self.reduced(self.program.add, "sum", times, 1)

    def is_long(self, axis: int) -> bool:
        """Whether an axis of the tensor that the operation is of is the long one."""
        return bool(self.long) and self.lengths[axis] == self.long


def objects(value: Any) -> ndarray:
    """Numbers, truth values or expressions as an object array."""
    if isinstance(value, ndarray) and value.dtype == object:
        return value
    if isinstance(value, Expression):
        array = np.empty((), dtype=object)
        array[()] = value
        return array
    plain = np.asarray(value.numpy() if isinstance(value, Tensor) else value)
    return plain.astype(bool if plain.dtype == bool else float).astype(object)


def sliced(
    x: ndarray, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
) -> ndarray:
    """x[start:end:step] along an axis."""
    index = [slice(None)] * x.ndim
    index[dim] = slice(start, end, step)
    return x[tuple(index)]


def split(x: ndarray, sizes: int | Sequence[int], dim: int = 0) -> list[ndarray]:
    """x in parts along an axis, of these sizes."""
    if isinstance(sizes, int):
        return np.split(x, range(sizes, x.shape[dim], sizes), dim)
    return np.split(x, np.cumsum(sizes)[:-1], dim)


FUNCTIONS = ("sqrt", "sin", "cos", "tan", "acos", "asin", "atan", "exp", "log", "tanh", "sinh", "cosh", "asinh",
             "floor", "ceil", "trunc")  # fmt: skip
FILLED = {"zeros_like": 0.0, "ones_like": 1.0}
COPIES = ("_to_copy", "to", "clone", "contiguous", "lift_fresh_copy")
# what shares its memory with what it is of, in PyTorch and in NumPy
VIEWS: dict[str, Callable[..., Any]] = {
    "alias": lambda x: x,
    "detach": lambda x: x,
    "lift_fresh": lambda x: x,
    "t": lambda x: x.T,
    "transpose": lambda x, a, b: np.swapaxes(x, a, b),
    "permute": lambda x, dims: x.transpose(dims),
    "unsqueeze": np.expand_dims,
    "squeeze": lambda x, dim=None: x.squeeze(dim if dim is None or isinstance(dim, int) else tuple(dim)),
    "select": lambda x, dim, index: sliced(x, dim, index, index + 1 or None).squeeze(dim),
    "slice": sliced,
    "unbind": lambda x, dim=0: [part.squeeze(dim) for part in np.split(x, x.shape[dim], dim)],
    "split": split,
    "split_with_sizes": split,
}
JOINS: dict[str, Callable[..., Any]] = {
    "cat": lambda parts, dim=0: np.concatenate([part for part in parts if part.shape != (0,)], dim),
    "stack": lambda parts, dim=0: np.stack(parts, dim),
    "flip": lambda x, dims: np.flip(x, tuple(dims)).copy(),
    "roll": lambda x, shifts, dims: np.roll(x, tuple(shifts), tuple(dims)),
}

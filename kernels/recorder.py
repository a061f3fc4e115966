"""What a function of tensors computes, as expressions: PyTorch's operations are recorded while it runs.

PyTorch hands every operation that it runs to `Recorder`: those of derivatives, too, and few, as most are made of
others. What they do to numbers is done to values as well.
"""

import functools
import gc
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from columns import ACTIVE, tensors_in
from kernels.operations.aten import Operations
from kernels.operations.expressions import MASK, NUMBER, Program, Value, kind_of
from kernels.operations.shapes import filled
from kernels.parts import TYPES, Called, Part, element

INTEGERS = {torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8}  # numbers without a fraction here
PLACES_AND_TYPES = {"dtype", "device", "layout", "pin_memory", "memory_format", "implicit", "non_blocking"}
# whose result depends on the shape and the type of what they are of, but not on its values
OF_SHAPE = {
    *(f"{kind}_like" for kind in ("zeros", "ones", "full", "empty")),
    *(f"new_{kind}" for kind in ("zeros", "ones", "full", "empty")),
    "empty",
    "_efficientzerotensor",
    "_new_zeros_with_same_feature_meta",
}
RECORDING = threading.RLock()  # the garbage collector is everybody's


SEEN_BY = (Tensor.tolist, Tensor.numpy, Tensor.__array__)  # without an operation
BRANCH = "values that decide what is computed, as in `if`, float() or x[x > 0], cannot be printed as C: use torch.where"


class Unprintable(NotImplementedError):
    """What cannot be printed, why, and where it is wanted."""


class Known(NamedTuple):
    """What is known of a tensor.

    Attributes:
        tensor: kept, so that no other is given its id or its memory.
        values: an array of its shape, see `kernels.operations.shapes`.
        fixed: its numbers are the same for any arguments, until something else is written to its memory.
    """

    tensor: Tensor
    values: ndarray
    fixed: bool


class Recorder(TorchDispatchMode):
    """Has every operation that PyTorch runs done on values, too.

    Tensors that share memory have arrays that do, so that what is written in place is seen in all of them. A tensor
    that no recorded operation made is a constant. What is computed from constants alone, PyTorch has computed.

    Args:
        on: the columns in which the function is wanted; True: there is one column.
        called: takes the functions that this one calls.

    Attributes:
        known: each tensor by its id; written, torn: memory that is not fixed any more, or that some view's array does
            not share.
        is_double: float64 was computed.
        is_aside: nothing is recorded now.
    """

    def __init__(self, program: Program, long: int, on: Value, called: Called) -> None:
        super().__init__()
        self.program, self.operations = program, Operations(program, long)
        self.on, self.called, self.is_aside = on, called, False
        self.known: dict[int, Known] = {}
        self.written: set[int] = set()
        self.torn: set[int] = set()
        self.is_double = False

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Of PyTorch's: no, nothing is compiled in here. Yes loads its compiler, which takes a second or two."""
        return False

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Records nothing meanwhile."""
        before, self.is_aside = self.is_aside, True
        try:
            yield
        finally:
            self.is_aside = before

    def put(self, tensor: Tensor, array: ndarray, fixed: bool = False) -> None:
        """Says what a tensor's values are."""
        if array.shape != self.operations.axes.short(tensor.shape):
            raise NotImplementedError("along an axis that is looped over")
        self.known[id(tensor)] = Known(tensor, array, fixed)

    def values(self, given: Any) -> Any:
        """The values of a tensor, and of those in lists; anything else as it is."""
        if isinstance(given, Tensor):
            if id(given) not in self.known:
                if any(id(given) in other.known and not other.is_fixed(given) for other in ACTIVE.all[:-1]):
                    raise NotImplementedError(f"of a tensor {tuple(given.shape)} that the body was not given")
                array = self.constant(given)
                array.flags.writeable = False  # it is not the function's own
                self.put(given, array, fixed=True)
            return self.known[id(given)].values
        return [self.values(each) for each in given] if isinstance(given, list | tuple) else given

    def is_fixed(self, tensor: Tensor) -> bool:
        """Whether a tensor's numbers are the same for any arguments."""
        self.values(tensor)
        return self.known[id(tensor)].fixed and memory(tensor) not in self.written

    def constant(self, tensor: Tensor) -> ndarray:
        """The values of a tensor as literals, along the long axis as tables."""
        check_type(tensor.dtype)
        if tensor._is_zerotensor() or tensor.is_meta:
            tensor = torch.zeros(tensor.shape, dtype=tensor.dtype)
        array = tensor.detach().cpu().numpy()
        axes = self.operations.axes
        axis = next((i for i, size in enumerate(array.shape) if axes.holds_long(size)), None)
        if axis is None:
            return array.astype(bool if array.dtype == bool else float).astype(object)
        times = array.shape[axis] // axes.long
        apart = array.reshape(*array.shape[:axis], times, axes.long, *array.shape[axis + 1 :])
        entries = np.moveaxis(apart, axis + 1, -1)
        rows = entries.reshape(-1, axes.long).tolist()
        return filled([self.program.table(row) for row in rows], axes.short(array.shape))

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """One operation."""
        result = function(*args, **(kwargs or {}))
        if self.is_aside:
            return result
        try:
            self.record(function, result, args, kwargs or {})
        except Unprintable:  # of what it is made of
            raise
        except NotImplementedError as error:
            raise Unprintable(explained(function.name(), str(error))) from error
        return result

    def record(self, function: Any, result: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> None:
        """Does an operation on values."""
        name, is_random, is_by_values = said_of(function)
        given = self.values(args)
        options = {key: self.values(each) for key, each in kwargs.items() if key not in PLACES_AND_TYPES}
        operands = tensors_in([*args, *kwargs.values()])
        fixed = all(self.is_fixed(each) for each in operands)
        if is_random:
            raise NotImplementedError("of random numbers")
        if is_by_values and not fixed:
            raise NotImplementedError(BRANCH)
        own = [each for each in tensors_in(result) if not each.is_meta]  # which has no numbers
        if not own:
            return
        self.operations.axes.given = [tuple(each.shape) for each in operands]
        if name == "lift_fresh":  # a constant that the function makes for itself
            self.put(result, given[0] if given[0].flags.writeable else given[0].copy(), fixed)
        elif name in self.operations.views:
            self.view(own, args[0], self.viewed(name, given, options, own, fixed))
        elif name in OF_SHAPE or fixed:
            for tensor in own:
                self.write(tensor, self.constant(tensor), name, fixed=True)
        elif name.removesuffix("_") not in self.operations.by_name and function in decompositions():
            with self:  # what it is made of
                found = decompositions()[function](*args, **kwargs)
            for tensor, part in zip(own, tensors_in(found), strict=True):
                self.put(tensor, self.values(part))
        else:
            found = self.operations.call(name.removesuffix("_"), *given, **options)
            for tensor, array in zip(own, found if isinstance(found, tuple) else [found], strict=True):
                self.write(tensor, self.typed(array, tensor.dtype, name), name)

    def write(self, tensor: Tensor, array: ndarray, name: str, fixed: bool = False) -> None:
        """Takes values for a tensor: for the one that an operation writes to in place, or for a new one."""
        if not name.endswith("_"):
            self.put(tensor, array, fixed)
            return
        own = self.values(tensor)
        if not own.flags.writeable:
            raise NotImplementedError("to a tensor that the function was given")
        if memory(tensor) in self.torn:
            raise NotImplementedError("to a tensor that others are views of")
        if not fixed:
            self.written.add(memory(tensor))
        own[...] = array

    def viewed(
        self, name: str, given: Sequence[Any], options: dict[str, Any], own: Sequence[Tensor], fixed: bool
    ) -> Any:
        """The values of views; of constants copies will do."""
        try:
            return self.operations.call(name, *given, **options)
        except NotImplementedError:
            if not fixed:
                raise
            return [self.constant(tensor) for tensor in own]

    def view(self, results: Sequence[Tensor], of: Tensor, found: Any) -> None:
        """Takes the values of views of a tensor."""
        for tensor, array in zip(results, found if isinstance(found, list) else [found], strict=True):
            self.put(tensor, array, self.known[id(of)].fixed)
            if array.size and not np.may_share_memory(array, self.values(of)):
                self.torn.add(memory(of))

    def typed(self, found: ndarray, dtype: torch.dtype, name: str) -> ndarray:
        """Values as their type in PyTorch has them: truth values or numbers, whole ones, or of single precision."""
        check_type(dtype)
        p = self.program
        if dtype == torch.bool:
            as_one: Callable[[Value], Value] = p.mask
        elif dtype == torch.float32 and p.real == "double":
            as_one = p.single
        elif dtype in INTEGERS and name in ("_to_copy", "to", "copy_"):
            as_one = partial(whole, p)
        else:
            as_one = p.number
            self.is_double |= dtype == torch.float64
        return filled([as_one(value) for value in found.flat], found.shape)


class Watch(TorchFunctionMode):
    """Refuses Python's looks at what is computed that run no operation."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__()
        self.recorder = recorder

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Any call of PyTorch's."""
        if function in SEEN_BY and not self.recorder.is_aside and not self.recorder.is_fixed(args[0]):
            raise Unprintable(explained("", BRANCH))
        return function(*args, **(kwargs or {}))


@torch.no_grad()
def evaluated(
    function: Callable[..., Any],
    examples: Sequence[Tensor],
    parts: Sequence[Part],
    recorder: Recorder,
) -> tuple[Any, list[ndarray]]:
    """What a function returns of examples, and the values of its tensors, (..., 1) each; `parts` are its arguments."""
    inputs = [x.clone() for x in examples]
    for part, x in zip(parts, inputs, strict=True):
        array = argument(recorder, part)
        array.flags.writeable = False
        recorder.put(x, array)
    with RECORDING, uncollected(), Watch(recorder), recorder:
        ACTIVE.all.append(recorder)
        try:
            results = function(*inputs)
        finally:
            ACTIVE.all.pop()
    return results, [recorder.values(each) for each in tensors_in(results)]


def argument(recorder: Recorder, part: Part) -> ndarray:
    """The values of an input."""
    shape = recorder.operations.axes.short(part.shape)
    kind = MASK if part.is_mask else NUMBER
    values = [
        recorder.program.input(element(part, place, shape), kind, shape != part.shape, part.kind == "float")
        for place in np.ndindex(shape)
    ]
    return filled(values, (*shape, 1))


@functools.cache
def decompositions() -> Mapping[Any, Callable[..., Any]]:
    """Operations as functions of others, as `torch.export` takes them apart."""
    from torch.export import default_decompositions

    return default_decompositions()


def whole(p: Program, value: Value) -> Value:
    """A number without its fraction."""
    return p.number(value) if kind_of(value) == MASK else p.call("trunc", value)


def check_type(dtype: torch.dtype) -> None:
    """Refuses numbers that C does not compute with here."""
    if dtype not in TYPES and dtype not in INTEGERS:
        raise NotImplementedError(f"of {dtype}")


def memory(tensor: Tensor) -> int:
    """Where a tensor's numbers are; 0 where PyTorch only knows that they are zero."""
    return 0 if tensor._is_zerotensor() else tensor.untyped_storage().data_ptr()


@functools.cache
def said_of(function: Any) -> tuple[str, bool, bool]:
    """An operation's name; whether its result is random, and whether values decide what it computes or its shape."""
    name, tags = function.name().split("::")[1].split(".")[0], function.tags
    by_values = torch.Tag.dynamic_output_shape in tags and name != "index"
    return (
        name,
        torch.Tag.nondeterministic_seeded in tags,
        by_values or torch.Tag.data_dependent_output in tags,
    )


@contextmanager
def uncollected() -> Iterator[None]:
    """Has the garbage collector wait: what is recorded stays, and to look through it takes a fifth of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def explained(operation: str, reason: str) -> str:
    """What cannot be printed, why not, and which line of whose program wants it."""
    text = reason if reason == BRANCH else f"{operation} {reason}".strip() + " cannot be printed as C"
    ours = (str(Path(torch.__file__).parent), str(Path(__file__).parent))
    for frame in reversed(traceback.extract_stack()):
        if not frame.filename.startswith(ours) and frame.name != "__torch_function__":
            return f"{text} ({Path(frame.filename).name}, line {frame.lineno}: {frame.line})"
    return text

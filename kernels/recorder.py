"""Records what a function of tensors computes, as expressions: PyTorch's operations while the function runs.

PyTorch passes every operation that it runs to `Recorder`, also those of derivatives. There are few kinds, since most
operations are made of others. The recorder applies each operation to values, too.
"""

import functools
import gc
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor
from torch.export import default_decompositions
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from columns import ACTIVE, tensors_in
from kernels.operations.aten import Operations
from kernels.operations.expressions import Program, Value
from kernels.operations.shapes import filled
from kernels.parts import TYPES, Called, Part, element

INTEGERS = {torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8}  # numbers without a fraction
PLACES_AND_TYPES = {"dtype", "device", "layout", "pin_memory", "memory_format", "implicit", "non_blocking"}
# operations whose result depends on the operand's shape and type, but not on its values
OF_SHAPE = {
    *(f"{kind}_like" for kind in ("zeros", "ones", "full", "empty")),
    *(f"new_{kind}" for kind in ("zeros", "ones", "full", "empty")),
    "empty",
    "_efficientzerotensor",
    "_new_zeros_with_same_feature_meta",
}
RECORDING = threading.RLock()  # needed because all threads share the garbage collector


SEEN_BY = (Tensor.tolist, Tensor.numpy, Tensor.__array__)  # read values without an operation
BRANCH = "values that decide what is computed, as in `if`, float() or x[x > 0], cannot be printed as C: use torch.where"


class Unprintable(NotImplementedError):
    """Signals what cannot be printed, why, and where it is needed."""


class Known(NamedTuple):
    """Holds what is known of a tensor.

    Attributes:
        tensor: kept, so that no other tensor gets its id or its memory.
        values: an array of its shape, see `kernels.operations.shapes`.
        fixed: its numbers are the same for any arguments, until something else is written to its memory.
    """

    tensor: Tensor
    values: ndarray
    fixed: bool


class Recorder(TorchDispatchMode):
    """Applies every operation that PyTorch runs to values, too.

    Tensors that share memory have arrays that share memory, so that writing in place is seen in all of them. A tensor
    that no recorded operation made is a constant. Results computed from constants alone are PyTorch's.

    Args:
        on: the columns in which the function is wanted; True: there is one column.
        called: collects the functions that this one calls.

    Attributes:
        known: each tensor by its id; written: memory that is not fixed any more; torn: memory that some view's array
            does not share.
        is_double: whether float64 was computed.
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
        """Returns PyTorch's setting: False, since nothing is compiled in here. True loads its compiler in 1 to 2 s."""
        return False

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Stops recording within the context."""
        before, self.is_aside = self.is_aside, True
        try:
            yield
        finally:
            self.is_aside = before

    def put(self, tensor: Tensor, array: ndarray, fixed: bool = False) -> None:
        """Sets a tensor's values."""
        if array.shape != self.operations.axes.short(tensor.shape):
            raise NotImplementedError("along an axis that is looped over")
        self.known[id(tensor)] = Known(tensor, array, fixed)

    def values(self, given: Any) -> Any:
        """Returns the values of a tensor, and of tensors in lists; other arguments as they are."""
        if isinstance(given, Tensor):
            if id(given) not in self.known:
                if any(id(given) in other.known and not other.is_fixed(given) for other in ACTIVE.all[:-1]):
                    raise NotImplementedError(f"of a tensor {tuple(given.shape)} that the body was not given")
                array = self.constant(given)
                array.flags.writeable = False  # the tensor is not the function's own
                self.put(given, array, fixed=True)
            return self.known[id(given)].values
        return [self.values(each) for each in given] if isinstance(given, list | tuple) else given

    def is_fixed(self, tensor: Tensor) -> bool:
        """Checks whether a tensor's numbers are the same for any arguments."""
        self.values(tensor)
        return self.known[id(tensor)].fixed and memory(tensor) not in self.written

    def constant(self, tensor: Tensor) -> ndarray:
        """Returns the values of a tensor as literals, along the long axis as tables."""
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
        """Runs one operation and records it."""
        result = function(*args, **(kwargs or {}))
        if self.is_aside:
            return result
        try:
            self.record(function, result, args, kwargs or {})
        except Unprintable:  # raised by an operation of which this one is made
            raise
        except NotImplementedError as error:
            raise Unprintable(explained(function.name(), str(error))) from error
        return result

    def record(self, function: Any, result: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> None:
        """Applies an operation to values."""
        name, is_random, is_by_values = said_of(function)
        given = self.values(args)
        options = {key: self.values(each) for key, each in kwargs.items() if key not in PLACES_AND_TYPES}
        operands = tensors_in([*args, *kwargs.values()])
        fixed = all(self.is_fixed(each) for each in operands)
        if is_random:
            raise NotImplementedError("of random numbers")
        if is_by_values and not fixed:
            raise NotImplementedError(BRANCH)
        own = [each for each in tensors_in(result) if not each.is_meta]  # meta tensors have no numbers
        if not own:
            return
        self.operations.axes.given = [tuple(each.shape) for each in operands]
        if name == "lift_fresh":  # a constant that the function makes for itself
            self.put(result, given[0] if given[0].flags.writeable else given[0].copy(), fixed)
        elif name in self.operations.views:
            self.view(name, args[0], own, given, options, fixed)
        elif name in OF_SHAPE or fixed:
            for tensor in own:
                self.write(tensor, self.constant(tensor), name, fixed=True)
        elif name.removesuffix("_") not in self.operations.by_name and function in decompositions():
            with self:  # records the operations of which this one is made
                found = decompositions()[function](*args, **kwargs)
            for tensor, part in zip(own, tensors_in(found), strict=True):
                self.put(tensor, self.values(part))
        else:
            found = self.operations.call(name.removesuffix("_"), *given, **options)
            for tensor, array in zip(own, found if isinstance(found, tuple) else [found], strict=True):
                self.write(tensor, self.typed(array, tensor.dtype, name), name)

    def write(self, tensor: Tensor, array: ndarray, name: str, fixed: bool = False) -> None:
        """Sets values of a tensor: of the one that an operation writes to in place, or of a new one."""
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

    def view(
        self,
        name: str,
        of: Tensor,
        results: Sequence[Tensor],
        given: Sequence[Any],
        options: dict[str, Any],
        fixed: bool,
    ) -> None:
        """Sets the values of views of a tensor; for constants, copies are enough."""
        try:
            found = self.operations.call(name, *given, **options)
        except NotImplementedError:
            if not fixed:
                raise
            found = [self.constant(tensor) for tensor in results]
        for tensor, array in zip(results, found if isinstance(found, list) else [found], strict=True):
            self.put(tensor, array, self.known[id(of)].fixed)
            if array.size and not np.may_share_memory(array, self.values(of)):
                self.torn.add(memory(of))

    def typed(self, found: ndarray, dtype: torch.dtype, name: str) -> ndarray:
        """Returns values in their PyTorch type: truth values, numbers, whole numbers or numbers of single precision."""
        check_type(dtype)
        p = self.program
        if dtype == torch.bool:
            as_one: Callable[[Value], Value] = p.mask
        elif dtype == torch.float32 and p.real == "double":
            as_one = p.single
        elif dtype in INTEGERS and name in ("_to_copy", "to", "copy_"):
            as_one = p.whole
        else:
            as_one = p.number
            self.is_double |= dtype == torch.float64
        return filled([as_one(value) for value in found.flat], found.shape)


class Watch(TorchFunctionMode):
    """Refuses Python's reads of recorded values that run no operation."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Handles any call of PyTorch."""
        recorder = ACTIVE.all[-1]
        if function in SEEN_BY and not recorder.is_aside and not recorder.is_fixed(args[0]):
            raise Unprintable(explained("", BRANCH))
        return function(*args, **(kwargs or {}))


@torch.no_grad()
def evaluated(
    function: Callable[..., Any], examples: Sequence[Tensor], parts: Sequence[Part], recorder: Recorder
) -> tuple[Any, list[ndarray]]:
    """Returns a function's results for examples of `parts`, and the values of its tensors, (..., 1) each."""
    inputs = [x.clone() for x in examples]
    for part, x in zip(parts, inputs, strict=True):
        shape = recorder.operations.axes.short(part.shape)
        kinds = part.values, shape != part.shape, part.kind == "float"
        places = [element(part, at, shape) for at in np.ndindex(shape)]
        array = filled([recorder.program.input(place, *kinds) for place in places], (*shape, 1))
        array.flags.writeable = False
        recorder.put(x, array)
    with RECORDING, uncollected(), Watch(), recorder:
        ACTIVE.all.append(recorder)
        try:
            results = function(*inputs)
        finally:
            ACTIVE.all.pop()
    return results, [recorder.values(each) for each in tensors_in(results)]


# operations as functions of others
decompositions = functools.cache(default_decompositions)


def check_type(dtype: torch.dtype) -> None:
    """Raises NotImplementedError for number types that the printed C does not support."""
    if dtype not in TYPES and dtype not in INTEGERS:
        raise NotImplementedError(f"of {dtype}")


def memory(tensor: Tensor) -> int:
    """Returns where a tensor's numbers are; 0 if PyTorch only knows that they are zero."""
    return 0 if tensor._is_zerotensor() else tensor.untyped_storage().data_ptr()


@functools.cache
def said_of(function: Any) -> tuple[str, bool, bool]:
    """Returns an operation's name, whether its result is random, and whether values decide its computation or shape."""
    name, tags = function.name().split("::")[1].split(".")[0], function.tags
    by_values = torch.Tag.dynamic_output_shape in tags and name != "index"
    by_values |= torch.Tag.data_dependent_output in tags
    return name, torch.Tag.nondeterministic_seeded in tags, by_values


@contextmanager
def uncollected() -> Iterator[None]:
    """Pauses the garbage collector: what is recorded stays, and searching it takes a fifth of the time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def explained(operation: str, reason: str) -> str:
    """Returns what cannot be printed, why, and which line of which program needs it."""
    text = reason if reason == BRANCH else f"{operation} {reason}".strip() + " cannot be printed as C"
    ours = (str(Path(torch.__file__).parent), str(Path(__file__).parent))
    for frame in reversed(traceback.extract_stack()):
        if not frame.filename.startswith(ours) and frame.name != "__torch_function__":
            return f"{text} ({Path(frame.filename).name}, line {frame.lineno}: {frame.line})"
    return text

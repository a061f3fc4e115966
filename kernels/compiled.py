"""Compiled functions of a batch: printed as C on a CPU, by torch.compile on CUDA."""

import ctypes
import os
import timeit
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from types import FunctionType
from typing import Any

import torch
from torch import Tensor

from kernels import build
from kernels.build import for_vectors, header
from kernels.printer import Printed, printed
from kernels.waiting import INCLUDE

WORTH_A_THREAD = 6e-5  # s of computing from which on a thread for a share is worth its overhead
WORTH_A_FILE = 4000  # lines of C from which on another process of the compiler is worth its overhead
SHARED = '__attribute__((visibility("hidden")))'  # visible only to the files of a library
PROBED = 512  # columns that are timed to know the time of a column

DTYPES = {"double": torch.float64, "float": torch.float32, "bool": torch.bool, "long": torch.int64}

Parts = list[Tensor]


class Compiled:
    """Compiles a function of tensors (..., B) to several tensors (..., B) whose columns are independent.

    Args:
        function: what to compile; without control flow that depends on values.
        examples: arguments of one column, on the device to compile for.
        batch: how many columns a call will usually have; any number is allowed.
        long: length of an axis that is looped over, see `printed`.

    Raises:
        NoCompilerError: no C compiler works.
        NotImplementedError: the function cannot be printed.
    """

    def __init__(
        self, function: Callable[..., Parts], *examples: Tensor, batch: int = 256, long: int = 0
    ) -> None:
        if examples[0].device.type == "cpu":
            self.run: Callable[..., Parts] = Kernel(printed(function, *examples, long=long), examples)
        else:
            self.run = torch.compile(with_own_code(function), dynamic=True)
            self(*(example.expand(*example.shape[:-1], batch).contiguous() for example in examples))

    @torch.no_grad()  # torch.compile specialises its code to this mode
    def __call__(self, *tensors: Tensor, times: int = 1) -> Parts:
        """Returns `function`'s results, or those after `times` calls in a row.

        Each further call has the last result as its first tensor.
        """
        if isinstance(self.run, Kernel):
            return self.run(*tensors, times=times)
        parts = self.run(*tensors)
        for _ in range(times - 1):
            parts = self.run(parts[0], *tensors[1:])
        return parts


class Kernel:
    """Runs a printed function on batches, with as many of PyTorch's threads as are worth their overhead.

    Args:
        examples: arguments of one column, to time a column with.
        library: contains `batch(function)`; None: make one.
    """

    def __init__(
        self, function: Printed, examples: Sequence[Tensor], library: ctypes.CDLL | None = None
    ) -> None:
        self.parts, self.shapes, self.dtypes = function.inputs, function.shapes, function.dtypes
        self.inputs = [i for i, shape in enumerate(function.given) if 0 not in shape]
        if library is None:
            library = build.library(sources(function))
        self.run = getattr(library, f"{function.name}_batch")
        self.run.argtypes = [ctypes.c_long, ctypes.c_long, *[ctypes.c_void_p] * 4, ctypes.c_long]
        self.run.restype = ctypes.c_long
        self.waits = bool(function.waiting)
        self.seconds = 0.0  # time of a column; 0: not known yet
        probe = [examples[i].expand(*examples[i].shape[:-1], PROBED).contiguous() for i in self.inputs]
        self.seconds = min(timeit.repeat(lambda: self.of(probe, PROBED), number=1, repeat=3)) / PROBED

    def __call__(self, *tensors: Tensor, times: int = 1) -> Parts:
        """Returns the function's results, after `times` calls in a row; raises ValueError for several if loops wait."""
        if times > 1 and self.waits:
            raise ValueError(f"times = {times}: must be 1 where loops wait")
        return self.of([tensors[i] for i in self.inputs], tensors[0].shape[-1], times)

    def of(self, tensors: Sequence[Tensor], columns: int, times: int = 1) -> Parts:
        """Returns the function's results for arguments that have components; raises ValueError if they do not fit."""
        for part, x in zip(self.parts, tensors, strict=True):
            dtype, shape = DTYPES[part.kind], (*part.shape, columns)
            if x.dtype != dtype or x.shape != shape or not x.is_cpu:
                raise ValueError(
                    f"{part.name}: {x.dtype} {tuple(x.shape)} on {x.device}: must be {dtype} {shape} on the CPU"
                )
        results = [
            torch.empty(*shape, columns, dtype=dtype)
            for shape, dtype in zip(self.shapes, self.dtypes, strict=True)
        ]
        # components evenly apart, columns neighbours
        flat = [x.reshape(part.size, columns) for part, x in zip(self.parts, tensors, strict=True)]
        given = [x if x.stride(1) == 1 or columns == 1 else x.contiguous() for x in flat]
        found = [x for x in results if x.numel()]
        if columns:
            arguments = (*pointers(given), *pointers(found), times)
            if in_shares(
                lambda first, last: self.run(first, last, *arguments), columns, self.seconds * times
            ):
                raise MemoryError("for columns that wait")
        return results


def sources(function: Printed, apart: bool = True) -> dict[str, str]:
    """Returns a printed function and its `batch` in C, by file.

    Args:
        apart: functions called by a long function get a file of their own, which is compiled in parallel.
    """
    head, own = for_vectors(function.real), function.text + batch(function)
    if function.waiting:
        own = function.waiting.replace(INCLUDE, header("waiting.h"))
    if not apart or sum(part.count("\n") for part in function.parts) < WORTH_A_FILE:
        return {function.name: "\n".join([head, *function.parts, own])}
    parts = [part.replace("\nstatic void ", f"\n{SHARED} void ", 1) for part in function.parts]
    declared = [part[part.index(SHARED) : part.index("\n{")] + ";" for part in parts]
    return {
        f"{function.name}_parts": "\n".join([head, *declared, *parts]),
        function.name: "\n".join([head, *declared, own]),
    }


def batch(function: Printed) -> str:
    """Returns in C the loop of a printed function over columns: NAME_batch(first, last, in, steps, out, steps, times).

    It runs several times in a row, each with the last result for its first argument, until this result does not change.
    """
    inputs, outputs = function.inputs, function.outputs
    both = (*inputs, *outputs)
    call = f"{function.name}({', '.join([*(['YES'] if function.is_told else []), *(part.name for part in both)])});"
    loads, stores = [], []
    for i, x in enumerate(inputs):
        load = f"load_{x.kind}(in[{i}], k * in_step[{i}] + column, lanes)"
        loads.append(f"        for (long k = 0; k < {x.size}; k++) {{ {x.name}[k] = {load}; }}")
    for i, y in enumerate(outputs):
        store = f"store_{y.kind}(out[{i}], k * out_step[{i}] + column, lanes, {y.name}[k]);"
        stores.append(f"        for (long k = 0; k < {y.size}; k++) {{ {store} }}")
    lines = [
        f"long {function.name}_batch(long first, long last, const void *const *in, const long *in_step,",
        "    void *const *out, const long *out_step, long times)",
        "{",
        "    for (long column = first; column < last; column += W) {",
        "        const long lanes = last - column;",
        *(f"        {part.array()};" for part in both),
        *loads,
        f"        {call}",
        *repeated(function, call),
        *stores,
        "    }",
        "    return 0;",
        "}",
        "",
    ]  # fmt: skip
    return "\n".join(lines)


def repeated(function: Printed, call: str) -> list[str]:
    """Returns the lines of C that call a function again, if its first result may be its first argument."""
    if not function.inputs or not function.outputs:
        return []
    start, end = function.inputs[0], function.outputs[0]
    if (start.shape, start.kind) != (end.shape, end.kind):
        return []
    return [
        f"        for (long k = 1; k < times && memcmp({start.name}, {end.name}, sizeof {end.name}); k++) {{",
        f"            memcpy({start.name}, {end.name}, sizeof {end.name});",
        f"            {call}",
        "        }",
    ]


def pointers(tensors: Sequence[Tensor]) -> tuple[Any, Any]:
    """Returns where tensors (..., B) begin, and how far apart their components are, as C takes them."""
    count = len(tensors)
    places = (ctypes.c_void_p * count)(*(x.data_ptr() for x in tensors))
    steps = (ctypes.c_long * count)(*(x.stride(-2) if x.dim() > 1 else 0 for x in tensors))
    return places, steps


most_threads: int | None = None  # limit of threads that share a batch's columns; None: PyTorch's number
POOLS: dict[int, ThreadPoolExecutor] = {}


def with_one_thread() -> None:
    """Makes a forked process use one thread: it inherits no others, and PyTorch would wait for its own threads."""
    global most_threads
    POOLS.clear()
    most_threads = None
    torch.set_num_threads(1)


os.register_at_fork(after_in_child=with_one_thread)


def in_shares(run: Callable[[int, int], int], columns: int, seconds: float) -> int:
    """Runs over columns in as many ranges as there are threads, if each has enough to do; sums the results.

    Args:
        run: of columns first to last.
        seconds: time of a column.
    """
    shares = int(columns * seconds / WORTH_A_THREAD)
    shares = min(most_threads or torch.get_num_threads(), shares) if shares > 1 else shares
    if shares < 2:
        return run(0, columns)
    size = -(-columns // shares)
    size += -size % 64  # whole vectors
    if shares not in POOLS:
        POOLS[shares] = ThreadPoolExecutor(shares)
    others = [POOLS[shares].submit(run, i, min(i + size, columns)) for i in range(size, columns, size)]
    try:
        own = run(0, min(size, columns))
    finally:
        wait(others)  # they write into tensors that an error would free
    return own + sum(other.result() for other in others)


def with_own_code(function: Callable[..., Parts]) -> FunctionType:
    """Returns a function, a method or a partial as a function with a code object of its own.

    `torch.compile` counts recompilations by code object: functions that share one have eight recompilations together,
    and further ones run uncompiled.
    """

    def run(*tensors: Tensor) -> Parts:
        return function(*tensors)

    return FunctionType(run.__code__.replace(), run.__globals__, run.__name__, None, run.__closure__)

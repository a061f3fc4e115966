"""Functions of a batch, compiled: ahead of time and by chunks on a CPU, kept across runs. Or traced only."""

import ctypes
import hashlib
import os
import platform
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import reduce
from pathlib import Path
from types import FunctionType
from typing import Any
from zipfile import ZipFile

import torch
from torch import Tensor
from torch.fx import GraphModule, Node

SIZES = (16, 256)  # of a chunk: for few spacecraft, for many; a CPU's caches hold the latter
WORTH_A_THREAD = 3e-4  # s of computing that repay handing a chunk to a thread, which waits for Python's lock
UNROLLED = 32  # terms of an inner product up to which they are written out

COPIES = {  # and other names of the same values
    getattr(torch.ops.aten, name).default for name in ("alias", "detach", "clone", "lift_fresh_copy")
}

TRACING = threading.Lock()  # PyTorch's tracer changes what all threads share

Parts = list[Tensor]


def unchanged(x: Tensor) -> Tensor:
    """x."""
    return x


class Compiled:
    """A function of tensors (..., B) to several tensors (..., B) whose columns are independent, compiled.

    Args:
        function: what to compile; without control flow that depends on values.
        examples: arguments of one column, on the device to compile for.
        batch: how many columns a call will usually have; any number is allowed.
        trace_only: run the traced operations one by one, bit for bit what `function` does, without a compiler.
        finish: what is done, elementwise, to what the function returns: chunk by chunk, too, but not compiled.

    Raises:
        whatever PyTorch's compiler raises where there is no working C++ compiler.
    """

    def __init__(
        self,
        function: Callable[..., Parts],
        *examples: Tensor,
        batch: int = SIZES[-1],
        trace_only: bool = False,
        finish: Callable[[Tensor], Tensor] = unchanged,
    ) -> None:
        self.finish = finish
        self.shapes = [part.shape[:-1] for part in function(*examples)]
        self.by_size = trace_only or examples[0].device.type == "cpu"
        self.on_threads = False

        def packed(*tensors: Tensor) -> Tensor:
            return torch.cat([part.flatten(0, -2) for part in function(*tensors)])

        self.size = next((size for size in SIZES if batch <= size), SIZES[-1])
        columns = [example.expand(*example.shape[:-1], self.size).contiguous() for example in examples]
        if trace_only:
            with TRACING:
                self.run = traced(packed, *columns)
        elif self.by_size:
            with TRACING:
                self.run = ahead_of_time(packed, *columns)
            self.on_threads = min(timed(self.run, *columns) for _ in range(3)) > WORTH_A_THREAD
        else:
            self.run = torch.compile(with_own_code(packed), dynamic=True)
            self(*columns)

    @torch.no_grad()  # a mode that torch.compile's code is specialised to
    def __call__(self, *tensors: Tensor, times: int = 1) -> Parts:
        """What `function` returns, or after `times` calls in a row, each with the last result for its first tensor."""
        batch = tensors[0].shape[-1]
        run = self.by_chunks if self.by_size else self.in_a_row
        packed = run(times, *tensors)
        parts = packed[:, :batch].split([shape.numel() for shape in self.shapes])
        return [part.view(*shape, batch) for part, shape in zip(parts, self.shapes, strict=True)]

    def in_a_row(self, times: int, first: Tensor, *others: Tensor) -> Tensor:
        """The packed parts (K, B) after `times` calls."""
        for _ in range(times):
            first = self.run(first, *others)
        return self.finish(first)

    def by_chunks(self, times: int, *tensors: Tensor) -> Tensor:
        """The packed parts (K, >= B), computed by chunks of a fixed size, the last one filled up with copies."""

        def chunk(start: int) -> Tensor:
            columns = (filled(tensor[..., start : start + self.size], self.size) for tensor in tensors)
            return self.in_a_row(times, *columns)

        starts = range(0, tensors[0].shape[-1], self.size)
        if not starts:
            return self.finish(tensors[0].new_empty(sum(shape.numel() for shape in self.shapes), 0))
        if len(starts) == 1:
            return chunk(0)
        threads = torch.get_num_threads() if self.on_threads else 1
        return torch.cat(list(pool(threads).map(chunk, starts) if threads > 1 else map(chunk, starts)), 1)


def with_own_code(function: FunctionType) -> FunctionType:
    """The function with a copy of its code, which `torch.compile` counts its recompilations by.

    Functions that share it have eight between them; what is compiled after those runs uncompiled.
    """
    parts = function.__globals__, function.__name__, function.__defaults__, function.__closure__
    return FunctionType(function.__code__.replace(), *parts)


def timed(function: Callable[..., Any], *arguments: Any) -> float:
    """s that a call takes."""
    started = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - started


def filled(x: Tensor, size: int) -> Tensor:
    """x (..., n) with its first column repeated at the end, contiguous (..., size)."""
    missing = size - x.shape[-1]
    return torch.cat((x, x[..., :1].expand(*x.shape[:-1], missing)), -1) if missing else x.contiguous()


POOLS: dict[int, ThreadPoolExecutor] = {}


def pool(threads: int) -> ThreadPoolExecutor:
    """Threads that outlive a call."""
    return POOLS.setdefault(threads, ThreadPoolExecutor(threads))


def ahead_of_time(function: Callable[..., Tensor], *examples: Tensor) -> Callable[..., Tensor]:
    """`function` compiled for tensors like the examples, single-threaded, from the cache where it holds the same.

    Traced first: torch.compile takes twelve seconds in every process and its code ran 2.5 times as long.
    """
    graph = traced(function, *examples, decompositions={torch.ops.aten.mm.default: product})
    path = Path(cache_dir()) / "columns" / f"{fingerprint(graph, examples)}.so"
    if path.exists():
        with suppress(OSError):  # damaged: compiled anew
            return Library(path, torch.get_num_threads())
    compile_to(path, graph, examples)
    return Library(path, torch.get_num_threads())


def traced(
    function: Callable[..., Tensor], *examples: Tensor, decompositions: dict[Any, Any] | None = None
) -> GraphModule:
    """`function` as a flat list of operations on tensors like the examples, which takes 3 s.

    Nested forward-mode differentiation is most of the time of a call for few columns; make_fx does it once.
    """
    from torch.fx.experimental.proxy_tensor import make_fx  # a second that a command without it need not wait

    pure = torch.func.functionalize(function, remove="mutations")  # which would hide common subexpressions
    with torch.no_grad():
        return without_repetitions(make_fx(pure, decomposition_table=decompositions or {})(*examples))


def without_repetitions(graph: GraphModule) -> GraphModule:
    """The graph with equal constants and common subexpressions computed once: several constraints begin alike.

    Copies are left out, which hide what is equal, but for those in another order in memory, which a view may need.
    Nothing writes in place, as the graph is functional.
    """
    from torch._functorch.compile_utils import fx_graph_cse

    for node in [node for node in graph.graph.nodes if node.target in COPIES]:
        if node.meta["val"].stride() == node.args[0].meta["val"].stride():
            node.replace_all_uses_with(node.args[0])
    seen: dict[tuple[Any, ...], Node] = {}
    for node in graph.graph.find_nodes(op="get_attr"):
        constant = getattr(graph, node.target)
        same = seen.setdefault((constant.dtype, constant.shape, constant.cpu().numpy().tobytes()), node)
        if same is not node:
            node.replace_all_uses_with(same)
    short = fx_graph_cse(graph.graph)
    short.eliminate_dead_code()
    return GraphModule(graph, short)


def compile_to(path: Path, graph: GraphModule, examples: tuple[Tensor, ...]) -> None:
    """Compiles a graph for tensors like the examples into a shared library."""
    path.parent.mkdir(parents=True, exist_ok=True)
    own = path.with_suffix(f".{os.getpid()}.pt2")  # another process may be compiling the same
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch's, about its own code
        program = torch.export.export(graph, examples)
        torch._inductor.aoti_compile_and_package(
            program, package_path=str(own), inductor_configs={"cpp.threads": 1}
        )
    with ZipFile(own) as package:
        library = next(name for name in package.namelist() if name.endswith(".so"))
        own.write_bytes(package.read(library))
    os.replace(own, path)


class Library:
    """A compiled function of contiguous tensors to one tensor, called through AOTInductor's C interface.

    That is torch/csrc/inductor/aoti_runtime/interface.h. PyTorch's own binding holds Python's global lock while the
    code runs (pytorch/pytorch#197516), so that threads would wait for each other.

    Args:
        path: the shared library; runners: how many threads may be in it at once.
    """

    def __init__(self, path: Path, runners: int) -> None:
        library = ctypes.CDLL(str(path))
        self.container = ctypes.c_void_p()
        self.check(
            library.AOTInductorModelContainerCreateWithDevice(
                ctypes.byref(self.container), ctypes.c_size_t(runners), b"cpu", None
            )
        )
        self.run = library.AOTInductorModelContainerRun

    @staticmethod
    def check(error: int) -> None:
        if error:
            raise RuntimeError("AOTInductor's code failed; the reason stands above")

    def __call__(self, *tensors: Tensor) -> Tensor:
        """What the function returns."""
        capsules = torch._C._aoti.unsafe_alloc_void_ptrs_from_tensors(list(tensors))
        inputs = (ctypes.c_void_p * len(tensors))(*(pointer(each, None) for each in capsules))
        output = ctypes.c_void_p()
        count, one = ctypes.c_size_t(len(tensors)), ctypes.c_size_t(1)
        self.check(self.run(self.container, inputs, count, ctypes.byref(output), one, None, None))
        return torch._C._aoti.alloc_tensors_by_stealing_from_void_ptrs([capsule(output, None, None)])[0]


pointer = ctypes.pythonapi.PyCapsule_GetPointer
pointer.argtypes, pointer.restype = [ctypes.py_object, ctypes.c_char_p], ctypes.c_void_p
capsule = ctypes.pythonapi.PyCapsule_New
capsule.argtypes, capsule.restype = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p], ctypes.py_object


def product(a: Tensor, b: Tensor) -> Tensor:
    """a @ b in operations that fuse with those around: a library's product of such small matrices takes longer.

    Long inner products are summed row by row, for which b is read once.
    """
    if a.shape[1] > UNROLLED:
        return torch.stack([(row[:, None] * b).sum(0) for row in a])
    return reduce(
        torch.add, (column[:, None] * row for column, row in zip(a.unbind(1), b.unbind(0), strict=True))
    )


def cache_dir() -> str:
    """Where PyTorch keeps what it compiled."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return cache_dir()


def fingerprint(graph: GraphModule, examples: tuple[Tensor, ...]) -> str:
    """What the compiled code depends on: operations, constants, shapes, PyTorch and the kind of processor."""
    digest = hashlib.sha256(graph.code.encode())
    for node in graph.graph.nodes:
        if node.op == "get_attr":
            digest.update(getattr(graph, node.target).numpy().tobytes())
    about = [(tuple(example.shape), example.dtype) for example in examples]
    digest.update(repr((about, torch.__version__, processor())).encode())
    return digest.hexdigest()[:32]


def processor() -> str:
    """What compiled code may rely on: the processor's instructions, or its name where Linux does not list them."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        return next((line for line in file if line.startswith(("flags", "Features"))), platform.machine())
    return platform.processor()

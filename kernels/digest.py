"""A digest of what a function computes: of its code, its constants, and all that these reach.

The code is the loaded one, so that a part that a program replaced counts as much as an edited line. Code of the
interpreter, PyTorch and similar libraries counts by name and version. Files that a function reads are not seen.
"""

import dis
import functools
import hashlib
import importlib.util
import platform
import re
import sys
import sysconfig
import threading
import types
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

# their code counts by name
LIBRARIES = {*sys.stdlib_module_names, "torch", "functorch", "numpy", "scipy", "piqp"}
# nothing in these modules is recorded
OF_RUNS = {f"kernels.{name}" for name in ("build", "cache", "compiled", "digest")}
BY_TEXT = {"getattr", "vars", "globals", "eval", "exec"}  # with these, code reads names that it lacks
PYTHON = Path(sysconfig.get_path("stdlib"))
SLOT = types.MemberDescriptorType
IMPORT = dis.opmap["IMPORT_NAME"]
PLAIN = (type(None), bool, int, float, complex, str, bytes, type(...), range, slice, np.generic, np.ufunc, torch.dtype,
         torch.device)  # fmt: skip
BUILTINS = (types.BuiltinFunctionType, types.MethodDescriptorType, types.WrapperDescriptorType, types.MethodWrapperType,
            types.ClassMethodDescriptorType, types.GetSetDescriptorType, SLOT)  # fmt: skip
OF_BUILTIN = "__module__", "__objclass__", "__self__"
UNREAD = {"__dict__", "__weakref__", "__doc__", "__annotations__", "__abstractmethods__", "_abc_impl",
          "__dataclass_fields__", "__dataclass_params__", "__slotnames__"}  # of a class  # fmt: skip


class Reached(NamedTuple):
    """Holds a module, as far as code with these names reads it."""

    module: types.ModuleType
    names: frozenset[str]


def digest(*things: Any) -> str | None:
    """Returns a digest of functions and arguments, the same in every process; None if what they reach is unknown."""
    versions = platform.python_version(), torch.__version__, np.__version__, torch.get_default_dtype()
    found: list[str] = []
    places: dict[Any, int] = {}
    kept, left = [], [*versions, *things]  # things are kept, so that no other thing gets their id
    try:
        while left:
            thing = left.pop()
            kind: Any = type(thing)
            parts_of = of_kind(kind)
            if parts_of is None:
                found += (kind.__qualname__, "(0);", repr(thing))
                continue
            key = (id(thing.module), thing.names) if kind is Reached else id(thing)
            if key in places:
                found.append(f"{places[key]};")
                continue
            places[key] = len(places)
            kept.append(thing)
            parts = list(parts_of(thing))
            found.append(f"{kind.__qualname__}({len(parts)});")
            left += reversed(parts)
        return hashlib.sha256("".join(found).encode()).hexdigest()[:32]
    except Exception:  # for things that are no functions, data or objects of these
        return None


@functools.cache
def of_kind(kind: type) -> Callable[[Any], Iterable[Any]] | None:
    """Returns the function that gives the identifying parts of a thing of this type; None: its text identifies it."""
    if issubclass(kind, PLAIN):
        return None
    return next((parts for kinds, parts in PARTS if issubclass(kind, kinds)), of_object)


@functools.cache
def is_library(module: str | None) -> bool:
    """Checks whether the code of a module, given by name, counts by name: not that of a user's `statistics.py`."""
    top = (module or "builtins").partition(".")[0]
    if module in OF_RUNS or top not in LIBRARIES:
        return module in OF_RUNS
    found = importlib.util.find_spec(top)
    path = Path(found.origin if found and found.has_location and found.origin else PYTHON)
    return path.is_relative_to(PYTHON) or not {"site-packages", "dist-packages"}.isdisjoint(path.parts)


def of_function(f: types.FunctionType) -> Iterator[Any]:
    """Yields a function's code or name, all that the code names, and what it was made with."""
    yield from (f.__defaults__, f.__kwdefaults__, f.__closure__, vars(f))
    where = f.__globals__
    if is_library(where.get("__name__")):
        yield f"{where['__name__']}.{f.__qualname__}"
        return
    yield f.__code__
    codes = list(nested(f.__code__))
    names = frozenset(name for code in codes for name in code.co_names)
    for name in sorted(names & where.keys()):
        yield reached(where[name], names)
    for code in codes:
        steps = list(dis.get_instructions(code)) if IMPORT in code.co_code[::2] else []
        for level, step in zip(steps, steps[2:], strict=False):
            if step.opcode == IMPORT and (level.argval or not is_library(step.argval)):
                name = "." * level.argval + step.argval
                yield reached(importlib.import_module(name, where.get("__package__")), names)


def nested(code: types.CodeType) -> Iterator[types.CodeType]:
    """Yields code, and the code of functions in it."""
    yield code
    for each in code.co_consts:
        if isinstance(each, types.CodeType):
            yield from nested(each)


def reached(value: Any, names: frozenset[str]) -> Any:
    """Returns what code with these names reads of a value: of a module, only a part."""
    return Reached(value, names) if isinstance(value, types.ModuleType) else value


def of_module(it: Reached) -> Iterator[Any]:
    """Yields a module's name and, unless its code counts by name, its parts that are read."""
    yield it.module.__name__
    if not is_library(it.module.__name__):
        own = vars(it.module)
        offered = own.keys() if it.names & BY_TEXT else it.names & {*own, *own.get("__all__", ())}
        for name in sorted(offered):
            yield reached(getattr(it.module, name), it.names)


def of_class(it: type) -> Iterator[Any]:
    """Yields a class's name and, unless its code counts by name, its members."""
    yield f"{it.__module__}.{it.__qualname__}"
    if not is_library(it.__module__):
        yield from it.__bases__
        for name, value in vars(it).items():
            if name not in UNREAD:
                yield from (name, value)


def of_object(it: Any) -> Iterator[Any]:
    """Yields an object's class and its state; for a library's class, the state as pickled."""
    kind = type(it)
    if kind in (dict, list, tuple):
        yield from it.items() if kind is dict else it
    elif kind.__module__ == "typing" or isinstance(it, types.GenericAlias | types.UnionType):
        yield repr(it)
    elif is_library(kind.__module__):
        yield from (kind, it.__reduce_ex__(4))
    else:
        yield from (kind, getattr(it, "__dict__", None))
        slots = [slot for own in kind.__mro__ for slot in vars(own).values() if isinstance(slot, SLOT)]
        yield from (slot.__get__(it) for slot in slots if hasattr(it, slot.__name__))
        yield from it.items() if isinstance(it, dict) else it if isinstance(it, list | tuple) else ()


def of_set(it: Collection[Any]) -> list[str]:
    """Returns the sorted texts of a set's members; raises TypeError if one contains a place in memory."""
    texts = sorted(map(repr, it))
    if any(" at 0x" in text for text in texts):
        raise TypeError(texts)
    return texts


PARTS: list[tuple[Any, Callable[[Any], Iterable[Any]]]] = [
    (types.FunctionType, of_function),
    (type, of_class),
    (Reached, of_module),
    (types.ModuleType, lambda it: of_module(Reached(it, frozenset(BY_TEXT)))),
    (types.CodeType, lambda it: (it.co_code, it.co_names, it.co_consts)),
    (types.CellType, lambda it: () if it == types.CellType() else (it.cell_contents,)),
    (types.MethodType, lambda it: (it.__func__, it.__self__)),
    (BUILTINS, lambda it: (it.__qualname__, *(getattr(it, name, None) for name in OF_BUILTIN))),
    (types.MappingProxyType, lambda it: (dict(it),)),
    (type(threading.RLock()), lambda it: ()),
    (threading.local, lambda it: ()),  # belongs to a run, like locks
    (re.Pattern, lambda it: (it.pattern, it.flags)),
    (functools._lru_cache_wrapper, lambda it: (it.__wrapped__,)),
    (functools.partial, lambda it: (it.func, it.args, it.keywords)),
    (functools.cached_property, lambda it: (it.func,)),
    (property, lambda it: (it.fget,)),
    (staticmethod | classmethod, lambda it: (it.__func__,)),
    (Tensor, lambda it: (it.dtype, tuple(it.shape), str(it.device), it.detach().cpu().numpy().tobytes())),
    (np.ndarray, lambda it: (str(it.dtype), it.shape, it.tolist())),
    (set | frozenset, of_set),
]

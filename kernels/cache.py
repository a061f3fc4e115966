"""Recordings, which take seconds to make, kept across runs beside the libraries built from them."""

import hashlib
import os
import pickle
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import ParamSpec, TypeVar

from kernels.build import WORK, cache_dir, clear, say
from kernels.digest import digest

P = ParamSpec("P")
R = TypeVar("R")


def remembered(function: Callable[P, R], *given: P.args, **named: P.kwargs) -> R:
    """Returns what a function returns, from the cache if it was called with the same arguments before, see `digest`.

    Nothing is kept if the digest cannot tell what the function computes, or if the cache cannot be used.
    """
    directory = cache_dir()
    name = digest(function, given, named) if directory else None
    if directory is None or name is None:
        return function(*given, **named)
    path = directory / f"{name}.recorded"
    try:
        return pickle.loads(contents(path))
    except FileNotFoundError:
        pass
    except Exception as error:  # the file may hold anything
        say(f"{path}: {error}; recorded anew")
    result = function(*given, **named)
    with suppress(OSError):  # `library` reports it
        keep(path, pickle.dumps(result))
    return result


def keep(path: Path, contents: bytes) -> None:
    """Puts a file into the cache, whole or not at all, since other processes may do the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    clear(path.parent)
    with tempfile.TemporaryDirectory(prefix=WORK, dir=path.parent) as work:
        own = Path(work) / path.name
        own.write_bytes(seal(path.name, contents) + contents)
        os.replace(own, path)


def contents(path: Path) -> bytes:
    """Returns what `keep` stored; raises ValueError if the file was not written by `keep` under this name."""
    whole = path.read_bytes()
    given, found = whole[:32], whole[32:]
    if given != seal(path.name, found):
        raise ValueError("damaged")
    return found


def seal(name: str, contents: bytes) -> bytes:
    """Returns the SHA-256 of a file's name and contents."""
    return hashlib.sha256(name.encode() + contents).digest()

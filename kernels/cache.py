"""What takes seconds to record, kept across runs beside the libraries that are built of it."""

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
    """What a function returns, from the cache where it was called with the same before, see `digest`.

    Nothing is kept where it cannot be told what the function computes, or the cache cannot be used.
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
    except Exception as error:  # whatever is there
        say(f"{path}: {error}; recorded anew")
    result = function(*given, **named)
    with suppress(OSError):  # of which `library` speaks
        keep(path, pickle.dumps(result))
    return result


def keep(path: Path, contents: bytes) -> None:
    """Puts a file into the cache, whole or not at all: other processes may be doing the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    clear(path.parent)
    with tempfile.TemporaryDirectory(prefix=WORK, dir=path.parent) as work:
        own = Path(work) / path.name
        own.write_bytes(seal(path.name, contents) + contents)
        os.replace(own, path)


def contents(path: Path) -> bytes:
    """What `keep` put there; ValueError where it did not, or under another name."""
    whole = path.read_bytes()
    given, found = whole[:32], whole[32:]
    if given != seal(path.name, found):
        raise ValueError("damaged")
    return found


def seal(name: str, contents: bytes) -> bytes:
    """SHA-256 of what is kept and of its name."""
    return hashlib.sha256(name.encode() + contents).digest()

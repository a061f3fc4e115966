"""Recordings, which take seconds to make, kept across runs beside the libraries built from them."""

import pickle
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import ParamSpec, TypeVar

from kernels.build import cache_dir, keep, kept
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

    def load(path: Path) -> R:
        content = path.read_bytes()
        try:
            return pickle.loads(content)
        except Exception as error:  # the file may hold anything
            raise OSError(f"damaged ({error})") from error

    found = kept(directory, name, ".recorded", load)
    if found is not None:
        return found
    result = function(*given, **named)

    def write(folder: Path) -> Path:
        (folder / "result").write_bytes(pickle.dumps(result))
        return folder / "result"

    with suppress(OSError):  # `library` reports it
        keep(directory, name, ".recorded", write)
    return result

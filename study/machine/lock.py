"""One process, or the ranks of one job, to a directory."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ppo.distributed import ranks
from settings import InputError

try:
    import fcntl
except ImportError:  # not a Unix: nothing is locked
    fcntl = None  # type: ignore[assignment]  # a module that may be missing has no type of its own


@contextmanager
def alone_in(directory: Path, flag: str) -> Iterator[None]:
    """Keeps every other process out of a directory; of many ranks, the first one does for all.

    The lock is on the directory itself: it leaves no file, and goes with the process, however that ends. A file system
    that knows no locks gets none.

    Args:
        flag: that named the directory.

    Raises:
        InputError: another process has it, or there is no such directory.
    """
    held: list[int] = []
    ranks().first_does(lambda: held.extend(lock(directory, flag)))
    try:
        yield
    finally:
        for descriptor in held:
            os.close(descriptor)


def lock(directory: Path, flag: str) -> list[int]:
    """The descriptor that holds the lock, which no child process inherits; none where there are no locks."""
    if fcntl is None:
        return []
    try:
        descriptor = os.open(directory, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{flag} {directory}: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise InputError(f"{flag} {directory}: is being trained by another process") from None
    except OSError:  # this file system knows no locks
        os.close(descriptor)
        return []
    return [descriptor]

"""Files that are written whole or not at all."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Adds the file's name to every OSError of the operating system, also that of a full disk, which has no name."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # not an error of the operating system
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None


def is_written_in_place(path: Path) -> bool:
    """Checks whether `path` exists and is no regular file, but a link (/dev/stdout), device, pipe or directory."""
    return path.exists() and (path.is_symlink() or not path.is_file())


def temporary_beside(path: Path) -> Path:
    """Returns the temporary file for `path`; a kill leaves at most this file, and the next write replaces it."""
    return path.parent / f"{path.name}.tmp"


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yields a file to write, which replaces `path` once it is whole and on the disk.

    A kill at any moment leaves the old file or the new one. An exception leaves the old one and no other file. A path
    that is written in place, see above, is not protected.
    """
    if is_written_in_place(path):
        sys.stdout.flush()  # for /dev/stdout: earlier output must come first
        with open(path, "wb") as file:
            yield file
        return
    temporary = temporary_beside(path)
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):  # the directory itself may be gone
            temporary.unlink(missing_ok=True)
        raise

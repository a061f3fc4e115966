"""Files that are written whole or not at all."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Lets every OSError of the operating system name the file, also that of a full disk, which names none."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # not of the operating system
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None


def is_written_in_place(path: Path) -> bool:
    """Whether `path` is there and no file of its own: a link such as /dev/stdout, a device, a pipe or a directory."""
    return path.exists() and (path.is_symlink() or not path.is_file())


def temporary_beside(path: Path) -> Path:
    """The file that is to become `path`; a kill leaves no other one behind, and the next write takes its place."""
    return path.parent / f"{path.name}.tmp"


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write, which takes the place of `path` once it is whole and on the disk.

    A kill at any moment leaves the old file or the new one, an exception the old one and nothing beside it. What is
    written in place, see above, is not protected.
    """
    if is_written_in_place(path):
        sys.stdout.flush()  # if it is /dev/stdout, what was printed before comes first
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

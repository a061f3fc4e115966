"""Files that are written whole or not at all."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


def is_written_in_place(path: Path) -> bool:
    """Whether `path` is there and no file of its own: a link such as /dev/stdout, a device, a pipe or a directory."""
    return path.exists() and (path.is_symlink() or not path.is_file())


def temporary_beside(path: Path) -> Path:
    """The file that is to become `path`; a kill leaves no other one behind."""
    return path.with_name(path.name + ".tmp")


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
        temporary.unlink(missing_ok=True)
        raise

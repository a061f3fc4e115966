"""What a command may read and write: no file that it reads is written, and no other one of another suffix."""

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ppo.files import temporary_beside
from study.errors import InputError
from study.files import check_writable


def check_inputs(inputs: Mapping[str, str]) -> None:
    """Refuses what is read without end, devices and pipes that nobody writes to; by flag, the path."""
    for flag, path in inputs.items():
        if Path(path).is_char_device() or Path(path).is_block_device():
            raise InputError(f"{flag}: is a device; name a file")
        if Path(path).is_fifo() and os.path.exists(os.path.realpath(path)):  # a shell's own pipe has no name
            raise InputError(f"{flag}: is a named pipe, which nobody may ever write to; name a file")


def check_outputs(outputs: Mapping[str, tuple[str, str]], inputs: Mapping[str, str]) -> None:
    """Refuses outputs, before any work is done, by whose writing anything would be lost.

    Args:
        outputs: by flag, the path and the suffix of what is written there; inputs: by flag, the path.

    Raises:
        InputError: an output cannot be written, is also an input or another output, perhaps through a link, or is there
            already under another suffix.
    """
    before = dict(inputs)
    for flag, (path, suffix) in outputs.items():
        for other, theirs in before.items():
            if same(path, theirs):
                raise InputError(f"{flag} {path}: is the file of {other}; name another one")
            if same(str(temporary_beside(Path(path))), theirs):
                raise InputError(f"{flag} {path}: is written by way of the file of {other}; name another one")
        check_writable(path, flag)
        before[flag] = path
        named = Path(path).suffix
        if suffix == ".png" and named not in ("", suffix):
            raise InputError(
                f"{flag} {path}: figures are written in PNG format; name it {Path(path).stem}.png"
            )
        if named != suffix and would_be_lost(Path(path)):
            raise InputError(f"{flag} {path}: exists and is no {suffix} file; name another one")


def same(one: str, other: str) -> bool:
    """Whether two paths lead to one file, which need not exist."""
    with suppress(OSError, ValueError):
        return os.path.samefile(one, other)
    with suppress(OSError, ValueError):  # of a name that no file can have
        return os.path.realpath(one) == os.path.realpath(other)
    return False


def would_be_lost(path: Path) -> bool:
    """Whether there is a file with content; what standard output is redirected to is to be written."""
    if not path.is_file() or path.stat().st_size == 0:
        return False
    with suppress(OSError, ValueError):  # without a standard output, or one that is no file
        return not os.path.samestat(path.stat(), os.fstat(sys.stdout.fileno()))
    return True

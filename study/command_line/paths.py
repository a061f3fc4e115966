"""What a command may read and write: no file that it reads is written, and no other one of another suffix."""

import json
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ppo.files import is_written_in_place, temporary_beside
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
        InputError: an output cannot be written, is also an input or another output, perhaps through a link, or has
            another suffix, with which the next call would not know it as its own.
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
        target = Path(path)
        if target.suffix == suffix:
            continue
        if not is_written_in_place(target):
            raise InputError(f"{flag} {path}: must end in {suffix}; name it {target.stem}{suffix}")
        if would_be_lost(target):
            raise InputError(f"{flag} {path}: exists and is no {suffix} file; name another one")


def check_replaced(path: str, command: str, key: str) -> None:
    """Refuses to write a command's results over a file of anything else; results have this key.

    Raises:
        InputError: see above; the message names the command.
    """
    if not would_be_lost(Path(path)):
        return
    content = None
    with suppress(OSError, ValueError):
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    if not isinstance(content, dict) or key not in content:
        raise InputError(f"--json {path}: holds no results of {command}; name another file")


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

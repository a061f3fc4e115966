"""What a command may read and write: no file that it reads is written, and no other one but of the same kind."""

import json
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from ppo.files import temporary_beside
from study.errors import MALFORMED, InputError
from study.files import check_writable

Fits = Callable[[Path], bool]


def json_with(*keys: str) -> Fits:
    """Whether a file is a JSON object with these keys."""

    def fits(path: Path) -> bool:
        content = json.loads(path.read_text(encoding="utf-8"))
        return set(keys) <= content.keys()

    return fits


def arrays_with(*names: str) -> Fits:
    """Whether a file is an archive of NumPy's with these arrays."""

    def fits(path: Path) -> bool:
        with np.load(path, allow_pickle=False) as arrays:
            return set(names) <= set(arrays.files)

    return fits


def page(path: Path) -> bool:
    """Whether a file is a replay."""
    with path.open(encoding="utf-8") as file:
        head = file.read(1000)
    return head.lower().startswith("<!doctype html>") and "<title>Replay" in head


def network(path: Path) -> bool:
    """Whether a file is an agent in ONNX's format, whose first field is its version."""
    content = path.read_bytes()
    return content.startswith(b"\x08") and b"action_period" in content


def png(path: Path) -> bool:
    """Whether a file is a PNG."""
    with path.open("rb") as file:
        return file.read(8) == b"\x89PNG\r\n\x1a\n"


FIGURE = "figure in PNG format"
KINDS: dict[str, Fits] = {
    "evaluation": json_with("metrics", "violations_percent", "outcomes"),
    "report of verify": json_with("campaign", "config"),
    "benchmark": json_with("simulator_steps_per_s", "min_max"),
    "run of simulate": arrays_with("time", "control_applied"),
    "result of filter": arrays_with("control_safe", "A_all"),
    "replay": page,
    "exported agent": network,
    FIGURE: png,
}


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
        outputs: by flag, the path and which of KINDS is written there; inputs: by flag, the path.

    Raises:
        InputError: an output cannot be written, is also an input or another output, perhaps through a link, or is a
            file of another kind.
    """
    before = dict(inputs)
    for flag, (path, kind) in outputs.items():
        for other, theirs in before.items():
            if same(path, theirs):
                raise InputError(f"{flag} {path}: is the file of {other}; name another one")
            if same(str(temporary_beside(Path(path))), theirs):
                raise InputError(f"{flag} {path}: is written by way of the file of {other}; name another one")
        check_writable(path, flag)
        before[flag] = path
        if kind == FIGURE and Path(path).suffix not in ("", ".png"):
            raise InputError(
                f"{flag} {path}: figures are written in PNG format; name it {Path(path).stem}.png"
            )
        if would_be_lost(Path(path)) and not is_a(kind, Path(path)):
            raise InputError(f"{flag} {path}: exists and is no {kind}; name another file")


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


def is_a(kind: str, path: Path) -> bool:
    """Whether a file is one of KINDS; one that cannot be read is not."""
    with suppress(OSError, EOFError, MemoryError, *MALFORMED):
        return KINDS[kind](path)
    return False

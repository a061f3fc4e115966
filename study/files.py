"""Files: arrays that are read, and whatever is written, whole or not at all."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ppo.files import is_written_in_place, naming, replacing, temporary_beside
from settings import InputError

ROOT = Path(__file__).parent.parent  # of the repository


def load_arrays(
    path: str, names: tuple[str, ...], what: str, where_missing: str, maybe: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """The named arrays of a .npz file; errors say `what` it should have been, and `where_missing` of one it lacks.

    Those of `maybe` may be missing.

    Raises:
        InputError: there is no such file, it cannot be read, or it lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in (*names, *maybe) if name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the {what}: no such file") from None
    except Exception:  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the {what}: not a .npz file of numbers") from None
    for name in names:
        if name not in found:
            raise InputError(f"{path}: {name} is missing{where_missing}")
    return found


def check_writable(path: Path) -> None:
    """Raises OSError or ValueError for an output that cannot be written; leaves nothing behind."""
    if path.is_fifo():  # opened and closed, it would tell its reader that all was written
        return
    if path.exists():
        path.open("ab").close()
    if not is_written_in_place(path):
        temporary_beside(path).open("wb").close()
        temporary_beside(path).unlink()


NUMBERS = re.compile(r"(?<=\[)\n[-\d.eE+,\s]+(?=\])")  # of an indented list that holds nothing else


@contextmanager
def writing(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write, see `ppo.files.replacing`; raises OSErrors that name the file, also for a full disk."""
    with naming(path), replacing(Path(path)) as file:
        yield file


def write_text(path: str | Path, text: str) -> None:
    """Writes text in UTF-8, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Writes content as indented JSON with a list of numbers on a line, whole or not at all."""
    indented = json.dumps(content, indent=2)
    write_text(path, NUMBERS.sub(lambda numbers: " ".join(numbers[0].split()), indented) + "\n")


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes named arrays as a compressed .npz file, whole or not at all."""
    with writing(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # none has the name of a flag

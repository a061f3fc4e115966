"""Files: reads JSON and arrays, and writes every file whole or not at all."""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ppo.files import is_written_in_place, naming, replacing, temporary_beside
from settings import InputError
from study.errors import as_input_error

ROOT = Path(__file__).parent.parent  # of the repository


UNREADABLE = (
    OSError,
    ValueError,
    RecursionError,
)  # errors from reading a file that is not JSON or nested too deep


def read_json(path: str | Path, what: str) -> dict[str, Any]:
    """Returns the object in a JSON file; errors say `what` it should have been.

    Raises:
        InputError: there is no such file, it is not JSON, or it holds something else than an object.
    """
    with as_input_error(f"{path}: cannot read the {what}", *UNREADABLE):
        return as_object(Path(path).read_text(encoding="utf-8-sig"))


def read_json_lines(path: str | Path, what: str) -> list[dict[str, Any]]:
    """Returns the objects in a file with a JSON object on each line; raises as `read_json`."""
    with as_input_error(f"{path}: cannot read the {what}", *UNREADABLE):
        return [as_object(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]


def as_object(text: str) -> dict[str, Any]:
    """Returns the object that JSON text holds; raises ValueError or RecursionError if the text holds none."""
    content = json.loads(text)
    if not isinstance(content, dict):
        found = "a number" if type(content) is int else kind(content)
        raise ValueError(f"must hold a JSON object, not {found}")
    return content


def kind(content: Any) -> str:
    """Returns the kind of a JSON value in words."""
    if isinstance(content, (bool, type(None))):
        return json.dumps(content)
    if isinstance(content, int):
        return "a count" if content >= 0 else "a negative integer"
    names: dict[type, str] = {dict: "an object", list: "a list", str: "a text"}
    return names.get(type(content), "a number")


def check_like(content: Any, form: Any, maybe: Collection[str] = (), name: str = "it") -> None:
    """Raises ValueError if JSON content has another form than a sample.

    Objects in the content must have all keys of the sample except the keys in `maybe`, and may have more. A count in
    the sample stands for any count (an integer, not negative), null for anything, and an empty object or list for any
    object or list.
    """
    allowed = ("a number", "a count", "a negative integer") if isinstance(form, float) else (kind(form),)
    if form is not None and kind(content) not in allowed:
        raise ValueError(f"{name}: must be {allowed[0]}, not {kind(content)}")
    for key, part in form.items() if isinstance(form, dict) else ():
        if key in content:
            check_like(content[key], part, maybe, key)
        elif key not in maybe:
            raise ValueError(f"{key} is missing")


def load_arrays(
    path: str | Path, names: tuple[str, ...], what: str, where_missing: str, maybe: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """Returns named arrays of a .npz file; errors say `what` the file should be, and `where_missing` for a lost array.

    Arrays named in `maybe` may be missing.

    Raises:
        InputError: there is no such file, it cannot be read, or it lacks an array.
    """
    found = read_npz(path, what, (*names, *maybe))
    for name in names:
        if name not in found:
            raise InputError(f"{path}: {name} is missing{where_missing}")
    return found


def read_npz(path: str | Path, what: str, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Returns the arrays of these names, or all arrays, of a .npz file; errors say `what` the file should be.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files if names is None or name in names}
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the {what}: no such file") from None
    except Exception:  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the {what}: not a .npz file of numbers") from None


def check_writable(path: Path) -> None:
    """Raises OSError or ValueError if an output cannot be written; leaves no file behind."""
    if path.is_fifo():  # opening and closing it would tell its reader that all was written
        return
    if path.exists():
        path.open("ab").close()
    if not is_written_in_place(path):
        temporary_beside(path).open("wb").close()
        temporary_beside(path).unlink()


NUMBERS = re.compile(r"(?<=\[)\n[-\d.eE+,\s]+(?=\])")  # the numbers of an indented list of numbers


@contextmanager
def writing(path: str | Path) -> Iterator[BinaryIO]:
    """Opens a file to write, see `ppo.files.replacing`; raises OSErrors that name the file, also for a full disk."""
    with naming(path), replacing(Path(path)) as file:
        yield file


def write_text(path: str | Path, text: str) -> None:
    """Writes text in UTF-8, whole or not at all."""
    with writing(path) as file:
        file.write(text.encode())


def write_json(path: str | Path, content: Mapping[str, Any]) -> None:
    """Writes content as indented JSON with each list of numbers on one line, whole or not at all."""
    indented = json.dumps(content, indent=2)
    write_text(path, NUMBERS.sub(lambda numbers: " ".join(numbers[0].split()), indented) + "\n")


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes named arrays as a compressed .npz file, whole or not at all."""
    with writing(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # no array has a parameter's name

"""Reading arrays from .npz files."""

import numpy as np

from study.errors import InputError


def load(path: str, names: tuple[str, ...], what: str, where_missing: str) -> dict[str, np.ndarray]:
    """The named arrays of a .npz file; errors say `what` it should have been, and `where_missing` of one it lacks.

    Raises:
        InputError: there is no such file, it cannot be read, or it lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in names if name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the {what}: no such file") from None
    except (Exception, MemoryError):  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the {what}: not a .npz file of numbers") from None
    for name in names:
        if name not in found:
            raise InputError(f"{path}: {name} is missing{where_missing}")
    return found

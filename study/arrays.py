"""Reading arrays from .npz files."""

import numpy as np

from study.errors import InputError


def load(path: str, names: tuple[str, ...], what: str) -> dict[str, np.ndarray]:
    """Those of the named arrays that a .npz file holds; `what` says in an error what it should have been.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names if name in file.files}
    except FileNotFoundError:
        raise InputError(f"{path}: cannot read the {what}: no such file") from None
    except (Exception, MemoryError):  # numpy reports damage through many exception types
        raise InputError(f"{path}: cannot read the {what}: not a .npz file of numbers") from None

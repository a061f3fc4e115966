"""The check that arguments of the model's functions are tensors, not arrays, lists or numbers."""

from typing import Any

import numpy as np

OTHERS = (np.ndarray, np.generic, list, tuple, int, float)


def check_tensors(**given: Any) -> None:
    """Raises TypeError, naming the argument, for a NumPy array, a list or a number in place of a tensor.

    Other objects that stand for a tensor may pass, because functions are recorded and differentiated with such objects.
    """
    for name, part in given.items():
        if isinstance(part, OTHERS):
            raise TypeError(
                f"{name} is of type {type(part).__name__}: must be a PyTorch tensor; torch.as_tensor({name}) makes one"
            )

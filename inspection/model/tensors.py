"""What the model's functions take: tensors, and nothing that only looks like them."""

from typing import Any

import numpy as np

OTHERS = (np.ndarray, np.generic, list, tuple, int, float)


def check_tensors(**given: Any) -> None:
    """Raises TypeError, naming the argument, for a NumPy array, a list or a number in place of a tensor.

    Whatever else stands for a tensor may pass: functions are recorded and differentiated with such.
    """
    for name, part in given.items():
        if isinstance(part, OTHERS):
            raise TypeError(
                f"{name} is of type {type(part).__name__}: must be a PyTorch tensor; torch.as_tensor({name}) makes one"
            )

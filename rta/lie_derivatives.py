"""Lie derivatives of barriers, as functions of functions (Sec. Run Time Assurance).

A barrier is any function of states (16, ...) whose trailing axes are independent spacecraft. A directional
derivative by forward mode is then the same for one spacecraft and for a batch.
"""

import threading
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

Function = Callable[[Tensor], Tensor]

FORWARD_MODE = threading.RLock()  # PyTorch counts the levels of forward mode for all threads together


class ByNumbers(TorchFunctionMode):
    """Has a tensor and a number added, subtracted, multiplied or divided by what PyTorch has for numbers.

    Else it takes the number for a tensor, whose derivative is zero, and asks Python for the shape of every such zero:
    half a millisecond each, two thirds of a call of the filter that is not traced. The results' bits are the same.
    """

    OPERATIONS = {  # noqa: RUF012
        Tensor.add: torch.ops.aten.add.Scalar,
        Tensor.sub: torch.ops.aten.sub.Scalar,
        Tensor.mul: torch.ops.aten.mul.Scalar,
        Tensor.div: torch.ops.aten.div.Scalar,
        Tensor.__rsub__: torch.ops.aten.rsub.Scalar,
    }

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Any call that involves a tensor."""
        if not kwargs and function in self.OPERATIONS and isinstance(args[1], int | float):
            function = self.OPERATIONS[function]
        return function(*args, **(kwargs or {}))


def directional(
    function: Callable[..., Tensor], at: Sequence[Tensor], along: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """A function of several tensors and its derivative along tensors of their shapes, by one forward-mode pass."""
    if torch.compiler.is_compiling():  # which knows no locks
        return torch.func.jvp(function, tuple(at), tuple(along))[:2]
    with FORWARD_MODE, ByNumbers():
        load_forward_mode()
        return torch.func.jvp(function, tuple(at), tuple(along))[:2]


def lie_derivative(h: Function, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """h(x) and its derivative along a direction (16, ...)."""
    return directional(h, (x,), (direction,))


@cache
def load_forward_mode() -> None:
    """Has PyTorch load what its first derivative needs, without its warning about code of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.func.jvp(torch.sin, (torch.zeros(1),), (torch.ones(1),))


def lie_derivatives(h: Function, x: Tensor, f: Tensor, g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """h, L_f h and L_g h.

    Args:
        h: barriers, states (16, ...) to (rows, ...).
        x: states (16, B).
        f, g: drift (16, B) and m control directions (16, m, B).

    Returns:
        h (rows, B), L_f h (rows, B), L_g h (rows, m, B).
    """
    directions = torch.cat((f[:, None], g), 1)
    values, slopes = lie_derivative(h, x[:, None].repeat(1, directions.shape[1], 1), directions)
    return values[:, 0], slopes[:, 0], slopes[:, 1:]

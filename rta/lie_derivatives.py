"""Lie derivatives of barriers, as functions of functions (Sec. Run Time Assurance).

A barrier is any function of states (16, ...) whose trailing axes are independent spacecraft. A directional
derivative by forward mode is then the same for one spacecraft and for a batch.
"""

import threading
import warnings
from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch import Tensor

Function = Callable[[Tensor], Tensor]

FORWARD_MODE = threading.RLock()  # PyTorch counts the levels of forward mode for all threads together


def directional(
    function: Callable[..., Tensor], at: Sequence[Tensor], along: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """A function of several tensors and its derivative along tensors of their shapes, by one forward-mode pass."""
    if torch.compiler.is_compiling():  # which knows no locks
        return torch.func.jvp(function, tuple(at), tuple(along))
    with FORWARD_MODE:
        load_forward_mode()
        return torch.func.jvp(function, tuple(at), tuple(along))


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

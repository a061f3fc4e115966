"""Lie derivatives of barriers, as functions of functions (Sec. Run Time Assurance).

A barrier is any function of states (16, ...) whose trailing axes are independent spacecraft. A directional derivative
by forward mode is then the same code for one spacecraft and for a batch.
"""

import threading
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual
from torch.overrides import TorchFunctionMode

Function = Callable[[Tensor], Tensor]

FORWARD_MODE = threading.RLock()  # needed because PyTorch counts forward mode's levels over all threads


class WithoutShapes(TorchFunctionMode):
    """Computes sums, differences, products and quotients in forward mode without asking Python for shapes.

    PyTorch asks for the shape of every derivative that is zero because the operand does not depend on x. Each takes
    half a millisecond, together two thirds of a call of the filter that is not compiled. For numbers PyTorch has
    separate operations; a tensor is given a derivative of zeros. The results' bits are the same where all operands are
    finite.
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
        """Handles any call that involves a tensor."""
        if not kwargs and function in self.OPERATIONS:
            first, second = args
            if isinstance(second, int | float):
                function = self.OPERATIONS[function]
            elif isinstance(second, Tensor):
                args = with_derivative(first, second), with_derivative(second, first)
        return function(*args, **(kwargs or {}))


def with_derivative(operand: Tensor, other: Tensor) -> Tensor:
    """Returns the operand with a derivative: zeros if it has none and the other operand has one."""
    if operand.dtype != other.dtype or unpack_dual(operand).tangent is not None:
        return operand
    if unpack_dual(other).tangent is None:
        return operand
    return torch.where(torch.zeros((), dtype=torch.bool, device=other.device), other, operand)


def directional(
    function: Callable[..., Tensor], at: Sequence[Tensor], along: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Returns a function of several tensors and its derivative along tensors, by one forward-mode pass."""
    if torch.compiler.is_compiling():  # the compiler does not support locks
        return torch.func.jvp(function, tuple(at), tuple(along))[:2]
    with FORWARD_MODE, WithoutShapes():
        load_forward_mode()
        return torch.func.jvp(function, tuple(at), tuple(along))[:2]


def lie_derivative(h: Function, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Returns h(x) and its derivative along a direction (16, ...)."""
    return directional(h, (x,), (direction,))


@cache
def load_forward_mode() -> None:
    """Loads what PyTorch needs for its first derivative, without PyTorch's warning about its own code."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.func.jvp(torch.sin, (torch.zeros(1),), (torch.ones(1),))


def lie_derivatives(h: Function, x: Tensor, f: Tensor, g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns h, L_f h and L_g h.

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

"""Lie derivatives of barriers; rows of the paper's conditions are compared with differences in test_paper.py."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rta.lie_derivatives import lie_derivative, lie_derivatives


def double_integrator(y: Tensor) -> Tensor:
    return torch.stack((y[1], torch.zeros_like(y[0])))


def high_order(y: Tensor) -> Tensor:
    """Returns Psi_1 = dh/dt + 3 h of h = 1 - p^2 along p' = v."""
    h, rate = lie_derivative(lambda z: 1 - z[:1] ** 2, y, double_integrator(y))
    return rate + 3 * h


def test_lie_derivatives_of_a_high_order_barrier() -> None:
    # L_f Psi_1 = (-2 v - 6 p) v and L_g Psi_1 = -2 p for v' = u
    p, v = y = torch.randn(2, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    g = torch.stack((torch.zeros_like(p), torch.ones_like(p)))[:, None]
    _, along_f, along_g = lie_derivatives(high_order, y, double_integrator(y), g)
    torch.testing.assert_close(along_f, ((-2 * v - 6 * p) * v)[None])
    torch.testing.assert_close(along_g, (-2 * p)[None, None])


@pytest.mark.parametrize("number", [float, torch.tensor])
def test_every_operation_of_what_does_not_depend_is_differentiated(
    number: Callable[[float], float | Tensor],
) -> None:
    def function(y: Tensor) -> Tensor:
        one, two, three, four = (number(each) for each in (1.0, 2.0, 3.0, 4.0))
        return three - (two * y - one) / four + (one + y) * 5 - 7

    y, along = torch.tensor([0.3, -2.0]), torch.tensor([1.0, 0.5])
    value, slope = lie_derivative(function, y, along)
    torch.testing.assert_close((value, slope), (3.0 - (2.0 * y - 1.0) / 4.0 + 5.0 * y - 2.0, 4.5 * along))

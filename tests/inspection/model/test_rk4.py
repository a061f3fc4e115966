"""The Runge-Kutta step against a closed form, and its order."""

import math

import pytest
import torch

from inspection.model.rk4 import rk4_step


def error(steps: int) -> float:
    """Returns the error of a harmonic oscillator after 1 s in so many steps."""
    y = [torch.tensor([1.0, 2.0]).double(), torch.tensor([0.0, 0.0]).double()]
    for _ in range(steps):
        y = rk4_step(lambda y: (y[1], -y[0]), y, 1.0 / steps)
    return (y[0] - torch.tensor([1.0, 2.0]).double() * math.cos(1.0)).abs().max().item()


def test_an_oscillator_is_followed_and_the_order_is_four() -> None:
    assert error(10) < 1e-5
    assert math.log2(error(20) / error(40)) == pytest.approx(4.0, abs=0.1)


def test_each_column_takes_a_step_of_its_own() -> None:
    seconds = torch.tensor([0.1, -0.1, 0.0]).double()
    (y,) = rk4_step(lambda y: y, [torch.ones(3).double()], seconds)
    torch.testing.assert_close(y, seconds.exp(), rtol=1e-6, atol=0.0)
    assert y[2] == 1.0

"""The sine, cosine and arc cosine of printed functions against 40 digits of mpmath, and where they hand over."""

import math
from collections.abc import Callable

import mpmath
import pytest
import torch
from torch import Tensor

from kernels.compiled import Compiled

UNITS = 1.75  # in the last place, at most

FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {"sin": torch.sin, "cos": torch.cos, "acos": torch.acos}


def compiled(name: str, x: Tensor) -> Tensor:
    return Compiled(lambda x: [FUNCTIONS[name](x)], x[:1])(x)[0]


def units(name: str, x: Tensor) -> float:
    """Returns the largest error, in units of the last place of the true value."""
    with mpmath.workdps(40):
        truths = [getattr(mpmath, name)(mpmath.mpf(value)) for value in x.tolist()]
        found = compiled(name, x).tolist()
        return max(
            float(abs(mpmath.mpf(value) - truth) / mpmath.mpf(math.ulp(float(truth))))
            for value, truth in zip(found, truths, strict=True)
        )


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_sine_and_cosine_are_true_to_the_last_place(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    uniform = 2.0 * torch.rand(1000, generator=generator, dtype=torch.float64) - 1.0
    quarters = torch.arange(-50, 51, dtype=torch.float64) * (math.pi / 2)
    beside = torch.cat((quarters, quarters + 1e-9, quarters * 1001 + 1e-6))
    parts = [uniform * most for most in (1e-3, 1.0, 10.0, 1e3, 99_999.0)]
    assert units(name, torch.cat((*parts, beside))) < UNITS


def test_the_arc_cosine_is_true_to_the_last_place() -> None:
    generator = torch.Generator().manual_seed(0)
    small = 0.5 ** torch.arange(1, 53, dtype=torch.float64)
    edges = torch.tensor([-1.0, -0.5, 0.0, 0.5], dtype=torch.float64)
    uniform = 2.0 * torch.rand(3000, generator=generator, dtype=torch.float64) - 1.0
    assert units("acos", torch.cat((uniform, small, -small, 1.0 - small, small - 1.0, edges))) < UNITS


def test_a_lane_does_not_depend_on_its_neighbours() -> None:
    """Where angles are far the library answers, of those angles alone."""
    near = torch.linspace(-3.0, 3.0, 64, dtype=torch.float64)
    mixed = near.clone()
    mixed[::3] = 1e9 + near[::3]
    for name in ("sin", "cos"):
        alone, among = compiled(name, near), compiled(name, mixed)
        is_near = mixed == near
        assert torch.equal(alone[is_near], among[is_near])
        torch.testing.assert_close(among[::3], FUNCTIONS[name](mixed[::3]), rtol=1e-13, atol=1e-15)


def test_what_is_no_angle_gives_no_number() -> None:
    strange = torch.tensor([math.nan, math.inf, -math.inf], dtype=torch.float64)
    assert all(compiled(name, strange).isnan().all() for name in FUNCTIONS)
    assert compiled("acos", torch.tensor([1.0000001, -1.0000001], dtype=torch.float64)).isnan().all()

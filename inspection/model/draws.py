"""Random numbers, and the directions and rotations that follow from numbers in [0, 1).

`uniform` and `random_quaternion` take the next numbers of a generator. The numbers of `counter_based_uniform` depend
on keys and times alone, not on earlier draws.
"""

import math

import torch
from torch import Tensor

from inspection.model.attitude import unit

GOLDEN = 0x9E3779B97F4A7C15 - 2**64  # the increment of SplitMix64


def uniform(low: float, high: float, count: int, generator: torch.Generator) -> Tensor:
    """Draws (count,) float64 numbers from [low, high)."""
    draw = torch.rand(count, generator=generator, device=generator.device, dtype=torch.float64)
    return low + (high - low) * draw


def random_quaternion(count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Draws uniformly distributed rotations (4, count): normalised 4-D Gaussians."""
    return unit(torch.randn(4, count, generator=generator, device=generator.device, dtype=dtype))


def counter_based_uniform(key: Tensor, time_ms: Tensor, count: int, first: int = 0) -> Tensor:
    """Returns uniform numbers in (0, 1), (count, k), by keys (k,) and times (k,) in ms.

    Every row has its own numbers; `first` is the index of the first row.
    """
    row = torch.arange(first + 1, first + count + 1, device=key.device)[:, None]
    z = scrambled(scrambled(scrambled(key) + GOLDEN * (time_ms + 2)) + GOLDEN * row)
    return (((z >> 11) & (2**53 - 1)).double() + 0.5) * 2.0**-53


def scrambled(z: Tensor) -> Tensor:
    """Returns a hash of int64 numbers, SplitMix64's finalizer (Steele, Lea, Flood 2014); shifts fill in zeros."""
    z = (z ^ ((z >> 30) & (2**34 - 1))) * (0xBF58476D1CE4E5B9 - 2**64)
    z = (z ^ ((z >> 27) & (2**37 - 1))) * (0x94D049BB133111EB - 2**64)
    return z ^ ((z >> 31) & (2**33 - 1))


def key_of(number: Tensor) -> Tensor:
    """Returns the keys (k,) for `counter_based_uniform` that follow from episodes' numbers in [0, 1), (k,)."""
    return (number * 2.0**53).long()


def spherical(radius: Tensor, azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Returns (3, k) m from radius m, azimuth rad, elevation rad, (k,) each (Sec. Initial and Terminal Conditions)."""
    return radius * torch.stack(
        (azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin())
    )


def isotropic(numbers: Tensor) -> Tensor:
    """Returns uniformly distributed unit vectors (3, k) from numbers in [0, 1), (2, k)."""
    azimuth, height = 2 * math.pi * numbers[0], 2 * numbers[1] - 1
    return spherical(torch.ones_like(height), azimuth, height.arcsin())


def shoemake(numbers: Tensor) -> Tensor:
    """Returns uniformly distributed rotations (4, k) from numbers in [0, 1), (3, k) (Shoemake 1992)."""
    low, high = (1 - numbers[0]).sqrt(), numbers[0].sqrt()
    first, second = 2 * math.pi * numbers[1], 2 * math.pi * numbers[2]
    return torch.stack((low * first.sin(), low * first.cos(), high * second.sin(), high * second.cos()))

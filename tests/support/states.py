"""States that tests begin from."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

# what a state must not hold: the component, and its number
IMPOSSIBLE = {
    "an endless battery": (14, math.inf),
    "endless cold": (13, -math.inf),
    "T = -1e150": (13, -1e150),
    "below absolute zero": (13, -273.2),
    "no attitude": (9, 0.0),
    "a long quaternion": (9, 1.001),
    "no number": (0, math.nan),
    "a battery beyond all": (14, 1e150),
    "a Sun that turned too often": (15, 1e300),
}


def seeded(seed: int) -> torch.Generator:
    """Returns a generator that begins from a seed."""
    return torch.Generator().manual_seed(seed)


def last_accepted(accepts: Callable[[Tensor], Tensor], count: int, halvings: int = 16) -> Tensor:
    """Returns by halvings the largest share (count,) between 0 and 1 for which a function (count,) to bool is true."""
    low, high = torch.zeros(count, dtype=torch.float64), torch.ones(count, dtype=torch.float64)
    for _ in range(halvings):
        share = (low + high) / 2
        fine = accepts(share)
        low, high = torch.where(fine, share, low), torch.where(fine, high, share)
    return low


def at_rest() -> Tensor:
    """Returns a state (16, 1) at rest, 100 m from the chief, from which nothing is near."""
    x = torch.zeros(16, 1, dtype=torch.float64)
    x[[0, 9, 13, 14, 15], 0] = torch.tensor([100.0, 1.0, 5.0, 6.0, 3.1], dtype=torch.float64)
    return x


def impossible(kind: str) -> Tensor:
    """Returns that state with an impossible number, (16, 1)."""
    x, (component, number) = at_rest(), IMPOSSIBLE[kind]
    x[component] = number
    return x

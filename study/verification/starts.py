"""Initial states of a campaign's episodes: the paper's distribution and a Latin hypercube of the whole safe set."""

import math

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from inspection.chief.hull import reach
from inspection.initial_state import sample_initial_state
from inspection.model.draws import isotropic, shoemake
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from rta.filter import SafetyFilter

INSIDE = 5.0  # m, least distance of the safe set's initial states from max_distance
NUMBERS = 17  # that determine a start
HYPERCUBES = 100  # most that are drawn before a safe set counts as empty


def spawned(seed: int, count: int) -> list[int]:
    """Returns seeds of independent streams of random numbers."""
    streams = np.random.SeedSequence(seed).spawn(count)
    return [int(stream.generate_state(1, np.uint64)[0]) for stream in streams]


def states_of(s: Tensor, c: Limits) -> tuple[Tensor, Tensor]:
    """Returns states (16, B) and priority vectors (3, B) in and around the safe set, from numbers in [0, 1], (17, B).

    The distance is at least INSIDE below the zone's end, the speed at most the limit at this distance. Rates,
    temperature and energy are within their limits. Directions, attitudes and the Sun's angle are arbitrary.
    """
    x = torch.zeros(SIZE, s.shape[1], dtype=torch.float64)
    outwards = isotropic(s[1:3])
    nearest = reach(outwards, c)
    distance = nearest + (c.max_distance - INSIDE - nearest) * s[0]
    x[P] = distance * outwards
    x[V] = (c.docking_speed + c.speed_slope * distance) * s[3] * isotropic(s[4:6])
    x[Q] = shoemake(s[6:9])
    x[OMEGA] = c.max_rate * (2 * s[9:12] - 1)
    x[T] = c.initial_temperature[0] + (c.max_temperature - c.initial_temperature[0]) * s[12]
    x[E] = c.min_energy + (c.initial_energy[1] - c.min_energy) * s[13]
    x[THETA_S] = 2 * math.pi * s[14]
    return x, isotropic(s[15:17])


def safe_set(count: int, seed: int, safety_filter: SafetyFilter) -> tuple[Tensor, Tensor, int]:
    """Returns initial states from the whole safe set, which the filter accepts (`SafetyFilter.is_safe`).

    They come from Latin hypercubes of `states_of`.

    Returns:
        States (16, count), priority vectors (3, count) and the number of rejected states of the hypercubes, up to the
        last one taken, with every h non-negative.

    Raises:
        RuntimeError: fewer were found in HYPERCUBES hypercubes.
    """
    c, accepts = safety_filter.c, safety_filter.is_safe
    sampler = qmc.LatinHypercube(NUMBERS, rng=np.random.default_rng(seed))
    kept, rejected = torch.zeros(SIZE + 3, 0, dtype=torch.float64), 0
    for _ in range(HYPERCUBES):
        x, priority = states_of(torch.from_numpy(sampler.random(4 * count).T.copy()), c)
        safe = accepts(x)
        missing = count - kept.shape[1]
        taken = torch.nonzero(safe).flatten()[:missing]
        seen = int(taken[-1]) + 1 if taken.numel() == missing else safe.numel()
        rejected += int((safety_filter.values(x[:, :seen][:, ~safe[:seen]]) >= 0.0).all(0).sum())
        kept = torch.cat((kept, torch.cat((x, priority))[:, taken]), 1)
        if kept.shape[1] == count:
            return kept[:SIZE], kept[SIZE:], rejected
    raise RuntimeError(f"only {kept.shape[1]} of {count} initial states found in the safe set")


def initial_states(count: int, seed: int, safety_filter: SafetyFilter) -> tuple[Tensor, Tensor, int]:
    """Returns initial states of the paper's distribution and the safe set in turns, in the form of `safe_set`."""
    first, second = spawned(seed, 2)
    generator = torch.Generator().manual_seed(first)
    paper = sample_initial_state(count - count // 2, generator, safety_filter.c, safety_filter.is_safe)
    x, priority, rejected = safe_set(count // 2, second, safety_filter)
    both = torch.zeros(SIZE + 3, count, dtype=torch.float64)
    both[:, ::2], both[:, 1::2] = torch.cat(paper), torch.cat((x, priority))
    return both[:SIZE], both[SIZE:], rejected

"""States and desired controls with the answers of the filter in Python, which the exported C is compared with."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import unit
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from rta.fast.filter import batched, latency
from rta.filter import SafetyFilter
from rta.result import FilterResult, Status

DRAWN = 400  # states, of which those are kept whose answers rounding does not decide
KEPT = 120
ROUNDING = 1e-12  # relative, what comes of it inside included
PERTURBED = 6  # times
NEARLY = 1e-3  # of a control, and of what it is compared within


class Vectors(NamedTuple):
    """Calls of the filter; last axis the calls.

    Attributes:
        state: (16, N); desired: (6, N); sent: (k, 6, N); result: what Python answers.
    """

    state: Tensor
    desired: Tensor
    sent: Tensor
    result: FilterResult


def states(count: int, seed: int, c: Limits) -> tuple[Tensor, Tensor]:
    """States (16, B) within some limits and beyond others, and desired controls (6, B), some beyond the actuators'."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, count, generator=draw, dtype=torch.float64)

    def direction(size: int) -> Tensor:
        return unit(torch.randn(size, count, generator=draw, dtype=torch.float64))

    x = torch.zeros(SIZE, count, dtype=torch.float64)
    nearest = c.collision_radius
    anywhere = nearest * (c.max_distance / nearest) ** uniform(0.0, 1.0)
    edge = torch.where(uniform(0.0, 1.0) < 0.5, nearest, c.max_distance) * uniform(0.99, 1.05)
    distance = torch.where(uniform(0.0, 1.0) < 0.5, anywhere, edge)
    x[P] = distance * direction(3)
    x[V] = uniform(0.0, 1.1) * (c.docking_speed + c.speed_slope * distance) * direction(3)
    x[Q], x[OMEGA] = direction(4), uniform(-1.1, 1.1, 3) * c.max_rate
    x[T] = c.max_temperature + uniform(-5.0, 0.5)
    x[E] = c.min_energy + uniform(-0.1, 3.0)
    x[THETA_S] = uniform(0.0, 2 * math.pi)
    return x, uniform(-1.2, 1.2, CONTROL_SIZE) * x.new_tensor(c.control_limit)[:, None]


def vectors(safety_filter: SafetyFilter) -> Vectors:
    """KEPT calls, and one for every number of a call that is none."""
    make, parts = safety_filter.__reduce__()
    other = batched(make(*parts))  # uncompiled
    x, desired = states(DRAWN, 0, other.c)
    draw = torch.Generator().manual_seed(1)
    most = desired.new_tensor(other.c.control_limit)[:, None]
    sent = desired.flip(1)[None].repeat(latency(other), 1, 1).maximum(-most).minimum(most)
    given = [x, desired, sent]
    kept = torch.nonzero(is_steady(other, given, draw)).flatten()[:KEPT]
    given = [part[..., kept] for part in given]
    given = [
        torch.cat(pair, -1) for pair in zip(given, hostile([part[..., :22] for part in given]), strict=True)
    ]
    state, desired, sent = given
    return Vectors(state, desired, sent, answered(other, given))


def answered(safety_filter: SafetyFilter, given: list[Tensor]) -> FilterResult:
    """What a filter answers to states, desired controls and, if it takes these, controls sent."""
    return safety_filter.correct(*(given if latency(safety_filter) else given[:2]))


def is_steady(safety_filter: SafetyFilter, given: list[Tensor], draw: torch.Generator) -> Tensor:
    """(B,) bool: every program is solved, and no status, active row, check or control turns on rounding."""
    count = 1 + PERTURBED  # of calls at each state, as they are and perturbed, all of them in one batch
    near = [part.unsqueeze(-2).repeat_interleave(count, -2) for part in given]
    for part in near[:2]:
        part[:, 1:] *= 1.0 + ROUNDING * torch.randn(part[:, 1:].shape, generator=draw, dtype=torch.float64)
    answer = answered(safety_filter, [part.flatten(-2) for part in near])
    limit = answer.control.new_tensor(safety_filter.c.control_limit)[:, None, None]

    def differs(values: Tensor) -> Tensor:
        """By how much those of perturbed calls are off, (..., PERTURBED, B)."""
        each = values.unflatten(-1, (count, -1)).double()
        return (each[..., 1:, :] - each[..., :1, :]).abs()

    steady = answer.status[: given[0].shape[1]] < Status.UNSOLVED
    for values in (answer.status[None], answer.active, answer.verified[None], answer.backup[None]):
        steady &= (differs(values) == 0.0).all(0).all(0)
    return steady & (differs(answer.control) / limit <= NEARLY).all(0).all(0)


def hostile(given: list[Tensor]) -> list[Tensor]:
    """22 calls with a number that is none, of a state or of a desired control; in turns NaN and infinity."""
    x, desired, *others = (part.clone() for part in given)
    for i in range(SIZE + CONTROL_SIZE):
        part, row = (x, i) if i < SIZE else (desired, i - SIZE)
        part[row, i] = (math.nan, math.inf)[i % 2] if i < SIZE else math.nan
    return [x, desired, *others]

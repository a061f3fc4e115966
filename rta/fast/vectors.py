"""States and desired controls with the filter's answers in Python, to compare the exported C with."""

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

DRAWN = 400  # states; states whose answers depend on rounding are left out
KEPT = 120  # states at most
ROUNDING = 1e-12  # relative perturbation, larger than the effect of rounding
PERTURBED = 6  # perturbed copies of each call
NEARLY = 1e-3  # largest difference between controls, in units of the actuators' limits


class Vectors(NamedTuple):
    """Holds calls of the filter; the last axis is the calls.

    Attributes:
        state: (16, N); desired: (6, N); sent: (k, 6, N); result: Python's answer.
    """

    state: Tensor
    desired: Tensor
    sent: Tensor
    result: FilterResult


def states(count: int, seed: int, c: Limits) -> tuple[Tensor, Tensor]:
    """Returns states (16, B) within some limits and beyond others, and desired controls (6, B).

    Some controls are beyond the actuators' limits.
    """
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
    """Returns at most KEPT calls, and one call for every number of a call that is NaN or infinite."""
    make, parts = safety_filter.__reduce__()
    other = batched(make(*parts))  # uncompiled
    x, desired = states(DRAWN, 0, other.c)
    draw = torch.Generator().manual_seed(1)
    most = desired.new_tensor(other.c.control_limit)[:, None]
    sent = desired.flip(1)[None].repeat(latency(other), 1, 1).maximum(-most).minimum(most)
    given = [x, desired, sent]
    kept = torch.nonzero(is_steady(other, given, draw)).flatten()[:KEPT]
    given = [part[..., kept] for part in given]
    others = hostile([part[..., :22] for part in given])
    given = [torch.cat(pair, -1) for pair in zip(given, others, strict=True)]
    state, desired, sent = given
    return Vectors(state, desired, sent, answered(other, given))


def answered(safety_filter: SafetyFilter, given: list[Tensor]) -> FilterResult:
    """Returns a filter's answer to states, desired controls and, if it takes these, controls sent."""
    return safety_filter.correct(*(given if latency(safety_filter) else given[:2]))


def is_steady(safety_filter: SafetyFilter, given: list[Tensor], draw: torch.Generator) -> Tensor:
    """Checks whether rounding decides nothing in a call, (B,) bool.

    Every program is solved, and no status, active row, check or control depends on rounding.
    """
    count = 1 + PERTURBED  # calls at each state, unchanged and perturbed, all in one batch
    near = [part.unsqueeze(-2).repeat_interleave(count, -2) for part in given]
    for part in near[:2]:
        part[:, 1:] *= 1.0 + ROUNDING * torch.randn(part[:, 1:].shape, generator=draw, dtype=torch.float64)
    answer = answered(safety_filter, [part.flatten(-2) for part in near])
    limit = answer.control.new_tensor(safety_filter.c.control_limit)[:, None, None]

    def differs(values: Tensor) -> Tensor:
        """Returns by how much values of perturbed calls are off, (..., PERTURBED, B)."""
        each = values.unflatten(-1, (count, -1)).double()
        return (each[..., 1:, :] - each[..., :1, :]).abs()

    steady = answer.status[: given[0].shape[1]] < Status.UNSOLVED
    for values in (answer.status[None], answer.active, answer.verified[None], answer.backup[None]):
        steady &= (differs(values) == 0.0).all(0).all(0)
    return steady & (differs(answer.control) / limit <= NEARLY).all(0).all(0)


def hostile(given: list[Tensor]) -> list[Tensor]:
    """Returns 22 calls, each with one number that is NaN or infinite in a state, or NaN in a desired control."""
    x, desired, *others = (part.clone() for part in given)
    for i in range(SIZE + CONTROL_SIZE):
        part, row = (x, i) if i < SIZE else (desired, i - SIZE)
        part[row, i] = (math.nan, math.inf)[i % 2] if i < SIZE else math.nan
    return [x, desired, *others]

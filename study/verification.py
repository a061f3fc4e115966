"""The Monte Carlo campaign: how often, and how badly, any constraint is violated behind the filter."""

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import beta, qmc
from torch import Tensor

from inspection.attitude import unit
from inspection.dynamics import step
from inspection.environment import InspectionEnv, Safety
from inspection.guidance import Controller
from inspection.initial_state import sample_initial_state, spherical
from inspection.parameters import InspectionParameters
from inspection.state import CONTROL_SIZE, OMEGA, SIZE, THETA_S, E, P, Q, T, V
from rta.constraints import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.qp import Status
from study.config import Config
from study.errors import InputError, refusing

BATCH = 1024  # episodes at once
FARTHEST = 795.0  # m, of the safe set's initial states
LONGEST_HOLD = 60  # s that the random policy holds an action
CONFIDENCE = 0.95
OUTCOMES = tuple(status.name.lower() for status in Status)


def safe_set(
    count: int, seed: int, c: InspectionParameters, is_safe: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Initial states (16, count) from the whole safe set and priority vectors (3, count).

    A Latin hypercube over distance up to FARTHEST, speed up to the limit there, all directions and attitudes,
    body rates, temperature and energy down to their limits and the Sun's angle; kept where `is_safe`.
    """
    sampler = qmc.LatinHypercube(16, rng=np.random.default_rng(seed))
    kept = torch.zeros(SIZE + 3, 0, dtype=torch.float64)
    while kept.shape[1] < count:
        s = torch.from_numpy(sampler.random(4 * count).T.copy())
        turn, lean = 2 * math.pi * s, (2 * s - 1).arcsin()  # azimuth, and elevation uniform on the sphere
        distance = c.collision_radius + (FARTHEST - c.collision_radius) * s[0]
        x = torch.zeros(SIZE, 4 * count, dtype=torch.float64)
        x[P] = spherical(distance, turn[1], lean[2])
        x[V] = spherical((c.docking_speed + c.speed_slope * distance) * s[3], turn[4], lean[5])
        # uniform rotations from three uniform numbers (Shoemake 1992)
        low, high = (1 - s[6]).sqrt(), s[6].sqrt()
        x[Q] = torch.stack(
            (low * turn[7].sin(), low * turn[7].cos(), high * turn[8].sin(), high * turn[8].cos())
        )
        x[OMEGA] = c.max_rate * (2 * s[9:12] - 1)
        x[T] = c.initial_temperature[0] + (c.max_temperature - c.initial_temperature[0]) * s[12]
        x[E] = c.min_energy + (c.initial_energy[1] - c.min_energy) * s[13]
        x[THETA_S] = turn[14]
        priority = spherical(torch.ones_like(distance), turn[15], lean[0])
        kept = torch.cat((kept, torch.cat((x, priority))[:, is_safe(x)]), 1)
    return kept[:SIZE, :count], kept[SIZE:, :count]


def initial_states(
    config: Config, seed: int, is_safe: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """BATCH states and priority vectors: the paper's distribution first, then as many from the safe set."""
    generator = torch.Generator().manual_seed(seed)
    paper = sample_initial_state(BATCH // 2, generator, config.inspection, is_safe)
    everywhere = safe_set(BATCH // 2, seed, config.inspection, is_safe)
    return torch.cat((paper[0], everywhere[0]), 1), torch.cat((paper[1], everywhere[1]), 1)


def held_at_random(c: InspectionParameters, generator: torch.Generator) -> Controller:
    """Uniformly random controls, each held for a uniformly random time of whole seconds."""
    held: dict[str, Tensor] = {}

    def control(t: float, x: Tensor) -> Tensor:
        draw = torch.rand(CONTROL_SIZE + 1, x.shape[1], generator=generator, dtype=torch.float64).to(x)
        fresh = (2.0 * draw[:CONTROL_SIZE] - 1.0) * x.new_tensor(c.control_limit)[:, None]
        until = t + (draw[CONTROL_SIZE] * LONGEST_HOLD).ceil()
        if held:
            keep = held["until"] > t
            fresh = torch.where(keep, held["u"], fresh)
            until = torch.where(keep, held["until"], until)
        held.update(u=fresh, until=until)
        return fresh

    return control


def adversarial(safety_filter: SafetyFilter) -> Controller:
    """Full control along the steepest descent of the worst thrust row and of the worst torque row.

    The worst row is the one that zero control comes closest to breaking, in units of the actuators' limits.
    """

    def control(t: float, x: Tensor) -> Tensor:
        halves = []
        for rows, limit in zip(safety_filter.rows(x), safety_filter.limits, strict=True):
            a = rows.a * limit
            worst = (rows.b / a.norm(dim=1).clamp(min=1e-9)).argmin(0)
            descent = -a.gather(0, worst.expand(1, 3, -1))[0]
            halves.append(limit * descent / descent.abs().amax(0).clamp(min=1e-12))
        return torch.cat(halves)

    return control


@dataclasses.dataclass
class Record:
    """What a batch of episodes did; last axis the episodes.

    Attributes:
        violating: (13, B) steps at which the constraint was negative; any: (B,) steps at which one was.
        worst: (13, B) smallest value; when: (13, B) s.
        status: (4, B) filter calls by `Status`; yielded: (13, B) calls with slack; slack: (13, B) largest.
        excess: (B,) largest control in units of its actuator's limit.
        desired: (steps, 6, B) controls that the policy desired, one per step.
    """

    violating: Tensor
    any: Tensor
    worst: Tensor
    when: Tensor
    status: Tensor
    yielded: Tensor
    slack: Tensor
    excess: Tensor
    desired: Tensor


@torch.no_grad()
def fly(safety_filter: SafetyFilter, controller: Controller, x: Tensor, duration: float, decide: float) -> Record:
    """Flies one episode per column behind the filter, checked at every second.

    Args:
        x: initial states (16, B).
        duration: s; decide: s between two desired controls. In between the filter is given its own last one.
    """
    c, period = safety_filter.c, round(safety_filter.period)
    steps, batch = round(duration), x.shape[1]
    limit = x.new_tensor(c.control_limit)[:, None]
    tally = x.new_zeros(len(CONSTRAINTS), batch)
    h = safety_filter.values(x)
    record = Record(
        violating=(h < 0.0).to(x),
        any=(h < 0.0).any(0).to(x),
        worst=h,
        when=tally.clone(),
        status=x.new_zeros(len(Status), batch),
        yielded=tally.clone(),
        slack=tally.clone(),
        excess=x.new_zeros(batch),
        desired=x.new_zeros(steps, CONTROL_SIZE, batch, dtype=torch.float32),
    )
    for i in range(steps):
        if i % decide == 0:
            desired = controller(float(i), x).float().to(x)
        record.desired[i] = desired
        if i % period == 0:
            result = safety_filter(x, desired)
            desired = result.control
            record.status[result.status, torch.arange(batch)] += 1
            record.yielded += result.slack > 0.0
            record.slack = torch.maximum(record.slack, result.slack)
            record.excess = torch.maximum(record.excess, (desired.abs() / limit).amax(0))
        x = step(x, desired, 1.0, c)
        h = safety_filter.values(x)
        record.violating += h < 0.0
        record.any += (h < 0.0).any(0)
        record.when = torch.where(h < record.worst, i + 1.0, record.when)
        record.worst = torch.minimum(record.worst, h)
    return record

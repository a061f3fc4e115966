"""Filters given states and returns every number of the quadratic programs, so that others can check them."""

import numpy as np
import torch
from torch import Tensor

from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from study.config import Config
from study.experiment import Experiment
from study.flight.state_files import read_states
from study.machine import bar

CHUNK = 4096  # states filtered at once, so that memory does not grow with their number


def run(config: Config, states: str) -> dict[str, np.ndarray]:
    """Filters the states in a file; returns the arrays that `filter` of the command line writes."""
    x, desired = read_states(states, config.inspection)
    calls = -(-x.shape[1] // CHUNK)
    experiment = Experiment(config, x.shape[1], calls * config.rta.period)
    return filter_states(experiment.filter, x.to(experiment.device), desired.to(experiment.device))


def filter_states(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> dict[str, np.ndarray]:
    """Filters states (16, N) and desired controls (6, N) in N and N m.

    Constraints are in the order of CONSTRAINTS. Units are SI: a row of A and b is the rate of h (of Psi_1 for relative
    degree two) in h's unit per s (per s^2), columns of A are per N and per N m. The paper's program, which proposes a
    control, minimises

        |(u - control_desired) / limit|^2 + sum slack_weight delta^2

    subject to A u + b >= delta and |u| <= limit, with delta = 0 where slack_weight is infinite. With the paper's filter
    u is `control_safe`. The checked filter solves the program with the mean body rates of a hold
    (`rta.demand.in_mid_hold`) and with capped weights (`rta.fast.program.HEAVIEST`); the returned A and b belong to the
    state itself.

    Returns:
        Arrays for N states and H constraints:
        control_safe: (N, 6).
        h: (N, H) constraint values, exactly as in the paper.
        A: (N, H, 6), b: (N, H) barrier conditions A u + b >= 0.
        active: (N, H) bool, the condition binds the program's control.
        slack: (N, H) delta <= 0; zero where the control is verified.
        status: (N,) `rta.result.Status`; violated: (N,) bool, some h is negative.
        verified, backup: (N,) bool, see `FilterResult`.
        constraints: (H,) names; slack_weight: (H,) per squared unit of the condition, infinite where it must hold.
    """
    parts = list(zip(x.split(CHUNK, 1), desired.split(CHUNK, 1), strict=True))
    shown = bar(len(parts), f"times {CHUNK:,} states", iterable=parts, leave=False)
    chunks = [filter_chunk(safety_filter, *part) for part in shown]
    result = {name: torch.cat([part[name] for part in chunks]).cpu().numpy() for name in chunks[0]}
    weights = [np.inf if limit.weight is None else limit.weight for limit in safety_filter.limits.values()]
    return result | {"constraints": np.array(CONSTRAINTS), "slack_weight": np.array(weights)}


def filter_chunk(safety_filter: SafetyFilter, x: Tensor, desired: Tensor) -> dict[str, Tensor]:
    """Filters a few states; returns the arrays of `filter_states` that have a row per state."""
    result, (a, b, *_) = safety_filter.correct(x, desired), safety_filter.program.evaluated(x)
    by_state = {
        "control_safe": result.control,
        "h": result.h,
        "A": a,
        "b": b,
        "active": result.active,
        "slack": -result.slack,
        "status": result.status,
        "violated": result.violated,
        "verified": result.verified,
        "backup": result.backup,
    }
    return {name: array.movedim(-1, 0) for name, array in by_state.items()}

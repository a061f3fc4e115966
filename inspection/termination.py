"""The five terminal conditions (Sec. Initial and Terminal Conditions)."""

import torch
from torch import Tensor

from inspection.chief.hull import clearance
from inspection.model.attitude import norm
from inspection.model.parameters import Episode, Limits
from inspection.model.state import E, P

# If several conditions hold at once, the first one is the episode's outcome.
OUTCOMES = ("crash", "out_of_bounds", "out_of_power", "success", "timeout")


def failures(x: Tensor, c: Limits) -> dict[str, Tensor]:
    """Returns the three conditions that end an episode at any time, each as (B,) bool for states (16, B)."""
    return {
        "crash": clearance(x[P], c) < 0.0,
        "out_of_bounds": norm(x[P]) > c.max_distance,
        "out_of_power": x[E] <= 0.0,
    }


def ends(score: Tensor, time: Tensor, c: Episode) -> dict[str, Tensor]:
    """Returns the two conditions checked after each interaction, (B,) bool, by inspected weight and time in s (B,)."""
    return {"success": score >= c.success_score, "timeout": time >= c.max_time}


def outcome_of(ended: dict[str, Tensor]) -> Tensor:
    """Returns (B,) int64, the first of `failures` and `ends` that holds as an index into OUTCOMES, or -1."""
    outcome = torch.full_like(ended["timeout"], -1, dtype=torch.int64)
    for i in reversed(range(len(OUTCOMES))):
        outcome[ended[OUTCOMES[i]]] = i
    return outcome

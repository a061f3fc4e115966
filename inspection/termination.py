"""The five terminal conditions (Sec. Initial and Terminal Conditions)."""

from torch import Tensor

from inspection.chief.hull import clearance
from inspection.model.attitude import norm
from inspection.model.parameters import InspectionParameters
from inspection.model.state import E, P

# Where several hold at once, the first one names the episode's outcome.
OUTCOMES = ("crash", "out_of_bounds", "out_of_power", "success", "timeout")


def failures(x: Tensor, c: InspectionParameters) -> dict[str, Tensor]:
    """The three that end an episode at whatever time they hold, each as (B,) bool for states (16, B)."""
    return {
        "crash": clearance(x[P], c) < 0.0,
        "out_of_bounds": norm(x[P]) > c.max_distance,
        "out_of_power": x[E] <= 0.0,
    }


def ends(score: Tensor, time: Tensor, c: InspectionParameters) -> dict[str, Tensor]:
    """The two that are asked after every interaction, (B,) bool, for inspected weight (B,) and time (B,) in s."""
    return {"success": score >= c.success_score, "timeout": time >= c.max_time}

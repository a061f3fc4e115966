"""The five terminal conditions, checked after every interaction (Sec. Initial and Terminal Conditions)."""

from torch import Tensor

from inspection.attitude import norm
from inspection.parameters import InspectionParameters
from inspection.state import E, P

# Where several hold at once, the first one names the episode's outcome.
OUTCOMES = ("crash", "out_of_bounds", "out_of_power", "success", "timeout")


def terminal_conditions(x: Tensor, score: Tensor, time: Tensor, c: InspectionParameters) -> dict[str, Tensor]:
    """Each condition as (B,) bool for states (16, B), inspected weight (B,) and time (B,) in s."""
    distance = norm(x[P])
    return {
        "crash": distance < c.collision_radius,
        "out_of_bounds": distance > c.max_distance,
        "out_of_power": x[E] <= 0.0,
        "success": score >= c.success_score,
        "timeout": time >= c.max_time,
    }

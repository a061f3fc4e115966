"""What the Sun allows: no spacecraft can inspect a point before it has been lit."""

from typing import Any

import torch
from torch import Tensor

from inspection import chief
from inspection.parameters import InspectionParameters
from inspection.state import THETA_S
from study.config import Config
from study.experiment import test_cases
from study.flight.summary import summary


def earliest_success(theta_s: Tensor, priority: Tensor, c: InspectionParameters) -> Tensor:
    """Time in s at which the points lit so far first weigh enough for success; infinite if not until the timeout.

    Args:
        theta_s: (B,) the Sun's angle at the start; priority: (3, B).
    """
    normals = chief.fibonacci_sphere(c.num_points)
    weights = chief.point_weights(normals, priority)
    lit = torch.zeros_like(weights, dtype=torch.bool)
    earliest = torch.full_like(theta_s, torch.inf)
    for step in range(round(c.max_time / c.action_period) + 1):
        time = step * c.action_period
        lit |= chief.illuminated(normals, theta_s - c.mean_motion * time)
        enough = (weights * lit).sum(0) >= c.success_score
        earliest[enough & earliest.isinf()] = time
    return earliest


def shortest_episodes(config: Config, episodes: int, seed: int) -> dict[str, Any]:
    """`summary` of `earliest_success` over the common test cases, and how many have none before the timeout.

    These count with the timeout.
    """
    x, priority = test_cases(config, episodes, seed)
    times = earliest_success(x[THETA_S], priority, config.inspection)
    shown = times.clamp(max=config.inspection.max_time)
    return {
        "episodes": episodes,
        "earliest_success_s": summary(shown.numpy()),
        "without": int(times.isinf().sum()),
    }

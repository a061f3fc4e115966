"""A bound by sunlight: no spacecraft can inspect a point before the Sun has lit it."""

from typing import Any

import torch
from torch import Tensor

from inspection.chief.points import point_weights
from inspection.chief.surface import light, surface
from inspection.chief.tumbling import Tumbling
from inspection.model.attitude import conjugate, rotate
from inspection.model.dynamics import sun_direction
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import THETA_S
from study.config import Config
from study.experiment import test_cases
from study.flight.summary import summary


def earliest_success(
    theta_s: Tensor,
    priority: Tensor,
    c: InspectionParameters,
    target: ChiefParameters,
    number: Tensor | None = None,
) -> Tensor:
    """Returns the time in s when the points lit so far first weigh enough for success; infinite after the timeout.

    Args:
        theta_s: (B,) the Sun's angle at the start; priority: (3, B).
        target: the chief; number: (B,) which determines its motion, if this is drawn.
    """
    whole, tumbling = surface(target, c), Tumbling(target, c, len(theta_s))
    tumbling.begin(torch.arange(len(theta_s)), number)
    weights = point_weights(whole.normals, priority, whole.areas)
    lit = torch.zeros_like(weights, dtype=torch.bool)
    earliest = torch.full_like(theta_s, torch.inf)
    angle = theta_s
    for step in range(round(c.max_time / c.action_period) + 1):
        time = step * c.action_period
        if step:
            angle = angle - c.mean_motion * c.action_period
        tumbling.at(torch.full_like(theta_s, time))
        lit |= light(whole, rotate(conjugate(tumbling.attitude), sun_direction(angle)).float()) > 0.0
        enough = (weights * lit).sum(0) >= c.success_score
        earliest[enough & earliest.isinf()] = time
    return earliest


def shortest_episodes(config: Config, episodes: int, seed: int) -> dict[str, Any]:
    """Returns `summary` of `earliest_success` over the test cases, and how many have no success before the timeout.

    Cases without success enter the summary with the timeout.
    """
    x, priority, number = test_cases(config, episodes, seed)
    times = earliest_success(x[THETA_S], priority, config.inspection, config.chief, number)
    shown = times.clamp(max=config.inspection.max_time)
    return {
        "episodes": episodes,
        "earliest_success_s": summary(shown.numpy()),
        "without": int(times.isinf().sum()),
    }

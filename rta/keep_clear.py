"""Correction of the desired control so that two days of free flight stay clear of the chief (off by default).

Free flight drifts along the track by 3 dv t, so a little thrust along the track moves every later pass. If the desired
control would lead to a free flight that is not clear, the first of STEPS along the track that helps is added. If none
helps, thrust is zero where that helps: coasting stays on a free flight. Nothing is guaranteed: coasting brings in what
lies beyond the two days, and a missed call, another plant or a correction by the filter may lead elsewhere. The filter
acts after this step, and its proof does not depend on this step.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from inspection.closed_loop import Correction, Safety
from inspection.model.attitude import conjugate, norm, rotate
from inspection.model.dynamics import integrate
from inspection.model.orbit import closest_pass
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THRUST, Q

SPACING = 60.0  # s between two looks at a free flight
# m, beyond the distance that a success needs. Between two looks a path is off its chord by
# (3 n^2 r + 2 n v) SPACING^2 / 8, which is less than this where it passes the chief at up to 1 m/s.
MARGIN = 1.0
# shares of the largest thrust, the smallest first
STEPS = [sign * 2.0**k / 1000.0 for k in range(10) for sign in (1.0, -1.0)]


def kept_clear(safety: Safety, c: InspectionParameters) -> Safety:
    """Returns the same safety, whose filter is given desired controls that lead to a clear free flight."""
    if safety.correct is None:
        return safety
    return replace(safety, correct=partial(corrected, c, safety.period, safety.correct))


def corrected(
    c: InspectionParameters,
    period: float,
    correct: Callable[..., Correction],
    x: Tensor,
    desired: Tensor,
    **told: Any,
) -> Correction:
    """Returns the filter's answer to `led`; it has intervened where its control differs from the desired one."""
    answer = correct(x, led(x, desired, period, c), **told)
    answer.intervened = (answer.control != desired).any(0)
    return answer


@torch.no_grad()
def led(x: Tensor, desired: Tensor, period: float, c: InspectionParameters) -> Tensor:
    """Returns the desired control, with a little thrust along the track where its free flight would not be clear.

    Args:
        x: states (16, B); desired: controls (6, B) in N and N m, held for `period` s.

    Returns:
        (6, B), as desired where nothing helps or is needed.
    """
    limit = x.new_tensor(c.control_limit)[:, None]
    given = desired.nan_to_num(0.0).clamp(-limit, limit)  # as the filter reads the desired control
    asked, left = desired.clone(), torch.nonzero(~is_clear(x, given, period, c)).flatten()
    along = x.new_tensor([0.0, 1.0, 0.0])[:, None].expand(3, x.shape[1])
    along = c.max_thrust * rotate(conjugate(x[Q]), along)
    for share in (*STEPS, None):
        if not left.numel():
            break
        tried = given[:, left]
        thrust = torch.zeros_like(tried[THRUST]) if share is None else tried[THRUST] + share * along[:, left]
        tried[THRUST] = thrust.clamp(-c.max_thrust, c.max_thrust)
        helps = is_clear(x[:, left], tried, period, c)
        asked[:, left[helps]] = tried[:, helps]
        left = left[~helps]
    return asked


def is_clear(x: Tensor, control: Tensor, period: float, c: InspectionParameters) -> Tensor:
    """Checks whether free flight after a hold stays clear by MARGIN, (B,) bool.

    The control (6, B) is held for `period` s.
    """
    times = max(1, round(period / c.substep))
    after = integrate(x, control, period / times, c, times)
    return norm(closest_pass(after, c.free_flight_horizon, c, SPACING)) >= c.collision_radius + MARGIN

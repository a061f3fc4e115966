"""Leads what is desired so that two days of free flight stay clear of the chief (off by default).

Free flight drifts along the track by 3 dv t, so a little thrust along it moves every later pass. Where what is desired
would lead to a free flight that is not clear, the least of STEPS along the track is added that helps, or else there is
no thrust: coasting stays on a free flight. Nothing is guaranteed, since coasting also brings in what lies beyond the
two days, and a missed call, another plant or the filter, which corrects what comes out, may lead elsewhere. The
filter's limits come first, and what is proven of them does not depend on this.
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
# m, beyond what a success asks for: between two looks a path strays (3 n^2 r + 2 n v) SPACING^2 / 8, which is less
# where it passes the chief at up to 1 m/s
MARGIN = 1.0
# of the largest thrust, the least first
STEPS = [sign * 2.0**k / 1000.0 for k in range(10) for sign in (1.0, -1.0)]


def kept_clear(safety: Safety, c: InspectionParameters) -> Safety:
    """The same safety, its filter asked for what leads to a free flight that is clear of the chief."""
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
    """What the filter answers to `led`; it has intervened where that is not what was desired."""
    answer = correct(x, led(x, desired, period, c), **told)
    answer.intervened = (answer.control != desired).any(0)
    return answer


@torch.no_grad()
def led(x: Tensor, desired: Tensor, period: float, c: InspectionParameters) -> Tensor:
    """The desired control, with a little thrust along the track where its free flight would not be clear.

    Args:
        x: states (16, B); desired: controls (6, B) in N and N m, held for `period` s.

    Returns:
        (6, B). As desired where nothing helps or is needed.
    """
    limit = x.new_tensor(c.control_limit)[:, None]
    given = desired.nan_to_num(0.0).clamp(-limit, limit)  # as the filter reads it
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
    """(B,) bool: after a control (6, B) is held for `period` s, free flight stays clear by MARGIN, too."""
    times = max(1, round(period / c.substep))
    after = integrate(x, control, period / times, c, times)
    return norm(closest_pass(after, c.free_flight_horizon, c, SPACING)) >= c.collision_radius + MARGIN

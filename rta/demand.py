"""Preparation of the desired control: finite numbers, and torque that keeps the body rates in their limits."""

import torch
from torch import Tensor

from inspection.model.dynamics import euler
from inspection.model.state import OMEGA, THRUST, TORQUE

# In units of the actuators' limits; larger controls are scaled down, so that no digits are lost.
LARGEST_DEMAND = 1e3
ENDLESS = 1e30  # N or N m, in place of infinity
Inertia = tuple[float, float, float]
FULL_RATE = 0.99  # largest body rate at the end of a hold, as a share of its limit


def known(x: Tensor) -> Tensor:
    """Replaces infinity in states (16, B) by NaN, since no spacecraft has an infinite state."""
    return x.masked_fill(x.isinf(), torch.nan)


def demanded(desired: Tensor, limit: list[float]) -> Tensor:
    """Returns the controls (6, B) in N and N m to filter: at most LARGEST_DEMAND limits, NaN counts as zero."""
    parts = []
    for group in (THRUST, TORQUE):
        part = torch.where(desired[group].isnan().any(0), 0.0, desired[group])
        most = LARGEST_DEMAND * limit[group.start]
        part = part.clamp(-ENDLESS, ENDLESS)
        parts.append(part * (most / part.abs().amax(0).clamp(min=most)))
    return torch.cat(parts)


def within_rates(x: Tensor, u: Tensor, hold: float, inertia: Inertia, rate: float) -> Tensor:
    """Clips torque of controls (6, B) so that a hold of `hold` s brings no body rate beyond `rate` in rad/s.

    J (+-rate - omega) / T + omega x J omega bounds the torque, to first order in time.
    """
    moments = x.new_tensor(inertia)[:, None]
    free = x[OMEGA] + hold * torch.stack(euler(x[OMEGA].unbind(), inertia))
    low, high = (moments * (end - free) / hold for end in (-rate, rate))
    return torch.cat((u[THRUST], u[TORQUE].maximum(low).minimum(high)))


def in_mid_hold(x: Tensor, u: Tensor, hold: float, inertia: Inertia) -> Tensor:
    """Returns states (16, B) with the mean body rates of a hold of controls (6, B), because torque acts over time.

    A condition depends on the body rate, which changes all the time while torque is held. With the rate at the
    beginning, torque swings back and forth from call to call.
    """
    mean = x[OMEGA] + hold / 2 * u[TORQUE] / x.new_tensor(inertia)[:, None]
    return torch.cat((x[: OMEGA.start], mean, x[OMEGA.stop :]))

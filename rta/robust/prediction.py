"""Prediction of a state that is some calls old, and of its error."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import step
from inspection.model.parameters import Limits
from inspection.model.state import THRUST, TORQUE
from inspection.world.uncertainty import Uncertainty

KINDS = 4  # groups of measured quantities: position, velocity, attitude, rates


def predicted(
    x: Tensor, error_bound: Tensor, u: Tensor, c: Limits, period: float, uncertainty: Uncertainty
) -> tuple[Tensor, Tensor]:
    """Returns the states a period later, and how much further off they may be than when they were measured.

    An acceleration that is off by A for T adds A T to the error of velocity and A T^2 / 2 to the error of position.
    Thrust is off by the error of its size, by each thruster's misalignment, and by the error of the attitude.

    Args:
        x: (16, B); error_bound: (4, B) in m, m/s, rad, rad/s, how much further off than measured they may be already.
        u: (6, B) the controls held since, NaN where a state is younger; such a state stays as it is.

    Returns:
        States (16, B) and (4, B).
    """
    model, t = replace(c, saturate_rates=False), period
    aside = math.sin(math.radians(uncertainty.thrust_misalignment))
    _, velocity, attitude, rate = uncertainty.radii
    error, most, twist = uncertainty.thrust_error, uncertainty.thrust[1], uncertainty.torque_error
    old = ~u.isnan().any(0)
    u = u.nan_to_num()
    p, v, q, omega = error_bound
    twisted = twist * norm(u[TORQUE]) / min(c.inertia) + uncertainty.angular_acceleration(c)
    angle = attitude + q + (rate + omega) * t / 2 + twisted * t**2 / 6
    off = (error + most * angle) * norm(u[THRUST]) + most * aside * u[THRUST].abs().sum(0)
    push = off / c.mass + uncertainty.acceleration
    grown = torch.stack(
        (
            p + (velocity + v) * t + push * t**2 / 2,
            v + push * t,
            q + (rate + omega) * t + twisted * t**2 / 2,
            omega + twisted * t,
        )
    )
    return torch.where(old, step(x, u, t, model), x), torch.where(old, grown, error_bound)

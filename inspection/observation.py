"""The agent's 26 observations in the paper's order, all vectors in the body frame (Sec. State and Observation)."""

from typing import NamedTuple

import torch
from torch import Tensor

from inspection.attitude import conjugate, dot, norm, rotate, unit
from inspection.dynamics import sun_direction
from inspection.state import OMEGA, THETA_S, E, P, Q, T, V


class Component(NamedTuple):
    """One number that the agent observes or commands; `scale`, in its unit, brings it into roughly [-1, 1]."""

    name: str
    unit: str
    scale: float


def vector(name: str, unit: str = "1", scale: float = 1.0) -> list[Component]:
    """The three components of a vector."""
    return [Component(f"{name}_{i}", unit, scale) for i in "xyz"]


# (decision: the paper does not give its scales)
OBSERVATIONS: tuple[Component, ...] = (
    Component("position_norm", "m", 100.0),
    *vector("position"),
    Component("velocity_norm", "m/s", 0.866),
    *vector("velocity"),
    *vector("angular_velocity", "rad/s", 0.035),
    Component("energy", "kJ", 10.0),
    Component("temperature", "deg C", 10.0),
    *vector("sun"),
    Component("sun_alignment", "1", 1.0),
    *vector("priority"),
    Component("priority_alignment", "1", 1.0),
    *vector("uninspected"),
    Component("uninspected_alignment", "1", 1.0),
    Component("inspected_score", "1", 1.0),
)
SIZE = len(OBSERVATIONS)


def observe(x: Tensor, priority: Tensor, uninspected: Tensor, score: Tensor) -> Tensor:
    """o in physical units, (26, B); divide by `scales` for the network.

    Args:
        x: states (16, B).
        priority, uninspected: r_p and r_UPS in Hill's frame (3, B).
        score: inspected weight w_p (B,).
    """
    to_body = conjugate(x[Q])
    p_hat, sun = unit(x[P]), sun_direction(x[THETA_S])
    rows = [norm(x[P])[None], rotate(to_body, p_hat), norm(x[V])[None], rotate(to_body, unit(x[V]))]
    rows += [x[OMEGA], x[E][None], x[T][None]]
    for direction in (sun, priority, uninspected):
        rows += [rotate(to_body, direction), dot(direction, p_hat)[None]]
    return torch.cat([*rows, score[None]])


def scales(like: Tensor) -> Tensor:
    """Divisors (26, 1) on the device and in the precision of `like`."""
    return like.new_tensor([scale for _, _, scale in OBSERVATIONS])[:, None]


def normalised(x: Tensor, priority: Tensor, uninspected: Tensor, score: Tensor) -> Tensor:
    """`observe` divided by `scales`, in float32 for the network."""
    o = observe(x, priority, uninspected, score)
    return (o / scales(o)).float()

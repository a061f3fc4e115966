"""The agent's 26 observations in the paper's order, all vectors in the body frame (Sec. State and Observation)."""

import torch
from torch import Tensor

from inspection.attitude import conjugate, dot, norm, rotate, unit
from inspection.dynamics import sun_direction
from inspection.state import OMEGA, THETA_S, E, P, Q, T, V

# name, and the value that brings it into roughly [-1, 1] (decision: the paper does not give its scales)
OBSERVATIONS: tuple[tuple[str, float], ...] = (
    ("position_norm", 100.0),  # m
    *((f"position_{i}", 1.0) for i in "xyz"),
    ("velocity_norm", 0.866),  # m/s
    *((f"velocity_{i}", 1.0) for i in "xyz"),
    *((f"angular_velocity_{i}", 0.035) for i in "xyz"),  # rad/s
    ("energy", 10.0),  # kJ
    ("temperature", 10.0),  # deg C
    *((f"sun_{i}", 1.0) for i in "xyz"),
    ("sun_alignment", 1.0),
    *((f"priority_{i}", 1.0) for i in "xyz"),
    ("priority_alignment", 1.0),
    *((f"uninspected_{i}", 1.0) for i in "xyz"),
    ("uninspected_alignment", 1.0),
    ("inspected_score", 1.0),
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
    return like.new_tensor([scale for _, scale in OBSERVATIONS])[:, None]


def normalised(x: Tensor, priority: Tensor, uninspected: Tensor, score: Tensor) -> Tensor:
    """`observe` divided by `scales`, in float32 for the network."""
    o = observe(x, priority, uninspected, score)
    return (o / scales(o)).float()

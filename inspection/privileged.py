"""Inputs of the critic beside the observation: where the points left to inspect lie, and when the Sun will light them.

The agent observes its score and the nearest lit cluster. The value of a state also depends on the points in the dark
and on the time. Only training uses the critic; the agent flies without it (asymmetric actor-critic, Pinto et al.
2018).
"""

import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, P, V

HARMONICS = 5
PRIVILEGED = 3 + 2 * HARMONICS + 3 + 3 + 5  # counts: weights, their moments, position, velocity, the rest


def privileged(x: Tensor, points: Tensor, left: Tensor, time: Tensor, c: InspectionParameters) -> Tensor:
    """Returns what is left to inspect, and where the deputy is, in Hill's frame turned to the Sun: (PRIVILEGED, B).

    The weights w left, at azimuths phi from the Sun and heights z, are described by the sums of w, w cos(k phi),
    w sin(k phi), w z and w z^2.

    Args:
        x: states (16, B).
        points: on the chief in Hill's frame, (3, N, 1), or (3, N, B) where it turns.
        left: (N, B) weights of the points, 0 where inspected; time: (B,) s, of the episode.
    """
    theta = x[THETA_S]
    k = torch.arange(1.0, HARMONICS + 1.0, dtype=x.dtype, device=x.device)
    azimuth = k[:, None, None] * torch.atan2(points[1], points[0])
    cos, sin = ((part * left).sum(1) for part in (azimuth.cos(), azimuth.sin()))  # (HARMONICS, B)
    turn = k[:, None] * theta
    height = points[2] / points.square().sum(0).sqrt()

    def to_sun(vector: Tensor) -> Tensor:
        """Returns the vector (3, B) in the frame whose x points to the Sun."""
        along = vector[0] * theta.cos() + vector[1] * theta.sin()
        return torch.stack((along, vector[1] * theta.cos() - vector[0] * theta.sin(), vector[2]))

    p = to_sun(x[P]) / c.initial_radius[1]
    parts = (
        left.sum(0)[None],
        cos * turn.cos() + sin * turn.sin(),
        sin * turn.cos() - cos * turn.sin(),
        (height * left).sum(0)[None],
        (height.square() * left).sum(0)[None],
        p,
        to_sun(x[V]),
        torch.stack(
            (p.square().sum(0).sqrt(), torch.atan2(p[1], p[0]), time / c.max_time, theta.cos(), theta.sin())
        ),
    )
    return torch.cat(parts)

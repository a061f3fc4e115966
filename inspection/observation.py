"""What the agent observes, all vectors in the body frame (Sec. State and Observation)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import conjugate, dot, norm, rotate, rotation_matrix, unit
from inspection.model.dynamics import sun_direction
from inspection.model.orbit import closest_pass
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, THETA_S, E, P, Q, T, V

# s between samples of free flight. The chords between samples are off by |a| spacing^2 / 8: at 100 m from the chief by
# 0.2 and 3 m at 1 m/s, and by 0.03 and 0.4 m at rest.
SHORT_SPACING, LONG_SPACING = 25.0, 100.0


class Component(NamedTuple):
    """Describes one number that the agent observes or commands; dividing by `scale` gives roughly [-1, 1]."""

    name: str
    unit: str
    scale: float


def vector(name: str, unit: str = "1", scale: float = 1.0) -> list[Component]:
    """Returns the three components of a vector."""
    return [Component(f"{name}_{i}", unit, scale) for i in "xyz"]


def groups(c: InspectionParameters) -> dict[str, list[Component]]:
    """Returns all components by group, in the paper's order, 26 in all, and three groups beyond the paper.

    "hill": the paper's observations give the Sun's direction, but do not tell radial from along-track, so an agent
    cannot know whether its flight drifts. "free_flight": where coasting passes the chief next, within the horizons of
    passive safety and of the success reward; a small network does not work that out. "chief": two axes of a chief that
    turns, and its rate.
    """
    position, velocity, rate = c.observation_scales
    return {
        "position": [Component("position_norm", "m", position), *vector("position")],
        "velocity": [Component("velocity_norm", "m/s", velocity), *vector("velocity")],
        "angular_velocity": vector("angular_velocity", "rad/s", rate),
        "energy": [Component("energy", "kJ", 10.0)],
        "temperature": [Component("temperature", "deg C", 10.0)],
        "sun": [*vector("sun"), Component("sun_alignment", "1", 1.0)],
        "priority": [*vector("priority"), Component("priority_alignment", "1", 1.0)],
        "uninspected": [*vector("uninspected"), Component("uninspected_alignment", "1", 1.0)],
        "score": [Component("inspected_score", "1", 1.0)],
        "hill": [*vector("radial"), *vector("along_track")],
        "free_flight": [*vector("next_pass"), *vector("later_pass")],
        "chief": [*vector("chief_x"), *vector("chief_y"), *vector("chief_rate", "rad/s", rate)],
    }


def components(c: InspectionParameters) -> list[Component]:
    """Returns the observed components."""
    return [component for name, group in groups(c).items() if name in c.observed for component in group]


def observe(
    x: Tensor,
    priority: Tensor,
    uninspected: Tensor,
    score: Tensor,
    c: InspectionParameters,
    chief: Tensor | None = None,
) -> Tensor:
    """Returns the observation o in physical units, a row (B,) per component; the network divides it by `scales`.

    Args:
        x: states (16, B).
        priority, uninspected: r_p and r_UPS in Hill's frame (3, B).
        score: inspected weight w_p (B,).
        chief: (7, B) its attitude, from its axes to Hill's, and its rate about them in rad/s, if observed.
        c: names what is observed, and the horizons of free flight.
    """
    to_body = conjugate(x[Q])
    p_hat = unit(x[P])

    def of_direction(direction: Tensor) -> Tensor:
        return torch.cat((rotate(to_body, direction), dot(direction, p_hat)[None]))

    def of_free_flight() -> Tensor:
        horizons = (c.passive_safety_horizon, SHORT_SPACING), (c.free_flight_horizon, LONG_SPACING)
        passes = [closest_pass(x, horizon, c, spacing) for horizon, spacing in horizons]
        # of length collision radius / distance, at most 2
        near = [unit(closest) * (c.collision_radius / norm(closest)).clamp(max=2.0) for closest in passes]
        return torch.cat([rotate(to_body, each) for each in near])

    radial, along_track, _ = torch.eye(3, dtype=x.dtype, device=x.device)[..., None].expand(3, *x[P].shape)
    rows: dict[str, Callable[[], Tensor]] = {
        "position": lambda: torch.cat((norm(x[P])[None], rotate(to_body, p_hat))),
        "velocity": lambda: torch.cat((norm(x[V])[None], rotate(to_body, unit(x[V])))),
        "angular_velocity": lambda: x[OMEGA],
        "energy": lambda: x[E][None],
        "temperature": lambda: x[T][None],
        "sun": lambda: of_direction(sun_direction(x[THETA_S])),
        "priority": lambda: of_direction(priority),
        "uninspected": lambda: of_direction(uninspected),
        "score": lambda: score[None],
        "hill": lambda: torch.cat((rotate(to_body, radial), rotate(to_body, along_track))),
        "free_flight": of_free_flight,
    }
    if chief is not None:
        own_axes = rotation_matrix(chief[:4])
        seen = (own_axes[:, 0], own_axes[:, 1], rotate(chief[:4], chief[4:7]))
        rows["chief"] = lambda: torch.cat([rotate(to_body, each) for each in seen])
    return torch.cat([row() for name, row in rows.items() if name in c.observed])


def scales(like: Tensor, c: InspectionParameters) -> Tensor:
    """Returns divisors (components, 1) on the device and in the precision of `like`."""
    return like.new_tensor([scale for _, _, scale in components(c)])[:, None]


def normalised(
    x: Tensor, priority: Tensor, uninspected: Tensor, score: Tensor, *chief: Tensor, c: InspectionParameters
) -> Tensor:
    """Returns `observe` divided by `scales`, in float32 for the network."""
    o = observe(x, priority, uninspected, score, c, *chief)
    return (o / scales(o, c)).float()

"""The nine reward terms by name (Sec. Rewards), and our own terms, with which an agent may be trained in addition."""

import math

import torch
from torch import Tensor

from inspection.model.attitude import conjugate, norm, rotate, unit
from inspection.model.orbit import closest_pass, free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, P, Q, V

PHASES = 64  # samples of an orbit of free flight
# The h below which a limit counts as near, in the unit of h; for limits that agents without a filter violate; chosen
NEAR = {"dynamic_speed": 0.06, "passive_safety": 6.0, "temperature": 0.5, "battery": 0.3}  # m/s, m, deg C, kJ
REWARDS = ("points", "delta_v", "torque", "orientation", "time", "success", "crash", "distance", "energy")


def orientation(x: Tensor, c: InspectionParameters) -> Tensor:
    """Returns R_orient: Gaussian-like decay of the boresight's misalignment with the chief, (16, B) to (B,)."""
    to_chief = rotate(conjugate(x[Q]), -unit(x[P]))
    misalignment = (to_chief[0] - 1.0).abs()
    reward = c.orientation_reward * (-misalignment / c.orientation_width).exp()
    return torch.where(misalignment <= 1.0, reward, 0.0)


def stays_clear(x: Tensor, columns: Tensor, c: InspectionParameters) -> Tensor:
    """Checks whether free flight from states x (16, B) stays clear of the chief, (B,); False outside `columns` (B,)."""
    clear = torch.zeros_like(columns)
    if columns.any():
        pass_ = closest_pass(x[:, columns], c.free_flight_horizon, c)
        clear[columns] = norm(pass_) >= c.collision_radius
    return clear


def success(x: Tensor, succeeded: Tensor, c: InspectionParameters) -> Tensor:
    """Returns R_success: +1 if two days of free flight after the last inspection stay clear of the chief, else -1."""
    sign = stays_clear(x, succeeded, c).to(x.dtype) * 2.0 - 1.0
    return torch.where(succeeded, c.terminal_reward * sign, 0.0)


def rewards(
    x: Tensor,
    new_score: Tensor,
    delta_v: Tensor,
    torque: Tensor,
    time: Tensor,
    ended: dict[str, Tensor],
    c: InspectionParameters,
) -> dict[str, Tensor]:
    """Returns every term as (B,) for the state x (16, B) after the interaction.

    Args:
        new_score: weight inspected in this interaction.
        delta_v: m/s spent by the applied control; torque: N m, |tau| summed over axes, mean over substeps.
        time: s since the episode began.
        ended: `failures` of the interaction and `ends` after it.
    """
    failed = -c.terminal_reward
    return {
        "points": c.points_reward * new_score,
        "delta_v": c.delta_v_reward * delta_v,
        "torque": c.torque_reward * torque,
        "orientation": orientation(x, c),
        "time": c.time_reward * (time <= c.time_reward_until).to(x.dtype),
        "success": success(x, ended["success"], c),
        "crash": failed * ended["crash"].to(x.dtype),
        "distance": failed * ended["out_of_bounds"].to(x.dtype),
        "energy": failed * ended["out_of_power"].to(x.dtype),
    }


def distance_from_track(x: Tensor, c: InspectionParameters) -> Tensor:
    """Returns the smallest distance (B,) in m, over an orbit of free flight, from the line along the chief's track.

    Free flight repeats every orbit, except for a drift along this line. So a flight that stays away from the line never
    meets the chief (D'Amico and Montenbruck 2006). On an ellipse of 50 m the samples miss the smallest distance by at
    most 50 m pi / PHASES, 2.5 m.
    """
    orbit = 2.0 * math.pi / c.mean_motion
    t = torch.arange(PHASES, dtype=x.dtype, device=x.device) * (orbit / PHASES)
    path = free_flight(x[P, None], x[V, None], t[:, None], c.mean_motion)
    return torch.hypot(path[0], path[2]).amin(0)


def shaping(
    x: Tensor,
    h: dict[str, Tensor],
    corrected: Tensor,
    delta_v: Tensor,
    progress: float,
    c: InspectionParameters,
) -> dict[str, Tensor]:
    """Returns our own terms as (B,) for the state x (16, B) after the interaction; none if all weights are 0.

    The learner gets these beside the paper's nine terms; reports contain only `rewards`.

    Args:
        h: constraint values (B,) by name.
        corrected: share of the filter's calls that it corrected; delta_v: of the interaction in m/s.
        progress: share of training that is done, with which the fuel penalty grows: noise costs fuel, and an agent that
            pays the full penalty from the start learns to stay where it is.
    """
    terms = {}
    if c.fuel_reward:
        terms["fuel"] = progress * c.fuel_reward * delta_v
    if c.duration_reward:
        terms["duration"] = torch.full_like(delta_v, c.duration_reward)
    if c.rate_reward:
        terms["rate"] = c.rate_reward * (x[OMEGA] / c.max_rate).square().sum(0)
    if c.correction_reward:
        terms["correction"] = c.correction_reward * corrected
    if c.limit_reward:
        near = [(1.0 - h[name] / margin).clamp(0.0, 2.0) for name, margin in NEAR.items() if name in h]
        terms["limit"] = c.limit_reward * sum(near, torch.zeros_like(corrected))
    if c.drift_reward:
        nearness = 1.0 - distance_from_track(x, c) / (2.0 * c.collision_radius)
        terms["drift"] = c.drift_reward * nearness.clamp(min=0.0)
    return terms

"""The check that a vehicle can hold its limits at all, whatever its filter."""

import math

import torch

from inspection.model.dynamics import energy_rate, euler, temperature_rate
from inspection.model.parameters import Limits

LEAST_BRAKING = 0.1  # share of a_max that must be left for braking across
LEAST_TORQUE = 0.5  # share of the torque that must be left when turning at full rate
MOST_THRUST = 1e6  # m/s^2; its squares are still finite


def check(c: Limits) -> None:
    """Raises ValueError if the vehicle cannot hold one of its limits, with the limit, the reason and the number."""
    if c.max_thrust / c.mass > MOST_THRUST:
        raise ValueError(
            f"max_thrust / mass = {c.max_thrust / c.mass:.3g} m/s^2: must be at most {MOST_THRUST:.0e}"
        )
    if c.max_acceleration <= 0.0:
        raise ValueError(
            f"max_thrust / mass = {c.max_thrust / c.mass:.3g} m/s^2: must exceed the natural acceleration within "
            f"max_distance, {c.max_thrust / c.mass - c.max_acceleration:.3g} m/s^2, to hold the keep-in zone"
        )
    fastest = min(c.docking_speed + c.speed_slope * c.max_distance, math.sqrt(3.0) * c.max_speed)
    falling = c.speed_slope * fastest
    braking = c.max_thrust / c.mass - c.largest_drift(c.max_distance, 0.0)  # the Coriolis force does no work
    if braking < falling:
        raise ValueError(
            f"max_thrust = {c.max_thrust:g}, mass = {c.mass:g}: brake by {braking:.3g} m/s^2, but the "
            f"dynamic speed limit falls by up to {falling:.3g} m/s^2 on the way in: lower speed_slope below "
            f"{braking / fastest:.3g} 1/s, or max_speed"
        )
    inwards = fastest**2 / c.max_distance
    if inwards > (1.0 - LEAST_BRAKING) * c.max_acceleration:
        slow_enough = math.sqrt((1.0 - LEAST_BRAKING) * c.max_acceleration * c.max_distance / 3.0)
        raise ValueError(
            f"max_thrust = {c.max_thrust:g}, mass = {c.mass:g}: brake by {c.max_acceleration:.3g} m/s^2, but flying "
            f"across at the speed limit of max_distance takes {inwards:.3g} m/s^2 to stay within it: must be at most "
            f"{1.0 - LEAST_BRAKING:.0%} of that: lower max_speed below {slow_enough:.3g} m/s, or speed_slope"
        )
    gyroscopic = max(
        abs(rate) * moment
        for rate, moment in zip(euler((c.max_rate,) * 3, c.inertia), c.inertia, strict=True)
    )
    if gyroscopic > (1.0 - LEAST_TORQUE) * c.max_torque:
        raise ValueError(
            f"max_torque = {c.max_torque:.3g} N m (of inertia, max_angular_acceleration and the wheels): turning at "
            f"max_rate takes up to {gyroscopic:.3g} N m against gyroscopic torque: must be at most half: lower max_rate"
        )
    if c.max_rate <= 2 * c.mean_motion:
        raise ValueError(
            f"max_rate = {c.max_rate:.3g} rad/s: must exceed twice the {c.mean_motion:.3g} rad/s of the Sun in "
            "Hill's frame, to keep the camera out of it"
        )
    full = torch.ones((), dtype=torch.float64)
    charging = energy_rate(full, c).item()
    if charging <= 0.0:
        raise ValueError(
            f"power_draw = {c.power_draw:g} W: must be below the {1000 * charging + c.power_draw:.3g} W of the panels "
            "in full light, to hold the battery's limit"
        )
    cooling = -temperature_rate(0 * full, 0 * full, c.max_temperature * full, c).item()
    if cooling <= 0.0:
        raise ValueError(
            f"emissivity = {c.emissivity:g}: the surface does not cool at max_temperature in the dark: must be positive"
        )

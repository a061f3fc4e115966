"""What the filter's gains and margins become for another vehicle, and which vehicle cannot hold its limits.

The values in `RtaParameters` were chosen on the paper's 6U. What they are worth elsewhere follows from what they stand
for: times, angles and amounts that a vehicle needs to turn. For the paper's every factor here is 1.

| quantity | of a vehicle | what it scales |
|---|---|---|
| time to stop a turn | omega / alpha | exclusion gains, each k2: faster ones ask for torque that is not there |
| time to turn by 90 deg | (pi / 2) / omega + omega / alpha | k1 of temperature and battery: act while a turn helps |
| angle of a stop | omega^2 / (2 alpha) | rounding of the terminator, least angle to a pole |
| speed of turning | alpha, omega^2 | exclusion margin: what a period at constant torque misses |
| heat, charge of a turn | most of either, times the time to turn | margins of temperature and battery |

omega is `max_rate`, alpha the least angular acceleration of an axis, `max_torque` over the largest moment. Gains fall
with a slower vehicle and margins grow; a quicker one keeps the 6U's, which the period limits.
"""

import math
from dataclasses import replace

import torch

from inspection.model.dynamics import energy_rate, euler, temperature_rate
from inspection.model.parameters import Limits
from rta.constraints.thrust import LEAST_BRAKING
from rta.parameters import RtaParameters

PAPER = Limits()
WIDEST = 1.0  # rad, of the terminator's rounding; beyond, most of the sphere would be terminator
# Share of the smallest speed limit that thrust may add in a period. At 0.67 passive safety and the speed limit found no
# common control in one of 10,000 episodes, at the 6U's 0.46 and, beside the hull of configs/chiefs, 0.56 in none.
MOST_GAINED = 0.56
LEAST_TORQUE = 0.5  # share of the torque that must be left for turning at full rate


def least_angular_acceleration(c: Limits) -> float:
    """rad/s^2, of the axis with the largest moment."""
    return c.max_torque / max(c.inertia)


def time_to_stop(c: Limits) -> float:
    """s, from the largest rate."""
    return c.max_rate / least_angular_acceleration(c)


def time_to_turn(c: Limits) -> float:
    """s, by 90 deg."""
    return math.pi / 2 / c.max_rate + time_to_stop(c)


def heat_of_a_turn(c: Limits) -> float:
    """deg C, that the surface is warmer after a turn in full light than after one in the dark."""
    none, full = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    rates = (temperature_rate(light, light, c.max_temperature * full, c) for light in (full, none))
    return (next(rates) - next(rates)).item() * time_to_turn(c)


def charge_of_a_turn(c: Limits) -> float:
    """kJ, that the spacecraft draws in a turn."""
    return c.power_draw / 1000.0 * time_to_turn(c)


def scaled(r: RtaParameters, c: Limits) -> RtaParameters:
    """The gains and margins of a vehicle, see the module."""

    def ratio(quantity: float, papers: float) -> float:
        return max(1.0, quantity / papers)

    stop, turn = ratio(time_to_stop(c), time_to_stop(PAPER)), ratio(time_to_turn(c), time_to_turn(PAPER))
    angle = ratio(c.max_rate * time_to_stop(c), PAPER.max_rate * time_to_stop(PAPER))
    strongest = (each.max_torque / min(each.inertia) for each in (c, PAPER))
    quick = max(ratio(*strongest), ratio(c.max_rate**2, PAPER.max_rate**2))

    def slower(k1: float, k2: float) -> tuple[float, float]:
        return k1 / turn, k2 / stop

    return replace(
        r,
        exclusion_gains=(r.exclusion_gains[0] / stop, r.exclusion_gains[1] / stop),
        temperature_gains=slower(*r.temperature_gains),
        battery_gains=slower(*r.battery_gains),
        exclusion_margin=r.exclusion_margin * quick,
        temperature_margin=r.temperature_margin * ratio(heat_of_a_turn(c), heat_of_a_turn(PAPER)),
        battery_margin=r.battery_margin * ratio(charge_of_a_turn(c), charge_of_a_turn(PAPER)),
        incidence_rounding=min(r.incidence_rounding * angle, max(WIDEST, r.incidence_rounding)),
        pole_angle=math.atan(math.tan(r.pole_angle) * angle) if angle > 1.0 else r.pole_angle,
    )


def check(c: Limits, period: float | None = None) -> None:
    """Raises ValueError where the vehicle cannot hold one of its limits, with the limit, the reason and the number.

    Args:
        period: s between two calls, where rows are of the rate of now; None: they are of all that a hold does.
    """
    if c.max_acceleration <= 0.0:
        raise ValueError(
            f"max_thrust / mass = {c.max_thrust / c.mass:.3g} m/s^2: must exceed the natural acceleration within "
            f"max_distance, {c.max_thrust / c.mass - c.max_acceleration:.3g} m/s^2, to hold the keep-in zone"
        )
    fastest = min(c.docking_speed + c.speed_slope * c.max_distance, math.sqrt(3.0) * c.max_speed)
    falling = c.speed_slope * fastest
    braking = c.max_thrust / c.mass - c.largest_drift(c.max_distance, 0.0)  # Coriolis' force does no work
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
    slowest = c.docking_speed + c.speed_slope * c.least_distance
    gained = math.sqrt(3.0) * c.max_thrust / c.mass * (period or 0.0)
    if gained > MOST_GAINED * slowest:
        raise ValueError(
            f"max_thrust = {c.max_thrust:g}, mass = {c.mass:g}: change the speed in {period:g} s by up to {gained:.3g} "
            f"m/s: must be at most {MOST_GAINED:.0%} of the limit beside the chief, {slowest:.3g} m/s at "
            f"{c.least_distance:.3g} m from its centre: lower max_thrust, or raise "
            f"docking_speed above {c.docking_speed + gained / MOST_GAINED - slowest:.3g} m/s"
            + (' or keep clear of the sphere ([chief] collision = "sphere")' if c.planes else "")
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
    if c.max_rate <= 2 * c.fastest_orbit_rate:
        raise ValueError(
            f"max_rate = {c.max_rate:.3g} rad/s: must exceed twice the {c.fastest_orbit_rate:.3g} rad/s of the Sun in "
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

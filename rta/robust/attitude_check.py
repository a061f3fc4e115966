"""The backup trajectory of torque with error bounds, to rest.

The law is that of `rta.check.attitude_law` in a form that is robust to errors: Lipschitz in the attitude, with one
attitude of rest, and slow enough to be followed. Let d be the panels' axis, s the direction to the Sun and w the body's
rate relative to the Sun. The law commands

    w* = kappa proj(d x s) + roll d,    torque = J (w* - w) / tau less the gyroscopic one,    tau = G times the hold,

where proj shortens what is longer than W / kappa, and G is the largest gain. At rest the panels face the Sun and the
cooled axis e is along Hill's z. In a hold the error z = w - w* shrinks by the share g t / tau, between 0 and 1 whenever
the hold ends, so a missed call does not overshoot. The remaining error is bounded per axis, call by call (`followed`).
The limits' bounds need only its sums (`trajectory_margin`). docs/reference/proof_with_bounds.md has the derivation, and
what is not proven.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import cross, dot, norm, rotation_matrix
from inspection.model.dynamics import euler, step, sun_and_earth_in_body, temperature_rate
from inspection.model.state import OMEGA, TORQUE, E, Q, T
from rta.check.attitude_law import upright, vector
from rta.check.flight import attitude_between, incidence
from rta.check.intersample_bounds import lowest
from rta.robust.attitude_constants import (
    BEGINS,
    FULL,
    LOOKAHEAD,
    ROOT2,
    ROOT3,
    AttitudeConstants,
    heating,
)

LOOK = 2.5  # s, longest time between two tests of a hold


@dataclass(frozen=True)
class Spread:
    """Holds bounds of how far true states may be from given ones (16, ...) at a call.

    Attributes:
        angle: (...) rad, in any direction; rate: (...) rad/s, of each axis.
        temperature, energy: (...) deg C, kJ.
        command: (...) rad/s^2, of each axis, of the torque that was held until the call.
        late: (2, ...) rad/s and rad, additional error of the state at the law's first calls: they answer measurements
            from before this torque acted, so other torque acted since.
    """

    angle: Tensor
    rate: Tensor
    temperature: Tensor
    energy: Tensor
    command: Tensor
    late: Tensor


class Start(NamedTuple):
    """Describes the beginning of a backup trajectory; upper bounds, but lower ones in the last two.

    Attributes:
        delta: (...) rad, of the panels from the Sun; z: (2, ...) rad/s, by which the rates across d are not the law's.
        rolling: (...) rad/s, of the rate about d; command, late: see `Spread`; hot: (...) deg C.
        near, energy: (...) rad, delta, and kJ.
    """

    delta: Tensor
    z: Tensor
    rolling: Tensor
    command: Tensor
    late: Tensor
    hot: Tensor
    near: Tensor
    energy: Tensor

    @classmethod
    def any_of(cls, starts: Sequence["Start"]) -> "Start":
        """Returns bounds that hold for all of several starts."""
        *most, near, energy = zip(*starts, strict=True)
        least = (-maximum([-each for each in parts]) for parts in (near, energy))
        return cls(*(maximum(list(parts)) for parts in most), *least)


def maximum(parts: list[Tensor]) -> Tensor:
    """Returns the largest of several tensors, element by element."""
    most, *others = parts
    for part in others:
        most = torch.maximum(most, part)
    return most


def wanted(x: Tensor, w: AttitudeConstants) -> Tensor:
    """Returns the law: omega (3, ...) in rad/s, relative to Hill's frame, for states (16, ...)."""
    d, e = vector(w.c.solar_panel_axis, x), vector(w.c.thermal_axis, x)
    s, _ = sun_and_earth_in_body(x)
    axis, cosine = torch.stack(cross(d, s)), dot(d, s)
    begins, full = math.cos(BEGINS), math.cos(FULL)
    off = (w.kappa_roll * dot(d, torch.stack(cross(e, upright(x, d, s))))).clamp(-w.roll, w.roll)
    roll = off * ((cosine - begins) / (full - begins)).clamp(0.0, 1.0)
    pointing = (w.rate / norm(axis).clamp(min=1e-12)).clamp(max=w.kappa)
    return pointing * axis + roll * d - w.c.mean_motion * rotation_matrix(x[Q])[2]


def law(x: Tensor, w: AttitudeConstants) -> Tensor:
    """Returns the law as torque (3, B) in N m at measured states (16, B)."""
    inertia = x.new_tensor(w.c.inertia)[:, None]
    faster = (wanted(x, w) - x[OMEGA]) / w.tau - torch.stack(euler(x[OMEGA], w.c.inertia))
    return (inertia * faster).clamp(-w.c.max_torque, w.c.max_torque)


class Followed(NamedTuple):
    """Holds how the law is followed in each period from a call on.

    Attributes:
        errors: (...) rad/s each, the largest |z|; paces: (...) rad/s, the smallest rate at which the law turns the
            panels until they are near the Sun.
        least: (...) rad, the smallest delta, before each period and after the last.
        farthest: (...) rad, the largest delta at the end, or a right angle; last: (...) rad/s, |z| of an axis at the
            end.
    """

    errors: list[Tensor]
    paces: list[Tensor]
    least: list[Tensor]
    farthest: Tensor
    last: Tensor


def followed(start: Start, w: AttitudeConstants) -> Followed:
    """Returns bounds of the error of the law's rates, call by call, whichever calls are missed.

    In a hold from a call with the error z_i, the error is at most |1 - b| |z_i| + b e + F t, with b between g t / tau
    and G t / tau. Here e is the measurement's error, and F is what the model does not know plus the change of the law's
    rates.
    """
    steps = math.ceil(LOOKAHEAD / (w.slowest * w.period))
    limit, long = w.c.max_rate + w.unknown, w.hold_periods * w.period
    none = torch.full_like(start.rolling, -math.inf)
    errors = [start.z, *[torch.stack((none, none))] * (steps + w.hold_periods)]
    rolls = [start.rolling, *[none] * (steps + w.hold_periods)]
    most = max(w.spin) * limit**2 + w.unknown * ROOT3 * limit
    commands = [start.command], [start.command]  # across d, and about d
    unknowns = [torch.full_like(none, most)], [torch.full_like(none, most)]
    sums: list[Tensor] = []
    paces: list[Tensor] = []
    least, slower = [start.near], math.asin(w.rate / w.kappa)
    farthest, right = start.delta, math.pi / 2
    slowest = w.pace(math.pi - w.c.field_of_view / 2 - w.c.exclusion_buffer)
    over = max(w.fastest * long, 1.0)  # the largest b

    def overshot(first: Tensor, last: Tensor) -> Tensor:
        """Returns the largest |1 - b| first + b last for any b that is reached."""
        return maximum([first, last, (over - 1.0) * first + over * last])

    for i in range(steps):
        z, rolling = errors[i], rolls[i]
        # The smallest delta in the hold. Near the Sun the law's rate changes its direction, then its size, and then the
        # body rolls.
        nearest_to = least[i] - ROOT2 * long * limit
        roll = torch.where(nearest_to > BEGINS + w.angle, 0.0, nearest_to.new_tensor(w.roll))
        calls = round(w.lag / w.period)
        first = max(i - calls - w.hold_periods + 1, 0 if i >= calls else -1) if calls else i - 1
        ago = slice(first + 1, i + 1) if calls else slice(0, 1)
        (e, angle), (e_d, angle_d) = (
            w.measured(maximum(sent[ago]), maximum(unknown[ago]))
            for sent, unknown in zip(commands, unknowns, strict=True)
        )
        if i < calls - 1:  # measured before the hold after which the trajectory begins
            late, late_angle = start.late[0] + w.unknown * ROOT2 * start.late[1], start.late[1]
            e, angle, e_d, angle_d = e + late, angle + late_angle, e_d + late, angle_d + late_angle
        e = e + w.kappa * torch.maximum(angle, angle_d) * ROOT3
        high = overshot(z, e)
        fast = overshot(rolling, roll + e_d) + e_d + most * long
        at_most = norm(high)

        def changes(
            turned_by: Tensor | float,
            slowing: Tensor | float,
            fast: Tensor = fast,
            at_most: Tensor = at_most,
        ) -> Tensor:
            """Returns F of an axis in rad/s^2, where z adds a share to its own change."""
            share = w.spin[1] * fast + w.unknown + turned_by
            change = w.spin[1] * fast * w.rate + w.unknown * (fast + w.rate + w.unknown)
            change = change + w.rate * fast + slowing + share * at_most
            return change / (1.0 - ROOT2 * long * share).clamp(min=1e-3)

        steep = w.rate * w.steepest
        change = changes(max(w.kappa, steep), w.kappa * w.rate)
        rises = long * (at_most + ROOT2 * long * change / 2 - slowest)
        opposite_to = farthest + rises.clamp(min=0.0)
        # near the Sun or opposite to it the law's rate changes its size, too
        is_steady = (nearest_to > slower) & (opposite_to < math.pi - slower)
        turned_by = torch.where(is_steady, steep, nearest_to.new_tensor(max(w.kappa, steep)))
        change = changes(turned_by, torch.where(is_steady, 0.0, nearest_to.new_tensor(w.kappa * w.rate)))
        turned = w.rate + at_most + ROOT2 * long * change
        along = w.spin[0] * turned**2 / 2 + w.unknown * (fast + turned + w.unknown)
        commands[0].append((high.amax(0) + e) / w.tau + w.look.gyroscopic)
        commands[1].append((rolling + roll + e_d) / w.tau + w.look.gyroscopic)
        unknowns[0].append(w.spin[1] * fast * turned + w.unknown * (fast + turned + w.unknown))
        unknowns[1].append(along)
        for j in range(1, w.hold_periods + 1):
            t = j * w.period
            less, more = w.slowest * t, w.fastest * t
            ends = [abs(1.0 - b) * z + b * e + change * t for b in (less, more)]
            turns = [abs(1.0 - b) * rolling + b * (roll + e_d) + along * t for b in (less, more)]
            errors[i + j] = torch.maximum(errors[i + j], torch.maximum(*ends))
            rolls[i + j] = torch.maximum(rolls[i + j], torch.maximum(*turns))
        sums.append(norm(torch.maximum(z, errors[i + 1])))
        least.append(least[i] - (w.rate + sums[i]) * w.period)
        opposite = (farthest + sums[i] * w.period).clamp(min=right, max=math.pi)
        paces.append((w.kappa * opposite.sin()).clamp(max=w.rate))
        farthest = (farthest + (sums[i] - paces[i]) * w.period).clamp(min=right)
    return Followed(sums, paces, least, farthest, maximum(errors[steps : steps + w.hold_periods]).amax(0))


def beginning(x: Tensor, off: Spread, w: AttitudeConstants) -> Start:
    """Returns the start of the backup trajectory from states (16, B)."""
    d = vector(w.c.solar_panel_axis, x)
    s, _ = sun_and_earth_in_body(x)
    delta = dot(d, s).clamp(-1.0, 1.0).arccos()
    further = off.rate + (w.kappa + w.unknown) * off.angle
    z = (wanted(x, w) - x[OMEGA])[1:].abs() + further  # d is along the first axis
    rolling = (
        (x[OMEGA.start] + w.unknown * rotation_matrix(x[Q])[2, 0]).abs() + off.rate + w.unknown * off.angle
    )
    hot, energy = x[T] + off.temperature, x[E] - off.energy
    return Start(delta + off.angle, z, rolling, off.command, off.late, hot, delta - off.angle, energy)


def trajectory_margin(start: Start, w: AttitudeConstants) -> Tensor:
    """Returns a lower bound of the attitude's limits on the backup trajectory from its start: (B,)."""
    c, t, delta = w.c, w.period, start.delta
    sums, paces, least, opposite, last = followed(start, w)
    gone, farthest = torch.zeros_like(delta), torch.zeros_like(delta)
    late, late_near = torch.zeros_like(delta), torch.zeros_like(delta)
    returns = torch.zeros_like(delta, dtype=torch.bool)
    turned = w.lowest_at(w.slow)
    for each, pace, at_least in zip(sums, paces, least[1:], strict=True):
        gone = gone + (each - pace) * t
        farthest = torch.maximum(farthest, gone)
        late = late + (each - (pace - w.slow)).clamp(min=0.0) * t
        late_near = late_near + (each - (pace - w.slow_near)).clamp(min=0.0) * t
        returns = returns | ((each > w.rate) & (at_least < turned))
    tail = 2.0 * ROOT2 / w.slowest
    more, more_near = (tail * (last - each.across).clamp(min=0.0) for each in (w.turning, w.near))
    slower = math.asin(w.rate / w.kappa)
    farthest = torch.maximum(farthest, gone + more_near)
    # while the panels have not reached the rate W yet
    still = (opposite + more - (math.pi - slower)).clamp(min=0.0) / w.slow_far
    late = late + more + still * max(w.slow - w.slow_far, 0.0)
    late_near = late_near + more_near + still * max(w.slow_near - w.slow_far, 0.0)
    returns = returns | (ROOT2 * last > w.rate)
    begin = torch.where(returns, delta.clamp(min=slower) + late_near, delta.clamp(min=BEGINS) + late)
    slow = torch.where(returns, w.slow_near, delta.new_tensor(w.slow))
    exclusion = math.pi - delta - farthest - c.field_of_view / 2 - c.exclusion_buffer

    draw, right = c.power_draw / 1000.0, math.pi / 2
    charging = w.look.charging
    lowest_at = torch.where(returns, w.lowest_at(w.slow_near), delta.new_tensor(turned))

    first = torch.maximum(begin, lowest_at)
    light = first.clamp(max=right).sin() - lowest_at.clamp(max=right).sin()
    spent = (draw * (first - lowest_at) - charging * light.clamp(min=0.0)) / slow  # kJ
    battery = start.energy - c.min_energy - spent - c.energy_sun_slope * torch.minimum(begin, lowest_at)

    hot, begin = start.hot, begin.clamp(min=slower)
    light = (begin - right).clamp(min=0.0) + (math.cos(slower) - begin.clamp(max=right).cos()).clamp(min=0.0)
    none = torch.zeros_like(hot)
    sun, earth, _ = heating(c)
    net = (temperature_rate(none, none, hot, c) + earth).clamp(min=0.0)
    gain = sun * (light / slow + w.lit) + net * ((begin - slower) / slow + w.facing) + earth * w.rolling
    warm = c.temperature_sun_slope * w.dim + c.temperature_earth_slope * right
    temperature = c.max_temperature - hot.clamp(min=w.warmest) - gain - warm
    return lowest(torch.stack((exclusion, temperature, battery)))


def hold_bounds(x: Tensor, u: Tensor, error_bound: Tensor, w: AttitudeConstants) -> tuple[Tensor, Start]:
    """Returns bounds of a hold of controls (6, B), of any length, at predicted states (16, B).

    Where a state is more calls old than the hold is long, controls from before the hold acted since the measurement.
    The errors of rate and attitude from these controls are already in the prediction's `error_bound`.

    Args:
        error_bound: (4, B) how far the states are off beyond their measurement, see `rta.robust.prediction`.

    Returns:
        The least of the attitude's limits (B,), and the start of the backup trajectory at the next call, whenever that
            is.
    """
    c, looks = w.c, math.ceil(w.period / LOOK)
    t = w.period / looks
    angle, rate = off(error_bound, w)
    command = (u[TORQUE].abs() / x.new_tensor(c.inertia)[:, None]).amax(0)
    faster = w.share * command + w.worst
    before = torch.stack((error_bound[3], error_bound[2] + w.lag * error_bound[3]))
    slopes = c.temperature_sun_slope + c.temperature_earth_slope
    parts, ends, y = [room(x, angle, rate, w)], [], x
    for i in range(1, w.hold_periods * looks + 1):
        z, seconds = step(y, u, t, w.look.c), i * t
        least = attitude_between(y, z, u, t, w.look)
        later = rate + faster * seconds
        wider = angle + ROOT3 * (rate * seconds + faster * seconds**2 / 2)
        light_error = wider * (w.lag + seconds)
        parts += [
            least[0] - wider,
            least[1] - slopes * wider - w.look.heating * light_error,
            least[2] - c.energy_sun_slope * wider - w.look.charging * light_error,
            room(z, wider, later, w) - w.look.gyroscopic * t / 2,
        ]
        if i % looks == 0:
            late = before if seconds < w.lag - t / 2 else torch.zeros_like(before)
            heat, charge = (rate_of * light_error for rate_of in (w.look.heating, w.look.charging))
            spread = Spread(wider, later, heat, charge, command, late)
            ends.append(beginning(z, spread, w))
        y = z
    return lowest(torch.stack(parts)), Start.any_of(ends)


def off(error_bound: Tensor, w: AttitudeConstants) -> tuple[Tensor, Tensor]:
    """Returns error bounds of an attitude in rad and of a rate of each axis in rad/s, (B,) each; see `hold_bounds`."""
    angle = math.sqrt(3.0) * w.attitude + error_bound[2]
    return angle, w.noise + error_bound[3] + w.unknown * angle


def room(x: Tensor, angle: Tensor, rate: Tensor, w: AttitudeConstants) -> Tensor:
    """Returns a lower bound in rad/s of the room between rates of states (16, B), with their errors, and limits."""
    omega = x[OMEGA].abs().amax(0)
    if w.offset:
        gyro = (x[OMEGA] + w.offset * rotation_matrix(x[Q])[2]).abs().amax(0)
        omega = gyro + w.offset * angle
    return w.c.max_rate - omega - rate


def within(x: Tensor, angle: Tensor, rate: Tensor, light_error: Tensor, w: AttitudeConstants) -> list[Tensor]:
    """Returns upper bounds of exclusion, temperature, battery and rates of states (16, B).

    The states may be off by `angle` rad and `rate` rad/s. Heat and charge may be off by the effect of light that is
    wrong by `light_error` rad s.
    """
    c = w.c
    sun, earth = sun_and_earth_in_body(x)
    lit, facing = ((math.pi / 2 - incidence(c.thermal_axis, r)).clamp(min=0.0) for r in (sun, earth))
    warm = c.temperature_sun_slope * lit + c.temperature_earth_slope * facing
    slopes = c.temperature_sun_slope + c.temperature_earth_slope
    return [
        incidence("+x", sun) - c.field_of_view / 2 - c.exclusion_buffer + angle,
        c.max_temperature - x[T] - warm + slopes * angle + w.look.heating * light_error,
        x[E]
        - c.min_energy
        - c.energy_sun_slope * (incidence(c.solar_panel_axis, sun) - angle)
        + w.look.charging * light_error,
        room(x, -angle, -rate, w),
    ]


def may_be_kept(x: Tensor, error_bound: Tensor, w: AttitudeConstants) -> Tensor:
    """Returns (B,), not negative where all limits of attitude may hold; states (16, B) are off as in `hold_bounds`."""
    angle, rate = off(error_bound, w)
    return lowest(torch.stack(within(x, angle, rate, angle * w.lag, w)))


def has_backup_trajectory(x: Tensor, w: AttitudeConstants) -> Tensor:
    """Checks whether the law satisfies the attitude's limits from true states (16, B), whatever is measured, (B,)."""
    none, late = torch.zeros_like(x[0]), torch.zeros_like(x[:2])
    # a plant's rate may be relative to the stars
    spread = Spread(none, none + w.offset, none, none, none, late)
    return trajectory_margin(beginning(x, spread, w), w) >= 0.0

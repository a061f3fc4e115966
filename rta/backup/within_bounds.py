"""The way to rest of torque where the world differs from the model within bounds that are told.

The law is that of `rta.backup.slew` in a form that errors do not lead astray: Lipschitz in the attitude, with one place
of rest, slow enough to be followed. With d the panels' axis, s the direction to the Sun and w the body's rate relative
to the Sun it asks for

    w* = kappa proj(d x s) + roll d,    torque = J (w* - w) / tau less the gyroscopic one,    tau = G times the hold,

proj shortening what is longer than W / kappa, G the largest gain. At rest the panels face the Sun and the cooled axis e
is along Hill's z. In a hold the error z = w - w* shrinks by the share g t / tau, between 0 and 1 whenever the hold
ends, so a missed call does not overshoot. What is left is bounded per axis, call by call (`followed`); its sums are all
that the limits' bounds need (`way`). Derivation, and what is not proven: docs/reference/proof.md.
"""

import math
from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from inspection.model.attitude import dot, norm, rotation_matrix
from inspection.model.dynamics import energy_rate, euler, step, sun_and_earth_in_body, temperature_rate
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, SIZE, TORQUE, E, Q, T
from rta.backup import slew
from rta.backup.check import nearest
from rta.backup.chords import lowest
from rta.backup.slew import Slewing, across, incidence, upright, vector
from rta.bounds.uncertainty import Uncertainty
from rta.parameters import RtaParameters
from rta.qp.programs import pick, put

POINTING, ROLLING = 0.12, 0.08  # kappa, of pointing and of rolling, as shares of the slowest rate of settling, g / tau
ROLL = 0.6  # of W
SATURATED = 0.9  # rad, from which on the panels turn at W: before the battery is at its lowest
BEGINS, FULL = 0.4, 0.25  # rad from the Sun, at which the roll begins, and at which it is full
LOOKAHEAD = 4.0  # times tau / g, of `followed`
ROOT2 = math.sqrt(2.0)
TURNS = 80  # of a fixed point's iteration


class NoRestError(ValueError):
    """Within these bounds no attitude of rest is known."""


@dataclass(frozen=True)
class Level:
    """What errors leave in the long run: rates in rad/s, per axis.

    Attributes:
        across, along: of z across d and about it; rolling: of the rate about d.
    """

    across: float
    along: float
    rolling: float


@dataclass(frozen=True)
class Turning:
    """What the law and its check depend on.

    Attributes:
        look: of a hold, as the model has it, in steps of a period.
        period, lag: s, between calls, and of a state's age; holds: periods that a control may be held.
        tau: s; slowest, fastest: 1/s, g / tau and G / tau; share: of a command, that an acceleration is off by.
        rate, roll: rad/s at most; kappa, kappa_roll: 1/s.
        spin: of gyroscopic accelerations about d and across it, in rad/s^2 per (rad/s)^2.
        attitude, noise: rad and rad/s, of each axis as it is measured; offset: rad/s, of the frame of a first rate.
        steepest: cot(delta) at most, while the panels turn.
        turning, near: levels far from the Sun, and where the panels slow down.
        slow, slow_near: rad/s, by which delta falls at least.
        settling, rolling: deg C, that the surface gains at most in the two last parts.
        warmest: deg C, that it comes to at rest.
    """

    c: Limits
    look: Slewing
    period: float
    lag: float
    holds: int
    tau: float
    slowest: float
    fastest: float
    share: float
    rate: float
    roll: float
    kappa: float
    kappa_roll: float
    spin: tuple[float, float]
    attitude: float
    noise: float
    unknown: float
    offset: float
    steepest: float
    turning: Level
    near: Level
    slow: float
    slow_near: float
    settling: tuple[float, float, float]
    warmest: float
    worst: float

    @classmethod
    def of(cls, c: Limits, r: RtaParameters, known: Uncertainty) -> "Turning":
        """Raises NoRestError where no attitude of rest is known within the bounds."""
        period, lag = r.period, known.latency * r.period
        holds = math.ceil(known.hold(r) / period - 1e-9)
        least, most = known.torque
        n = c.fastest_orbit_rate
        strongest = c.max_torque / max(c.inertia) - max(abs(each) for each in euler((c.max_rate,) * 3, c.inertia))
        if strongest <= 0.0:
            raise NoRestError("the gyroscopic torque")
        tau = max(most * holds * period, 1.9 * (c.max_rate + n) / strongest)
        spin = spins(c, known, most)
        w = cls(
            c, Slewing.of(replace(c, saturate_rates=False), holds * period, holds), period, lag, holds, tau,
            least / tau, most / tau, known.torque_error, 0.0, 0.0, POINTING * least / tau, ROLLING * least / tau,
            spin, math.radians(known.attitude), math.radians(known.rate), n, known.unknown_turning(c),
            1.0 / math.tan(c.field_of_view / 2 + c.exclusion_buffer),
            Level(0, 0, 0), Level(0, 0, 0), 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, max(spin) * c.max_rate**2 + n * math.sqrt(3.0) * c.max_rate,
        )  # fmt: skip
        at_first = c.max_torque / min(c.inertia)
        rate = c.max_rate - n - w.measured(at_first, w.worst)[0] - w.worst / w.slowest
        rate = min(rate, math.sin(SATURATED) * w.kappa)
        if rate <= 0.0:
            raise NoRestError("the body rates")
        w = replace(w, rate=rate, roll=min(ROLL * rate, 2 * w.kappa_roll))
        turning, near = w.level(None, 0.0), w.level(rate / w.kappa, 0.0)
        slow, slow_near = (rate - ROOT2 * level.across for level in (turning, near))
        if slow_near <= 0.0:
            raise NoRestError("the turn to the Sun")
        w = replace(w, turning=turning, near=near, slow=slow, slow_near=slow_near)
        return w.settled()

    def measured(self, command: float, unknown: float) -> tuple[float, float]:
        """rad/s and rad, of each axis, by which a rate and an attitude are off when a call answers.

        Args:
            command: rad/s^2, at most, of what was sent since; unknown: rad/s^2, that the model does not know of.
        """
        off = self.share * command + unknown
        angle = self.attitude + self.lag * self.noise + off * self.lag**2 / 2
        return self.noise + self.unknown * ROOT2 * angle + self.lag * off, angle

    def level(self, u: float | None, roll: float, tilt: float = 0.0, by_axis: bool = False) -> Level:
        """Where |z| settles.

        Args:
            u: sin(delta) at most, or its part along each axis `by_axis`; None: the panels turn at W.
            roll: rad/s, that the law rolls at most; tilt: tan(delta / 2) at most.
        """
        z = z_d = e = e_d = 1e-4
        for _ in range(TURNS):
            rolling = roll + z_d
            wanted = self.rate if u is None else min(self.kappa * u, self.rate)
            turned = ROOT2 * (wanted + z) if by_axis else wanted + ROOT2 * z
            unknown = self.unknown * (math.hypot(rolling, turned) + self.unknown)
            across, along = self.spin[1] * rolling * turned + unknown, self.spin[0] * turned**2 / 2 + unknown
            rate, angle = self.measured((z + e) / self.tau, across)
            rate_d, angle_d = self.measured((z_d + e_d) / self.tau, along)
            if u is None:
                e = rate + self.kappa * ROOT2 * max(angle, angle_d)
                moved = self.rate * (rolling + self.steepest * ROOT2 * z)
            else:
                e = rate + self.kappa * (angle + min(u, 1.0) * ROOT2 * angle_d)
                moved = self.kappa * (wanted + (z if by_axis else ROOT2 * z) + u * rolling)
            e_d, moved_d = rate_d, 0.0
            if roll > 0.0:
                e_d += self.kappa_roll * (angle_d + tilt * ROOT2 * angle)
                moved_d = self.kappa_roll * (rolling + tilt * turned)
            z, z_d = e + (across + moved) / self.slowest, e_d + (along + moved_d) / self.slowest
            if max(z, z_d) > self.c.max_rate:
                raise NoRestError("what errors leave of the rates")
        return Level(z, z_d, roll + z_d)

    def settled(self) -> "Turning":
        """With what the surface gains on the last part of the way, and comes to at rest."""
        c = self.c
        to_roll = lambda u: self.level(u, self.roll, math.tan(math.asin(u) / 2))  # noqa: E731
        u = math.sin(BEGINS)
        for _ in range(60):
            level = to_roll(u)
            u = min(u, ROOT2 * level.across / (self.kappa * math.sqrt(1.0 - u**2)))
        rolling, level = u, to_roll(1.05 * u)
        free = self.roll - level.along - math.tan(rolling / 2) * (self.kappa * rolling + ROOT2 * level.across)
        if math.asin(rolling) > FULL - 2 * self.measured(0.01, 0.001)[1]:
            raise NoRestError("the roll")
        roll, tilt = self.roll, 0.0
        for by_axis in (False, True):
            for _ in range(100):
                tilt = math.tan(math.asin(min(ROOT2 * u, 0.9)) / 2)
                level = self.level(u, roll, tilt, by_axis)
                turned = ROOT2 * (self.kappa * u + level.across)
                aside = (level.along + tilt * turned) / self.kappa_roll
                if aside >= 1.0:
                    raise NoRestError("the roll")
                roll = min(roll, self.kappa_roll * aside)
                if not by_axis:
                    u = min(u, ROOT2 * level.across / (self.kappa * math.sqrt(1.0 - u**2)))
                elif (pull := self.kappa * math.sqrt(1.0 - 2 * u**2) - level.rolling) > 0.0:
                    u = min(u, level.across / pull)
        one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        hot = torch.full_like(one, c.max_temperature)
        dark = temperature_rate(none, none, hot, c).item()
        sun, earth = (temperature_rate(*lit, hot, c).item() - dark for lit in ((one, none), (none, one)))
        light = sun * u + earth * math.hypot(u, aside)
        warmest = -c.zero_celsius + (c.max_temperature + c.zero_celsius) * (light / -dark) ** 0.25
        # light while delta falls from where the panels slow down
        first, steps, shone, seconds = self.rate / self.kappa, 100, 0.0, 0.0
        for i in range(steps):
            high, low = (first + (1.05 * rolling - first) * j / steps for j in (i, i + 1))
            level = self.level(high, 0.0)
            pull = math.sqrt(1.0 - high**2) * (self.kappa * low - ROOT2 * level.across)
            if pull <= 0.0:
                raise NoRestError("the last part of the turn")
            shone, seconds = shone + high * (high - low) / pull, seconds + (high - low) / pull
        if free <= 0.0:
            raise NoRestError("the roll")
        slowing = math.asin(min(self.roll / self.kappa_roll, 1.0))
        rolled, slowly = (math.pi - 2 * slowing) / free, 2 * slowing / self.kappa_roll
        lit = shone + rolling * (rolled + slowly)
        self = replace(self, settling=(lit, seconds + rolled, slowly))
        if energy_rate(one * math.cos(rolling), c).item() <= 0.0:
            raise NoRestError("the battery at rest")
        return replace(self, warmest=warmest)


@dataclass(frozen=True)
class Spread:
    """How far true states may be from others (16, ...) at a call.

    Attributes:
        angle: (...) rad, in any direction; rate: (...) rad/s, of each axis.
        temperature, energy: (...) deg C, kJ.
        command: (...) rad/s^2, of each axis, of what acted since the state was measured that is answered at the call.
    """

    angle: Tensor
    rate: Tensor
    temperature: Tensor
    energy: Tensor
    command: Tensor


def wanted(x: Tensor, w: Turning) -> Tensor:
    """The law: omega (3, ...) in rad/s, relative to Hill's frame, for states (16, ...)."""
    d, e = vector(w.c.solar_panel_axis, x), vector(w.c.thermal_axis, x)
    s, _ = sun_and_earth_in_body(x)
    axis, cosine = across(d, s), dot(d, s)
    begins, full = math.cos(BEGINS), math.cos(FULL)
    off = (w.kappa_roll * dot(d, across(e, upright(x, d, s)))).clamp(-w.roll, w.roll)
    roll = off * ((cosine - begins) / (full - begins)).clamp(0.0, 1.0)
    pointing = (w.rate / norm(axis).clamp(min=1e-12)).clamp(max=w.kappa)
    return pointing * axis + roll * d - w.c.mean_motion * rotation_matrix(x[Q])[2]


def turn(x: Tensor, w: Turning) -> Tensor:
    """The law as torque (3, B) in N m at states (16, B), as they are measured."""
    inertia = x.new_tensor(w.c.inertia)[:, None]
    faster = (wanted(x, w) - x[OMEGA]) / w.tau - torch.stack(euler(x[OMEGA], w.c.inertia))
    return (inertia * faster).clamp(-w.c.max_torque, w.c.max_torque)


def followed(z: Tensor, rolling: Tensor, command: Tensor, far: Tensor, w: Turning) -> tuple[list[Tensor], Tensor]:
    """Bounds of the error of the law's rates, call by call, whichever calls are missed.

    In a hold from a call at which they are z and rolling, |z_i(t)| <= (1 - b) |z_i| + b e + F t with b between g t / tau
    and G t / tau: e is what is measured amiss, F what the model does not know and how the law's rates change.

    Args:
        z: (2, ...) rad/s at most, at the call, of the axes across d; rolling: (...) the rate about d.
        command: (...) rad/s^2, as of `Spread`.

    Returns:
        For each period from the call on, |z| (...) at most; at the end, that of an axis.
    """
    steps = math.ceil(LOOKAHEAD / (w.slowest * w.period))
    limit, long = w.c.max_rate + w.unknown, w.holds * w.period
    none = torch.full_like(rolling, -math.inf)
    errors, rolls = [z, *[torch.stack((none, none))] * (steps + w.holds)], [rolling, *[none] * (steps + w.holds)]
    most = max(w.spin) * limit**2 + w.unknown * math.sqrt(3.0) * limit
    commands, unknowns = [command], [torch.full_like(rolling, most)]
    sums = []
    turned_by = torch.where(far, w.rate * w.steepest, w.kappa)
    slowing, roll = torch.where(far, 0.0, w.kappa * w.rate), torch.where(far, 0.0, w.roll)
    for i in range(steps):
        z, rolling = errors[i], rolls[i]
        calls = round(w.lag / w.period)
        first = max(i - calls - w.holds + 1, 0 if i >= calls else -1) if calls else i - 1
        sent = maximum(commands[first + 1 : i + 1] or commands[-1:])
        off = w.share * sent + maximum(unknowns[first + 1 : i + 1] or unknowns[-1:])
        angle = w.attitude + w.lag * w.noise + off * (w.lag**2 / 2)
        measured = w.noise + w.unknown * ROOT2 * angle + w.lag * off
        e, e_d = measured + w.kappa * ROOT2 * angle, measured
        high = torch.maximum(z, e)
        fast = torch.maximum(rolling, roll + e_d) + most * long
        at_most = norm(high)
        share = w.spin[1] * fast + w.unknown + turned_by  # of what z adds to its own change
        change = w.spin[1] * fast * w.rate + w.unknown * (fast + w.rate + w.unknown)
        change = change + w.rate * fast + slowing + share * at_most
        change = change / (1.0 - ROOT2 * long * share).clamp(min=1e-3)
        turned = w.rate + at_most + ROOT2 * long * change
        along = w.spin[0] * turned**2 / 2 + w.unknown * (fast + turned + w.unknown)
        commands.append(torch.maximum(high.amax(0) + e, rolling + roll + e_d) / w.tau)
        unknowns.append(torch.maximum(along, w.spin[1] * fast * turned + w.unknown * (fast + turned + w.unknown)))
        for j in range(1, w.holds + 1):
            t = j * w.period
            less, more = w.slowest * t, min(w.fastest * t, 1.0)
            ends = [(1.0 - b) * z + b * e + change * t for b in (less, more)]
            turns = [(1.0 - b) * rolling + b * (roll + e_d) + along * t for b in (less, more)]
            errors[i + j] = torch.maximum(errors[i + j], torch.maximum(*ends))
            rolls[i + j] = torch.maximum(rolls[i + j], torch.maximum(*turns))
        sums.append(norm(torch.maximum(z, errors[i + 1])))
    return sums, maximum(errors[steps : steps + w.holds]).amax(0)


def maximum(parts: list[Tensor]) -> Tensor:
    """The largest of several tensors, element by element."""
    most, *others = parts
    for part in others:
        most = torch.maximum(most, part)
    return most


def way(x: Tensor, off: Spread, w: Turning) -> Tensor:
    """A lower bound of the least of the attitude's limits on the way to rest from states (16, B), at a call: (B,)."""
    return from_here(*beginning(x, off, w), off.command, off.angle, w)


def beginning(x: Tensor, off: Spread, w: Turning) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What the way depends on: delta, |z| (2, B) and the rate about d at most, T at most, E at least."""
    d = vector(w.c.solar_panel_axis, x)
    s, _ = sun_and_earth_in_body(x)
    delta = dot(d, s).clamp(-1.0, 1.0).arccos() + off.angle
    further = off.rate + (w.kappa + w.unknown) * off.angle
    z = (wanted(x, w) - x[OMEGA])[1:].abs() + further
    rolling = (x[OMEGA.start] + w.unknown * rotation_matrix(x[Q])[2, 0]).abs() + off.rate + w.unknown * off.angle
    return delta, z, rolling, x[T] + off.temperature, x[E] - off.energy


def from_here(
    delta: Tensor, z: Tensor, rolling: Tensor, hot: Tensor, energy: Tensor, command: Tensor, off_angle: Tensor, w: Turning
) -> Tensor:
    """`way` from what it depends on."""
    c, t = w.c, w.period
    far = delta > math.pi / 2
    sums, last = followed(z, rolling, command, far, w)
    gone, farthest = torch.zeros_like(delta), torch.zeros_like(delta)
    late, late_near = torch.zeros_like(delta), torch.zeros_like(delta)
    least, returns = delta - 2.0 * off_angle, torch.zeros_like(far)
    turned = math.acos((c.power_draw / 1000.0 - c.energy_sun_slope * w.slow) / w.look.charging)
    for each in sums:
        gone = gone + (each - w.rate) * t
        farthest = torch.maximum(farthest, gone)
        late = late + (each - (w.rate - w.slow)).clamp(min=0.0) * t
        late_near = late_near + (each - (w.rate - w.slow_near)).clamp(min=0.0) * t
        least = least - (each + w.rate) * t
        returns = returns | ((each > w.rate) & (least < turned))
    tail = 2.0 * ROOT2 / w.slowest
    late = late + tail * (last - w.turning.across).clamp(min=0.0)
    late_near = late_near + tail * (last - w.near.across).clamp(min=0.0)
    returns = returns | (ROOT2 * last > w.rate)
    slower = math.asin(w.rate / w.kappa)
    start = torch.where(returns, delta.clamp(min=slower) + late_near, delta + late)
    slow = torch.where(returns, w.slow_near, w.slow)
    exclusion = math.pi - delta - farthest - c.field_of_view / 2 - c.exclusion_buffer

    draw, right = c.power_draw / 1000.0, math.pi / 2
    charging = w.look.charging
    lowest_at = ((draw - c.energy_sun_slope * slow) / charging).arccos()

    def spent(first: Tensor, end: Tensor) -> Tensor:
        """kJ while delta falls from a first to a last angle."""
        first = torch.maximum(first, end)
        light = first.clamp(max=right).sin() - end.clamp(max=right).sin()
        return (draw * (first - end) - charging * light.clamp(min=0.0)) / slow

    battery = energy - c.min_energy - spent(start, lowest_at) - c.energy_sun_slope * torch.minimum(start, lowest_at)

    begin = start.clamp(min=slower)
    light = (begin - right).clamp(min=0.0) + (math.cos(slower) - begin.clamp(max=right).cos()).clamp(min=0.0)
    one, none = torch.ones_like(hot), torch.zeros_like(hot)
    dark = temperature_rate(none, none, hot, c)
    sun, earth = (temperature_rate(*lit, hot, c) - dark for lit in ((one, none), (none, one)))
    lit, seconds, slowly = w.settling
    net = (earth + dark).clamp(min=0.0)
    gain = sun * (light / slow + lit) + net * ((begin - slower) / slow + seconds) + earth * slowly
    warm = (c.temperature_sun_slope + c.temperature_earth_slope) * right
    temperature = c.max_temperature - hot.clamp(min=w.warmest) - gain - warm
    return lowest(torch.stack((exclusion, temperature, battery)))


def held(x: Tensor, u: Tensor, error_bound: Tensor, w: Turning) -> tuple[Tensor, tuple[Tensor, ...], Tensor]:
    """A hold of controls (6, B), however long, at states (16, B) as they are predicted.

    Args:
        error_bound: (4, B) by how far the states are off beyond their measurement, see `Condition.propose`.

    Returns:
        The least of the attitude's limits (B,); what the way depends on at the next call, whenever it comes, as of
        `beginning`; and by how far a state may be off in angle then (B,).
    """
    c, t = w.c, w.period
    angle, rate = off(error_bound, w)
    inertia = x.new_tensor(c.inertia)[:, None]
    command = (u[TORQUE].abs() / inertia).amax(0)
    faster = w.share * command + w.worst
    limits = within(x, angle, rate, angle * w.lag, w)
    parts, ends, y, at = [limits[-1]], [], x, (angle, rate)
    for i in range(1, w.holds + 1):
        z = step(y, u, t, w.look.c)
        least = slew.between(y, z, t, w.look)
        seconds = i * t
        later = rate + faster * seconds
        wider = angle + math.sqrt(3.0) * (rate * seconds + faster * seconds**2 / 2)
        astray = wider * (w.lag + seconds)
        slopes = c.temperature_sun_slope + c.temperature_earth_slope
        parts += [
            least[0] - wider,
            least[1] - slopes * wider - w.look.heating * astray,
            least[2] - c.energy_sun_slope * wider - w.look.charging * astray,
            room(z, wider, later, w) - w.look.gyroscopic * t / 8,
        ]
        spread = Spread(wider, later, w.look.heating * astray, w.look.charging * astray, command)
        ends.append(beginning(z, spread, w))
        y, at = z, (wider, later)
    delta, z, rolling, hot, energy = zip(*ends, strict=True)
    last = tuple(maximum(list(each)) for each in (delta, z, rolling, hot))
    return lowest(torch.stack(parts)), (*last, -maximum([-each for each in energy])), at[0]


def off(error_bound: Tensor, w: Turning) -> tuple[Tensor, Tensor]:
    """By how far an attitude is off, in rad, and a rate of each axis, in rad/s: (B,) each; as `held`."""
    angle = math.sqrt(3.0) * w.attitude + error_bound[2]
    return angle, w.noise + error_bound[3] + w.unknown * angle


def room(x: Tensor, angle: Tensor, rate: Tensor, w: Turning) -> Tensor:
    """rad/s, that rates of states (16, B) are within their limits at least, off by so much."""
    omega = x[OMEGA].abs().amax(0)
    if w.offset:
        gyro = (x[OMEGA] + w.offset * rotation_matrix(x[Q])[2]).abs().amax(0)
        omega = gyro + w.offset * angle
    return w.c.max_rate - omega - rate


def within(x: Tensor, angle: Tensor, rate: Tensor, astray: Tensor, w: Turning) -> list[Tensor]:
    """By how much exclusion, temperature, battery and rates of states (16, B) are kept at most, and the last at least.

    Each where the states may be off by so many rad and rad/s, and heat and charge by what light that is off does in
    `astray` rad s.
    """
    c = w.c
    sun, earth = sun_and_earth_in_body(x)
    lit, facing = ((math.pi / 2 - incidence(c.thermal_axis, r)).clamp(min=0.0) for r in (sun, earth))
    warm = c.temperature_sun_slope * lit + c.temperature_earth_slope * facing
    slopes = c.temperature_sun_slope + c.temperature_earth_slope
    return [
        incidence("+x", sun) - c.field_of_view / 2 - c.exclusion_buffer + angle,
        c.max_temperature - x[T] - warm + slopes * angle + w.look.heating * astray,
        x[E] - c.min_energy - c.energy_sun_slope * (incidence(c.solar_panel_axis, sun) - angle) + w.look.charging * astray,
        room(x, -angle, -rate, w),
        room(x, angle, rate, w),
    ]


def may_be_kept(x: Tensor, error_bound: Tensor, w: Turning) -> Tensor:
    """Not negative where each of the attitude's limits may be kept now, states (16, B) being off as of `held`: (B,)."""
    angle, rate = off(error_bound, w)
    return lowest(torch.stack(within(x, angle, rate, angle * w.lag, w)[:-1]))


def verified(x: Tensor, u: Tensor, error_bound: Tensor, w: Turning) -> Tensor:
    """A lower bound of the least of the limits in a hold of controls (6, B) and on the way after it, as `held`: (B,)."""
    least, at, angle = held(x, u, error_bound, w)
    command = (u[TORQUE].abs() / x.new_tensor(w.c.inertia)[:, None]).amax(0)
    return torch.minimum(least, from_here(*at, command, angle, w))


class TurnBackup:
    """The check of torque, of a filter that is told of bounds.

    Attributes:
        turning: the law and what its check depends on.
    """

    def __init__(self, turning: Turning) -> None:
        self.turning = turning

    @classmethod
    def of(cls, c: Limits, r: RtaParameters, known: Uncertainty) -> "TurnBackup | None":
        """None: no way is known within the bounds, with this vehicle, or where actuators may fail."""
        if not (c.is_circular and not c.hill_rotation and slew.has_rest(c)) or known.is_nil or known.health:
            return None
        try:
            return cls(Turning.of(c, r, known))
        except NoRestError:
            return None

    def has_way(self, x: Tensor) -> Tensor:
        """(B,) bool: from true states (16, B) whatever is measured the law keeps the attitude's limits."""
        w, none = self.turning, torch.zeros_like(x[0])
        # a plant's rate may be one relative to the stars
        return way(x, Spread(none, none + w.offset, none, none, none), w) >= 0.0

    def torque_is_safe(self, y: Tensor, u: Tensor) -> Tensor:
        """(B,) bool: torque of controls (6, B) keeps the limits and leaves a way; y (20, B): states, then error bounds."""
        return verified(y[:SIZE], u, y[SIZE:], self.turning) >= 0.0

    def committed(self, x: Tensor, u: Tensor, error_bound: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What is applied in the place of proposed controls (6, B) at predicted states (16, B).

        Returns:
            Controls (6, B); (B,) bool each: their torque is verified; it is another.
        """
        u, y = u.clone(), torch.cat((x, error_bound))
        checked = y.isfinite().all(0) & (may_be_kept(x, error_bound, self.turning) >= 0.0)
        kept = self.torque_is_safe(y, u) & checked
        changed = ~kept & checked
        columns = torch.nonzero(changed).flatten()
        if columns.numel():
            there, proposed = pick(y, columns), pick(u, columns)
            law = turn(there[:SIZE], self.turning)
            control, found = nearest(there, proposed, TORQUE, law, self.torque_is_safe)
            put(u, columns, control)
            put(kept, columns, found)
        return u, kept, changed


def spins(c: Limits, known: Uncertainty, most: float) -> tuple[float, float]:
    """Gyroscopic accelerations at most, about the first body axis and across it, with what the law takes for them."""

    def worst(i: int) -> float:
        j, k = (i + 1) % 3, (i + 2) % 3
        moments = c.inertia
        nominal = abs(moments[j] - moments[k]) / moments[i]
        corners = product((1 - known.inertia, 1 + known.inertia), repeat=3)
        true = max(abs(f[j] * moments[j] - f[k] * moments[k]) / (f[i] * moments[i]) for f in corners)
        return true + most * nominal

    return worst(0), max(worst(1), worst(2))

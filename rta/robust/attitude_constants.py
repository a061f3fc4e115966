"""Constants of the law of torque with error bounds, see `rta.robust.attitude_check`; derived once.

Errors and the remaining rates are per body axis. The panels' axis d is the first axis. "About d" means the first axis,
"across d" either of the others.
"""

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import torch

from inspection.model.dynamics import energy_rate, euler, temperature_rate
from inspection.model.parameters import Limits
from inspection.world.uncertainty import Uncertainty
from rta.check.commit import NoCheckError
from rta.check.flight import Flight

POINTING, ROLLING = 0.123, 0.098  # kappa of pointing and of rolling, as shares of g / tau
ROLL = 0.9  # the largest roll rate as a share of W
SATURATED = 0.84  # rad, above which the panels turn at W; the battery is lowest above it
BEGINS, FULL = 0.32, 0.2  # rad from the Sun at which the roll begins, and at which it is full
OVERSHOOT = 1.2  # largest G t / tau of a hold: an error may change its sign, and 20 % of it remains
TORQUE_LEFT = 1.745  # in max_rate: rates this far from the law's are corrected by torque within tau
LOOKAHEAD = 4.0  # duration of `followed`, in tau / g
ROOT2, ROOT3 = math.sqrt(2.0), math.sqrt(3.0)
TURNS, FALLS = 80, 100  # iterations of a fixed point; parts of the fall of delta


@dataclass(frozen=True)
class Level:
    """Holds the long-term effect of errors on the rates, in rad/s per axis.

    Attributes:
        across, along: of z across d and about d; rolling: of the rate about d.
    """

    across: float
    along: float
    rolling: float


@dataclass(frozen=True)
class AttitudeConstants:
    """Holds the constants of the law and of its check.

    Attributes:
        look: how a hold is tested, by the model, in steps of a period.
        period, lag: s, between calls, and a state's age; hold_periods: the longest hold of a control in periods.
        tau: s; slowest, fastest: 1/s, g / tau and G / tau; share: of a command, by which an acceleration is off.
        kappa, kappa_roll: 1/s; spin: gyroscopic accelerations about d and across d, in rad/s^2 per (rad/s)^2.
        attitude, noise: rad and rad/s, errors of the measurement; unknown: rad/s, of Hill's frame; offset: the same,
            where limits are for rates relative to the stars.
        steepest: the largest cot(delta) while the panels turn at `rate`.
        rate, roll: largest rad/s, W and R.
        turning, near: levels of errors where the panels turn at W, and where they slow down.
        slow, slow_near, slow_far: rad/s, the slowest fall of delta there, and where the panels face away from the Sun
            and have not reached W yet.
        angle: rad, the largest error of an attitude.
        lit, facing, rolling: s of full light by the Sun, of the Earth's light beside it, and of the Earth's alone while
            the body hardly rolls. They heat the surface as much as the trajectory does once the panels slow down.
        warmest: deg C, the temperature at rest.
    """

    c: Limits
    look: Flight
    period: float
    lag: float
    hold_periods: int
    tau: float
    slowest: float
    fastest: float
    share: float
    kappa: float
    kappa_roll: float
    spin: tuple[float, float]
    attitude: float
    noise: float
    unknown: float
    offset: float
    steepest: float
    rate: float = 0.0
    roll: float = 0.0
    turning: Level = Level(0.0, 0.0, 0.0)
    near: Level = Level(0.0, 0.0, 0.0)
    slow: float = 0.0
    slow_near: float = 0.0
    slow_far: float = 0.0
    angle: float = 0.0
    lit: float = 0.0
    facing: float = 0.0
    rolling: float = 0.0
    warmest: float = 0.0

    @classmethod
    def of(cls, c: Limits, period: float, uncertainty: Uncertainty) -> "AttitudeConstants":
        """Derives the constants; raises NoCheckError if no attitude of rest is known within the bounds."""
        lag = uncertainty.latency * period
        hold_periods = math.ceil(uncertainty.hold(period) / period - 1e-9)
        least, most = uncertainty.torque
        n = c.mean_motion
        strongest = c.max_torque / max(c.inertia) - max(
            abs(each) for each in euler((c.max_rate,) * 3, c.inertia)
        )
        if strongest <= 0.0:
            raise NoCheckError("the gyroscopic torque")
        tau = max(most * hold_periods * period / OVERSHOOT, TORQUE_LEFT * c.max_rate / strongest)
        slowest = least / tau
        w = cls(
            c, Flight.of(replace(c, saturate_rates=False), period, 0.0), period, lag, hold_periods, tau, slowest,
            most / tau, uncertainty.torque_error, POINTING * slowest, ROLLING * slowest, spins(c, uncertainty, most),
            math.radians(uncertainty.attitude), math.radians(uncertainty.rate), n, uncertainty.unknown_turning(c),
            1.0 / math.tan(SATURATED),
        )  # fmt: skip
        at_first = c.max_torque / min(c.inertia)
        rate_error, angle = w.measured(at_first, w.worst)
        excluded = c.field_of_view / 2 + c.exclusion_buffer
        over = max(w.fastest * hold_periods * period, 1.0)
        rates = (
            c.max_rate - w.worst / w.slowest,  # a body that turns at its limit slows down
            ((2.0 - over) * c.max_rate - w.worst * hold_periods * period)
            / over,  # the rate does not overshoot the opposite limit
            tau * strongest - c.max_rate,  # torque is never at its limit
        )
        rate = min(min(rates) - n - rate_error, math.sin(SATURATED) * w.kappa)
        if rate <= 0.0:
            raise NoCheckError("the body rates")
        w = replace(
            w,
            angle=ROOT3 * angle,
            rate=rate,
            roll=min(ROLL * rate, 2 * w.kappa_roll),
            steepest=1.0 / math.tan(min(math.asin(rate / w.kappa), excluded)),
        )
        turning, near = w.level(None, 0.0), w.level(rate / w.kappa, 0.0)
        slow, slow_near = (rate - ROOT2 * level.across for level in (turning, near))
        slow_far = w.pace(math.pi - excluded) - ROOT2 * near.across
        coupled = ROOT2 * (max(rate * w.steepest, w.kappa) + max(w.spin) * (w.roll + near.along) + n)
        coupled += w.slowest * w.share * w.lag / w.tau
        if min(slow_near, slow_far) <= 0.0 or coupled > w.slowest / 2 or w.lowest_at(slow) < SATURATED:
            raise NoCheckError("the turn to the Sun")
        w = replace(w, turning=turning, near=near, slow=slow, slow_near=slow_near, slow_far=slow_far)
        return w.settled()

    @property
    def worst(self) -> float:
        """Returns the largest acceleration in rad/s^2 of an axis unknown to the model, within the rates' limits."""
        return max(self.spin) * self.c.max_rate**2 + self.unknown * ROOT3 * self.c.max_rate

    @property
    def dim(self) -> float:
        """Returns the angle from the Sun in rad down to which the surface warms faster than its limit relaxes.

        The temperature's limit relaxes as less light falls on the surface.
        """
        sun, _, _ = heating(self.c)
        return max(math.asin(min(self.c.temperature_sun_slope * self.rate / sun, 1.0)), FULL)

    def pace(self, delta: float) -> float:
        """Returns the rate in rad/s at which the panels turn at the angle `delta` in rad from the Sun."""
        return min(self.kappa * math.sin(delta), self.rate)

    def measured(self, command: Any, unknown: Any) -> tuple[Any, Any]:
        """Returns the errors of a rate in rad/s and of an attitude in rad, of each axis, when a call answers.

        Args:
            command: largest rad/s^2 that was commanded since the measurement; unknown: rad/s^2, unknown to the model.
                Numbers or tensors.
        """
        off = self.share * command + unknown
        angle = self.attitude + self.lag * self.noise + off * self.lag**2 / 2
        return self.noise + self.unknown * ROOT2 * angle + self.lag * off, angle

    def level(self, u: float | None, roll: float, tilt: float = 0.0, by_axis: bool = False) -> Level:
        """Returns the level at which |z| settles.

        Args:
            u: the largest sin(delta), or its part along each axis if `by_axis`; None: the panels turn at W.
            roll: rad/s, the law's largest roll rate; tilt: the largest tan(delta / 2).
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
                e = rate + self.kappa * ROOT3 * max(angle, angle_d)
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
                raise NoCheckError("what errors leave of the rates")
        return Level(z, z_d, roll + z_d)

    def lowest_at(self, slow: float) -> float:
        """Returns the angle from the Sun in rad at which the battery is lowest while delta falls at `slow` rad/s."""
        c = self.c
        return math.acos(min((c.power_draw / 1000.0 - c.energy_sun_slope * slow) / self.look.charging, 1.0))

    def settled(self) -> "AttitudeConstants":
        """Returns the constants with the surface's heating at the end of the trajectory, and its temperature there."""
        c = self.c
        gone = self.rate / self.kappa

        def rolled(u: float) -> Level:
            return self.level(u, self.roll, math.tan(math.asin(u) / 2))

        def pulled(u: float, level: Level) -> float:
            return ROOT2 * level.across / (self.kappa * math.sqrt(1.0 - u**2))

        # Bound delta while the body rolls, in any direction; then at rest, along each axis.
        u = math.sin(BEGINS)
        for _ in range(TURNS):
            u = min(u, pulled(u, rolled(u)))
        most, level = u, rolled(u)
        free = self.roll - level.along - math.tan(most / 2) * (self.kappa * most + ROOT2 * level.across)
        if math.asin(most) > FULL - self.angle or free <= 0.0:
            raise NoCheckError("the roll")
        roll = self.roll
        for by_axis in (False, True):
            for _ in range(TURNS):
                tilt = math.tan(math.asin(min(ROOT2 * u, 0.9)) / 2)
                level = self.level(u, roll, tilt, by_axis)
                aside = (level.along + tilt * ROOT2 * (self.kappa * u + level.across)) / self.kappa_roll
                if aside >= 1.0:
                    raise NoCheckError("the roll")
                roll = min(roll, self.kappa_roll * aside)
                if not by_axis:
                    u = min(u, pulled(u, level))
                elif (pull := self.kappa * math.sqrt(1.0 - 2 * u**2) - level.rolling) > 0.0:
                    u = min(u, level.across / pull)
        sun, earth, dark = heating(c)
        warmest = (c.max_temperature + c.zero_celsius) * (
            (sun * u + earth * math.hypot(u, aside)) / -dark
        ) ** 0.25
        # Add up the light while delta falls from where the panels slow down.
        lit, facing = 0.0, 0.0
        for i in range(FALLS):
            high, low = (gone + (1.05 * most - gone) * j / FALLS for j in (i, i + 1))
            pull = math.sqrt(1.0 - high**2) * (self.kappa * low - ROOT2 * self.level(high, 0.0).across)
            if pull <= 0.0:
                raise NoCheckError("the last part of the turn")
            lit, facing = lit + high * (high - low) / pull, facing + (high - low) / pull
        slow = math.asin(min(self.roll / self.kappa_roll, 1.0))
        fast, slowly = (math.pi - 2 * slow) / free, 2 * slow / self.kappa_roll
        charges = energy_rate(torch.tensor(math.sqrt(1.0 - most**2), dtype=torch.float64), c).item() > 0.0
        if not charges or warmest - c.zero_celsius > c.max_temperature - c.temperature_sun_slope:
            raise NoCheckError("the battery and the surface at rest")
        return replace(
            self,
            lit=lit + most * (fast + slowly),
            facing=facing + fast,
            rolling=slowly,
            warmest=warmest - c.zero_celsius,
        )


def heating(c: Limits) -> tuple[float, float, float]:
    """Returns the heating in deg C/s of full light by the Sun, by the Earth, and of none at the highest temperature."""
    one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    hot = c.max_temperature * one
    dark = temperature_rate(none, none, hot, c).item()
    sun, earth = (temperature_rate(*lit, hot, c).item() - dark for lit in ((one, none), (none, one)))
    return sun, earth, dark


def spins(c: Limits, uncertainty: Uncertainty, most: float) -> tuple[float, float]:
    """Returns the largest gyroscopic accelerations about the first body axis and across it, with the law's share."""

    def worst(i: int) -> float:
        j, k = (i + 1) % 3, (i + 2) % 3
        moments = c.inertia
        nominal = abs(moments[j] - moments[k]) / moments[i]
        corners = product((1 - uncertainty.inertia, 1 + uncertainty.inertia), repeat=3)
        true = max(abs(f[j] * moments[j] - f[k] * moments[k]) / (f[i] * moments[i]) for f in corners)
        return true + most * nominal

    return worst(0), max(worst(1), worst(2))

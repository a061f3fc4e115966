"""A lower bound of every limit on the whole backup trajectory from one test, which is enough where limits are far.

The bound uses only coarse properties of the laws, each taken generously: the attitude is at rest within `arrives` s,
the camera recedes from the Sun once the body has the law's rates, and a spacecraft brakes on a straight line. The
simulated trajectory accepts everything that this test accepts (tests/rta/check/test_early_accept.py).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.dynamics import sun_and_earth_in_body, temperature_rate
from inspection.model.state import OMEGA, E, P, T, V
from rta.check.attitude_law import Pointing
from rta.check.flight import Flight, incidence
from rta.check.intersample_bounds import FreeFlight, Strays, between
from rta.check.motion_law import BESIDE, DRIFT, INSIDE, STEEP, Braking
from rta.check.terminal_set import TerminalSet

SLOWER = 0.8  # smallest rate at which the panels turn to the Sun, as a share of the law's rate
CELLS = (5, 1)  # as in `flight`
SLACK = 0.1  # rad, margin of every angle, since the turn is not simulated


@dataclass(frozen=True)
class EarlyAccept:
    """Holds the constants of the bound.

    Attributes:
        flight: how a hold is simulated; free: bounds of free flight.
        stopping: s, until a body has the law's rates; arrives: s, until it is at rest.
        sunlight: deg C/s, the Sun's largest heating.
    """

    pointing: Pointing
    braking: Braking
    flight: Flight
    free: FreeFlight
    stopping: float
    arrives: float
    sunlight: float

    @classmethod
    def of(cls, pointing: Pointing, braking: Braking, flight: Flight, terminal: TerminalSet) -> "EarlyAccept":
        c, w = pointing.c, pointing
        alpha = c.max_torque / max(c.inertia)
        stopping = math.ceil((c.max_rate + w.rate) / (alpha * w.hold) - 1e-9) * w.hold
        turn = math.pi / w.rate + math.pi / 2 / w.roll + math.log(1.0 / terminal.radius) / w.kappa
        one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        sunlight = (temperature_rate(one, none, none, c) - temperature_rate(none, none, none, c)).item()
        free = FreeFlight.of(c, *CELLS)
        return cls(pointing, braking, flight, free, stopping, stopping + turn / SLOWER, sunlight)

    def attitude(self, x: Tensor) -> Tensor:
        """Returns lower bounds of exclusion, temperature, battery and rates from states (16, B) on: (4, B)."""
        c, w = self.pointing.c, self.flight
        # while the body comes to the law's rates
        swept = 0.6 * self.stopping * (norm(x[OMEGA]) + self.pointing.fastest) + SLACK
        sun, _ = sun_and_earth_in_body(x)
        delta = incidence(c.solar_panel_axis, sun) + swept
        # e . s is at most sin(delta); delta falls at a share of the law's rate, and at the end of kappa delta
        full, none = torch.ones_like(x[T]), torch.zeros_like(x[T])
        turning = (1.0 - delta.clamp(max=math.pi).cos()) / (SLOWER * self.pointing.rate)
        lit = self.stopping + turning + self.pointing.rate / (SLOWER * self.pointing.kappa**2)
        heat = temperature_rate(none, full, x[T], c).clamp(min=0.0) * self.arrives + self.sunlight * lit
        warm = (c.temperature_sun_slope + c.temperature_earth_slope) * (math.pi / 2 + SLACK)
        # the panels charge enough below this angle
        charged = math.acos(c.power_draw / 1000.0 / w.charging) - SLACK
        falling = (delta - charged).clamp(min=0.0) / (SLOWER * self.pointing.rate)
        used = (self.stopping + falling) * c.power_draw / 1000.0 + w.charging * SLACK
        room = c.max_rate - x[OMEGA].abs().amax(0) - self.pointing.overshoot
        return torch.stack(
            (
                incidence("+x", sun) - swept - c.field_of_view / 2 - c.exclusion_buffer,
                c.max_temperature - x[T] - heat - warm,
                x[E] - c.min_energy - used - c.energy_sun_slope * delta,
                room,
            )
        )

    def motion(self, x: Tensor) -> Tensor:
        """Returns lower bounds of the limits of motion on a straight backup trajectory from states (16, B): (7, B).

        Position and speed lie on one parabola until the last hold, and on another one in it. Their distance from the
        chord is at most the larger sag, (v - s)^2 / (8 a) or s T / 8, plus the distance of the point where both
        parabolas meet. A hold leaves mean_error |G| T of velocity, and no later hold makes this error larger.
        """
        c, w, n = self.pointing.c, self.braking, self.pointing.c.mean_motion
        p, v, t = x[P], x[V], w.hold
        speed = norm(v)
        direction = v / speed.clamp(min=1e-30)
        full = (-(1.0 - speed / (w.straight * t)).floor()).clamp(min=0.0)  # holds but the last
        slow = speed - full * w.straight * t
        fallen = (speed**2 - slow**2) / (2 * w.straight)
        length = fallen + slow * t / 2
        start, rest = x[:6], torch.cat((p + length * direction, torch.zeros_like(p)))
        meet = (fallen - length * (1.0 - slow / speed.clamp(min=1e-30))).abs()
        sag = meet + torch.maximum((speed - slow) ** 2 / (8 * w.straight), slow * t / 8)
        holds = full + 2.0
        drift = w.thrust - w.straight  # largest natural acceleration, in any direction
        push = torch.minimum(speed / t, torch.full_like(speed, w.straight)) + drift
        turn = 1.05 * norm(x[OMEGA]).clamp(min=self.pointing.fastest) + 4 * n
        far = norm(p + length / 2 * direction)
        fields = (far - length / 2 < BESIDE * c.collision_radius + DRIFT / STEEP + 1.0) | (
            far + length / 2 > c.max_distance - INSIDE - DRIFT / STEEP - 1.0
        )
        e_v = (
            holds * w.mean_error * w.thrust * t
            + (push * turn + 2 * n * w.thrust + 3 * n**2 * speed) * t**2 / 8
        )
        e_v = e_v + torch.where(fields, DRIFT, torch.zeros_like(speed))
        e_p = e_v * (holds * t + self.arrives * torch.where(fields, 1.0, torch.full_like(speed, 0.05)))
        limits = between(start, rest, Strays(e_p + sag, e_v, e_v), c, self.free)
        # The law estimates the trajectory's end. It moves from the first of these distances to the second.
        ends = [norm(p + direction * speed * (speed / (2 * w.straight) + late)) for late in (0.0, t / 2)]
        straight = c.max_distance - INSIDE - w.buffer - torch.maximum(*ends) - e_p
        return torch.minimum(limits, straight)

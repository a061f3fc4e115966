"""Bounds on the errors of model, measurement and actuators, within which the filter checks its controls.

The worst of them are taken all at once. All zero: the plant is the model, and the filter that of the paper.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

from inspection.model.parameters import Limits
from rta.parameters import RtaParameters
from settings import Settings, setting

if TYPE_CHECKING:  # who asks for settings alone does not wait for PyTorch
    from torch import Tensor

LONGEST_HOLD = (
    10.0  # s; at 20 s, in which a body at 2 deg/s turns by 70 deg, one episode in ten broke a limit
)
OLDEST = 10  # calls
# bounds that take something off the least braking
BRAKING = (
    *("mass", "thrust_gain", "acceleration", "thrust_misalignment", "thrust_quantum"),
    *("attitude", "rate", "inertia", "torque_gain", "longest_hold"),
)
SHORT = 1.0  # s, up to which the rate of now, less what it can change by, says what a control does


class HoldDisturbance(NamedTuple):
    """Bounds of what disturbs a hold.

    Attributes:
        position, velocity, attitude, rate: m, m/s, rad and rad/s, errors of the state at its start.
        thrust_share, torque_share: errors of the actuators, by the controls' sizes.
        force, torque: N and N m, that the model does not know.
    """

    position: float
    velocity: float
    attitude: float
    rate: float
    thrust_share: float
    torque_share: float
    force: float
    torque: float


@dataclass(frozen=True)
class Uncertainty(Settings):
    """Largest differences between world and model; those of sensors are the largest error of each axis."""

    mass: float = setting(0.0, "share, by which the true mass is more or less at most", below=1, note="Body")
    inertia: float = setting(0.0, "share, by which each moment of inertia is more or less at most", below=1)
    acceleration: float = setting(0.0, "m/s^2, unknown, in any direction")
    saturates_rates: bool = setting(True, "false: the plant does not hold the body rates, so the filter does")
    hill_rotation: bool = setting(
        False, "the limit of the body rates is also one of rates relative to the stars"
    )

    thrust_gain: float = setting(
        0.0, "share, by which an axis gives more or less thrust at most", below=1, note="Actuators"
    )
    torque_gain: float = setting(0.0, "share, by which an axis gives more or less torque at most", below=1)
    thrust_misalignment: float = setting(0.0, "deg, between an axis and the thrust along it", below=90)
    minimum_thrust: float = setting(
        0.0, "N, dead-band: the thrusters give no less, so the filter asks for none"
    )
    thrust_quantum: float = setting(
        0.0, "N, the thrusters give multiples of it, so the filter asks for these"
    )
    health: bool = setting(False, "the filter is told at each call what is left of each actuator")

    position: float = setting(0.0, "m", note="Sensors")
    velocity: float = setting(0.0, "m/s")
    attitude: float = setting(0.0, "deg", below=90)
    rate: float = setting(0.0, "deg/s")

    latency: int = setting(
        0,
        "calls, the state's age at most: it is predicted by the controls that were sent since",
        most=OLDEST,
        note="Computer",
    )
    longest_hold: float = setting(
        0.0, "s that a control may be held, calls being missed; 0: the period", most=LONGEST_HOLD
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minimum_thrust and self.thrust_quantum:
            raise ValueError("minimum_thrust and thrust_quantum: give the one or the other")

    @property
    def is_zero(self) -> bool:
        """Whether every bound is zero: the plant is the model."""
        return self == Uncertainty()

    @property
    def radii(self) -> tuple[float, ...]:
        """m, m/s, rad and rad/s, of the balls around these."""
        root = math.sqrt(3.0)
        angles = (math.radians(root * angle) for angle in (self.attitude, self.rate))
        return root * self.position, root * self.velocity, *angles

    def hold_disturbance(self, c: Limits, r: RtaParameters) -> HoldDisturbance:
        """Bounds the disturbance of a hold. A state that is old has been disturbed since, too."""
        position, velocity, attitude, rate = self.radii
        thrust = self.thrust_error + self.thrust[1] * self.thrust_angle(c, r)
        force, twist = c.mass * self.acceleration, max(c.inertia) * self.angular_acceleration(c)
        old = self.latency * r.period
        push = (math.sqrt(3.0) * c.max_thrust * thrust + force) / c.mass * old
        faster = (math.sqrt(3.0) * c.max_torque * self.torque_error + twist) / min(c.inertia) * old
        return HoldDisturbance(
            position + (velocity + push / 2) * old,
            velocity + push,
            attitude + (rate + faster / 2) * old,
            rate + faster,
            thrust,
            self.torque_error,
            force,
            twist,
        )

    def check(self, c: Limits, r: RtaParameters) -> None:
        """Raises ValueError where a bound leaves no control that could hold a limit."""
        if 0 < self.longest_hold < r.period:
            raise ValueError(
                f"longest_hold = {self.longest_hold:g}: must be at least the period, {r.period:g} s"
            )
        if self.minimum_thrust > c.max_thrust:
            raise ValueError(
                f"minimum_thrust = {self.minimum_thrust:g}: must be at most max_thrust, {c.max_thrust:g} N"
            )
        if (left := self.max_acceleration(c, r)) <= 0.0:
            bounds = ", ".join(f"{name} = {value:g}" for name in BRAKING if (value := getattr(self, name)))
            raise ValueError(
                f"{bounds}: of a braking of {c.max_acceleration:.3g} m/s^2 leave {left:.3g} within "
                f"max_distance = {c.max_distance:g} m: must be above zero for the keep-in zone"
            )
        if self.rate_offset(c) + math.radians(self.rate) >= c.max_rate:
            raise ValueError(
                f"rate = {self.rate:g}: must be below max_rate, {math.degrees(c.max_rate):g} deg/s"
            )
        # at rest both rows of an axis ask for no more than unknown torque can do against them
        kept = r.gain(r.rate_gain, self.longest_hold) * (
            c.max_rate - self.rate_offset(c) - math.radians(self.rate)
        )
        if self.needs_sampled_rows(r) and (unknown := self.angular_acceleration(c)) >= kept:
            raise ValueError(
                f"inertia = {self.inertia:g}, hill_rotation = {str(self.hill_rotation).lower()}: turn a body by up to "
                f"{unknown:.3g} rad/s^2 otherwise than the model, held for {self.hold(r):g} s: must be below "
                f"{kept:.3g} for the limits of the body rates"
            )

    def hold(self, r: RtaParameters) -> float:
        """s, the longest time that a control is held."""
        return max(r.period, self.longest_hold)

    def needs_sampled_rows(self, r: RtaParameters) -> bool:
        """Whether a control is held for longer than SHORT, or in a world unlike the model, so that rows are sampled."""
        return self.hold(r) > SHORT or not self.is_zero

    def rows(self, r: RtaParameters) -> str:
        """Which rows the filter has, "paper", "sampled" or "none"; see `rta.barrier`."""
        return r.rows.replace("auto", "sampled" if self.needs_sampled_rows(r) else "paper")

    @property
    def thrust(self) -> tuple[float, float]:
        """Smallest and largest acceleration along an axis for that of the model: gain and alignment over mass."""
        least = (1 - self.thrust_gain) * math.cos(math.radians(self.thrust_misalignment)) / (1 + self.mass)
        return least, (1 + self.thrust_gain) / (1 - self.mass)

    @property
    def torque(self) -> tuple[float, float]:
        """Smallest and largest angular acceleration of an axis for that of the model."""
        return (1 - self.torque_gain) / (1 + self.inertia), (1 + self.torque_gain) / (1 - self.inertia)

    @property
    def thrust_error(self) -> float:
        """Largest share by which an acceleration along an axis is off."""
        least, most = self.thrust
        return max(1.0 - least, most - 1.0)

    @property
    def torque_error(self) -> float:
        """Largest share by which an angular acceleration is off."""
        least, most = self.torque
        return max(1.0 - least, most - 1.0)

    def thrust_angle(self, c: Limits, r: RtaParameters) -> float:
        """rad, between the mean direction of a thruster over a hold and that of the rows at most, of a body at rest.

        Its misalignment, the attitude's error, the rates' times half the hold, and what torque turns the body by
        otherwise (an angular acceleration e for t turns it by e t^2 / 2, in the mean over t by e t^2 / 6).
        """
        hold = self.hold(r)
        measured = math.sqrt(3.0) * math.radians(self.attitude + self.rate * hold / 2)
        strongest = math.sqrt(3.0) * c.max_torque / min(c.inertia)
        otherwise = self.torque_error * strongest + self.angular_acceleration(c)
        return math.radians(self.thrust_misalignment) + measured + otherwise * hold**2 / 6

    def max_acceleration(self, c: Limits, r: RtaParameters) -> float:
        """a_max in m/s^2 that is there in the worst case, in every attitude of a body that does not turn.

        Of the model's thrust |u_j| along n, axis j gives at least |u_j| (k |n_j| - s sqrt(1 - n_j^2)) where it may be
        off by an angle: s = most angle, k = least - most angle^2 / 2. All axes together give least where two are at the
        angle at which they begin to help, tan(phi) = s / k, and the third is all that does:
        n = (sqrt(1 - 2 sin^2 phi), sin phi, sin phi).
        """
        (least, most), angle = self.thrust, self.thrust_angle(c, r)
        s, k = most * angle, least - most * angle**2 / 2
        squared = 2.0 * s**2 / (s**2 + k**2)  # of what is across that axis
        helps = k > 0.0 and squared < 2.0 / 3.0
        share = k * math.sqrt(1.0 - squared) - s * math.sqrt(squared) if helps else 0.0
        lost = c.max_thrust - share * self.largest_thrust(c.max_thrust)
        return c.max_acceleration - lost / c.mass - self.acceleration

    def angular_acceleration(self, c: Limits) -> float:
        """rad/s^2, the largest that the model does not know of within the limits of the rates.

        The gyroscopic one of other moments of inertia, at the worst corner of their bounds, and where Hill's frame
        turns by n, the rate of R^T (0, 0, n), n |omega|.
        """
        from inspection.model.dynamics import euler

        at_most, worst = (c.max_rate,) * 3, [0.0] * 3  # plain numbers: the filter asks at every call
        nominal = euler(at_most, c.inertia)
        for factors in product((1 - self.inertia, 1 + self.inertia), repeat=3):
            moments = [moment * factor for moment, factor in zip(c.inertia, factors, strict=True)]
            off = zip(worst, euler(at_most, moments), nominal, strict=True)
            worst = [max(most, abs(true - model)) for most, true, model in off]
        return math.hypot(*worst) + self.unknown_turning(c) * math.sqrt(3.0) * c.max_rate

    def rate_offset(self, c: Limits) -> float:
        """rad/s, by which a body rate relative to the stars exceeds one relative to Hill's frame at most."""
        return self.unknown_turning(c)

    def unknown_turning(self, c: Limits) -> float:
        """rad/s, of Hill's frame at perigee, where the model leaves it out."""
        return c.fastest_orbit_rate if self.hill_rotation and not c.hill_rotation else 0.0

    @property
    def is_quantised(self) -> bool:
        """Whether thrusters give some values only."""
        return self.minimum_thrust > 0.0 or self.thrust_quantum > 0.0

    def largest_thrust(self, limit: float) -> float:
        """N, that thrusters give within their limit."""
        quantum = self.thrust_quantum
        return quantum * math.floor(limit / quantum + 1e-9) if quantum else limit

    def rounding(self, limit: float) -> float:
        """N, by which thrust within its limit is given otherwise along an axis at most."""
        return max(self.minimum_thrust, self.thrust_quantum / 2, limit - self.largest_thrust(limit))

    def quantised(self, thrust: "Tensor", limit: float) -> "Tensor":
        """Rounds thrust in N to what the thrusters can give within their limit."""
        from torch import where

        if quantum := self.thrust_quantum:
            most = self.largest_thrust(limit)
            return (quantum * (thrust / quantum).round()).clamp(-most, most)
        return where(thrust.abs() < self.minimum_thrust, 0.0, thrust)


NO_UNCERTAINTY = Uncertainty()

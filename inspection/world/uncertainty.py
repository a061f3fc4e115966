"""Bounds on the errors of model, measurement and actuators.

The worst of all errors are taken at once. If all bounds are zero, the plant is the model.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

from inspection.model.parameters import Limits
from settings import Settings, setting

if TYPE_CHECKING:  # reading settings alone must not wait for the import of PyTorch
    from torch import Tensor

LONGEST_HOLD = 10.0  # s
OLDEST = 10  # calls


@dataclass(frozen=True)
class Uncertainty(Settings):
    """Holds the largest differences between plant and model; those of sensors are per axis."""

    mass: float = setting(0.0, "share, by which the true mass is more or less at most", below=1, note="Body")
    inertia: float = setting(0.0, "share, by which each moment of inertia is more or less at most", below=1)
    acceleration: float = setting(0.0, "m/s^2, unknown, in any direction")
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
        """Checks whether every bound is zero, so that the plant is the model."""
        return self == Uncertainty()

    @property
    def said(self) -> str:
        """Returns the bounds that are not zero, by name, as text."""
        default = Uncertainty()
        bounds = ((name, value) for name, value in vars(self).items() if value != getattr(default, name))
        return ", ".join(f"{name} = {value}" for name, value in bounds)

    @property
    def radii(self) -> tuple[float, ...]:
        """Returns the radii of the balls around position, velocity, attitude and rate: m, m/s, rad and rad/s."""
        root = math.sqrt(3.0)
        angles = (math.radians(root * angle) for angle in (self.attitude, self.rate))
        return root * self.position, root * self.velocity, *angles

    def check(self, c: Limits, period: float) -> None:
        """Raises ValueError if bounds do not fit the period or the thrusters."""
        if 0 < self.longest_hold < period:
            raise ValueError(
                f"longest_hold = {self.longest_hold:g}: must be at least the period, {period:g} s"
            )
        if self.minimum_thrust > c.max_thrust:
            raise ValueError(
                f"minimum_thrust = {self.minimum_thrust:g}: must be at most max_thrust, {c.max_thrust:g} N"
            )

    def hold(self, period: float) -> float:
        """Returns the longest time in s that a control is held."""
        return max(period, self.longest_hold)

    @property
    def thrust(self) -> tuple[float, float]:
        """Returns the smallest and largest acceleration along an axis as a factor of the model's.

        Gain and alignment are in the numerator, mass in the denominator.
        """
        least = (1 - self.thrust_gain) * math.cos(math.radians(self.thrust_misalignment)) / (1 + self.mass)
        return least, (1 + self.thrust_gain) / (1 - self.mass)

    @property
    def torque(self) -> tuple[float, float]:
        """Returns the smallest and largest angular acceleration of an axis as a factor of the model's."""
        return (1 - self.torque_gain) / (1 + self.inertia), (1 + self.torque_gain) / (1 - self.inertia)

    @property
    def thrust_error(self) -> float:
        """Returns the largest share by which an acceleration along an axis is off."""
        least, most = self.thrust
        return max(1.0 - least, most - 1.0)

    @property
    def torque_error(self) -> float:
        """Returns the largest share by which an angular acceleration is off."""
        least, most = self.torque
        return max(1.0 - least, most - 1.0)

    def angular_acceleration(self, c: Limits) -> float:
        """Returns the largest angular acceleration in rad/s^2 unknown to the model, within the limits of the rates.

        It is the gyroscopic one of other moments of inertia, at the worst corner of their bounds. Where Hill's frame
        turns at n, n |omega| is added, from the rate of R^T (0, 0, n).
        """
        from inspection.model.dynamics import euler

        at_most, worst = (c.max_rate,) * 3, [0.0] * 3  # plain numbers, since the filter asks at every call
        nominal = euler(at_most, c.inertia)
        for factors in product((1 - self.inertia, 1 + self.inertia), repeat=3):
            moments = [moment * factor for moment, factor in zip(c.inertia, factors, strict=True)]
            off = zip(worst, euler(at_most, moments), nominal, strict=True)
            worst = [max(most, abs(true - model)) for most, true, model in off]
        return math.hypot(*worst) + self.unknown_turning(c) * math.sqrt(3.0) * c.max_rate

    def unknown_turning(self, c: Limits) -> float:
        """Returns the rate in rad/s of Hill's frame, if the model leaves it out, else 0."""
        return c.mean_motion if self.hill_rotation and not c.hill_rotation else 0.0

    @property
    def is_quantised(self) -> bool:
        """Checks whether thrusters give some values only."""
        return self.minimum_thrust > 0.0 or self.thrust_quantum > 0.0

    def largest_thrust(self, limit: float) -> float:
        """Returns the largest thrust in N that thrusters give within their limit."""
        quantum = self.thrust_quantum
        return quantum * math.floor(limit / quantum + 1e-9) if quantum else limit

    def rounding(self, limit: float) -> float:
        """Returns in N by how much the thrusters' rounding changes thrust along an axis at most, within its limit."""
        return max(self.minimum_thrust, self.thrust_quantum / 2, limit - self.largest_thrust(limit))

    def quantised(self, thrust: "Tensor", limit: float) -> "Tensor":
        """Rounds thrust in N to what the thrusters can give within their limit."""
        from torch import where

        if quantum := self.thrust_quantum:
            most = self.largest_thrust(limit)
            return (quantum * (thrust / quantum).round()).clamp(-most, most)
        return where(thrust.abs() < self.minimum_thrust, 0.0, thrust)


NO_UNCERTAINTY = Uncertainty()

"""Differences between a plant and the model: the table `[plant]`."""

from dataclasses import dataclass, fields

from inspection.model.parameters import Limits
from inspection.model.state import CONTROLS
from settings import Settings, setting

Range = float | tuple[float, float]
Count = int | tuple[int, int]

SIMULATORS, ACTUATORS = ("own", "basilisk"), ("ideal", "real")
OF_BASILISK = {"j2": False, "drag": False, "actuators": "ideal"}  # only Basilisk has these
NOT_OF_PULSES = {"thrust_gain": 1.0, "thrust_misalignment": 0.0}  # pulses have full thrust along the axes
HOW = ("drawn", "steady", "worst")
FAILING = ("none", "thrust", "torque", "any", *CONTROLS)
# These settings have no effect of their own.
DETAILS = {"errors", "noise_bound", "missed_in_a_row", "failing_from", "failing_strength"}


@dataclass(frozen=True)
class PlantParameters(Settings):
    """Holds the differences of the plant from the model; by default there are none.

    A setting is a value, or a range [low, high] from which each episode draws its own value, constant over the episode.
    """

    simulator: str = setting(
        "own",
        "simulator of the motion; basilisk must be installed (docs/guides/basilisk.md)",
        among=SIMULATORS,
        note="Simulator",
    )
    j2: bool = setting(False, "basilisk: the Earth is flattened")
    drag: bool = setting(False, "basilisk: there is air at the chief's height")
    actuators: str = setting("ideal", "of basilisk (real: wheels and pulsed thrusters)", among=ACTUATORS)

    errors: str = setting(
        "drawn",
        "where the errors are within their bounds (at random; at a corner for the whole episode; at a corner that an "
        "adversary chooses at every call)",
        among=HOW,
        note="How far it goes",
    )

    mass_factor: Range = setting(1.0, "true mass / [inspection] mass", above=0, note="Body")
    inertia_factor: Range = setting(
        1.0, "true moment / that of [inspection] inertia, of each axis apart", above=0
    )
    saturate_rates: bool = setting(
        True, "false: body rates may exceed max_rate, as [inspection] saturate_rates"
    )
    hill_rotation: bool = setting(False, "attitude relative to Hill's frame as that turns")
    acceleration: Range = setting(0.0, "m/s^2, unknown and constant, in a random direction of Hill's frame")

    thrust_gain: Range = setting(
        1.0, "what acts / what is commanded, of each axis apart", above=0, note="Actuators"
    )
    torque_gain: Range = setting(1.0, "what acts / what is commanded, of each axis apart", above=0)
    thrust_misalignment: Range = setting(
        0.0, "deg, between an axis and the thrust along it, of each axis apart", most=90
    )
    minimum_thrust: Range = setting(0.0, "N, dead-band: a smaller thrust of an axis is not given at all")
    thrust_quantum: Range = setting(0.0, "N, the thrust of an axis is a multiple of it, the next one")
    failing: str = setting("none", "what fails (thrust, torque, any: one axis at random)", among=FAILING)
    failing_from: Range = setting(0.0, "s, time of the episode from which on it fails")
    failing_strength: Range = setting(0.0, "share of its strength that is left then; 0: it is dead", most=1)

    position_noise: Range = setting(0.0, "m, 1 sigma of each axis", note="Sensors")
    velocity_noise: Range = setting(0.0, "m/s, 1 sigma of each axis")
    attitude_noise: Range = setting(0.0, "deg, 1 sigma about each axis")
    rate_noise: Range = setting(0.0, "deg/s, 1 sigma of each axis")
    noise_bound: float = setting(3.0, "sigmas at which noise is clipped", above=0, most=10)
    position_bias: Range = setting(0.0, "m, size of a constant error in a random direction")
    velocity_bias: Range = setting(0.0, "m/s, size of a constant error in a random direction")
    attitude_bias: Range = setting(0.0, "deg, angle of a constant error about a random axis")
    rate_bias: Range = setting(0.0, "deg/s, size of a constant error in a random direction")

    latency: Count = setting(
        0, "calls of the filter, age of the state that is seen", most=1000, note="Computer"
    )
    missed_calls: Range = setting(
        0.0, "probability that a call but the first is missed; the last control is held", most=1
    )
    missed_in_a_row: int = setting(1000, "calls, at most so many", above=0)

    def check_simulator(self) -> None:
        """Raises ValueError if a setting is used that the simulator does not have."""
        for name, default in OF_BASILISK.items():
            if self.simulator != "basilisk" and getattr(self, name) != default:
                raise ValueError(f'{name}: needs --plant basilisk (simulator = "basilisk")')
        for name, default in NOT_OF_PULSES.items():
            if self.actuators == "real" and getattr(self, name) != default:
                raise ValueError(
                    f'{name}: is not there with actuators = "real", whose pulses are of full thrust'
                )

    @property
    def is_nominal(self) -> bool:
        """Checks whether the plant is the model."""
        return all(getattr(self, f.name) == f.default for f in fields(self) if f.name not in DETAILS)

    def check_body(self, c: Limits) -> None:
        """Raises ValueError if moments of inertia could be drawn that no body has."""
        low, high = bounds(self.inertia_factor)
        if low < high and max(c.inertia) * (high + low) > sum(c.inertia) * low * (1 + 1e-9):
            raise ValueError(
                f"inertia_factor = {[low, high]}: of inertia = {list(c.inertia)}, one moment could exceed the sum of "
                "the other two"
            )


def bounds(value: Range) -> tuple[float, float]:
    """Returns low and high of a value or a range."""
    return value if isinstance(value, tuple) else (value, value)

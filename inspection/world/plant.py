"""The world: what the plant, its actuators, its sensors and its computer do that the filter is not told.

`PlantParameters` says what there is, `Plant` is what was drawn of it for each episode of a batch. Everything random
follows from one number per episode, drawn like its initial state, and from the episode's time: by a hash, so that an
episode is the same whatever flies beside it, and resumed where it stopped.
"""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import rate_in_hill, turned_by
from inspection.model.draws import hashed, isotropic, key_of
from inspection.model.dynamics import Body, integrate
from inspection.model.orbit import orbit_rate
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, CONTROLS, OMEGA, SIZE, THETA_S, THRUST, TORQUE, P, Q, V
from setting import Settings, setting

Range = float | tuple[float, float]
Count = int | tuple[int, int]

SIMULATORS, ACTUATORS = ("own", "basilisk"), ("ideal", "real")
OF_BASILISK = {"j2": False, "drag": False, "actuators": "ideal"}  # what no other simulator has
NOT_OF_PULSES = {"thrust_gain": 1.0, "thrust_misalignment": 0.0}  # which are at full thrust along the axes
FAILING = ("none", "thrust", "torque", "any", *CONTROLS)
# What has no effect of its own.
DETAILS = {"noise_bound", "missed_in_a_row", "failing_from", "failing_strength"}


@dataclass(frozen=True)
class PlantParameters(Settings):
    """What differs from the model; by default nothing does.

    A value, or a range [low, high] from which each episode draws its own, constant over the episode.
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
        """Raises ValueError where something is asked for that the simulator does not have."""
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
        """Whether the plant is the model."""
        return all(getattr(self, f.name) == f.default for f in fields(self) if f.name not in DETAILS)

    def check_body(self, c: Limits) -> None:
        """Raises ValueError where moments of inertia could be drawn that no body has."""
        low, high = bounds(self.inertia_factor)
        if low < high and max(c.inertia) * (high + low) > sum(c.inertia) * low * (1 + 1e-9):
            raise ValueError(
                f"inertia_factor = {[low, high]}: of inertia = {list(c.inertia)}, one moment could exceed the sum of "
                "the other two"
            )


def bounds(value: Range) -> tuple[float, float]:
    """Low and high of a value or a range."""
    return value if isinstance(value, tuple) else (value, value)


class Drawn(NamedTuple):
    """What an episode's plant is; last axis the episodes, k.

    Attributes:
        body: (7, k) mass in kg, moments of inertia in kg m^2, acceleration in Hill's frame in m/s^2.
        thrust: (3, 3, k) from what the thrusters of each axis give to what acts, without unit; torque: (3, k).
        minimum, quantum: (k,) N.
        fails: (6, k) bool; fails_from: (k,) s; strength: (k,) that is left.
        noise: (12, k) 1 sigma of position, velocity, attitude, rates in m, m/s, rad, rad/s; bias: (12, k).
        latency: (k,) calls; misses: (k,) probability.
    """

    body: Tensor
    thrust: Tensor
    torque: Tensor
    minimum: Tensor
    quantum: Tensor
    fails: Tensor
    fails_from: Tensor
    strength: Tensor
    noise: Tensor
    bias: Tensor
    latency: Tensor
    misses: Tensor


NUMBERS = 48  # of an episode's draw, at least as many as it takes
BEFORE = -1  # the time in ms of these numbers


def draw(parameters: PlantParameters, c: Limits, key: Tensor) -> Drawn:
    """What follows from the episodes' keys (k,), each quantity from numbers of its own whatever else is set."""
    rows = iter(hashed(key, torch.full_like(key, BEFORE), NUMBERS))

    def within(value: Range) -> Tensor:
        low, high = bounds(value)
        return low + (high - low) * next(rows)

    def each(value: Range) -> Tensor:
        return torch.stack([within(value) for _ in range(3)])

    def direction() -> Tensor:
        return isotropic(torch.stack((next(rows), next(rows))))

    p = parameters
    mass = c.mass * within(p.mass_factor)
    inertia = each(p.inertia_factor) * mass.new_tensor(c.inertia)[:, None]
    push = within(p.acceleration) * direction()
    gain, torque = each(p.thrust_gain), each(p.torque_gain)
    tilt, side = each(p.thrust_misalignment).deg2rad(), each((0.0, 2 * math.pi))
    thrust = mass.new_zeros(3, 3, mass.numel())
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        thrust[i, i] = gain[i] * tilt[i].cos()
        thrust[j, i] = gain[i] * tilt[i].sin() * side[i].cos()
        thrust[k, i] = gain[i] * tilt[i].sin() * side[i].sin()
    minimum, quantum = within(p.minimum_thrust), within(p.thrust_quantum)
    names = torch.arange(CONTROL_SIZE, device=key.device)[:, None]
    chance = next(rows)
    first, count = {"thrust": (0, 3), "torque": (3, 3), "any": (0, 6), "none": (0, 0)}.get(
        p.failing, (CONTROLS.index(p.failing) if p.failing in CONTROLS else 0, 1)
    )
    fails = (names == first + (count * chance).long()) & (count > 0)
    fails_from, strength = within(p.failing_from), within(p.failing_strength)
    to_si = mass.new_tensor([1.0, 1.0, math.radians(1.0), math.radians(1.0)])[:, None]
    kinds = ("position", "velocity", "attitude", "rate")
    sigma = torch.stack([within(getattr(p, f"{kind}_noise")) for kind in kinds]) * to_si
    sizes = torch.stack([within(getattr(p, f"{kind}_bias")) for kind in kinds]) * to_si
    bias = torch.cat([size * direction() for size in sizes])
    low, high = bounds(p.latency)
    latency = low + ((high - low + 1) * next(rows)).long()
    return Drawn(
        body=torch.cat((mass[None], inertia, push)),
        thrust=thrust,
        torque=torque,
        minimum=minimum,
        quantum=quantum,
        fails=fails,
        fails_from=fails_from,
        strength=strength,
        noise=sigma.repeat_interleave(3, 0),
        bias=bias,
        latency=latency,
        misses=within(p.missed_calls),
    )


class Plant:
    """The plants of a batch of episodes, and what stands between them and the controls and the states that are seen.

    Args:
        parameters: what may differ from the model; c: the model.
        batch: episodes, B.

    Attributes:
        every, acts_for: s between two calls and that a control acts, set by whose clocks they are.
        drawn: what each episode's plant is.
        held: (6, B) the last control that a call gave; missed: (B,) calls missed since.
        past: (latency, 6, B) what was held from the last calls on, the oldest first.
        true, seen: (16, B) the states last sensed, and what they were taken for.

    Raises:
        ValueError: the parameters do not fit the model.
    """

    STATE: tuple[str, ...] = ("key", "held", "missed", "history", "past")
    is_traceable = True  # `integrate` is of operations that PyTorch traces

    def __init__(
        self,
        parameters: PlantParameters,
        c: Limits,
        batch: int,
        device: torch.device | str,
    ) -> None:
        parameters.check_simulator()
        parameters.check_body(c)
        self.parameters, self.c = parameters, c
        self.every = self.acts_for = 1.0
        self.key = torch.zeros(batch, dtype=torch.int64, device=device)
        self.held = torch.zeros(CONTROL_SIZE, batch, dtype=torch.float64, device=device)
        self.missed = torch.zeros_like(self.key)
        length = int(bounds(parameters.latency)[1]) + 1
        self.history = torch.zeros(length, SIZE, batch, dtype=torch.float64, device=device)
        self.past = torch.zeros(length - 1, CONTROL_SIZE, batch, dtype=torch.float64, device=device)
        self.drawn = draw(parameters, c, self.key)
        self.true = self.seen = self.held[:0]  # none yet
        self.limit = self.held.new_tensor(c.control_limit)[:, None]

    def begin(self, columns: Tensor, x: Tensor, number: Tensor | None) -> None:
        """Begins episodes in the given columns, in states (16, k) and from a number in [0, 1) each, (k,)."""
        assert number is not None
        self.key[columns] = key_of(number)
        self.held[:, columns] = 0.0
        self.past[..., columns] = 0.0
        self.missed[columns] = 0
        for whole, part in zip(self.drawn, draw(self.parameters, self.c, self.key[columns]), strict=True):
            whole[..., columns] = part
        self.true = self.seen = self.held[:0]

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs; the rest follows from it."""
        return {name: getattr(self, name).clone() for name in self.STATE}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores `state_dict`; raises KeyError or ValueError where it does not fit."""
        for name in self.STATE:
            if getattr(self, name).shape != state[name].shape:
                raise ValueError(f"plant {name} is {tuple(state[name].shape)}")
            setattr(self, name, state[name].clone())
        self.drawn = draw(self.parameters, self.c, self.key)
        self.true = self.seen = self.held[:0]

    @property
    def turns(self) -> bool:
        """Whether a state's body rates are relative to the stars, as a gyro's are."""
        return self.parameters.hill_rotation or self.parameters.simulator == "basilisk"

    @property
    def body(self) -> Tensor:
        """(7, B) what `integrate` takes."""
        return self.drawn.body

    @property
    def mass(self) -> Tensor:
        """(B,) kg."""
        return self.drawn.body[0]

    def integrate(self, x: Tensor, u: Tensor, body: Tensor, duration: float, times: int = 1) -> Tensor:
        """The states (16, B) after so many steps of `duration` s under what acts, (6, B), of bodies (7, B)."""
        mass, *rest = body.unbind(0)
        p = self.parameters
        turns = self.turns or self.c.hill_rotation
        own = Body(mass, rest[:3], rest[3:], turns, self.c.saturate_rates and p.saturate_rates)
        return integrate(x, u, duration, self.c, times, own)

    def actuate(self, time: Tensor, u: Tensor) -> Tensor:
        """What acts from a time of the episodes (B,) on where u (6, B) is commanded."""
        drawn, p = self.drawn, self.parameters
        thrust = u[THRUST]
        if p.thrust_quantum != 0.0:
            quantum = torch.where(drawn.quantum > 0.0, drawn.quantum, 1.0)
            most = (self.limit[THRUST] / quantum + 1e-9).floor()
            given = quantum * (thrust / quantum).round().clamp(-most, most)
            thrust = torch.where(drawn.quantum > 0.0, given, thrust)
        thrust = torch.where(thrust.abs() < drawn.minimum, 0.0, thrust)
        u = torch.cat((thrust, u[TORQUE]))
        if p.failing != "none":
            u = self.left(time) * u
        thrust = (drawn.thrust * u[THRUST]).sum(1)
        return torch.cat((thrust, drawn.torque * u[TORQUE]))

    def sense(self, time: Tensor, x: Tensor) -> Tensor:
        """What states x (16, B) at a time of the episodes (B,) are taken for; the same whenever it is asked."""
        if x is self.true:
            return self.seen
        seen = self._measure(time, x)
        if len(self.history) > 1:
            call, columns = (time / self.every).round().long(), torch.arange(x.shape[1], device=x.device)
            self.history[call % len(self.history), :, columns] = seen.T
            past = (call - self.drawn.latency).clamp(min=0)  # before the second call nothing else is known
            seen = self.history[past % len(self.history), :, columns].T
        self.true, self.seen = x, seen
        return seen

    def behind(self, x: Tensor) -> Tensor:
        """The true states where x is what they were last taken for."""
        return self.true if x is self.seen else x

    def _measure(self, time: Tensor, x: Tensor) -> Tensor:
        """The states (16, B) with the sensors' errors, the rates relative to Hill's frame as the filter wants them."""
        bound = self.parameters.noise_bound
        noise = torch.special.ndtri(hashed(self.key, milliseconds(time), 12)).clamp(-bound, bound)
        error = self.drawn.bias + self.drawn.noise * noise
        seen = x.clone()
        seen[P] += error[0:3]
        seen[V] += error[3:6]
        seen[Q] = turned_by(x[Q], error[6:9])
        seen[OMEGA] += error[9:12]
        if self.turns and not self.c.hill_rotation:  # which the model does not know
            turns = orbit_rate(x[THETA_S], self.c)
            seen[OMEGA] = torch.stack(rate_in_hill(seen[Q], seen[OMEGA], turns))
        return seen

    def hold(self, time: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """What is held from a call on that wants u (6, B): that, or the last one where it is missed, (B,) bool.

        The first call of an episode is not, since there is no last one.
        """
        chance = hashed(self.key, milliseconds(time), 1, first=12)[0]
        likely = (chance < self.drawn.misses) & (time > 0.0)
        missed = likely & (self.missed < self.parameters.missed_in_a_row)
        self.missed = torch.where(missed, self.missed + 1, 0)
        self.held = torch.where(missed, self.held, u)
        if len(self.past):
            self.past = torch.cat((self.past[1:], self.held[None]))
        return self.held, missed

    def tell(self, time: Tensor) -> dict[str, Tensor]:
        """The controls held since the state was measured, NaN where it is younger; what is left of each actuator."""
        age = self.drawn.latency.minimum((time / self.every).round().long())
        last = torch.arange(len(self.past), 0, -1, device=age.device)[:, None]  # how many calls ago
        sent = torch.where((last <= age)[:, None], self.past, torch.nan)
        return {"sent": sent, "left": self.left(time)}

    def left(self, time: Tensor) -> Tensor:
        """(6, B) the share that each actuator gives of what it is told."""
        drawn = self.drawn
        return torch.where(drawn.fails & (time >= drawn.fails_from), drawn.strength, 1.0)


def milliseconds(time: Tensor) -> Tensor:
    """(B,) s as int64."""
    return (1000.0 * time).round().long()

"""The plant: what body, actuators, sensors and computer do that the filter is not told.

`PlantParameters` describes the possible differences from the model. `Plant` holds what was drawn for each episode of a
batch. Everything random follows, by a hash, from one number per episode, drawn like its initial state, and from the
episode's time. So an episode does not depend on the others in its batch, and it resumes where it stopped.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.fixed import Fixed
from inspection.model.attitude import rate_in_hill
from inspection.model.draws import counter_based_uniform, isotropic, key_of
from inspection.model.dynamics import Body, integrate, step
from inspection.model.parameters import Limits
from inspection.model.state import CONTROL_SIZE, CONTROLS, OMEGA, SIZE, THRUST, TORQUE, Q
from inspection.world.corners import (
    BEFORE,
    CORNER,
    ERRORS,
    FIRST,
    GAINS,
    MISSED,
    Adversary,
    displaced,
    wandering_ends,
)
from inspection.world.parameters import PlantParameters, Range, bounds


class PlantSample(NamedTuple):
    """Describes the plants of episodes; the last axis is the episodes, k.

    Attributes:
        body: (7, k) mass in kg, moments of inertia in kg m^2, acceleration in Hill's frame in m/s^2.
        thrust: (3, 3, k) from the thrust of each axis to the acting thrust, without unit; torque: (3, k). At a corner
            both are without the gains, which are the corner's.
        minimum, quantum: (k,) N.
        fails: (6, k) bool; fails_from: (k,) s; strength: (k,) share that is left.
        noise: (12, k) 1 sigma of position, velocity, attitude, rates in m, m/s, rad, rad/s; bias: (12, k). At a
            corner there is no noise, and the bias is the size of the error of each axis, bias + noise_bound sigma.
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


def sample_plant(parameters: PlantParameters, c: Limits, key: Tensor) -> PlantSample:
    """Returns the plants that follow from the episodes' keys (k,).

    Each quantity has numbers of its own, whatever else is set. At a corner a factor is one end of its range, and a size
    is the largest of its range.
    """
    rows = iter(counter_based_uniform(key, torch.full_like(key, BEFORE), FIRST))
    at_corner = parameters.errors != "drawn"

    def within(value: Range) -> Tensor:
        low, high = bounds(value)
        return low + (high - low) * next(rows)

    def factor(value: Range) -> Tensor:
        low, high = bounds(value)
        number = next(rows)
        return low + (high - low) * (number.round() if at_corner else number)

    def size(value: Range) -> Tensor:
        return within(bounds(value)[1] if at_corner else value)

    def each(value: Range, drawn: Callable[[Range], Tensor]) -> Tensor:
        return torch.stack([drawn(value) for _ in range(3)])

    def direction() -> Tensor:
        return isotropic(torch.stack((next(rows), next(rows))))

    p = parameters
    mass = c.mass * factor(p.mass_factor)
    inertia = each(p.inertia_factor, factor) * mass.new_tensor(c.inertia)[:, None]
    push = size(p.acceleration) * direction()
    along, torque = (each(1.0 if at_corner else gain, within) for gain in (p.thrust_gain, p.torque_gain))
    tilt, side = each(p.thrust_misalignment, size).deg2rad(), each((0.0, 2 * math.pi), within)
    thrust = mass.new_zeros(3, 3, mass.numel())
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        thrust[i, i] = along[i] * tilt[i].cos()
        thrust[j, i] = along[i] * tilt[i].sin() * side[i].cos()
        thrust[k, i] = along[i] * tilt[i].sin() * side[i].sin()
    minimum, quantum = size(p.minimum_thrust), size(p.thrust_quantum)
    names = torch.arange(CONTROL_SIZE, device=key.device)[:, None]
    chance = next(rows)
    first, count = {"thrust": (0, 3), "torque": (3, 3), "any": (0, 6), "none": (0, 0)}.get(
        p.failing, (CONTROLS.index(p.failing) if p.failing in CONTROLS else 0, 1)
    )
    fails = (names == first + (count * chance).long()) & (count > 0)
    fails_from, strength = within(p.failing_from), within(p.failing_strength)
    to_si = mass.new_tensor([1.0, 1.0, math.radians(1.0), math.radians(1.0)])[:, None]
    kinds = ("position", "velocity", "attitude", "rate")
    sigma = torch.stack([size(getattr(p, f"{kind}_noise")) for kind in kinds]) * to_si
    biases = torch.stack([size(getattr(p, f"{kind}_bias")) for kind in kinds]) * to_si
    bias, noise = torch.cat([each * direction() for each in biases]), sigma.repeat_interleave(3, 0)
    if at_corner:
        bias = biases.repeat_interleave(3, 0) + p.noise_bound * noise
        noise = torch.zeros_like(noise)
    low, high = bounds(p.latency)
    age = factor((0, high - low)) if at_corner else (high - low + 1) * next(rows)
    return PlantSample(
        body=torch.cat((mass[None], inertia, push)),
        thrust=thrust,
        torque=torque,
        minimum=minimum,
        quantum=quantum,
        fails=fails,
        fails_from=fails_from,
        strength=strength,
        noise=noise,
        bias=bias,
        latency=low + age.long(),
        misses=within(p.missed_calls),
    )


class Plant(Fixed):
    """Holds the plants of a batch of episodes, with their actuators, sensors and computers.

    Args:
        parameters: the differences from the model; c: the model.
        batch: episodes, B.

    Attributes:
        every: s between two calls; acts_for: s of a step of the plant. The owner of the clocks sets both.
        drawn: what each episode's plant is; corner: (19, B) bool, the present corner, see `inspection.world.corners`.
        adversary: chooses the corner if `errors` is "worst"; None: chance does.
        held: (6, B) the last control that a call gave; missed: (B,) calls missed since.
        past: (latency, 6, B) the controls held from the last calls on, the oldest first.
        true, seen: (16, B) the states last sensed, and their measurements.

    Raises:
        ValueError: the parameters do not fit the model.
    """

    FIXED = ("parameters", "c")
    STATE: tuple[str, ...] = ("key", "held", "missed", "history", "past")
    is_recordable = True  # all operations of `integrate` can be recorded

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
        self.corner = torch.zeros(CORNER, batch, dtype=torch.bool, device=device)
        self.adversary: Adversary | None = None
        self.at_corner, self.is_worst = parameters.errors != "drawn", parameters.errors == "worst"
        gains = (bounds(each) for each in (parameters.thrust_gain, parameters.torque_gain) for _ in range(3))
        self.gains = self.held.new_tensor(list(gains))  # (6, 2) low and high
        self.drawn = sample_plant(parameters, c, self.key)
        self.true = self.seen = self.held[:0]  # no state yet
        self.limit = self.held.new_tensor(c.control_limit)[:, None]

    def begin(self, columns: Tensor, x: Tensor, number: Tensor | None) -> None:
        """Begins episodes in the given columns, in states (16, k) and from a number in [0, 1) each, (k,)."""
        assert number is not None
        self.key[columns] = key_of(number)
        self.held[:, columns] = 0.0
        self.past[..., columns] = 0.0
        self.missed[columns] = 0
        sample = sample_plant(self.parameters, self.c, self.key[columns])
        for whole, part in zip(self.drawn, sample, strict=True):
            whole[..., columns] = part
        self.true = self.seen = self.held[:0]

    def state_dict(self) -> dict[str, Tensor]:
        """Returns what a resumed run needs; the rest follows from it."""
        return {name: getattr(self, name).clone() for name in self.STATE}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores `state_dict`; raises KeyError or ValueError if it does not fit."""
        for name in self.STATE:
            if getattr(self, name).shape != state[name].shape:
                raise ValueError(f"plant {name} is {tuple(state[name].shape)}")
            setattr(self, name, state[name].clone())
        self.drawn = sample_plant(self.parameters, self.c, self.key)
        self.true = self.seen = self.held[:0]

    @property
    def turns(self) -> bool:
        """Checks whether a state's body rates are relative to the stars, as a gyro's are."""
        return self.parameters.hill_rotation or self.parameters.simulator == "basilisk"

    @property
    def body(self) -> Tensor:
        """Returns the bodies (7, B) that `integrate` takes."""
        return self.drawn.body

    def integrate(self, x: Tensor, u: Tensor, body: Tensor, duration: float, times: int = 1) -> Tensor:
        """Returns the states (16, B) after `times` steps of `duration` s.

        Args:
            x: states (16, B); u: acting controls (6, B); body: the bodies (7, B).
        """
        return integrate(x, u, duration, self.c, times, self._body(body))

    def read(self, x: Tensor, u: Tensor, body: Tensor, duration: Tensor) -> Tensor:
        """Returns the states (16, B) a duration in s (B,) after a step began; other arguments as in `integrate`."""
        return step(x, u, duration, self.c, self._body(body))

    def _body(self, body: Tensor) -> Body:
        """Returns a body (7, B) as the equations of motion take it."""
        mass, *rest = body.unbind(0)
        saturates = self.c.saturate_rates and self.parameters.saturate_rates
        return Body(mass, rest[:3], rest[3:], self.turns or self.c.hill_rotation, saturates)

    def actuate(self, time: Tensor, u: Tensor) -> Tensor:
        """Returns what acts from the episodes' time (B,) in s on if u (6, B) is commanded."""
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
            left = torch.where(drawn.fails & (time >= drawn.fails_from), drawn.strength, 1.0)
            u = left * u
        if self.at_corner:
            u = torch.where(self.corner[GAINS], self.gains[:, 1:], self.gains[:, :1]) * u
        thrust = (drawn.thrust * u[THRUST]).sum(1)
        return torch.cat((thrust, drawn.torque * u[TORQUE]))

    def sense(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns the states seen for true states x (16, B) at the episodes' time (B,) in s; the same at every call."""
        if x is self.true:
            return self.seen
        seen = self._measure(time, x)
        if len(self.history) > 1:
            call, columns = (time / self.every).round().long(), torch.arange(x.shape[1], device=x.device)
            self.history[call % len(self.history), :, columns] = seen.T
            past = (call - self.drawn.latency).clamp(min=0)  # no state is older than the first call's
            seen = self.history[past % len(self.history), :, columns].T
        self.true, self.seen = x, seen
        return seen

    def _measure(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns the states (16, B) with the sensors' errors, rates relative to the frame that the filter expects."""
        if self.at_corner:
            self.corner = torch.cat((self._ends(time, x), self.corner[MISSED:]))
            error = torch.where(self.corner[ERRORS], self.drawn.bias, -self.drawn.bias)
        else:
            bound = self.parameters.noise_bound
            numbers = counter_based_uniform(self.key, (1000.0 * time).round().long(), 12)
            error = self.drawn.bias + self.drawn.noise * torch.special.ndtri(numbers).clamp(-bound, bound)
        seen = displaced(x, error)
        if self.turns and not self.c.hill_rotation:  # the model does not know that Hill's frame turns
            attitude = seen[Q]
            if self.at_corner:  # the attitude's error must not bring the error of the rates beyond its bound
                attitude = x[Q]
            seen[OMEGA] = torch.stack(rate_in_hill(attitude, seen[OMEGA], self.c.mean_motion))
        return seen

    def _ends(self, time: Tensor, x: Tensor) -> Tensor:
        """Returns the corner (18, B) bool for a measurement of x.

        An adversary chooses the gains later, with its response to the control.
        """
        if not self.is_worst:
            before = torch.full_like(self.key, BEFORE)
            return counter_based_uniform(self.key, before, GAINS.stop, FIRST) < 0.5
        if self.adversary is None:
            return wandering_ends(self.key, time)
        return torch.cat((self.adversary.errors(time, x), self.corner[GAINS]))

    def hold(self, time: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the control held from a call on, and whether the call is missed, (B,) bool.

        The held control is u (6, B), or the last one if the call is missed. The first call of an episode is never
        missed, since there is no last control.
        """
        possible = (time > 0.0) & (self.missed < self.parameters.missed_in_a_row) & (self.drawn.misses > 0.0)
        if self.is_worst and self.adversary:
            otherwise = torch.where(possible, self.held, u)
            response = self.adversary.response(time, self.true, u, otherwise)
            missed = possible & response[-1]
            self.corner = torch.cat((self.corner[ERRORS], response))
        else:
            chance = counter_based_uniform(self.key, (1000.0 * time).round().long(), 1, first=12)[0]
            missed = possible & (chance < self.drawn.misses)
            self.corner = torch.cat((self.corner[:MISSED], missed[None]))
        self.missed = torch.where(missed, self.missed + 1, 0)
        self.held = torch.where(missed, self.held, u)
        if len(self.past):
            self.past = torch.cat((self.past[1:], self.held[None]))
        return self.held, missed

    def filter_inputs(self, time: Tensor) -> dict[str, Tensor]:
        """Returns the controls held since the state was measured, NaN for calls before its measurement."""
        age = self.drawn.latency.minimum((time / self.every).round().long())
        last = torch.arange(len(self.past), 0, -1, device=age.device)[:, None]  # age of each control in calls
        sent = torch.where((last <= age)[:, None], self.past, torch.nan)
        return {"sent": sent}

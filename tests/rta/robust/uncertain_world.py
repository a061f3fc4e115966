"""The world of U1 at its worst, and flights in it: what the cone and the terminal set are compared with."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from inspection.model.dynamics import Body
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, THRUST, TORQUE, P, V
from inspection.world.corners import displaced
from inspection.world.uncertainty import Uncertainty
from rta.check.commit import LIMITS, NoCheckError, only
from rta.robust.check import RobustCheck
from rta.robust.prediction import predicted
from rta.robust.terminal_set import RobustTerminalSet, thrust
from tests.oracles import motion, moved

C, PERIOD = InspectionParameters(), 1.0  # s
U1 = Uncertainty(
    mass=0.1,
    inertia=0.2,
    thrust_gain=0.05,
    torque_gain=0.05,
    thrust_misalignment=1.0,
    acceleration=1e-5,
    position=0.6,
    velocity=0.006,
    attitude=0.3,
    rate=0.03,
    latency=1,
    longest_hold=3.0,
    hill_rotation=True,
)
FINE = Uncertainty(latency=1, longest_hold=1.0, position=0.1, velocity=0.001, thrust_misalignment=1.0)
ROUNDED = replace(FINE, thrust_quantum=0.1)  # with thrusters that give some values only
LOOK = 0.5  # s
Law = Callable[[Tensor, Tensor, Tensor], Tensor]  # states, torque and error bounds to thrust


class World:
    """U1's world, in which everything that may be wrong is at its bound.

    Args:
        batch: spacecraft; seed: of what each has for good: mass, moments, a push, the tilt of its thrusters.
        how: steady: errors and gains stay; worst: they change at each call, towards the chief or the edge of the zone.
        misses: calls missed after each: always two, or at random.
    """

    def __init__(self, batch: int, seed: int, how: str, misses: str, uncertainty: Uncertainty = U1) -> None:
        self.generator, self.how, self.misses = torch.Generator().manual_seed(seed), how, misses
        self.uncertainty, self.batch = uncertainty, batch
        sign = self.signs
        push = torch.randn(3, batch, generator=self.generator, dtype=torch.float64)
        push = uncertainty.acceleration * push / push.norm(dim=0)
        inertia = torch.tensor(C.inertia, dtype=torch.float64)[:, None] * (1 + uncertainty.inertia * sign(3))
        self.body = Body(
            C.mass * (1 + uncertainty.mass * sign(1)[0]),
            list(inertia),
            list(push),
            uncertainty.hill_rotation,
            False,
        )
        self.gains = 1 + uncertainty.thrust_gain * sign(3)
        self.turns = 1 + uncertainty.torque_gain * sign(3)
        tilt, side = np.radians(uncertainty.thrust_misalignment), 2 * np.pi * self.uniform(3)
        self.aslant = torch.zeros(3, 3, batch, dtype=torch.float64)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            self.aslant[i, i] = np.cos(tilt)
            self.aslant[j, i], self.aslant[k, i] = np.sin(tilt) * side[i].cos(), np.sin(tilt) * side[i].sin()
        self.errors = sign(12)
        self.torque = C.max_torque * sign(3)

    def uniform(self, count: int) -> Tensor:
        return torch.rand(count, self.batch, generator=self.generator, dtype=torch.float64)

    def signs(self, count: int) -> Tensor:
        return 2 * self.uniform(count).round() - 1

    def sees(self, x: Tensor, w: RobustTerminalSet) -> Tensor:
        """Returns a measurement of true states (16, B), each error at its bound."""
        if self.how == "worst":
            # velocity is seen so that the law lets the spacecraft drift to where it must not: nearer, or farther out
            inwards = torch.where(x[P].norm(dim=0) < 400.0, 1.0, -1.0)
            self.errors[:3], self.errors[3:6] = (x[P] * inwards).sign(), (x[P] * inwards).sign()
        radii = torch.tensor(self.uncertainty.radii, dtype=torch.float64)
        sizes = (radii / 3.0**0.5).repeat_interleave(3)[:, None]
        return displaced(x, self.errors * sizes)

    def asks_torque(self, x: Tensor) -> Tensor:
        """Returns torque (3, B) in N m that turns the body as fast as allowed, sometimes in the other direction."""
        self.torque = torch.where(self.uniform(3) < 0.1, -self.torque, self.torque)
        limit = C.max_rate - 3 * 1.3 * C.max_torque / min(C.inertia)
        rates = x[OMEGA]
        slow = torch.where(rates.abs() > limit, -rates.sign() * C.max_torque, self.torque)
        return torch.where((rates.abs() > limit) & (rates.sign() != self.torque.sign()), self.torque, slow)

    def acts(self, x: Tensor, u: Tensor) -> Tensor:
        """Returns the acting control (6, B) for a command u."""
        if self.how == "worst":
            self.gains = torch.where(self.uniform(3) < 0.5, self.gains, 2 - self.gains)
        given = (
            self.uncertainty.quantised(u[THRUST], C.max_thrust)
            if self.uncertainty.is_quantised
            else u[THRUST]
        )
        force = (self.aslant * (self.gains * given)).sum(1)
        return torch.cat((force, self.turns * u[TORQUE]))

    def held_for(self) -> int:
        """Calls that all of them are held for."""
        if self.misses == "always":
            return round(self.uncertainty.longest_hold)
        return int(torch.randint(1, 4, (1,), generator=self.generator))


def flown(
    x: Tensor,
    w: RobustTerminalSet,
    world: World,
    seconds: float,
    spacing: float | None,
    law: Law | None = None,
) -> tuple[ndarray, Tensor, list[Tensor]]:
    """Returns the least of the seven limits (7, B) on a flight of the law, the last states, and those of each call.

    Args:
        spacing: s, between two looks at free flight, which is looked at in every call; None: it is not.
    """
    least = np.full((7, x.shape[1]), np.inf)
    measured, sent, time, states = world.sees(x, w), None, 0.0, []
    none = torch.zeros(4, x.shape[1], dtype=x.dtype)
    while time < seconds:
        states.append(x.clone())
        taken, bound = measured, none
        if sent is not None:
            taken, bound = predicted(measured, none, sent, C, PERIOD, w.uncertainty)
        u = torch.zeros(6, x.shape[1], dtype=x.dtype)
        u[TORQUE] = world.asks_torque(taken)
        u[THRUST] = law(taken, u[TORQUE], bound) if law else thrust(taken, u[TORQUE], w)
        for _ in range(world.held_for()):
            measured, sent = world.sees(x, w), u
            acting = world.acts(x, u)
            for _ in range(round(w.period / LOOK)):
                x = moved(x, acting, LOOK, C, world.body)
                time += LOOK
                least = np.minimum(least, motion(x[P].numpy(), x[V].numpy(), C, spacing))
    return least, x, states


def of_thrust(c: InspectionParameters, period: float, uncertainty: Uncertainty) -> RobustCheck:
    """Returns the check of thrust alone; raises NoCheckError where there is no invariant set."""
    return alone(c, period, uncertainty, 0)


def of_torque(c: InspectionParameters, period: float, uncertainty: Uncertainty) -> RobustCheck:
    """Returns the check of torque alone; raises NoCheckError where there is no backup trajectory."""
    return alone(c, period, uncertainty, 1)


def alone(c: InspectionParameters, period: float, uncertainty: Uncertainty, group: int) -> RobustCheck:
    """Returns the check of one group alone."""
    check = RobustCheck(c, period, uncertainty)
    if not check.knows[group]:
        raise NoCheckError(check.reason)
    object.__setattr__(check, ("attitude", "terminal_set")[group], None)
    return check


def committed(
    check: RobustCheck, group: int, x: Tensor, u: Tensor, bound: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the applied controls (6, B) for proposed ones, and whether a group's are safe, and changed."""
    y = torch.cat((x, bound))
    control, safe, changed = check.committed(y, u, *check.fit(y, y))
    return control, safe[group], changed[group]


def is_safe(check: RobustCheck, group: int, y: Tensor, u: Tensor) -> Tensor:
    """Tells where (B,) a group of controls (6, B) is safe."""
    none = torch.zeros_like(y[:LIMITS], dtype=torch.bool)
    return check.is_safe(y, u, none, only(group, none))[group]

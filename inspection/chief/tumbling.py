"""A tumbling chief without torques: Euler's equations and the kinematics of its attitude."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from inspection.model.attitude import quaternion_rate, rate_in_hill, unit
from inspection.model.draws import counter_based_uniform, isotropic, key_of, shoemake
from inspection.model.dynamics import euler
from inspection.model.parameters import ChiefParameters, Model
from inspection.model.rk4 import rk4_step

ANGLE = 0.05  # rad, the largest turn in an RK4 step; the error of a step is about ANGLE^5 / 120, 3e-9 rad
NUMBERS = -2  # the time in ms that stands for an episode's draws of the chief; no other draws use it
ATTITUDE, RATE, TIME = slice(0, 4), slice(4, 7), 7  # components of a motion


class Tumbling:
    """Turns the chiefs of a batch of episodes.

    Args:
        parameters: attitude, rate and moments; c: the task; batch: episodes, B.

    Attributes:
        motion: (8, B) attitude from the chief's axes to Hill's, rates about the chief's axes in rad/s, and the time of
            the episode in s at which both hold.
    """

    def __init__(
        self,
        parameters: ChiefParameters,
        c: Model,
        batch: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.parameters, self.c = parameters, c
        self.motion = torch.zeros(8, batch, dtype=torch.float64, device=device)
        self.motion[3] = 1.0

    @property
    def fastest(self) -> float:
        """Returns the largest rate in rad/s at which the chief may come to turn.

        The energy sum J w^2 / 2 is constant. So |w|^2 grows at most by the ratio of the largest to the smallest moment.
        """
        p, c = self.parameters, self.c
        given = math.radians(max(p.largest_rate, math.hypot(*p.rate)))
        own = given * math.sqrt(max(p.moments) / min(p.moments))
        return own + (c.mean_motion if p.turns and c.hill_rotation else 0.0)

    @property
    def attitude(self) -> Tensor:
        """Returns the attitude (4, B) from the chief's axes to Hill's, scalar last."""
        return self.motion[ATTITUDE]

    def begin(self, columns: Tensor, number: Tensor | None) -> None:
        """Begins episodes in the given columns.

        Args:
            number: (k,) in [0, 1), from which everything random follows; may be None if nothing is drawn.
        """
        p, motion = self.parameters, self.motion.clone()
        q = motion.new_tensor(p.attitude)
        motion[:, columns] = 0.0
        motion[ATTITUDE, columns] = unit(q)[:, None].expand(4, len(columns))
        motion[RATE, columns] = motion.new_tensor(p.rate).deg2rad()[:, None].expand(3, len(columns))
        if p.is_drawn:
            assert number is not None
            key = key_of(number)
            draws = counter_based_uniform(key, torch.full_like(key, NUMBERS), 6)
            if p.random_attitude:
                motion[ATTITUDE, columns] = shoemake(draws[:3])
            if p.largest_rate:
                motion[RATE, columns] = math.radians(p.largest_rate) * draws[3] * isotropic(draws[4:6])
        self.motion = motion

    def at(self, time: Tensor) -> None:
        """Moves all chiefs on to the episodes' time (B,) in s."""
        self.motion = self.moved(self.motion, time)

    def moved(self, motion: Tensor, time: Tensor) -> Tensor:
        """Returns a motion (8, B) at another time (B,) in s.

        A chief without a rate keeps its attitude in Hill's frame.
        """
        seconds = time - motion[TIME]
        steps = math.ceil(float(seconds.abs().max()) * self.fastest / ANGLE)
        turns = self.c.mean_motion if self.c.hill_rotation else None
        y = motion[: RATE.stop]
        for _ in range(steps):
            y = self.step(y, seconds / steps, turns)
        return torch.cat((y, time[None]))

    def step(self, y: Tensor, seconds: Tensor, turns: float | None) -> Tensor:
        """Returns attitude and rates (7, B) after one RK4 step."""

        def rate(y: Sequence[Tensor]) -> tuple[Tensor, ...]:
            q, omega = y[ATTITUDE], y[RATE]
            relative = omega if turns is None else rate_in_hill(q, omega, turns)
            return *quaternion_rate(q, relative), *euler(omega, self.parameters.moments)

        y = torch.stack(rk4_step(rate, y.unbind(0), seconds))
        return torch.cat((unit(y[ATTITUDE]), y[RATE]))

"""How a state at a moment of a hold changes with that at its beginning and with the control, to first order in n t."""

from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import rotation_matrix
from inspection.model.orbit import orbit_rate
from inspection.model.parameters import Limits
from inspection.model.state import THETA_S, Q
from rta.qp.programs import total


class Maps(NamedTuple):
    """How a state at a moment of a hold changes with that at its beginning and with the control.

    Attributes:
        moment: s; turned, once: (3, 3, B) the integrals of R(s) and s R(s) up to it; to_end: (3, 3, B) from Hill's
            frame into the body's there.
    """

    x: Tensor
    moment: float
    turned: Tensor
    once: Tensor
    to_end: Tensor
    c: Limits

    def by_state(self, by_end: Tensor, held_by: str, coupled: bool) -> Tensor:
        """Derivatives (R, D, B) along `directions` at the moment to those along them at the beginning."""
        parts = list(by_end.split(3, 1))
        if coupled or held_by == "thrust":
            parts[1] = parts[1] + self.moment * (parts[0] + self.coriolis(parts[1]))
        if coupled or held_by == "torque":
            attitude, rate = parts[-2:]
            hill = times(attitude, self.to_end)
            parts[-2] = times(hill, rotation_matrix(self.x[Q]))
            parts[-1] = rate + times(hill, self.turned)
        return torch.cat(parts, 1)

    def coriolis(self, velocity: Tensor) -> Tensor:
        """Derivatives (R, 3, B) by velocity to those by what Hill's turning frame adds to it in a second."""
        x, y, z = velocity.unbind(1)
        return 2 * orbit_rate(self.x[THETA_S], self.c) * torch.stack((-y, x, torch.zeros_like(z)), 1)

    def by_control(self, by_end: Tensor, held_by: str, coupled: bool) -> Tensor:
        """Derivatives along `directions` at the moment to those by controls, (R, m, B)."""
        parts = by_end.split(3, 1)
        both = []
        if coupled or held_by == "thrust":
            position, velocity = parts[:2]
            later = self.moment * self.turned - self.once  # the integral of (t - s) R(s)
            both.append(
                (times(velocity, self.turned) + times(position + self.coriolis(velocity), later))
                / self.c.mass
            )
        if coupled or held_by == "torque":
            attitude, rate = parts[-2:]
            moments = self.x.new_tensor(self.c.inertia)[:, None]
            both.append((times(times(attitude, self.to_end), self.once) + self.moment * rate) / moments)
        return torch.cat(both, 1)


def times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Rows (R, 3, B) times matrices (3, 3, B)."""
    return total(rows[:, :, None] * matrix, 1)

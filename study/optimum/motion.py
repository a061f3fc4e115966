"""The deputy's translation as a linear map of its thrust, exact where thrust is held in Hill's frame."""

from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.model.orbit import clohessy_wiltshire
from inspection.model.parameters import Model


def system(n: float) -> Tensor:
    """A (6, 6) of d/dt (p, v) = A (p, v), in 1/s, from the simulator's own Clohessy-Wiltshire acceleration."""
    unit = torch.eye(6, dtype=torch.float64)
    return torch.cat((unit[3:], torch.stack(clohessy_wiltshire(unit[:3], unit[3:], n))))


def held(seconds: float, c: Model) -> tuple[Tensor, Tensor]:
    """What (p, v) in m and m/s becomes in some s: of itself (6, 6), and of a thrust in N held in Hill's frame (6, 3).

    The exponential of the system beside its constant input (Van Loan 1978).
    """
    whole = torch.zeros(9, 9, dtype=torch.float64)
    whole[:6, :6] = system(c.mean_motion)
    whole[3:6, 6:] = torch.eye(3, dtype=torch.float64) / c.mass
    end = torch.matrix_exp(whole * seconds)
    return end[:6, :6], end[:6, 6:]


@dataclass(frozen=True)
class Motion:
    """The knots k T, k = 1..K, of flights whose thrust is held for T s at a time.

    Attributes:
        free: (K 6, 6), their (p, v) in m and m/s of those at the start.
        forced: (K 6, K 3), of the thrusts in N.
    """

    free: Tensor
    forced: Tensor

    @classmethod
    def of(cls, knots: int, seconds: float, c: Model) -> "Motion":
        """K knots, so many s apart."""
        step, push = held(seconds, c)
        free = [step]
        for _ in range(knots - 1):
            free.append(step @ free[-1])
        answers = torch.cat([push, *(power @ push for power in free[:-1])])  # of one thrust, from its end on
        forced = torch.zeros(6 * knots, 3 * knots, dtype=torch.float64)
        for k in range(knots):
            forced[6 * k :, 3 * k : 3 * k + 3] = answers[: 6 * (knots - k)]
        return cls(torch.cat(free), forced)

    def states(self, start: Tensor, thrust: Tensor) -> Tensor:
        """(p, v) at the knots, (K, 6, B), from those at the start (6, B) and thrusts (K, 3, B) in N, Hill's frame."""
        return (self.free @ start + self.forced @ thrust.flatten(0, 1)).unflatten(0, (-1, 6))

    def to(self, dtype: torch.dtype) -> "Motion":
        """The same in another precision."""
        return Motion(self.free.to(dtype), self.forced.to(dtype))

"""PPO-Lagrangian: a penalty on costs that rises until costs are as rare as allowed (Ray et al. 2019, sec. 4)."""

import torch
from torch import Tensor, nn

# The penalty is in units of reward per cost of one step; a step of the task earns about 0.01. Untrained agents violate
# limits hundreds of times more often than allowed. Their excess counts as 1, so that the integral falls as fast as it
# rose.
PROPORTIONAL_GAIN = 0.03
INTEGRAL_GAIN = 0.003  # per update
LEAST_LIMIT = 1e-6  # smallest divisor of an excess, so that a limit of 0 has a finite penalty


class Multiplier(nn.Module):
    """Holds the Lagrange multiplier of S seeds under PI control (Stooke et al. 2020, algorithm 2, without derivative).

    Its error is the excess of costs in units of their limit, and at most 1. At a limit of 0 the penalty never falls.

    Attributes:
        value: (S,), never negative; 0 at first.
    """

    def __init__(self, limit: float, seeds: int, device: torch.device) -> None:
        super().__init__()
        self.limit = limit
        self.integral: Tensor = nn.Buffer(torch.zeros(seeds, device=device))
        self.value: Tensor = nn.Buffer(torch.zeros(seeds, device=device))

    def update(self, cost: Tensor) -> None:
        """Adapts the multiplier to the mean cost per step (S,) of a batch."""
        excess = ((cost - self.limit) / max(self.limit, LEAST_LIMIT)).clamp(max=1.0)
        # I = (I + K_I Delta)^+, lambda = (K_P Delta + I)^+
        self.integral = (self.integral + INTEGRAL_GAIN * excess).clamp(min=0.0)
        self.value = (PROPORTIONAL_GAIN * excess + self.integral).clamp(min=0.0)

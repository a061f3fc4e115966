"""A penalty on how far an update moves the policy, which adapts to a target (Schulman et al. 2017, sec. 4)."""

import torch
from torch import Tensor, nn

# RLlib's: factors of the target beyond which the penalty changes, and the penalty's factors then
FAR, NEAR, RISE, FALL = 2.0, 0.5, 1.5, 0.5


def divergence(mean: Tensor, log_std: Tensor, new_mean: Tensor, new_log_std: Tensor) -> Tensor:
    """Returns KL(old || new) in nats, (S, B), of diagonal Gaussians over A controls, each (S, B, A)."""
    # sum of log(sigma' / sigma) + (sigma^2 + (mu - mu')^2) / (2 sigma'^2) - 1 / 2
    squares = (2.0 * log_std).exp() + (mean - new_mean).square()
    return (new_log_std - log_std + 0.5 * squares * (-2.0 * new_log_std).exp() - 0.5).sum(-1)


class KLPrice(nn.Module):
    """Holds the penalty on KL(old || new) in the loss of S seeds, per nat.

    Attributes:
        value: (S,).
    """

    def __init__(self, first: float, target: float, seeds: int, device: torch.device) -> None:
        super().__init__()
        self.target = target
        self.value: Tensor = nn.Buffer(torch.full((seeds,), first, device=device))

    def update(self, kl: Tensor) -> None:
        """Adapts the penalty to the mean divergence (S,) of an update in nats."""
        self.value = torch.where(kl > FAR * self.target, RISE * self.value, self.value)
        self.value = torch.where(kl < NEAR * self.target, FALL * self.value, self.value)

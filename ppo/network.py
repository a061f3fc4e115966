"""Gaussian policy and value networks whose parameters carry a leading seed axis S.

Seed k of a stacked network is exactly the network that seed k alone would have: every draw for seed k comes from
generators[k], and no operation mixes seeds.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ppo.parameters import log_std_bias

HIDDEN_GAIN = math.sqrt(2.0)
POLICY_GAIN = 0.01  # small, so that the first policy hardly depends on the observation
VALUE_GAIN = 1.0


class StackedLinear(nn.Module):
    """Applies S independent affine maps: weight (S, inputs, outputs), bias (S, 1, outputs).

    The weight of seed k is orthogonal, scaled by `gain` and drawn from generators[k]; the bias is zero.
    """

    def __init__(self, inputs: int, outputs: int, generators: Sequence[torch.Generator], gain: float) -> None:
        super().__init__()
        weights = [
            torch.empty(inputs, outputs, device=each.device, dtype=torch.float32) for each in generators
        ]
        for weight, generator in zip(weights, generators, strict=True):
            nn.init.orthogonal_(weight, gain, generator=generator)
        self.weight = nn.Parameter(torch.stack(weights))
        self.bias = nn.Parameter(torch.zeros_like(self.weight[:, :1]))

    def forward(self, x: Tensor) -> Tensor:
        """Maps (S, B, inputs) to (S, B, outputs)."""
        outputs = self.weight.shape[2]
        if outputs > 1:
            return torch.baddbmm(self.bias, x, self.weight)
        # A single seed sums a matrix-vector product in another order than a stack; with two columns the orders agree.
        return torch.baddbmm(self.bias, x, nn.functional.pad(self.weight, (0, 1)))[..., :1]


class StackedMLP(nn.Module):
    """Applies S independent perceptrons: tanh after every hidden layer, a linear last layer.

    `sizes` lists the widths from input to output and `gains` the orthogonal gain of each layer, one fewer. Parameters
    start on the generators' device.
    """

    def __init__(
        self, sizes: Sequence[int], generators: Sequence[torch.Generator], gains: Sequence[float]
    ) -> None:
        super().__init__()
        self.layers: Sequence[StackedLinear] = nn.ModuleList(  # type: ignore[assignment]  # of one kind
            StackedLinear(inputs, outputs, generators, gain)
            for inputs, outputs, gain in zip(sizes[:-1], sizes[1:], gains, strict=True)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Maps (S, B, sizes[0]) to (S, B, sizes[-1]), in single precision whatever `torch.autocast` says."""
        *hidden, last = self.layers
        with torch.autocast(x.device.type, enabled=False):
            for layer in hidden:
                x = torch.tanh(layer(x))
            return last(x)


def draw_noise(generators: Sequence[torch.Generator], shape: Sequence[int], device: torch.device) -> Tensor:
    """Returns standard normal noise (S, *shape) on `device`, slice k drawn from generators[k] only."""
    draws = [
        torch.randn(shape, generator=each, device=each.device, dtype=torch.float32) for each in generators
    ]
    return torch.stack(draws).to(device)


def gaussian_log_prob(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Returns the log-density (S, B) of actions (S, B, A) under independent Gaussians, summed over A."""
    z = (action - mean) * torch.exp(-log_std)
    # log N(a; mu, sigma) = -z^2 / 2 - log sigma - log(2 pi) / 2
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2.0 * math.pi)).sum(-1)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Returns the differential entropy (S, B) in nats of Gaussians, summed over A."""
    # H = sum over controls of log sigma + (1 + log(2 pi)) / 2
    return (log_std + 0.5 * (1.0 + math.log(2.0 * math.pi))).sum(-1)


def standard_deviation(entropy: float, actions: int) -> float:
    """Returns the geometric mean of a Gaussian's standard deviations over `actions`, from its entropy in nats."""
    return math.exp(entropy / actions - 0.5 * (1.0 + math.log(2.0 * math.pi)))


class Policy(nn.Module):
    """Draws actions from a diagonal Gaussian with mean in (-1, 1) and log-std within `log_std_bounds`, both by state.

    Every layer, also the last, ends in a tanh. Without `tanh_outputs` the last layer is linear; its log-std is clipped
    to the bounds, and its mean action to [-1, 1]. `initial_std` is the standard deviation of the untrained policy at a
    zero observation. `power` shapes the environment's actions, see `shaped`. Raises ValueError if `initial_std` is not
    inside the bounds.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        generators: Sequence[torch.Generator],
        hidden: Sequence[int] = (256, 256),
        log_std_bounds: tuple[float, float] = (-5.0, 0.0),
        initial_std: float = 0.03,
        power: float = 1.0,
        tanh_outputs: bool = True,
    ) -> None:
        super().__init__()
        bias = log_std_bias(initial_std, log_std_bounds) if tanh_outputs else math.log(initial_std)
        self.log_std_bounds, self.tanh_outputs = log_std_bounds, tanh_outputs
        self.power = power
        gains = [HIDDEN_GAIN] * len(hidden) + [POLICY_GAIN]
        self.network = StackedMLP((observation_size, *hidden, 2 * action_size), generators, gains)
        with torch.no_grad():
            self.network.layers[-1].bias[..., action_size:] = bias

    @property
    def seeds(self) -> int:
        """Returns S."""
        return len(self.network.layers[0].weight)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and log-std, each (S, B, A), at observations (S, B, observation_size)."""
        own = observation[..., : self.network.layers[0].weight.shape[1]]  # inputs of a critic may follow
        low, high = self.log_std_bounds
        if not self.tanh_outputs:
            mean, log_std = self.network(own).chunk(2, dim=-1)
            return mean, log_std.clamp(low, high)
        mean, level = torch.tanh(self.network(own)).chunk(2, dim=-1)
        # log std = low + (high - low) (1 + tanh) / 2: unlike a clamp, it always has a gradient
        return mean, low + (high - low) * 0.5 * (1.0 + level)

    @torch.no_grad()
    def sample(self, observation: Tensor, generators: Sequence[torch.Generator]) -> tuple[Tensor, Tensor]:
        """Draws actions (S, B, A), not clipped, with their log-probabilities (S, B); carries no gradient."""
        mean, log_std = self(observation)
        action = mean + log_std.exp() * draw_noise(generators, mean.shape[1:], mean.device)
        # computed from the action, not the noise: so the learner recomputes the same number and starts at ratio one
        return action, gaussian_log_prob(action, mean, log_std)

    def shaped(self, action: Tensor) -> Tensor:
        """Returns the environment's actions for actions a (..., A): sign(a) |a|^k in [-1, 1].

        With power k > 1 noise around zero costs almost nothing, while the full range of an actuator remains within
        reach. With k = 1, as in the paper, actions are unchanged.
        """
        if self.power == 1.0:
            return action
        return action.sign() * action.abs().clamp(max=1.0) ** self.power

    def unshaped(self, control: Tensor) -> Tensor:
        """Returns the actions (..., A) that `shaped` maps to the given ones, which must be within [-1, 1]."""
        if self.power == 1.0:
            return control
        return control.sign() * control.abs() ** (1.0 / self.power)

    @torch.no_grad()
    def mean_action(self, observation: Tensor) -> Tensor:
        """Returns the deterministic action (S, B, A), shaped from the mean, in [-1, 1]; carries no gradient."""
        return self.shaped(self(observation)[0].clamp(-1.0, 1.0))


class Value(nn.Module):
    """Predicts the value of a state, in units of discounted reward."""

    def __init__(
        self,
        observation_size: int,
        generators: Sequence[torch.Generator],
        hidden: Sequence[int] = (256, 256),
    ) -> None:
        super().__init__()
        gains = [HIDDEN_GAIN] * len(hidden) + [VALUE_GAIN]
        self.network = StackedMLP((observation_size, *hidden, 1), generators, gains)

    def forward(self, observation: Tensor) -> Tensor:
        """Returns values (S, B) at observations (S, B, observation_size)."""
        return self.network(observation).squeeze(-1)

"""Settings of the learner: the table `[ppo]`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from settings import Settings, setting

MAX_WIDTH = 65_536  # of a hidden layer
LARGEST_WEIGHT = 1e3  # of a term of the loss; far larger weights overflow the gradient


@dataclass(frozen=True)
class PPOParameters(Settings):
    """Holds the settings of the learner."""

    gamma: float = setting(0.999, "discount per step", above=0, most=1)
    gae_lambda: float = setting(
        0.97, "GAE's lambda: 0 trusts the value network, 1 the observed returns", most=1
    )
    epochs: int = setting(4, "passes over each batch", above=0)
    minibatch_size: int = setting(1024, "largest number of samples of a gradient step, per seed", least=2)
    learning_rate: float = setting(3e-4, "Adam's step size at the start", above=0)
    anneal: bool = setting(True, "whether the learning rate falls linearly, to 0 at the end")
    clip: float = setting(0.2, "largest rewarded change of the probability ratio from 1", above=0, below=1)
    value_coefficient: float = setting(
        0.5, "weight of the mean squared value error in the loss", most=LARGEST_WEIGHT
    )
    value_clip: float = setting(
        math.inf,
        "largest squared value error in the loss; above it a sample has no gradient",
        above=0,
        most=math.inf,
    )
    kl_price: float = setting(
        0.0, "first price of the divergence of the policy in an update, per nat", most=LARGEST_WEIGHT
    )
    kl_target: float = setting(0.01, "nats; the price rises above twice of it and falls below half", above=0)
    privileged: bool = setting(
        False, "show the value network, beside the observation, what is left to inspect, and the time"
    )
    cost_limit: float = setting(
        1.0,
        "share of steps that may break a limit; a price rises above it, falls below it (PPO-Lagrangian); 1: no price",
        most=1,
    )
    entropy_coefficient: float = setting(0.0, "weight of the entropy bonus, per nat", most=LARGEST_WEIGHT)
    max_grad_norm: float = setting(
        0.5,
        "largest Euclidean gradient norm, per seed, policy and value together; infinity: no clipping",
        above=0,
        most=math.inf,
    )
    initial_std: float = setting(0.03, "standard deviation of each control before training, in action units")
    log_std_bounds: tuple[float, float] = setting(
        (-5.0, 0.0), "range of the log standard deviation, in nats", least=None
    )
    tanh_outputs: bool = setting(
        True,
        "whether a tanh bounds mean and log standard deviation; if not, they are cut off at their bounds",
    )
    action_power: float = setting(
        1.0, "k of u = sign(a) |a|^k, what is commanded for an action a; 1 is the paper's", least=1, most=10
    )
    hidden: tuple[int, ...] = setting(
        (256, 256), "widths of the hidden layers of policy and value network", above=0, most=MAX_WIDTH
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        log_std_bias(self.initial_std, self.log_std_bounds)  # raises where the two do not fit together


def log_std_bias(std: float, log_std_bounds: Sequence[float]) -> float:
    """Returns the output bias b at which the log-std that a tanh bounds equals log(std).

    Raises ValueError unless the bounds are finite and exp(low) < std < exp(high).
    """
    low, high = log_std_bounds
    if not -math.inf < low < high < math.inf:
        raise ValueError(f"log_std_bounds = {[low, high]}: must be two finite numbers, low < high")
    if not math.exp(low) < std < math.exp(high):
        raise ValueError(
            f"initial_std = {std}: must lie strictly between exp(log_std_bounds), "
            f"here {math.exp(low):.4g} and {math.exp(high):.4g}"
        )
    # log std = low + (high - low) (1 + tanh b) / 2, solved for b
    return math.atanh(2.0 * (math.log(std) - low) / (high - low) - 1.0)

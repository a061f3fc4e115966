"""Generalised advantage estimation (Schulman et al. 2016, eq. 16) over episodes that end in two ways."""

import torch
from torch import Tensor


def generalized_advantage(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    done: Tensor,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Returns (advantage, return_), each (T, ...) like all given tensors, in units of discounted reward.

    next_value[t] is the value of the state that step t led to. Where the episode ended, this is its last state, not the
    one after the reset. `terminated` (bool) marks a true end, beyond which the value is zero. `done` (bool) is
    terminated | truncated. So a truncated step bootstraps from next_value, a terminated one does not, and no advantage
    flows back across either. `gamma` discounts per step, `lam` is GAE's lambda.
    """
    # delta_t = r_t + gamma V(s_{t+1}) - V(s_t), with V(s_{t+1}) = 0 after a termination
    delta = reward + gamma * next_value.masked_fill(terminated, 0.0) - value
    # gamma lambda inside an episode, 0 across its end
    decay = (gamma * lam) * (~done).to(delta.dtype)
    advantage = torch.empty_like(delta)
    following = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        # A_t = delta_t + gamma lambda A_{t+1}
        following = delta[t] + decay[t] * following
        advantage[t] = following
    # R_t = A_t + V(s_t), the lambda-return
    return advantage, advantage + value

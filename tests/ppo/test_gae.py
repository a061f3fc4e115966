"""Generalised advantages against numbers worked out by hand and closed forms."""

import torch
from torch import Tensor

from ppo.gae import generalized_advantage


def trajectory() -> dict[str, Tensor]:
    """Returns twelve steps of three environments, with random ends of both kinds."""
    generator = torch.Generator().manual_seed(0)
    reward, value, next_value = torch.randn(3, 12, 3, generator=generator, dtype=torch.float64)
    terminated, truncated = torch.rand(2, 12, 3, generator=generator) < 0.2
    return {
        "reward": reward,
        "value": value,
        "next_value": next_value,
        "terminated": terminated,
        "done": terminated | truncated,
    }


def test_hand_computed_termination_and_truncation() -> None:
    # gamma = lambda = 1/2, so gamma lambda = 1/4
    # column 0 terminates at step 1: delta = (1 + 2 - 2, 2 - 4, 3 + 4 - 6) = (1, -2, 1)
    # column 1 is truncated there:   delta = (1 + 2 - 2, 2 + 5 - 4, 3 + 4 - 6) = (1, 3, 1)
    advantage, return_ = generalized_advantage(
        reward=torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]),
        value=torch.tensor([[2.0, 2.0], [4.0, 4.0], [6.0, 6.0]]),
        next_value=torch.tensor([[4.0, 4.0], [10.0, 10.0], [8.0, 8.0]]),
        terminated=torch.tensor([[False, False], [True, False], [False, False]]),
        done=torch.tensor([[False, False], [True, True], [False, False]]),
        gamma=0.5,
        lam=0.5,
    )
    assert advantage.tolist() == [[0.5, 1.75], [-2.0, 3.0], [1.0, 1.0]]
    assert return_.tolist() == [[2.5, 3.75], [2.0, 7.0], [7.0, 7.0]]


def test_lambda_one_is_the_discounted_return_with_bootstrap() -> None:
    data = trajectory()
    data["next_value"] = torch.where(data["done"], data["next_value"], data["value"].roll(-1, 0))
    _, return_ = generalized_advantage(**data, gamma=0.9, lam=1.0)
    for column in range(3):
        for start in range(12):
            ends = data["done"][start:, column].nonzero()
            last = start + int(ends[0]) if len(ends) else 11
            steps = torch.arange(last - start + 1)
            expected = (0.9**steps * data["reward"][start : last + 1, column]).sum()
            if not data["terminated"][last, column]:
                expected = expected + 0.9 ** (last - start + 1) * data["next_value"][last, column]
            torch.testing.assert_close(return_[start, column], expected)


def test_the_value_after_a_termination_is_never_read() -> None:
    data = trajectory()
    advantage, _ = generalized_advantage(**data, gamma=0.9, lam=0.5)
    data["next_value"] = data["next_value"].masked_fill(data["terminated"], torch.nan)
    assert torch.equal(generalized_advantage(**data, gamma=0.9, lam=0.5)[0], advantage)

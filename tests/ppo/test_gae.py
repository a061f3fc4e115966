"""Generalised advantages against numbers worked out by hand; `test_rollout.py` has every return of a rollout."""

import torch

from ppo.gae import generalized_advantage


def test_hand_computed_termination_and_truncation() -> None:
    # gamma = lambda = 1/2, so gamma lambda = 1/4
    # column 0 terminates at step 1: delta = (1 + 2 - 2, 2 - 4, 3 + 4 - 6) = (1, -2, 1), whatever the value after it
    # column 1 is truncated there:   delta = (1 + 2 - 2, 2 + 5 - 4, 3 + 4 - 6) = (1, 3, 1)
    advantage, return_ = generalized_advantage(
        reward=torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]),
        value=torch.tensor([[2.0, 2.0], [4.0, 4.0], [6.0, 6.0]]),
        next_value=torch.tensor([[4.0, 4.0], [torch.nan, 10.0], [8.0, 8.0]]),
        terminated=torch.tensor([[False, False], [True, False], [False, False]]),
        done=torch.tensor([[False, False], [True, True], [False, False]]),
        gamma=0.5,
        lam=0.5,
    )
    assert advantage.tolist() == [[0.5, 1.75], [-2.0, 3.0], [1.0, 1.0]]
    assert return_.tolist() == [[2.5, 3.75], [2.0, 7.0], [7.0, 7.0]]


def test_discount_and_lambda_are_told_apart() -> None:
    # delta = 1 + 0.9 * 1 - 1 = 0.9 at both steps; gamma lambda = 0.45
    ones, never = torch.ones(2, 1, dtype=torch.float64), torch.zeros(2, 1, dtype=torch.bool)
    advantage, _ = generalized_advantage(ones, ones, ones, never, never, 0.9, 0.5)
    torch.testing.assert_close(advantage[:, 0], torch.tensor([0.9 + 0.45 * 0.9, 0.9]).double())

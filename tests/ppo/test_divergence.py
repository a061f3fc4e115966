"""The price on the divergence of an update: the closed form, its adaptation, its part in the loss."""

import copy

import torch

from ppo.divergence import KLPrice, divergence
from tests.ppo.test_learner import ONE_MINIBATCH, batch_of, gradients, learner, replace


def test_the_divergence_is_that_of_two_gaussians() -> None:
    generator = torch.Generator().manual_seed(0)
    old, new = torch.randn(2, 2, 3, 5, 6, generator=generator)
    one, other = (torch.distributions.Normal(mean, log_std.exp()) for mean, log_std in (old, new))
    expected = torch.distributions.kl_divergence(one, other).sum(-1)
    torch.testing.assert_close(divergence(*old, *new), expected)
    torch.testing.assert_close(divergence(*old, *old), torch.zeros(3, 5), rtol=0.0, atol=1e-6)


def test_the_price_rises_beyond_twice_the_target_and_falls_below_half_of_it() -> None:
    price = KLPrice(0.2, 0.01, 5, torch.device("cpu"))
    price.update(torch.tensor([0.021, 0.019, 0.01, 0.006, 0.004]))
    torch.testing.assert_close(price.value, torch.tensor([0.3, 0.2, 0.2, 0.2, 0.1]))


def test_the_price_adds_its_divergence_to_the_loss() -> None:
    """After a first step, the gradients differ from those without a price by the price times the divergence's."""
    plain, with_price = (learner((1, 2), replace(ONE_MINIBATCH, kl_price=price)) for price in (0.0, 3.0))
    batch = batch_of(plain)
    old = [part.detach() for part in plain.policy(batch["observation"])]
    for ppo in (plain, with_price):
        with torch.no_grad():
            for weight in ppo.policy.parameters():
                weight.mul_(1.3)
    own = {"mean": old[0], "log_std": old[1]}
    for ppo, rows in ((plain, batch), (with_price, batch | own)):
        loss, _ = ppo._loss(rows)
        loss.sum().backward()
    expected = copy.deepcopy(gradients(plain))
    plain.optimiser.zero_grad()
    (3.0 * divergence(*old, *plain.policy(batch["observation"])).mean(1)).sum().backward()
    for total, without, weight in zip(
        gradients(with_price), expected, plain.policy.parameters(), strict=False
    ):
        torch.testing.assert_close(total, without + weight.grad, rtol=1e-4, atol=1e-6)


def test_an_update_says_its_divergence_and_answers_it() -> None:
    ppo = learner((1, 2), replace(ONE_MINIBATCH, epochs=10, kl_price=0.2, kl_target=1e-9, learning_rate=1e-2))
    statistics = ppo.update(batch_of(ppo), 0.0)
    assert (statistics["kl"] > 1e-6).all()
    torch.testing.assert_close(statistics["kl_price"], torch.full((2,), 0.2))
    torch.testing.assert_close(ppo.update(batch_of(ppo), 0.0)["kl_price"], torch.full((2,), 0.3))

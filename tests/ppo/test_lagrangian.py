"""PPO-Lagrangian: its price in closed form, its costs step by step, and a problem whose best safe share is known."""

import copy
from types import SimpleNamespace
from typing import Any

import torch

from ppo.lagrangian import INTEGRAL_GAIN, PROPORTIONAL_GAIN, Multiplier
from ppo.learner import PPO
from ppo.network import Policy, Value
from ppo.parameters import PPOParameters
from ppo.rollout import collect

LIMIT = 0.2


class Bandit:
    """Makes each step an episode that rewards a hundredth of its action, and costs 1 if the action is above 0.

    So the most reward with a cost in `LIMIT` of the steps has costs in just so many; without a limit all steps cost.
    """

    def observation(self) -> torch.Tensor:
        return torch.ones(256, 1)

    def step(self, action: torch.Tensor) -> Any:
        ends = torch.ones(len(action), dtype=torch.bool)
        seen = self.observation()
        return SimpleNamespace(
            observation=seen,
            final_observation=seen,
            reward=0.01 * action[:, 0].double(),
            cost=(action[:, 0] > 0.0).double(),
            terminated=ends,
            truncated=~ends,
        )


def trained(cost_limit: float) -> torch.Tensor:
    """Returns the mean cost (S,) of the last 40 of 100 updates in the bandit."""
    generators = [torch.Generator().manual_seed(seed) for seed in (3, 4)]
    parameters = PPOParameters(
        cost_limit=cost_limit,
        epochs=4,
        minibatch_size=256,
        learning_rate=1e-2,
        log_std_bounds=(-2.0, 0.0),
        initial_std=0.5,
    )
    policy = Policy(1, 1, generators, hidden=(8,), log_std_bounds=parameters.log_std_bounds, initial_std=0.5)
    value, cost_value = (Value(1, generators, hidden=(8,)) for _ in range(2))
    learner = PPO(policy, value, parameters, generators, cost_value=cost_value if cost_limit < 1.0 else None)
    costs = []
    env = Bandit()
    for _ in range(100):
        batch = collect(env, learner, 2, generators)
        costs.append((batch["action"][..., 0] > 0.0).float().mean(1))
        learner.update(batch, 0.0)
    return torch.stack(costs[-40:]).mean(0)


def test_the_price_is_proportional_and_integral_and_never_negative() -> None:
    multiplier = Multiplier(LIMIT, 2, torch.device("cpu"))
    for _ in range(5):
        multiplier.update(LIMIT * torch.tensor([1.5, 0.5]))
    expected = PROPORTIONAL_GAIN * 0.5 + 5 * INTEGRAL_GAIN * 0.5
    torch.testing.assert_close(multiplier.value, torch.tensor([expected, 0.0]))
    # at its limit the price stays; what was below owes nothing
    multiplier.update(LIMIT * torch.tensor([1.0, 1.5]))
    torch.testing.assert_close(
        multiplier.value,
        torch.tensor([5 * INTEGRAL_GAIN * 0.5, PROPORTIONAL_GAIN * 0.5 + INTEGRAL_GAIN * 0.5]),
    )


def test_the_price_of_many_violations_falls_as_fast_as_it_rose() -> None:
    multiplier = Multiplier(LIMIT, 1, torch.device("cpu"))
    for _ in range(20):
        multiplier.update(torch.tensor([1.0]))
    torch.testing.assert_close(multiplier.value, torch.tensor([PROPORTIONAL_GAIN + 20 * INTEGRAL_GAIN]))
    for _ in range(5):
        multiplier.update(torch.tensor([0.0]))
    torch.testing.assert_close(multiplier.integral, torch.tensor([15 * INTEGRAL_GAIN]))


def test_a_limit_of_nothing_has_a_price_too() -> None:
    multiplier = Multiplier(0.0, 2, torch.device("cpu"))
    multiplier.update(torch.tensor([0.0, 0.1]))
    torch.testing.assert_close(multiplier.value, torch.tensor([0.0, PROPORTIONAL_GAIN + INTEGRAL_GAIN]))


def test_costs_are_returned_as_rewards_are(toy, small_learner) -> None:
    """Without values and discount, the return of an episode's costs is what is left of them to its end."""
    learner = small_learner(cost_limit=LIMIT, gamma=1.0, gae_lambda=1.0)
    for weight in learner.critics["cost"].parameters():
        weight.data.zero_()
    batch = collect(toy(), learner, 6, learner.generators)
    cost, return_ = (batch[name].unflatten(1, (6, 2))[0, :, 0] for name in ("cost", "cost_return"))
    assert cost.tolist() == [1, 0, 1, 1, 0, 1] and return_.tolist() == [2, 1, 1, 2, 1, 1]
    torch.testing.assert_close(batch["cost_advantage"], batch["cost_return"])


def test_costs_settle_at_their_limit_where_reward_pulls_beyond_it() -> None:
    assert (trained(LIMIT) - LIMIT).abs().max() < 0.05
    assert trained(1.0).min() > 0.95


def test_the_critic_of_costs_takes_no_gradient_from_the_others(toy, small_learner) -> None:
    """Costs a thousand times as large, at no price, leave policy and value as they would be without costs."""
    plain, costly = small_learner(max_grad_norm=0.1), small_learner(cost_limit=0.99, max_grad_norm=0.1)
    batch = collect(toy(), plain, 6, plain.generators)
    assert "cost" not in batch and plain.multiplier is None and "multiplier" not in plain.state_dict()
    none = torch.zeros_like(batch["return_"])
    costs = {"cost": none, "cost_advantage": none, "cost_return": none + 1000.0}
    for learner, more in ((plain, {}), (costly, costs)):
        for generator in learner.generators:
            generator.manual_seed(7)
        learner.update(batch | more, 0.0)
    for name, weight in plain.policy.state_dict().items():
        torch.testing.assert_close(costly.policy.state_dict()[name], weight)


def test_a_learner_that_goes_on_has_its_price(toy, small_learner) -> None:
    def train(learner, env, updates: range) -> None:
        for update in updates:
            learner.update(collect(env, learner, 5, learner.generators), update / 4)

    whole, first, second = (small_learner(cost_limit=LIMIT, learning_rate=1e-2) for _ in range(3))
    env = toy()
    train(whole, toy(), range(4))
    train(first, env, range(2))
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for ours, theirs in zip(second.generators, first.generators, strict=True):
        ours.set_state(theirs.get_state())
    train(second, env, range(2, 4))
    for part in ("policy", "cost_value", "multiplier"):
        ours, theirs = (learner.state_dict()[part] for learner in (second, whole))
        assert all(torch.equal(tensor, theirs[name]) for name, tensor in ours.items())
    assert whole.state_dict()["multiplier"]["value"].min() > 0.0

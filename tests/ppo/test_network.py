"""The stacked networks against torch.distributions and against each seed alone."""

import math

import pytest
import torch
from torch import Tensor, nn

from ppo.network import Policy, StackedMLP, Value, draw_noise, gaussian_entropy, standard_deviation

SEEDS = (3, 11, 7)


def generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def observations(count: int = 5) -> Tensor:
    return torch.randn(len(SEEDS), count, 26, generator=torch.Generator().manual_seed(0))


def excited_policy() -> Policy:
    """Returns a policy whose last layer is scaled up, so that its outputs depend on the observation."""
    policy = Policy(26, 6, generators(*SEEDS), log_std_bounds=(-4.0, 0.0), initial_std=0.5)
    with torch.no_grad():
        policy.network.layers[-1].weight.mul_(300.0)
    return policy


@pytest.mark.parametrize("k", range(len(SEEDS)))
def test_each_stacked_seed_equals_that_seed_alone(k: int) -> None:
    x = observations()
    together, alone = generators(*SEEDS), generators(SEEDS[k])
    for build in (lambda g: Policy(26, 6, g), lambda g: Value(26, g)):
        stacked, single = build(together), build(alone)
        for a, b in zip(stacked.parameters(), single.parameters(), strict=True):
            assert torch.equal(a[k : k + 1], b)
        output, expected = stacked(x), single(x[k : k + 1])
        torch.testing.assert_close(
            [t[k : k + 1] for t in output] if isinstance(output, tuple) else output[k : k + 1],
            list(expected) if isinstance(expected, tuple) else expected,
        )
    assert torch.equal(draw_noise(together, (4, 6), x.device)[k], draw_noise(alone, (4, 6), x.device)[0])


def test_mlp_equals_unstacked_layers_and_is_orthogonal() -> None:
    mlp = StackedMLP((26, 32, 3), generators(*SEEDS), (math.sqrt(2.0), 0.5))
    x = observations()
    first, last = mlp.layers
    for k in range(len(SEEDS)):
        expected = nn.functional.linear(torch.tanh(x[k] @ first.weight[k]), last.weight[k].T)
        torch.testing.assert_close(mlp(x)[k], expected)
        torch.testing.assert_close(first.weight[k] @ first.weight[k].T, 2.0 * torch.eye(26))
        torch.testing.assert_close(last.weight[k].T @ last.weight[k], 0.25 * torch.eye(3))
    assert not first.bias.any() and not last.bias.any()


def test_log_prob_and_entropy_equal_torch_distributions() -> None:
    policy, x = excited_policy(), observations()
    action, log_prob = policy.sample(x, generators(1, 2, 3))
    mean, log_std = policy(x)
    reference = torch.distributions.Normal(mean, log_std.exp())
    torch.testing.assert_close(log_prob, reference.log_prob(action).sum(-1).detach())
    torch.testing.assert_close(gaussian_entropy(log_std), reference.entropy().sum(-1))
    assert torch.equal(policy.mean_action(x), mean)


def test_sample_has_the_mean_and_std_of_the_policy() -> None:
    policy = excited_policy()
    x = observations(1).expand(-1, 20000, -1)
    action, _ = policy.sample(x, generators(1, 2, 3))
    mean, log_std = policy(x[:, :1])
    std = log_std.exp()
    assert ((action.mean(1, keepdim=True) - mean).abs() < 4.0 * std / math.sqrt(20000)).all()
    torch.testing.assert_close(action.std(1, keepdim=True), std, rtol=0.03, atol=0.0)


@pytest.mark.parametrize("std", [0.05, 0.9])
def test_initial_std_and_mean_at_zero_observation(std: float) -> None:
    mean, log_std = Policy(26, 6, generators(*SEEDS), initial_std=std)(torch.zeros(3, 1, 26))
    torch.testing.assert_close(log_std.exp(), torch.full((3, 1, 6), std))
    assert not mean.any()


def test_a_linear_last_layer_is_cut_off_at_the_bounds() -> None:
    """The mean as it is, that of a deterministic flight within the actuators' limits; the log-std within its bounds."""
    policy = Policy(
        26, 6, generators(*SEEDS), log_std_bounds=(-2.0, 1.0), initial_std=0.5, tanh_outputs=False
    )
    mean, log_std = policy(torch.zeros(3, 1, 26))
    torch.testing.assert_close(log_std.exp(), torch.full((3, 1, 6), 0.5))
    assert not mean.any()
    with torch.no_grad():
        policy.network.layers[-1].weight.mul_(3000.0)
    x = observations()
    plain = policy.network(x)
    mean, log_std = policy(x)
    assert torch.equal(mean, plain[..., :6]) and (mean.abs() > 1.0).any()
    assert torch.equal(log_std, plain[..., 6:].clamp(-2.0, 1.0)) and (plain[..., 6:].abs() > 2.0).any()
    assert torch.equal(policy.mean_action(x), mean.clamp(-1.0, 1.0))


def test_actions_are_shaped_by_hand() -> None:
    policy, actions = excited_policy(), torch.tensor([-3.0, -1.0, -0.5, -0.1, 0.0, 0.1, 0.5, 1.0])
    assert torch.equal(policy.shaped(actions), actions)
    policy.power = 2.0
    squares = torch.tensor([-1.0, -1.0, -0.25, -0.01, 0.0, 0.01, 0.25, 1.0])
    torch.testing.assert_close(policy.shaped(actions), squares)


@pytest.mark.parametrize("power", [1.0, 1.5])
def test_what_a_control_is_made_of_becomes_it_again(power: float) -> None:
    policy = excited_policy()
    policy.power = power
    control = torch.tensor([-1.0, -0.5, -1e-4, 0.0, 1e-4, 0.3, 1.0], dtype=torch.float64)
    torch.testing.assert_close(policy.shaped(policy.unshaped(control)), control, rtol=1e-9, atol=1e-12)


def test_the_mean_action_is_shaped_and_what_is_learned_from_is_not() -> None:
    policy, x = excited_policy(), observations()
    linear = policy.mean_action(x)
    drawn, _ = policy.sample(x, generators(1, 2, 3))
    policy.power = 2.0
    torch.testing.assert_close(policy.mean_action(x), linear.sign() * linear.square())
    assert torch.equal(policy.sample(x, generators(1, 2, 3))[0], drawn)


def test_the_standard_deviation_is_that_of_a_gaussian_of_this_entropy() -> None:
    scale = torch.tensor([0.5, 0.2, 0.1], dtype=torch.float64)
    entropy = torch.distributions.Normal(torch.zeros_like(scale), scale).entropy().sum().item()
    assert standard_deviation(entropy, 3) == pytest.approx(0.01 ** (1 / 3))

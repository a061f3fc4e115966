"""The learner against an unstacked reference, each seed alone, a resumed run and a toy problem."""

import copy
import io
import math
import shutil
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ppo.errors import NonFiniteError
from ppo.learner import PPO
from ppo.network import Policy, Value
from ppo.parameters import PPOParameters

OBSERVATION, ACTION = 5, 2
ONE_MINIBATCH = PPOParameters(epochs=1, minibatch_size=64, max_grad_norm=math.inf, entropy_coefficient=0.01)


def learner(seeds: tuple[int, ...], parameters: PPOParameters) -> PPO:
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    policy = Policy(
        OBSERVATION, ACTION, generators, hidden=(16, 16), log_std_bounds=(-4.0, 0.0), initial_std=0.5
    )
    return PPO(policy, Value(OBSERVATION, generators, hidden=(16, 16)), parameters, generators)


def batch_of(ppo: PPO, samples: int = 64) -> dict[str, Tensor]:
    """Returns a random batch, in which seed k depends on its generator only."""

    def draw(*shape: int) -> Tensor:
        return torch.stack([torch.randn(samples, *shape, generator=g) for g in ppo.generators])

    observation = draw(OBSERVATION)
    action, log_prob = ppo.policy.sample(observation, ppo.generators)
    value = ppo.value(observation).detach()
    batch = {"observation": observation, "action": action, "log_prob": log_prob, "value": value}
    return batch | {"advantage": 2.0 * draw() + 1.0, "return_": draw()}


def seed_of(tensors: dict[str, Tensor], k: int) -> dict[str, Tensor]:
    return {name: tensor[k : k + 1] for name, tensor in tensors.items()}


def weights(ppo: PPO) -> dict[str, Tensor]:
    return {**ppo.policy.state_dict(prefix="policy."), **ppo.value.state_dict(prefix="value.")}


def gradients(ppo: PPO) -> list[Tensor]:
    return [weight.grad for module in (ppo.policy, ppo.value) for weight in module.parameters()]


@pytest.mark.campaign
@pytest.mark.skipif(not shutil.which("c++"), reason="torch.compile needs a C++ compiler")
def test_compiled_updates_equal_the_others() -> None:
    parameters = PPOParameters(epochs=3, minibatch_size=16)
    plain, compiled = learner((4, 9), parameters), learner((4, 9), parameters)
    batch = batch_of(plain, 70)
    batch_of(compiled, 70)  # moves its generators as far
    compiled.compile(70)
    torch.testing.assert_close(plain.update(batch, 0.25), compiled.update(batch, 0.25), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(weights(plain), weights(compiled), rtol=1e-4, atol=1e-6)


def test_stacked_seeds_equal_each_seed_alone() -> None:
    """Each with its own price of the divergence."""
    parameters = PPOParameters(epochs=3, minibatch_size=16, kl_price=0.2, kl_target=1e-3, learning_rate=1e-2)
    together = learner((4, 9), parameters)
    batch = batch_of(together, 70)
    statistics = [together.update(batch, 0.25) for _ in range(3)]
    for k, seed in enumerate((4, 9)):
        alone = learner((seed,), parameters)
        own = batch_of(alone, 70)
        torch.testing.assert_close(seed_of(batch, k), own)
        for both in statistics:
            torch.testing.assert_close(seed_of(both, k), alone.update(own, 0.25), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(seed_of(weights(together), k), weights(alone), rtol=1e-3, atol=1e-5)


def test_first_minibatch_starts_at_ratio_one() -> None:
    ppo = learner((1, 2), ONE_MINIBATCH)
    batch = batch_of(ppo)
    statistics = ppo.update(batch, 0.0)
    zero = torch.zeros(2)
    for name in ("policy_loss", "approx_kl", "clip_fraction"):
        torch.testing.assert_close(statistics[name], zero, rtol=0.0, atol=1e-6)
    error = batch["return_"] - batch["value"]
    torch.testing.assert_close(statistics["value_loss"], error.square().mean(1))
    torch.testing.assert_close(statistics["explained_variance"], 1 - error.var(1) / batch["return_"].var(1))


def test_what_is_said_of_the_ratio_is_that_of_two_gaussians() -> None:
    """The divergence of the closed form, and the share of ratios beyond the clip as two densities have it."""
    samples = 40_000
    ppo = learner((3,), replace(ONE_MINIBATCH, minibatch_size=samples))
    old = torch.distributions.Normal(torch.tensor([0.1, -0.2]), torch.tensor([0.3, 0.2]))
    new = torch.distributions.Normal(torch.tensor([0.25, -0.3]), torch.tensor([0.4, 0.15]))
    last, level = ppo.policy.network.layers[-1], (new.scale.log() + 4.0) / 2.0 - 1.0
    with torch.no_grad():  # whatever is observed
        last.weight.zero_()
        last.bias[:] = torch.cat((new.loc, level)).atanh()
    noise = torch.randn(samples, ACTION, generator=ppo.generators[0])
    action = old.loc + old.scale * noise
    drawn = {"action": action[None], "log_prob": old.log_prob(action).sum(-1)[None]}
    statistics = ppo.update(batch_of(ppo, samples) | drawn, 1.0)
    divergence = torch.distributions.kl_divergence(old, new).sum().item()
    assert statistics["approx_kl"].item() == pytest.approx(divergence, rel=0.02)
    ratio = (new.log_prob(action) - old.log_prob(action)).sum(-1).exp()
    beyond = ((ratio < 0.8) | (ratio > 1.2)).float().mean().item()
    assert statistics["clip_fraction"].item() == pytest.approx(beyond, abs=1e-4)


def reference_loss(
    policy: list[Tensor], value: list[Tensor], batch: dict[str, Tensor]
) -> tuple[Tensor, Tensor]:
    """Returns the loss and policy loss of one seed, written without a seed axis: weights as [W, b, W, b, W, b]."""

    def network(parameters: list[Tensor], x: Tensor) -> Tensor:
        w0, b0, w1, b1, w2, b2 = parameters
        return torch.tanh(torch.tanh(x @ w0 + b0) @ w1 + b1) @ w2 + b2

    mean, level = torch.tanh(network(policy, batch["observation"])).split(ACTION, -1)
    gaussian = torch.distributions.Normal(mean, torch.exp(-4.0 + 2.0 * (1.0 + level)))
    ratio = torch.exp(gaussian.log_prob(batch["action"]).sum(-1) - batch["log_prob"])
    advantage = batch["advantage"] - batch["advantage"].mean()
    advantage = advantage / advantage.square().mean().sqrt()
    # clipped where moving further would be rewarded: ratio > 1.2 and A > 0, or ratio < 0.8 and A < 0
    held = torch.where(advantage > 0, ratio.clamp(max=1.2), ratio.clamp(min=0.8))
    policy_loss = -(held * advantage).mean()
    value_loss = (network(value, batch["observation"])[:, 0] - batch["return_"]).square().mean()
    return policy_loss + 0.5 * value_loss - 0.01 * gaussian.entropy().sum(-1).mean(), policy_loss


def test_gradient_and_loss_equal_an_unstacked_reference() -> None:
    ppo = learner((1, 2), ONE_MINIBATCH)
    batch = batch_of(ppo)
    shift = 0.3 * torch.randn(2, 64, generator=ppo.generators[0])  # some ratios leave the clip range
    batch["log_prob"] = batch["log_prob"] + shift
    before = [copy.deepcopy(list(module.parameters())) for module in (ppo.policy, ppo.value)]
    statistics = ppo.update(batch, 0.0)
    for k in range(2):
        policy, value = ([w[k].detach().requires_grad_() for w in module] for module in before)
        loss, policy_loss = reference_loss(policy, value, {name: tensor[k] for name, tensor in batch.items()})
        loss.backward()
        torch.testing.assert_close(statistics["policy_loss"][k], policy_loss.detach())
        for stacked, single in zip(gradients(ppo), [w.grad for w in policy + value], strict=True):
            torch.testing.assert_close(stacked[k], single, rtol=1e-4, atol=1e-6)
    clipped = ((-shift).exp() - 1.0).abs() > 0.2
    torch.testing.assert_close(statistics["clip_fraction"], clipped.float().mean(1))


def test_gradient_is_clipped_per_seed() -> None:
    parameters = PPOParameters(epochs=1, minibatch_size=64, max_grad_norm=20.0)
    ppo = learner((1, 2), parameters)
    batch = batch_of(ppo)
    batch["return_"][0] *= 1000.0
    statistics = ppo.update(batch, 0.0)
    norm = torch.cat([gradient.flatten(1) for gradient in gradients(ppo)], 1).norm(dim=1)
    assert statistics["grad_norm"][0] > 20.0 > statistics["grad_norm"][1]
    torch.testing.assert_close(norm, torch.stack([torch.tensor(20.0), statistics["grad_norm"][1]]))


@pytest.mark.parametrize(("samples", "size"), [(64, 16), (70, 14), (10, 10)])
def test_minibatches_are_equal_and_never_repeat_a_sample(samples: int, size: int) -> None:
    ppo = learner((1, 2), PPOParameters(epochs=1, minibatch_size=16))
    minibatches = list(ppo.minibatches(samples, torch.device("cpu")))
    assert {part.shape[1] for part in minibatches} == {size}
    index = torch.cat(minibatches, 1)
    for k in range(2):
        assert index[k].unique().numel() == index.shape[1] == samples // size * size
        assert k * samples <= index[k].min() and index[k].max() < (k + 1) * samples
    assert not torch.equal(index[0], index[1] - samples)


@pytest.mark.parametrize(("anneal", "expected"), [(True, [1e-3, 5e-4, 0.0]), (False, [1e-3] * 3)])
def test_the_learning_rate_anneals_to_zero_if_asked_to(anneal: bool, expected: list[float]) -> None:
    ppo = learner((1,), PPOParameters(epochs=1, minibatch_size=16, anneal=anneal, learning_rate=1e-3))
    rates = []
    for progress in (0.0, 0.5, 1.0):
        before = copy.deepcopy(weights(ppo))
        ppo.update(batch_of(ppo), progress)
        rates.append(ppo.optimiser.param_groups[0]["lr"])
        stays = all(torch.equal(weight, before[name]) for name, weight in weights(ppo).items())
        assert stays == (rates[-1] == 0.0)
    assert rates == expected
    with pytest.raises(ValueError, match=r"progress is 1\.5"):
        ppo.update(batch_of(ppo), 1.5)


def test_a_value_error_beyond_the_clip_teaches_nothing() -> None:
    """Its gradient is that of the samples below the clip alone, as PyTorch's own formula has it."""
    ppo = learner((1, 2), replace(ONE_MINIBATCH, value_clip=0.5, value_coefficient=1.0))
    batch = batch_of(ppo)
    error = ppo.value(batch["observation"]) - batch["return_"]
    taught = (error.square() < 0.5).float()
    assert 0.2 < taught.mean() < 0.8
    (taught * error.square()).mean(1).sum().backward()
    expected = [weight.grad.clone() for weight in ppo.value.parameters()]
    ppo.optimiser.zero_grad()
    ppo.update(batch, 1.0)
    for weight, gradient in zip(ppo.value.parameters(), expected, strict=True):
        torch.testing.assert_close(weight.grad, gradient)


def test_resumed_training_is_bit_identical() -> None:
    parameters = PPOParameters(epochs=2, minibatch_size=16, kl_price=0.2, kl_target=1e-4)
    ppo, resumed = learner((1, 2), parameters), learner((3, 4), parameters)
    ppo.update(batch_of(ppo), 0.0)
    file = io.BytesIO()
    torch.save(ppo.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for source, target in zip(ppo.generators, resumed.generators, strict=True):
        target.set_state(source.get_state())
    for progress in (0.3, 0.6):
        expected = ppo.update(batch_of(ppo), progress)
        statistics = resumed.update(batch_of(resumed), progress)
        torch.testing.assert_close(statistics, expected, rtol=0.0, atol=0.0)
    torch.testing.assert_close(weights(resumed), weights(ppo), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", ["observation", "return_"])
def test_what_is_not_finite_is_named_with_its_seed_in_the_study(name: str) -> None:
    ppo = learner((1, 2), ONE_MINIBATCH)
    ppo.first_seed = 3  # of a rank that trains the fourth and fifth
    batch = batch_of(ppo)
    batch[name][1, 5] = math.nan
    with pytest.raises(NonFiniteError, match=rf"batch's {name} is not finite \(seed 4\)"):
        ppo.update(batch, 0.0)
    ppo.policy.network.layers[1].weight.register_hook(lambda gradient: gradient * math.nan)
    with pytest.raises(NonFiniteError, match=r"\(seed 3, minibatch 0"):
        ppo.update(batch_of(ppo), 0.0)

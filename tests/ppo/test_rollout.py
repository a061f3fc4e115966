"""The batch of a rollout against returns worked out transition by transition."""

import pytest
import torch
from torch import Tensor

from ppo import rollout
from ppo.learner import PPO
from ppo.network import Policy, gaussian_log_prob
from ppo.rollout import Transition, as_applied, collect

STEPS, GAMMA = 7, 0.9


def by_hand(learner: PPO, seen: list[Transition]) -> Tensor:
    """Returns discounted returns (S, N) of the environment's steps, each summed to the end of episode or rollout."""
    columns = len(seen[0].reward)
    values = learner.value(
        torch.stack([step.final_observation for step in seen]).expand(2, -1, -1, -1).flatten(1, 2)
    )
    values = values.unflatten(1, (len(seen), columns)).detach()
    returns = torch.zeros(len(seen), columns, dtype=torch.float64)
    for column in range(columns):
        seed = column // (columns // 2)
        for start in range(len(seen)):
            discount = 1.0
            for t in range(start, len(seen)):
                returns[start, column] += discount * seen[t].reward[column]
                discount *= GAMMA
                if seen[t].terminated[column]:
                    discount = 0.0
                if seen[t].terminated[column] or seen[t].truncated[column]:
                    break
            returns[start, column] += discount * values[seed, t, column]
    return returns.unflatten(1, (2, -1)).transpose(0, 1).flatten(1, 2)


def test_returns_are_those_of_every_transition(toy, small_learner) -> None:
    env, learner = toy(), small_learner(gamma=GAMMA, gae_lambda=1.0)
    batch = collect(env, learner, STEPS, learner.generators)
    expected = by_hand(learner, env.seen)
    torch.testing.assert_close(batch["return_"].double(), expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(batch["advantage"], batch["return_"] - batch["value"])


@pytest.mark.parametrize("fault", ["discount", "dropped", "reset"])
def test_planted_faults_show_in_the_returns(fault: str, toy, small_learner, monkeypatch) -> None:
    env, learner = toy(), small_learner(gamma=GAMMA, gae_lambda=1.0)
    if fault == "discount":
        estimate = rollout.generalized_advantage
        monkeypatch.setattr(
            rollout, "generalized_advantage", lambda *given: estimate(*given[:5], 1.01 * given[5], given[6])
        )
    batch = collect(env, learner, STEPS, learner.generators)
    if fault == "dropped":
        del env.seen[2]
        batch = {name: torch.cat((rows[:, :4], rows[:, 6:]), 1) for name, rows in batch.items()}
    if fault == "reset":  # the value after a time limit is of the state before the reset
        for step in env.seen:
            step.final_observation = step.observation
    expected = by_hand(learner, env.seen)
    assert not torch.allclose(batch["return_"].double(), expected, rtol=1e-3, atol=1e-3)


def test_the_environment_is_given_what_the_policy_makes_of_its_actions(toy, small_learner) -> None:
    env, learner = toy(), small_learner()
    learner.policy.power = 3.0
    batch = collect(env, learner, 1, learner.generators)
    given = (env.seen[0].reward - 1.0 - 10.0 * env.column) / 0.1  # see `Counter`
    expected = batch["action"].flatten(0, 1)[:, 0].double() ** 3
    torch.testing.assert_close(given, expected.clamp(-1.0, 1.0), rtol=1e-4, atol=1e-4)
    assert (batch["action"].abs() > 0.2).any()


def test_rows_follow_one_another_by_seed_then_step_then_episode(toy, small_learner) -> None:
    env, learner = toy(), small_learner()
    watched: list[Transition] = []
    batch = collect(env, learner, STEPS, learner.generators, watched.append)
    assert watched == env.seen and len(watched) == STEPS
    observation = batch["observation"].unflatten(1, (STEPS, 2))
    assert observation[..., 0].unique(dim=1).squeeze(1).tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert observation[0, :, 0, 1].tolist() == [0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 0.0]  # an episode of 3 steps
    assert observation[0, :, 1, 1].tolist() == [0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]  # one of 2
    count, column = observation[..., 1], observation[..., 0]
    paid = torch.stack([step.reward for step in env.seen]).unflatten(1, (2, 2)).transpose(0, 1)
    action = batch["action"].unflatten(1, (STEPS, 2))[..., 0]
    torch.testing.assert_close(paid.float(), 1.0 + count + 10.0 * column + 0.1 * action)
    torch.testing.assert_close(batch["value"], learner.value(batch["observation"]).detach())
    log_prob = gaussian_log_prob(batch["action"], *learner.policy(batch["observation"]))
    torch.testing.assert_close(batch["log_prob"], log_prob.detach())


def test_a_rollout_continues_where_the_last_one_ended(toy, small_learner) -> None:
    env, learner = toy(), small_learner()
    batches = [collect(env, learner, steps, learner.generators) for steps in (2, 3)]
    whole, fresh = toy(), small_learner()
    expected = collect(whole, fresh, 5, fresh.generators)
    for name in ("observation", "action", "log_prob", "value"):
        assert torch.equal(torch.cat([batch[name] for batch in batches], 1), expected[name])


def test_learning_from_what_acted_keeps_its_action_and_probability(toy, small_learner) -> None:
    """An environment that holds the first control at a tenth: the others are kept as drawn, the first as it acted."""

    def half(transition: Transition, action: Tensor) -> Transition:
        transition.applied = action.clamp(-1.0, 1.0).clone()
        transition.applied[:, 0] = 0.1
        return transition

    env, learner = toy(), small_learner()
    step = env.step
    env.step = lambda action: half(step(action), action)
    drawn = collect(toy(), small_learner(), 1, small_learner().generators)
    kept = collect(env, learner, 1, learner.generators, from_applied=True)
    assert (kept["action"][..., 0] - 0.1).abs().max() < 1e-6
    assert torch.equal(kept["action"][..., 1:], drawn["action"][..., 1:])
    again = gaussian_log_prob(kept["action"], *learner.policy(kept["observation"]))
    torch.testing.assert_close(kept["log_prob"], again)
    assert not torch.allclose(kept["log_prob"], drawn["log_prob"])


def test_an_action_that_acted_as_it_was_drawn_is_kept_to_the_bit() -> None:
    policy = Policy(4, 3, [torch.Generator().manual_seed(2)], (8,), initial_std=0.9, power=3.0)
    action, _ = policy.sample(torch.randn(1, 500, 4), [torch.Generator().manual_seed(0)])
    acted = policy.shaped(action).clamp(-1.0, 1.0)
    assert (action.abs() > 1.0).any() and torch.equal(as_applied(policy, action, acted), action)
    torch.testing.assert_close(policy.shaped(as_applied(policy, action, 0.5 * acted)), 0.5 * acted)

"""The training loop: what it counts and reports, where it stops, and that it continues bit for bit."""

import copy

import pytest
import torch

from ppo.trainer import Trainer, standard_deviation

STEPS, UPDATES = 5, 4


@pytest.fixture
def make(toy, small_learner):
    """A new trainer at each call."""

    def trainer() -> Trainer:
        learner = small_learner(epochs=2, learning_rate=1e-2)
        return Trainer(toy(), learner, STEPS, UPDATES, learner.generators)

    return trainer


def run(trainer: Trainer, updates: int = UPDATES) -> list[dict[str, float]]:
    """The statistics of each update up to so many in all."""
    log: list[dict[str, float]] = []
    trainer.run(lambda transition: None, log.append, lambda: trainer.update >= updates)
    return log


def test_every_transition_is_watched_and_every_update_reported(make) -> None:
    trainer, watched, log = make(), [], []
    trainer.run(watched.append, log.append, lambda: False)
    assert trainer.update == len(log) == UPDATES
    assert watched == trainer.env.seen and len(watched) == STEPS * UPDATES
    rates = [statistics["learner/learning_rate"] for statistics in log]
    assert rates == pytest.approx([1e-2 * (1.0 - k / UPDATES) for k in range(UPDATES)])
    assert trainer.seconds == pytest.approx(
        sum(statistics["time/rollout_s"] + statistics["time/learning_s"] for statistics in log)
    )
    assert all("losses/value_loss" in statistics for statistics in log)


def test_the_standard_deviation_is_that_of_a_gaussian_of_this_entropy() -> None:
    scale = torch.tensor([0.5, 0.2, 0.1], dtype=torch.float64)
    entropy = torch.distributions.Normal(torch.zeros_like(scale), scale).entropy().sum().item()
    assert standard_deviation(entropy, 3) == pytest.approx(0.01 ** (1 / 3))


def test_it_stops_between_two_updates_and_asks_first(make) -> None:
    trainer = make()
    assert run(trainer, updates=0) == [] and trainer.env.seen == []
    assert len(run(trainer, updates=3)) == 3
    assert len(trainer.env.seen) == 3 * STEPS
    assert len(run(trainer)) == 1
    assert run(trainer) == []  # all done


def test_resumed_training_is_that_of_one_session(make) -> None:
    whole, first, second = make(), make(), make()
    expected = run(whole)
    log = run(first, updates=2)
    saved = copy.deepcopy(first.state_dict())
    for generator in second.generators:
        generator.manual_seed(99)
    second.load_state_dict(saved)
    assert (second.update, second.seconds) == (2, first.seconds)
    log += run(second)
    for one, other in zip(expected, log, strict=True):
        assert all(one[tag] == other[tag] for tag in one if not tag.startswith("time/"))
    ours, theirs = second.state_dict(), whole.state_dict()
    for part in ("policy", "value", "env"):
        assert all(torch.equal(tensor, theirs[part][name]) for name, tensor in ours[part].items())
    assert all(map(torch.equal, ours["generators"], theirs["generators"]))

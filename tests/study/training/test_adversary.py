"""An agent trained to come near the limits: its reward, and that its file flies in a campaign."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from inspection.transition import Transition
from rta.names import CONSTRAINTS
from study.experiment import Experiment
from study.scales import scales
from study.training import session as training
from study.training.adversary import WEIGHT, Adversary
from study.training.run import Run
from study.verification import campaign
from study.verification.adversaries import learned
from study.verification.starts import initial_states
from tests.study.training.test_run import tiny
from tests.study.verification.test_findings import verify
from tests.test_main import call

pytestmark = pytest.mark.usefixtures("small_pools")

ATTACKED = ("passive_safety", "attitude_exclusion")


@pytest.fixture(scope="module")
def trained(small_pools: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Returns a run of two updates behind the filter."""
    directory = tmp_path_factory.mktemp("adversary") / "run"
    config = tiny(
        10.0, adversary=list(ATTACKED), rta=True, num_envs=8, interactions=2 * 32, minibatch_size=16
    )
    run = training.start(config, directory)
    run.train()
    return run


def test_the_reward_is_the_nearness_of_the_nearest_attacked_limit() -> None:
    experiment = Experiment(tiny(adversary=list(ATTACKED)), 32, seconds=1.0)
    env = experiment.env(32)
    env.start(*initial_states(32, 2, experiment.filter)[:2])
    transition = env.step(torch.zeros(32, 6))
    c, state = experiment.config.inspection, transition.state
    rows = [CONSTRAINTS.index(name) for name in ATTACKED]
    h = experiment.filter.values(state)[rows].numpy() / np.array(scales(c, 1.0))[rows, None]
    ended = torch.arange(32) % 3 == 0
    done = dataclasses.replace(transition, terminated=ended, truncated=ended.roll(1))
    turned = Adversary(env, ATTACKED).turned(done)
    np.testing.assert_allclose(turned.reward, -WEIGHT * np.arcsinh(h.min(0)))
    assert set(h.argmin(0)) == {0, 1} and list(turned.reward_terms) == ["adversary"]
    assert torch.equal(turned.truncated, done.done) and not turned.terminated.any()  # no end is rewarded
    lower, higher = (-WEIGHT * math.asinh(h) for h in (-0.2, -0.1))
    assert lower > higher > 0.0  # a larger violation more


def test_an_adversary_learns_from_its_own_reward(trained: Run) -> None:
    assert isinstance(trained.learning_env, Adversary) and trained.update == 2
    assert trained.config.train.adversary == ATTACKED
    again = training.resume(trained.directory)
    assert isinstance(again.learning_env, Adversary)
    for name, value in trained.state_dict()["policy"].items():
        assert torch.equal(value, again.state_dict()["policy"][name])
    again.config = dataclasses.replace(
        again.config, train=dataclasses.replace(again.config.train, interactions=3 * 32)
    )
    rewards: list[torch.Tensor] = []
    watch = again.watch

    def watching(transition: Transition) -> None:
        rewards.append(transition.reward)
        watch(transition)

    again.watch = watching  # type: ignore[method-assign]
    again.train()
    assert torch.cat(rewards).max() < 0.0  # nowhere beyond a limit; the task pays for points


@pytest.mark.parametrize(
    "plant",
    [
        pytest.param("", marks=pytest.mark.campaign),
        "[plant]\nlatency = 1\nmass_factor = 1.1\nvelocity_noise = 0.01\n",
    ],
)
def test_its_file_flies_behind_the_filter(
    plant: str,
    trained: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(campaign, "BATCH", 4)  # it draws the starts of no more episodes than it flies
    path, config = tmp_path / "report.json", tmp_path / "plant.toml"
    config.write_text(plant)
    policy = f"learned:{trained.directory / 'policy.pt'}"
    flags = ["--policy", policy, "--episodes", "4", "--config", str(config), "--keep-worst"]
    code, _, err = call(verify(path, *flags), capsys)
    assert code == 0, err
    report = json.loads(path.read_text())
    assert report["campaign"]["policy"] == policy and len(report["campaign"]["weights"]) == 16
    assert sum(report["filter_calls"].values()) == 4 * 2  # every 10 s, as it was trained
    code, _, err = call(["refly", f"{path}.passive_safety.npz"], capsys)
    assert code == 0, err


def test_its_controls_are_drawn_by_the_numbers_of_columns(trained: Run) -> None:
    env = trained.experiment.env(4)
    x, priority, _ = initial_states(4, 2, trained.experiment.filter)
    env.start(x, priority)
    drawn = [
        learned(trained.policy, env, torch.Generator().manual_seed(seed), 9, first)(0.0, env.x)
        for seed, first in ((1, 2), (1, 2), (1, 3), (2, 2))
    ]
    mean, log_std = trained.policy(env.observation()[None])
    noise = torch.randn(9, 6, generator=torch.Generator().manual_seed(1))[2:6]
    expected = (mean + log_std.exp() * noise)[0].T.double().clamp(-1.0, 1.0) * env.limit
    np.testing.assert_allclose(drawn[0], expected.detach(), rtol=1e-5)
    assert torch.equal(drawn[0], drawn[1])
    assert not any(torch.equal(drawn[0], other) for other in drawn[2:])

"""The jump start: the policy does what the guidance would, and PPO goes on from there."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from inspection.guidance import natural_motion
from inspection.orbits import GUIDANCE, Orbit
from settings import from_toml
from study.config import Config
from study.errors import Stopped
from study.experiment import Experiment, settled
from study.experiment import test_cases as common_cases
from study.training import jump_start, session
from study.training.run import Run

SETTINGS = """
[train]
rta = false
interactions = 28_672
jump_start = 24_576
num_envs = 256
rollout_steps = 16
compile = "off"
device = "cpu"
[inspection]
observed = ["position", "velocity", "angular_velocity", "sun", "hill"]
[ppo]
action_power = 2.0
initial_std = 0.05
hidden = [64, 64]
epochs = 8
minibatch_size = 256
"""


def config(**train: object) -> Config:
    base = from_toml(SETTINGS, "test", Config())
    return replace(base, train=replace(base.train, **train))


@pytest.mark.parametrize("orbit", [GUIDANCE["following"], Orbit(out_of_plane=30.0, tracking=0.01)])
def test_the_guidance_that_teaches_violates_nothing_without_the_filter(orbit: Orbit) -> None:
    experiment = Experiment(config(), 64)
    env = experiment.env(64, experiment.generators([0]), compiled=True)
    c = env.c
    env.start(*common_cases(experiment.config, 64, 1))
    guidance, worst = natural_motion(c, c.action_period, orbit), []
    for _ in range(100):  # the way to the orbit
        env.step(guidance, lambda hold: worst.append(env.constraint_values(hold.after).amin(1)))
    held = torch.stack(worst).amin() >= 0.0
    assert held == (orbit == GUIDANCE["following"])


def created(*arguments: Any) -> Run:
    """Returns a fresh run with its first checkpoint."""
    run = session.create(*arguments)
    session.save_first(run)
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> session.Run:
    """Returns a run after its imitation phase and before PPO; compiled, since this phase is long."""
    return taught(session.start(config(compile="on"), tmp_path_factory.mktemp("taught") / "run"))


def taught(run: session.Run) -> session.Run:
    with run.log.open(0, run.config.train.interactions, ""):
        run.begin(lambda: False)
    return run


def test_the_copy_does_what_the_guidance_would_in_states_of_its_own(run: session.Run) -> None:
    env, c = run.env, run.config.inspection
    guidance = natural_motion(
        c, c.action_period, GUIDANCE[run.config.train.teacher], env.sight.score, rolls=False
    )
    chance = run.experiment.policy(run.experiment.generators([1]))
    errors = {"taught": 0.0, "chance": 0.0}
    for _ in range(16):
        wanted = run.policy.unshaped((guidance(0.0, env.x) / env.limit).T.float())
        observation = env.observation()[None]
        for name, policy in (("taught", run.policy), ("chance", chance)):
            errors[name] += (policy(observation)[0][0] - wanted).square().mean().item()
        env.step(run.policy.mean_action(observation)[0])
    assert errors["taught"] < 0.7 * errors["chance"]  # of so short a lesson; an agent's is ten times as long
    log_std = run.policy(env.observation()[None])[1]
    assert log_std.exp().mean().item() == pytest.approx(run.config.ppo.initial_std, rel=0.1)


def test_what_is_flown_counts_as_interactions_and_ppo_does_the_rest(run: session.Run) -> None:
    assert run.interactions == 24_576 and run.trained_s > 0.0
    before = [weight.clone() for weight in run.policy.parameters()]
    run.train()
    assert run.interactions == 28_672
    assert not any(torch.equal(*pair) for pair in zip(before, run.policy.parameters(), strict=True))


@pytest.mark.campaign
def test_seeds_side_by_side_are_taught_what_each_is_alone(tmp_path: Path) -> None:
    short = settled(config(jump_start=8192))
    both = taught(created(short, tmp_path / "both", [3, 4]))
    alone = taught(created(replace(short, train=replace(short.train, seed=4)), tmp_path / "alone"))
    for name, weight in alone.policy.state_dict().items():
        torch.testing.assert_close(weight[0], both.policy.state_dict()[name][1], rtol=1e-3, atol=1e-4)


def test_the_guidance_that_is_named_teaches(run: session.Run) -> None:
    """Without its roll. What it wants depends on the state and on the score, which both change on the way."""
    env, policy = run.env, run.policy
    taught = jump_start.ImitationEnv(env, policy, GUIDANCE["quick"])
    quick, *others = (
        natural_motion(env.c, env.c.action_period, GUIDANCE[name], env.sight.score, rolls)
        for name, rolls in (("quick", False), ("thrifty", False), ("quick", True))
    )
    for _ in range(16):
        wanted, *unwanted = (
            policy.unshaped((each(0.0, env.x) / env.limit).T.float()) for each in (quick, *others)
        )
        taught.step(torch.zeros_like(wanted))
        assert torch.equal(taught.lessons[-1], wanted)
        assert not any(torch.equal(wanted, other) for other in unwanted)


SHORT = {"jump_start": 4 * 512, "interactions": 6 * 512, "num_envs": 128, "rollout_steps": 4}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(None, id="a seed"),
        pytest.param([3, 4], id="two seeds", marks=pytest.mark.campaign),
    ],
)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> session.Run:
    """Returns a short run that nothing interrupted."""
    short = settled(config(**SHORT))
    run = created(short, tmp_path_factory.mktemp("whole") / "run", request.param)
    run.train()
    return run


def continued(whole: session.Run, directory: Path) -> session.Run:
    """Returns the run in a directory, trained to its end."""
    run = session.resume(directory, whole.config, whole.seeds if len(whole.seeds) > 1 else None)
    run.train()
    return run


def assert_same(one: session.Run, other: session.Run) -> None:
    learners = one.learner, other.learner
    for network in ("policy", "value"):
        pairs = zip(*(getattr(each, network).parameters() for each in learners), strict=True)
        assert all(torch.equal(*pair) for pair in pairs)
    assert torch.equal(one.env.x, other.env.x) and one.interactions == other.interactions


@pytest.mark.parametrize("after", [1, 3])
@pytest.mark.parametrize("how", ["signal", "kill"])
def test_a_run_that_ends_in_its_lessons_goes_on_as_if_it_had_not(
    whole: session.Run, how: str, after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = whole.seeds if len(whole.seeds) > 1 else None
    run = created(whole.config, tmp_path / "run", seeds)
    teach = jump_start.JumpStart.teach

    def interrupted(self: jump_start.JumpStart, watch: object) -> dict[str, float]:
        if self.taught == after and how == "kill":
            raise MemoryError  # after which nothing is saved
        if self.taught == after - 1 and how == "signal":
            os.kill(os.getpid(), signal.SIGINT)
        return teach(self, watch)

    with monkeypatch.context() as patch:
        patch.setattr(jump_start.JumpStart, "teach", interrupted)
        with pytest.raises(Stopped if how == "signal" else MemoryError):
            run.train()
    (tmp_path / "run" / "lessons" / f"{after + 1}.pt").write_bytes(
        b"half a lesso"
    )  # its checkpoint was never written
    assert run.interactions == after * 512
    other = continued(whole, tmp_path / "run")
    assert_same(whole, other)
    assert not (tmp_path / "run" / "lessons").exists()

"""The study: each seed equals that seed trained alone, interruptions change nothing, other settings are refused."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import main
from ppo import checkpoint
from settings import override
from study.experiment import load_policy
from study.training import study as arms
from study.training.run import Run
from study.training.session import RESUMABLE, start

SEEDS = (5, 6, 7)

pytestmark = pytest.mark.usefixtures("small_pools")
SETTINGS = """
[study]
seeds = 3
[train]
seed = 5
num_envs = 3
rollout_steps = 4
interactions = 36
evaluation_interval = 12
evaluation_episodes = 2
final_episodes = 4
compile = "on"
device = "cpu"
[rta]
period = 1.0
qp_solver = "batched"
[inspection]
action_period = 1.0
max_time = 3.0 # every episode ends within each update
[ppo]
epochs = 2
minibatch_size = 8
"""


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the configuration of a study of 3 updates that takes a few seconds."""
    path = tmp_path_factory.mktemp("study") / "tiny.toml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture(scope="module")
def whole(settings: Path, small_pools: None) -> Path:
    """Returns the directory of a study that nothing interrupted."""
    directory = settings.parent / "whole"
    assert main.main(["study", "--config", str(settings), "--study-dir", str(directory)]) == 0
    return directory


def evaluations(directory: Path) -> list[dict[str, Any]]:
    """Returns the periodic evaluations, without the time they took."""
    lines = (directory / "evaluations.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if name != "seconds"} for line in lines]


def scalars(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """Returns the episodes' charts that TensorBoard shows."""
    events = EventAccumulator(str(directory))
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith(("episode/", "evaluation/"))]
    assert "episode/reward" in tags and "evaluation/reward" in tags
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags}


def same(one: Any, other: Any) -> bool:
    """Tells whether nested dictionaries and lists of tensors and plain values are equal bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


@pytest.mark.parametrize("arm", ["no_rta", pytest.param("rta", marks=pytest.mark.campaign)])
def test_each_seed_of_an_arm_equals_that_seed_trained_alone(arm: str, whole: Path, tmp_path: Path) -> None:
    config = arms.read_settings(whole).of_arm(arm)
    together = checkpoint.load(whole / arm / "checkpoint.pt", RESUMABLE)
    lines = evaluations(whole / arm)
    for k in (0, 2):
        seed = SEEDS[k]
        directory = tmp_path / str(seed)
        tables = {"train": {"seed": seed}}
        start(override(config, tables, "test"), directory).train()
        alone = checkpoint.load(directory / "checkpoint.pt", RESUMABLE)
        for network in ("policy", "value"):
            for name, weight in alone[network].items():
                assert torch.equal(together[network][name][k : k + 1], weight), name
        for name, values in alone["env"].items():
            if name != "pools":
                assert torch.equal(together["env"][name][..., 3 * k : 3 * k + 3], values), name
        assert torch.equal(together["env"]["pools"][k], alone["env"]["pools"][0])
        assert torch.equal(together["generators"][k], alone["generators"][0])
        policy = whole / arm / f"seed{seed}" / "policy.pt"
        assert same(
            torch.load(policy, weights_only=True), torch.load(directory / "policy.pt", weights_only=True)
        )
        assert [line for line in lines if line["config"]["train"]["seed"] == seed] == evaluations(directory)
        assert scalars(whole / arm / f"seed{seed}") == scalars(directory)


@pytest.mark.parametrize("arm", ["no_rta", pytest.param("rta", marks=pytest.mark.campaign)])
def test_results_per_seed_are_what_evaluate_says_of_its_policy(arm: str, whole: Path, tmp_path: Path) -> None:
    per_seed = json.loads((whole / arm / "results.json").read_text())["per_seed"]
    assert len(per_seed) == 3
    for seed, expected in zip(SEEDS, per_seed, strict=True):
        arguments = ["evaluate", "--checkpoint", str(whole / arm / f"seed{seed}" / "policy.pt")]
        arguments += ["--qp-solver", "batched", "--episodes", "4", "--json", str(tmp_path / "one.json")]
        assert main.main(arguments) == 0
        assert json.loads((tmp_path / "one.json").read_text()) == expected


def kill_after(patch: pytest.MonkeyPatch, owner: Any, name: str, count: int, number: int) -> None:
    """Sends this process a signal at the end of the count-th call of a function."""
    original: Callable[..., Any] = getattr(owner, name)
    calls = []

    def killing(*arguments: Any, **keywords: Any) -> Any:
        result = original(*arguments, **keywords)
        calls.append(0)
        if len(calls) == count:
            os.kill(os.getpid(), number)
        return result

    patch.setattr(owner, name, killing)


@pytest.mark.campaign
def test_interruptions_change_nothing(
    settings: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["study", "--config", str(settings), "--study-dir", str(tmp_path)]
    first, second = tmp_path / "no_rta", tmp_path / "rta"
    with pytest.MonkeyPatch.context() as patch:  # in the first arm's training, after its first update
        kill_after(patch, Run, "after_update", 1, signal.SIGINT)
        assert main.main(arguments) == 130
    assert checkpoint.load(first / "checkpoint.pt", ("update",))["update"] == 1

    with pytest.MonkeyPatch.context() as patch:  # killed outright after an evaluation, before its checkpoint
        patch.setattr(Run, "save", lambda self: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main.main(arguments) == 130
    with open(first / "evaluations.jsonl", "a") as file:
        file.write('{"interactions": 12, "seco')
    assert checkpoint.load(first / "checkpoint.pt", ("update",))["update"] == 1

    with pytest.MonkeyPatch.context() as patch:  # in the first arm's final evaluation
        kill_after(patch, arms, "write_episodes", 1, signal.SIGTERM)
        assert main.main(arguments) == 143
    assert checkpoint.load(first / "checkpoint.pt", ("update",))["update"] == 3
    assert not (first / "results.json").exists()

    with pytest.MonkeyPatch.context() as patch:  # between the arms
        kill_after(patch, arms, "evaluate_arm", 1, signal.SIGTERM)
        assert main.main(arguments) == 143
    assert (first / "results.json").exists()
    assert not second.exists()

    with pytest.MonkeyPatch.context() as patch:  # among the second arm's first episodes
        kill_after(patch, arms, "create", 1, signal.SIGTERM)
        assert main.main(arguments) == 143
    with pytest.MonkeyPatch.context() as patch:  # in the second arm's training, after its last update
        kill_after(patch, Run, "after_update", 3, signal.SIGTERM)
        assert main.main(arguments) == 143
    assert not (second / "episodes.npz").exists()
    assert (
        capsys.readouterr().out.count(f"continue with\n  python main.py study --study-dir {tmp_path}\n") == 5
    )
    assert list(json.loads((tmp_path / "results.json").read_text())["arms"]) == [first.name]

    assert main.main(arguments) == 0
    for arm in ("no_rta", "rta"):
        one, other = (json.loads((d / arm / "results.json").read_text()) for d in (whole, tmp_path))
        assert one.pop("wall_clock_s") and other.pop("wall_clock_s")
        assert one == other
        assert evaluations(whole / arm) == evaluations(tmp_path / arm)
        ours, theirs = (dict(np.load(d / arm / "episodes.npz")) for d in (tmp_path, whole))
        assert ours.keys() == theirs.keys()
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
        ours, theirs = (torch.load(d / arm / "checkpoint.pt", weights_only=True) for d in (tmp_path, whole))
        assert ours.pop("seconds") and theirs.pop("seconds")
        assert same(ours, theirs)
        for seed in SEEDS:
            path = Path(arm) / f"seed{seed}"
            assert scalars(tmp_path / path) == scalars(whole / path)
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in whole.iterdir()}


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--seeds", "4"], ["[study] seeds = 3, not 4"]),
        (["--arms", "rta"], ["[study] arms", "not ('rta',)"]),
        (["--interactions", "37"], ["[train] interactions = 36, not 37"]),
        (["--solar-panel-axis", "+x"], ["[inspection] solar_panel_axis = '-x', not '+x'"]),
    ],
)
def test_other_settings_are_refused(
    flags: list[str], words: list[str], whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main.main(["study", "--study-dir", str(whole), *flags]) == 2
    refusal = capsys.readouterr().err.splitlines()[-1]  # before it stands what is said of the filter
    assert refusal.startswith("error: ")
    assert all(word in refusal for word in ("--study-dir", *words)), refusal


@pytest.mark.campaign
def test_arms_of_its_own_are_trained_and_shown_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = "[arms.squared.train]\nrta = false\n[arms.squared.ppo]\naction_power = 2.0\n"
    text = SETTINGS.replace("seeds = 3", 'seeds = 1\narms = ["no_rta", "squared"]') + own
    (tmp_path / "own.toml").write_text(text)
    directory = tmp_path / "study"
    words = ["study", "--config", str(tmp_path / "own.toml"), "--study-dir", str(directory)]
    assert main.main(words) == 0
    heading, *lines = capsys.readouterr().out.split("\n\n")[-2].splitlines()
    assert heading.split()[:2] == ["success", "%"] and [line.split()[0] for line in lines] == [
        "no_rta",
        "squared",
    ]
    results = json.loads((directory / "results.json").read_text())["arms"]
    for line in lines:
        name, *numbers = line.split()
        reward = results[name]["metrics"]["reward"]["iqm"]
        assert float(numbers[2]) == pytest.approx(reward, abs=6e-4) == float(numbers[3])
    policy, config = load_policy(directory / "squared" / "seed5" / "policy.pt")
    assert policy.power == config.ppo.action_power == 2.0
    (tmp_path / "own.toml").write_text(text.replace("2.0", "3.0"))
    assert main.main(words) == 2
    assert "holds a study with [arms] squared = " in capsys.readouterr().err

"""Bad input ends with one line and exit code 2, and nothing is written or lost."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.test_main import STATE, assert_refused, run

__all__ = ["run"]  # a fixture

SIMULATE = "simulate --controller zero --duration 10 --out x.npz"
FLAGS = {
    "train --num-envs 0": ["[train] num_envs = 0", "positive"],
    "train --interactions many": ["--interactions", "'many'", "must be an integer"],
    "train --threads 100000": ["--threads 100000", "at most", "processors"],
    "train --config nowhere.toml": ["nowhere.toml", "neither a file nor one that comes with the code"],
    "train --config chiefs/hull": ["needs a mesh"],
    "train --resume nowhere": ["nowhere", "no run there"],
    "train --resume nowhere --seed 3": ["--resume", "only --interactions"],
    "train --no-rta --learn-from applied": ["--learn-from", "without the filter", "desired"],
    "train --num-envs 1_000_000_000 --no-rta --compile off": ["1,000,000,000 episodes", "not enough memory"],
    "train --run_dir=d --seed 3": ["unrecognized: --run_dir=d; did you mean --run-dir?"],
    "evaluate --controller zero --total-timesteps 8": ["unrecognized: --total-timesteps"],
    "train --interactions 1.5": ["--interactions", "'1.5'", "must be an integer"],
    "evaluate --controller zero --episodes 1e400": ["--episodes", "must be a positive integer"],
    "trian": ["no command 'trian'; did you mean train?"],
    "study --no-rta --arms rta": ["--no-rta", "the arms rta say it", "--arms"],
    "study --seeds 9999": ["seeds = 9999", "at most 1,000"],
    "study --arms rta,both": ["--arms", "'both'", "no_rta, rta"],
    "study --study-dir /proc/nowhere": ["--study-dir", "cannot write there"],
    "evaluate": ["--checkpoint"],
    "evaluate --controller quik": ["--controller", "'quik'", "thrifty", "quick"],
    "evaluate --controller natural-motion --checkpoint x.pt": ["--checkpoint", "not allowed", "--controller"],
    "evaluate --checkpoint nowhere.pt": ["nowhere.pt", "no such checkpoint"],
    "evaluate --checkpoint x.pt --episodes 0": ["--episodes", "'0'", "positive"],
    f"{SIMULATE} --controller policy": ["--checkpoint", "--controller policy"],
    f"{SIMULATE} --controller recorded": ["--actions", "--controller recorded"],
    f"{SIMULATE} --step 3": ["--step 3", "10 s"],
    f"{SIMULATE} --duration 1e300": ["--duration", "--step"],
    f"{SIMULATE} --out nowhere/x.npz": ["--out", "cannot write"],
    f"{SIMULATE} --out /proc/nothing.npz": ["--out"],
    f"{SIMULATE} --no-rta --out /dev/full": ["/dev/full: No space left on device"],
    f"{SIMULATE} --figure no/x.png": ["--figure", "cannot write"],
    "filter --states nowhere.npz --out x.npz": ["nowhere.npz", "no such file"],
    "filter --states x.npz --out x.npz": ["--out", "the file of --states"],
    "verify --policy checkpoint:": ["--policy", "checkpoint:F"],
    "export --checkpoint x.pt": ["--out", "--c"],
    "refly nowhere.npz": ["nowhere.npz", "no such file"],
}


@pytest.mark.parametrize("words", FLAGS)
def test_bad_flags_are_refused(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(words.split(), FLAGS[words], capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_absent_cuda_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cuda", "no CUDA device"]
    assert_refused(["train", "--device", "cuda", "--run-dir", str(tmp_path / "r")], words, capsys)


def test_an_existing_run_is_not_overwritten(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(["train", "--run-dir", str(run)], ["--run-dir", "--resume"], capsys)
    (tmp_path / "policy.pt").write_bytes((run / "policy.pt").read_bytes())  # shipped without its checkpoint
    assert_refused(["train", "--run-dir", str(tmp_path)], ["--run-dir", "holds a run"], capsys)


def test_bad_checkpoints_are_refused(tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, whole = tmp_path / "policy.pt", (run / "policy.pt").read_bytes()
    evaluate = ["evaluate", "--checkpoint", str(path)]
    for content in (b"", b"\x80garbage", whole[: len(whole) // 2]):
        path.write_bytes(content)
        assert_refused(evaluate, [str(path), "not a readable"], capsys)
    torch.save({"weights": torch.zeros(3)}, path)
    assert_refused(evaluate, [str(path), "lacks policy"], capsys)
    for spoil, words in (
        (lambda weight: weight.fill_(torch.nan), "not finite"),
        (lambda weight: weight.double(), "float64: must be torch.float32"),
    ):
        content = torch.load(run / "policy.pt", weights_only=True)
        name = next(iter(content["policy"]))
        content["policy"][name] = spoil(content["policy"][name])
        torch.save(content, path)
        assert_refused(evaluate, [str(path), words], capsys)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": [1.0, 2.0]}, ["position", "3 numbers"]),
        ({"position": [0.0, 0.0, 0.0]}, ["position", "centre"]),
        ({"velocity": [0.0, float("nan"), 0.0]}, ["velocity", "finite"]),
        ({"temperature": "warm"}, ["temperature", "number"]),
        ({"quaternion": [0.0, 0.0, 0.0, 2.0]}, ["quaternion", "length 1"]),
        ({"colour": 1}, ["'colour'", "position"]),
        (None, []),  # no object
    ],
)
def test_bad_state_files_are_refused(
    change: dict[str, Any] | None, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text("[1, 2]" if change is None else json.dumps(STATE | change))
    assert_refused([*SIMULATE.split(), "--initial-state", str(path)], [str(path), *words], capsys)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((3, 5)), ["(3, 5)", "(N, 6)"]),
        (np.full((3, 6), np.nan), ["finite"]),
        (np.full((3, 6), 0.5), ["0.5", "0.001"]),
        (np.zeros((9, 6)), ["9 rows", "--duration", "10"]),
    ],
)
def test_bad_actions_are_refused(
    actions: np.ndarray, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "actions.npy"
    np.save(path, actions)
    flags = ["--controller", "recorded", "--actions", str(path), "--no-rta"]
    assert_refused([*SIMULATE.split(), *flags], [str(path), *words], capsys)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("value"),
        lambda content: content["env"].update(x=torch.zeros(16, 3)),
        lambda content: content.update(generators=[]),
        lambda content: content.update(config=3),
    ],
)
def test_a_damaged_run_is_not_resumed(
    damage: Any, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(run / "checkpoint.pt", weights_only=True)
    damage(content)
    torch.save(content, tmp_path / "checkpoint.pt")
    (tmp_path / "config.toml").write_text((run / "config.toml").read_text())
    assert_refused(["train", "--resume", str(tmp_path)], [str(tmp_path / "checkpoint.pt")], capsys)


def test_a_run_whose_configuration_was_edited_is_not_resumed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "checkpoint.pt").write_bytes((run / "checkpoint.pt").read_bytes())
    text = (run / "config.toml").read_text().replace("mass = 12.0", "mass = 20.0")
    (tmp_path / "config.toml").write_text(text)
    assert_refused(["train", "--resume", str(tmp_path)], ["config.toml", "trained with"], capsys)

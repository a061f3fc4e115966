"""Bad input ends with one line and exit code 2, and nothing is lost."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import main
from tests.test_main import STATE, assert_refused, run

__all__ = ["run"]  # a fixture


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--rta-period", "2"], ["[rta] period = 2.0", "1, 5 or 10"]),
        (["train", "--num-envs", "0"], ["[train] num_envs = 0", "positive"]),
        (["train", "--interactions", "-5"], ["[train] interactions = -5", "positive"]),
        (["train", "--interactions", "many"], ["--interactions", "'many'", "must be an integer"]),
        (["train", "--threads", "100000"], ["--threads 100000", "at most", "processors"]),
        (["refly", "nowhere.npz", "--threads", "20000"], ["--threads 20000", "at most", "processors"]),
        (["train", "--learning-rate", "nan"], ["[ppo] learning_rate = nan", "finite and positive"]),
        (["train", "--seed", "-1"], ["[train] seed = -1", "not negative"]),
        (["train", "--device", "tpu"], ["[train] device = 'tpu'", "auto, cpu or cuda"]),
        (["train", "--solar-panel-axis", "x"], ["solar_panel_axis = 'x'", "+x"]),
        (
            ["train", "--config", "nowhere.toml"],
            ["nowhere.toml", "neither a file nor one that comes with the code"],
        ),
        (["train", "--resume", "nowhere"], ["nowhere", "no run there"]),
        (["train", "--resume", "nowhere", "--seed", "3"], ["--resume", "only --interactions"]),
        (["train", "--unknown"], ["--unknown"]),
        (["train", "--learn-from", "both"], ["[train] learn_from = 'both'", "applied"]),
        (["train", "--no-rta", "--learn-from", "applied"], ["--learn-from", "without the filter", "desired"]),
        (["train", "--no-rta", "--learn-from", "penalty"], ["--learn-from", "without the filter", "desired"]),
        (
            ["train", "--learn-from", "penalty", "--adversary", "collision"],
            ["--learn-from", "penalty", "an adversary", "must be desired"],
        ),
        (["study", "--seeds", "0"], ["[study] seeds = 0", "positive"]),
        (["study", "--seeds", "9999"], ["seeds = 9999", "at most 1,000"]),
        (["study", "--arms", "rta,both"], ["--arms", "'both'", "no_rta, rta"]),
        (["study", "--arms", "rta,rta"], ["[study] arms = ['rta', 'rta']", "each once"]),
        (
            ["study", "--config", "nowhere.toml"],
            ["nowhere.toml", "neither a file nor one that comes with the code"],
        ),
        (["study", "--study-dir", "/proc/nowhere"], ["--study-dir", "cannot write there"]),
        (["benchmark", "--batches", "256,none"], ["--batches", "'none'", "positive integer"]),
        (["benchmark", "--json", "nowhere/x.json"], ["--json", "cannot write"]),
        (["train", "--qp-solver", "osqp"], ["qp_solver = 'osqp'", "auto, piqp or batched"]),
        (["verify", "--qp-solver", "osqp"], ["qp_solver = 'osqp'", "auto, piqp or batched"]),
        (["evaluate"], ["--checkpoint"]),
        (
            ["simulate", "--controller", "zero", "--duraton", "5", "--out", "x.npz"],
            ["--duration", "unrecognized: --duraton; did you mean --duration?"],
        ),
        (["evaluate", "--controler", "quick"], ["unrecognized: --controler; did you mean --controller?"]),
        (["train", "--run_dir=d", "--seed", "3"], ["unrecognized: --run_dir=d; did you mean --run-dir?"]),
        (["train", "runs/x"], ["main.py train: unrecognized: runs/x (see --help)"]),
        (["trian"], ["no command 'trian'; did you mean train?"]),
        (["launch"], ["no command 'launch'; allowed are train, study, report"]),
        (
            ["train", "--config", str(Path(main.__file__).parent / "configs/chiefs/hull.toml")],
            ["needs a mesh"],
        ),
        (["evaluate", "--controller", "lqr-pd"], ["--controller", "'lqr-pd'", "natural-motion"]),
        (["evaluate", "--controller", "quik"], ["--controller", "'quik'", "thrifty", "quick"]),
        (
            ["evaluate", "--controller", "natural-motion", "--checkpoint", "x.pt"],
            ["--checkpoint", "not allowed", "--controller"],
        ),
        (["evaluate", "--checkpoint", "nowhere.pt"], ["nowhere.pt", "no such checkpoint"]),
        (["evaluate", "--checkpoint", "x.pt", "--episodes", "0"], ["--episodes", "'0'", "positive"]),
        (["simulate", "--controller", "pid"], ["--controller", "'pid'", "lqr-pd"]),
        (["simulate", "--controller", "zero", "--duration", "0", "--out", "x.npz"], ["--duration", "'0'"]),
        (
            ["simulate", "--controller", "policy", "--duration", "10", "--out", "x.npz"],
            ["--checkpoint", "--controller policy"],
        ),
        (
            ["simulate", "--controller", "recorded", "--duration", "10", "--out", "x.npz"],
            ["--actions", "--controller recorded"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "10", "--step", "3", "--out", "x.npz"],
            ["--step 3", "10 s"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "15", "--step", "10", "--out", "x.npz"],
            ["--duration 15", "--step"],
        ),
        (
            ["simulate", "--controller", "zero", "--duration", "10", "--out", "nowhere/x.npz"],
            ["--out", "cannot write"],
        ),
        (
            [
                "simulate",
                "--controller",
                "zero",
                "--duration",
                "10",
                "--out",
                "x.npz",
                "--figure",
                "no/x.png",
            ],
            ["--figure", "cannot write"],
        ),
        (["filter", "--out", "x.npz"], ["--states"]),
        (["filter", "--states", "nowhere.npz", "--out", "x.npz"], ["nowhere.npz", "no such file"]),
        (["filter", "--states", "x", "--out", "x.npz", "--no-rta"], ["--no-rta"]),
        (["filter", "--states", "x.npz", "--out", "x.npz"], ["--out", "the file of --states"]),
        (["filter", "--states", "x.npz", "--out", "x.txt"], ["--out", "must end in .npz"]),
        (["verify", "--policy", "checkpoint:"], ["--policy", "checkpoint:F"]),
        (
            ["train", "--num-envs", "1_000_000_000", "--no-rta", "--compile", "off"],
            ["1,000,000,000 episodes", "not enough memory"],
        ),
        (["export", "--checkpoint", "x.pt"], ["--out", "--c"]),
        (["export", "--checkpoint", "nowhere.pt", "--out", "x.onnx"], ["nowhere.pt", "no such checkpoint"]),
        (["export", "--checkpoint", "x.pt", "--out", "nowhere/x.onnx"], ["--out", "cannot write"]),
    ],
)
def test_bad_flags_are_refused(
    arguments: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(arguments, words, capsys)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_absent_cuda_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cuda", "no CUDA device"]
    assert_refused(["train", "--device", "cuda", "--run-dir", str(tmp_path / "r")], words, capsys)


def test_an_existing_run_is_not_overwritten(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert_refused(["train", "--run-dir", str(run)], ["--run-dir", "--resume"], capsys)


def test_corrupt_checkpoints_are_refused(
    tmp_path: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (run / "policy.pt").read_bytes()
    other = tmp_path / "other.pt"
    torch.save({"weights": torch.zeros(3)}, other)
    for name, content in (("empty", b""), ("garbage", b"\x80garbage"), ("half", whole[: len(whole) // 2])):
        path = tmp_path / f"{name}.pt"
        path.write_bytes(content)
        assert_refused(["evaluate", "--checkpoint", str(path)], [str(path), "not a readable"], capsys)
    assert_refused(["evaluate", "--checkpoint", str(other)], [str(other), "lacks policy"], capsys)
    assert_refused(["evaluate", "--checkpoint", str(tmp_path)], [str(tmp_path), "is a directory"], capsys)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": [1.0, 2.0]}, ["position", "3 numbers"]),
        ({"position": [0.0, 0.0, 0.0]}, ["position", "centre"]),
        ({"velocity": [0.0, float("nan"), 0.0]}, ["velocity", "finite"]),
        ({"energy": float("inf")}, ["energy", "finite"]),
        ({"temperature": "warm"}, ["temperature", "number"]),
        ({"quaternion": [0.0, 0.0, 0.0, 2.0]}, ["quaternion", "length 1"]),
        ({"quaternion": [1.0, 0.0, 0.0]}, ["quaternion", "4 numbers"]),
        ({"priority_vector": [0.0, 0.0, 0.0]}, ["priority_vector", "zero"]),
        ({"colour": 1}, ["'colour'", "position"]),
        ({"sun_angle": None}, ["sun_angle", "number"]),
    ],
)
def test_bad_state_files_are_refused(
    change: dict[str, Any], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps(STATE | change))
    arguments = ["simulate", "--controller", "zero", "--duration", "10", "--initial-state", str(path)]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path), *words], capsys)


@pytest.mark.parametrize("text", ["[1, 2]", "{", '{"position": [1, 2, 3]}'])
def test_malformed_state_files_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(text)
    arguments = ["simulate", "--controller", "zero", "--duration", "10", "--initial-state", str(path)]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path)], capsys)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((3, 5)), ["(3, 5)", "(N, 6)"]),
        (np.full((3, 6), np.nan), ["finite"]),
        (np.full((3, 6), 0.5), ["0.5", "0.001"]),
        (np.array(["a"]), ["(N, 6)"]),
        (np.zeros((9, 6)), ["9 rows", "--duration", "10"]),
    ],
)
def test_bad_actions_are_refused(
    actions: np.ndarray, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "actions.npy"
    np.save(path, actions)
    arguments = [
        "simulate",
        "--controller",
        "recorded",
        "--actions",
        str(path),
        "--duration",
        "10",
        "--no-rta",
    ]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], [str(path), *words], capsys)


def test_a_finished_run_without_its_checkpoint_is_not_overwritten(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = tmp_path / "shipped"
    shipped.mkdir()
    (shipped / "policy.pt").write_bytes((run / "policy.pt").read_bytes())
    assert_refused(["train", "--run-dir", str(shipped)], ["--run-dir", "holds a run"], capsys)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("value"),
        lambda content: content["env"].pop("x"),
        lambda content: content["env"].update(x=torch.zeros(16, 3)),
        lambda content: content.update(update="many"),
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


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda weight: weight.fill_(torch.nan), "not finite"),
        (lambda weight: weight.fill_(1e30), "beyond 1000"),
        (lambda weight: weight.to(torch.complex64), "complex64: must be torch.float32"),
        (lambda weight: weight.double(), "float64: must be torch.float32"),
    ],
)
def test_a_policy_with_weights_that_no_training_leaves_is_refused(
    spoil: Any, words: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(run / "policy.pt", weights_only=True)
    name = next(iter(content["policy"]))
    content["policy"][name] = spoil(content["policy"][name])
    torch.save(content, tmp_path / "policy.pt")
    words = [str(tmp_path / "policy.pt"), words]
    assert_refused(["evaluate", "--checkpoint", str(tmp_path / "policy.pt")], words, capsys)


@pytest.mark.parametrize(
    "text",
    [
        "[inspection]\nsubstep = 0.3",
        "[inspection]\nmax_distance = 10.0",
        "[inspection]\ninitial_temperature = [50.0, 60.0]",
        "[inspection]\nmax_thrust = 1e-4",
        "[ppo]\nlog_std_bounds = [-1e5, 1e5]",
        "[train]\nseed = 99999999999999999999",
        '[rta]\nqp_solver = "osqp"',
        "[rta]\npassive_safety_segments = [0.0, 400.0]",
    ],
)
def test_impossible_settings_are_refused(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    arguments = ["train", "--config", str(path), "--run-dir", str(tmp_path / "run"), "--num-envs", "2"]
    assert_refused([*arguments, "--compile", "off", "--device", "cpu"], ["["], capsys)


@pytest.mark.parametrize("out", ["/proc/nothing.npz", "x" * 300])
def test_unwritable_output_is_refused_before_the_work(
    out: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(["simulate", "--controller", "zero", "--duration", "10", "--out", out], ["--out"], capsys)


def test_a_full_disk_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["simulate", "--controller", "zero", "--no-rta", "--duration", "10", "--out", "/dev/full"]
    assert_refused(arguments, ["/dev/full: No space left on device"], capsys)


@pytest.mark.parametrize(("duration", "step"), [("1e300", "1"), ("10", "1e-12"), ("1e8", "1")])
def test_endless_simulations_are_refused(
    duration: str, step: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["simulate", "--controller", "zero", "--duration", duration, "--step", step]
    assert_refused([*arguments, "--out", str(tmp_path / "x.npz")], ["--duration", "--step"], capsys)


def test_a_compile_cache_that_cannot_be_made_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "file" / "cache"))
    arguments = ["evaluate", "--controller", "zero", "--episodes", "1"]
    assert_refused(arguments, ["TORCHINDUCTOR_CACHE_DIR", "cannot make", "Not a directory"], capsys)

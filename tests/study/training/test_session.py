"""What ends a run early and what begins one: full disks, deleted directories, kills, locks, longer runs, agents."""

import hashlib
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import main
from ppo import checkpoint
from ppo.learner import PPO
from settings import load
from study.config import Config
from study.experiment import load_policy
from study.training import run as run_of
from study.training import session as training

ROOT = Path(main.__file__).parent
SETTINGS = """
[train]
rta = false
interactions = 96
num_envs = 4
rollout_steps = 4
evaluation_interval = 16
evaluation_episodes = 1
checkpoint_interval = 32
final_episodes = 2
compile = "off"
device = "cpu"
[inspection]
action_period = 1.0
max_time = 3.0 # every episode ends within each update
[ppo]
epochs = 1
minibatch_size = 8
hidden = [64, 64]
[plant]
mass_factor = [0.9, 1.1] # each episode draws its own
position_noise = 0.2
latency = [1, 2]
missed_calls = 0.3
"""
CONCLUDE = training.Run.conclude

pytestmark = pytest.mark.usefixtures("small_pools")


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the configuration of a run of six updates, with a checkpoint after every other."""
    path = tmp_path_factory.mktemp("session") / "tiny.toml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture(scope="module")
def whole(settings: Path, small_pools: None) -> Path:
    """Returns the directory of that run, which nothing interrupted."""
    directory = settings.parent / "whole"
    assert main.main(["train", "--config", str(settings), "--run-dir", str(directory)]) == 0
    return directory


@pytest.fixture(autouse=True)
def nothing_concluded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spares a run its evaluation and figure, but where a test says otherwise."""
    monkeypatch.setattr(training.Run, "conclude", lambda self: "")


def weights(directory: Path) -> dict[str, torch.Tensor]:
    content = checkpoint.load(directory / "checkpoint.pt", training.RESUMABLE)
    return {f"{part}.{name}": value for part in ("policy", "value") for name, value in content[part].items()}


def assert_same(one: Path, other: Path) -> None:
    ours, theirs = weights(one), weights(other)
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def after(monkeypatch: pytest.MonkeyPatch, update: int, deed: Callable[[Path], Any]) -> None:
    """Does something to the directory of a run at the beginning of what follows an update."""
    original = training.Run.after_update

    def after_update(self: training.Run, statistics: dict[str, float]) -> None:
        if self.update == update:
            deed(self.directory)
        original(self, statistics)

    monkeypatch.setattr(training.Run, "after_update", after_update)


@pytest.fixture
def limits() -> Iterator[None]:
    """Lets a test limit the size of files, as a full disk would."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def one_line(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Returns the error's line, which must be the only one and the last."""
    err = capsys.readouterr().err
    line = err.splitlines()[-1]
    assert line.startswith("error: ") and err.count("error: ") == 1 and "Traceback" not in err, err
    assert all(word in line for word in words), line
    return line


def test_a_full_disk_ends_training_in_a_line_and_room_lets_it_go_on(
    settings: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], limits: None
) -> None:
    run, (_, hard) = tmp_path / "run", resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        after(patch, 4, lambda _: resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard)))
        assert main.main(["train", "--config", str(settings), "--run-dir", str(run)]) == 2
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    one_line(capsys, "checkpoint.pt: ", "File too large", f"last good checkpoint: {run / 'checkpoint.pt'}")
    assert not list(run.glob("*.tmp"))
    assert checkpoint.load(run / "checkpoint.pt", ("update",))["update"] == 2
    for name in ("checkpoint.pt", "policy.pt", "evaluations.jsonl", "config.toml"):  # by an earlier kill
        (run / f"{name}.tmp").write_bytes(bytes(1000))
    assert main.main(["train", "--resume", str(run)]) == 0
    assert not list(run.glob("*.tmp"))
    assert_same(run, whole)


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_disk_that_charts_fill_ends_training_in_a_line(
    settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], limits: None
) -> None:
    run, (_, hard) = tmp_path / "run", resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(directory: Path) -> None:
        (charts,) = directory.glob("events.*")
        resource.setrlimit(resource.RLIMIT_FSIZE, (charts.stat().st_size, hard))

    with pytest.MonkeyPatch.context() as patch:
        after(patch, 3, fill)
        assert main.main(["train", "--config", str(settings), "--run-dir", str(run)]) == 2
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    one_line(capsys, f"{run}/events.", "File too large", f"last good checkpoint: {run / 'checkpoint.pt'}")
    assert threading.excepthook.__module__ != "study.training.log"


JOB = """
import os, signal, subprocess, sys, time
import torch
import main
from pathlib import Path
from inspection import initial_state
from study.training import run as run_of
from study.training import session as training

torch.set_num_threads(1)
initial_state.POOL = 64  # as `small_pools` has it
settings, directory = sys.argv[1:]
original, update = os.fsync, training.Run.after_update

def killing(descriptor):
    os.kill(os.getpid(), signal.SIGKILL)  # all is written, nothing replaced

def after_update(self, statistics):
    if self.update == 2:
        child = subprocess.Popen(["sleep", "60"], close_fds=False, stdout=subprocess.DEVNULL)
        print(child.pid, flush=True)
        sys.stdin.readline()  # until the others have tried
    if self.update == 4:
        os.fsync = killing
    update(self, statistics)

training.Run.after_update = after_update
main.main(["train", "--config", settings, "--run-dir", directory])
"""


@pytest.mark.campaign
def test_a_live_run_is_nobody_elses_until_a_kill_in_the_midst_of_a_save(
    settings: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    job = subprocess.Popen([sys.executable, "-c", JOB, str(settings), str(run)], cwd=ROOT, text=True, **pipes)
    for _ in range(3):  # the lines about the run and its plan
        job.stdout.readline()
    child = int(job.stdout.readline())
    try:
        before = {path.name: path.read_bytes() for path in run.iterdir()}
        for _ in range(2):
            assert main.main(["train", "--resume", str(run)]) == 2
            one_line(capsys, f"--resume {run}: is being trained by another process")
        assert {path.name: path.read_bytes() for path in run.iterdir()} == before
        job.communicate("\n", timeout=60)
        assert job.returncode == -9 and (run / "checkpoint.pt.tmp").exists()
        os.kill(child, 0)  # it lives on, and has not inherited the lock
        assert main.main(["train", "--resume", str(run)]) == 0
    finally:
        job.kill()
        os.kill(child, 9)
    assert_same(run, whole)
    assert not list(run.glob("*.tmp"))


@pytest.mark.parametrize("moment", ["__init__", "save"])
def test_an_interrupt_before_the_first_checkpoint_hinders_nobody(
    moment: str,
    settings: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    arguments = ["train", "--config", str(settings), "--run-dir", str(tmp_path / "run")]
    with monkeypatch.context() as patch:
        patch.setattr(training.Run, moment, interrupted)
        assert main.main(arguments) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert (tmp_path / "run").exists() == (moment == "save")  # before `save` nothing is written
    assert main.main([*arguments, "--interactions", "1"]) == 0


def test_a_directory_of_other_things_is_refused(
    settings: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["train", "--config", str(settings), "--run-dir", str(tmp_path)]
    for name, words in (
        ("notes.txt", "holds no run but notes.txt; name a new directory"),
        ("config.toml", "holds no run but config.toml"),  # somebody's settings: no run writes them first
    ):
        (tmp_path / name).write_text("mine")
        assert main.main(arguments) == 2
        one_line(capsys, f"--run-dir {tmp_path}: {words}")
        assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
        (tmp_path / name).unlink()
    for name in ("provenance.json", "config.toml"):  # a run killed before its first checkpoint
        shutil.copy(whole / name, tmp_path)
    (tmp_path / "checkpoint.pt.tmp").write_text("half a")
    assert main.main([*arguments, "--interactions", "1"]) == 0
    assert not list(tmp_path.glob("*.tmp"))


def test_a_finished_run_goes_on_as_a_longer_one_but_for_the_annealing(
    settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    update = PPO.update
    monkeypatch.setattr(PPO, "update", lambda self, batch, progress: update(self, batch, 0.0))
    train = ["train", "--config", str(settings), "--run-dir"]
    assert main.main([*train, str(tmp_path / "long")]) == 0
    assert main.main([*train, str(tmp_path / "short"), "--interactions", "32"]) == 0
    for interactions in ("32", "17"):
        arguments = ["train", "--resume", str(tmp_path / "short"), "--interactions", interactions]
        assert main.main(arguments) == (0 if interactions == "32" else 2)
    one_line(capsys, "32 interactions are done; --interactions must be more")
    assert main.main(["train", "--resume", str(tmp_path / "short"), "--interactions", "96"]) == 0
    line = "learning rate from 0 to 0.0002, since it is annealed to 0 at 96 interactions now, not at 32\n"
    assert line in capsys.readouterr().out
    assert_same(tmp_path / "long", tmp_path / "short")
    assert load(tmp_path / "short" / "config.toml", Config()).train.interactions == 96
    assert not (tmp_path / "short" / "config.toml.tmp").exists()


def test_a_finished_run_takes_other_final_episodes(
    settings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training.Run, "conclude", CONCLUDE)
    run = tmp_path / "run"
    train = ["train", "--config", str(settings), "--run-dir", str(run), "--interactions", "16"]
    assert main.main(train) == 0
    for words, episodes in (([], 2), (["--final-episodes", "3"], 3), ([], 3)):
        assert main.main(["train", "--resume", str(run), *words]) == 0
        results = json.loads((run / "evaluation.json").read_text())
        assert results["episodes"] == episodes
        assert load(run / "config.toml", Config()).train.final_episodes == episodes
        assert f"then {episodes} test flights" in capsys.readouterr().out
    assert main.main(["train", "--resume", str(run), "--evaluation-episodes", "3"]) == 2
    one_line(capsys, "only --interactions and --final-episodes may stand beside it")


@pytest.mark.parametrize("name", ["policy.pt", "checkpoint.pt"])
def test_a_run_starts_from_an_agent_and_goes_on_from_there(
    name: str, settings: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collected: list[dict[str, torch.Tensor]] = []
    collect = run_of.collect

    def watching(env: Any, learner: PPO, *rest: Any) -> dict[str, torch.Tensor]:
        if not collected:
            collected.append({key: value.clone() for key, value in learner.policy.state_dict().items()})
            collected.append({key: value.clone() for key, value in learner.value.state_dict().items()})
        return collect(env, learner, *rest)

    monkeypatch.setattr(run_of, "collect", watching)
    source = whole / name
    arguments = ["train", "--config", str(settings), "--run-dir", str(tmp_path / "run"), "--seed", "9"]
    assert main.main([*arguments, "--interactions", "16", "--init-from", str(source)]) == 0
    trained = checkpoint.load(whole / "checkpoint.pt", training.RESUMABLE)
    assert all(torch.equal(value, trained["policy"][key]) for key, value in collected[0].items())
    values = [torch.equal(value, trained["value"][key]) for key, value in collected[1].items()]
    assert all(values) == (name == "checkpoint.pt")
    assert not torch.equal(
        weights(tmp_path / "run")["policy.network.layers.0.weight"], next(iter(collected[0].values()))
    )
    about = json.loads((tmp_path / "run" / "provenance.json").read_text())["init_from"]
    assert about == {"file": str(source), "sha256": hashlib.sha256(source.read_bytes()).hexdigest()}


def test_widths_are_keys_from_training_to_export_and_the_last_lines_can_be_pasted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training.Run, "conclude", CONCLUDE)
    path = tmp_path / "deep.toml"
    path.write_text(
        SETTINGS.replace("[64, 64]", "[64, 64, 64]").replace("interactions = 96", "interactions = 16")
    )
    run, out = tmp_path / "my 'first' run", tmp_path / "agent.onnx"
    assert main.main(["train", "--config", str(path), "--run-dir", str(run)]) == 0
    said = capsys.readouterr().out
    policy, config = load_policy(run / "policy.pt")
    assert config.ppo.hidden == (64, 64, 64)
    assert [layer.weight.shape[2] for layer in policy.network.layers] == [64, 64, 64, 12]
    assert main.main(["export", "--checkpoint", str(run / "policy.pt"), "--out", str(out)]) == 0
    assert f"\nWritten to {run}: " in said
    evaluate, fly, show = (shlex.split(line) for line in said.partition("Next:\n")[2].splitlines())
    simulate, replay = fly[: fly.index("&&")], fly[fly.index("&&") + 1 :]
    assert show == ["tensorboard", "--logdir", str(run)]
    for words in (evaluate, simulate, replay):
        assert words[:2] == ["python", "main.py"]
        shorter = {"1000": "2", "3600": "20"}
        assert main.main([shorter.get(word, word) for word in words[2:]]) == 0
    assert (run / "flight.html").exists()

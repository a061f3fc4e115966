"""Two ranks under torchrun: they follow one, stop together, continue bit for bit, and survive one another's end."""

import itertools
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.distributed import HashStore

import main
from inspection import initial_state
from ppo import checkpoint
from ppo.distributed import Ranks, ranks
from ppo.errors import NonFiniteError, RankLostError
from settings import from_toml, load
from study.config import Config
from study.training import jump_start
from study.training import session as training

ROOT = Path(main.__file__).parent
# Weights of 2 ranks from those of 1 after 3 updates of 12 gradient steps: the order of sums alone differs.
TOLERANCE = 1e-6
SETTINGS = """
[train]
num_envs = 6
rollout_steps = 4
interactions = 72
evaluation_interval = 48
evaluation_episodes = 2
checkpoint_interval = 24
final_episodes = 2
compile = "off"
device = "cpu"
[rta]
period = 1.0
qp_solver = "batched"
[inspection]
action_period = 1.0
max_time = 3.0 # s; every episode ends within each update
[ppo]
epochs = 4
minibatch_size = 9
[plant]
mass_factor = [0.9, 1.1] # each episode draws its own
position_noise = 0.2
latency = [1, 2]
missed_calls = 0.3
"""
STUDY = '[study]\nseeds = 3\narms = ["no_rta"]\n' + SETTINGS.replace("72", "48")
TAUGHT = SETTINGS.replace("72", "72\njump_start = 48")
RATE = 1e-3  # of the lessons: at an agent's, eight times as high, rounding grows likewise
POOL = 16  # initial states drawn at once, so that more are drawn in the midst of a run


def job(directory: Path) -> None:
    """Runs on each of two ranks under torchrun; rank 1 ends early."""
    torch.set_num_threads(1)
    initial_state.POOL, jump_start.LEARNING_RATE = POOL, RATE
    settings, after_update = directory / "train.toml", training.Run.after_update
    config = load(settings, Config())
    training.start(config, directory / "whole").train()
    training.start(from_toml(TAUGHT, "test", Config()), directory / "taught").train()

    def end(signal_number: int, update: int) -> None:
        """Lets rank 1 signal itself at the end of an update."""

        def ending(self: training.Run, statistics: dict[str, float]) -> None:
            after_update(self, statistics)
            if ranks().rank == 1 and self.update == update:
                os.kill(os.getpid(), signal_number)

        training.Run.after_update = ending

    def say(arguments: list[str], expected: int) -> None:
        assert main.main(arguments) == expected

    train = ["train", "--config", str(settings), "--run-dir"]
    end(signal.SIGTERM, update=1)
    say([*train, str(directory / "stopped")], 0)
    training.Run.after_update = after_update
    training.resume(directory / "stopped").train()
    say([*train, str(directory / "stopped")], 2)
    say([*train, str(directory / "odd"), "--num-envs", "5"], 2)
    say(["verify", "--episodes", "1"], 2)
    say(["study", "--config", str(directory / "study.toml"), "--study-dir", str(directory / "study")], 0)
    end(signal.SIGKILL, update=2)
    say([*train, str(directory / "lost")], 1)
    (directory / "survived").touch()
    sys.exit(1)


@pytest.fixture(scope="module", autouse=True)
def small_pools() -> Iterator[None]:
    """Uses the job's pools also for the runs of this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial_state, "POOL", POOL)
        yield


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, list[str]]:
    """Returns the job's directory, what its ranks printed and each rank's stderr."""
    directory = tmp_path_factory.mktemp("ranks")
    (directory / "train.toml").write_text(SETTINGS)
    (directory / "study.toml").write_text(STUDY)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    command = [*torchrun, "--log-dir", str(directory / "logs"), "--redirects", "3", __file__, str(directory)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    logs = next((directory / "logs").glob("*/attempt_0"))
    out, *err = (
        "".join((logs / str(rank) / f"{name}.log").read_text() for rank in on)
        for name, on in (("stdout", (0, 1)), ("stderr", (0,)), ("stderr", (1,)))
    )
    assert process.returncode == 1, err
    assert (directory / "survived").exists(), err
    return directory, out, err


def state(directory: Path) -> dict[str, Any]:
    return checkpoint.load(directory / "checkpoint.pt", training.RESUMABLE)


def assert_close(one: Any, other: Any, tolerance: float) -> None:
    """Asserts equal keys, equal shapes and, within the tolerance, equal numbers."""
    one, other = ({name: part for name, part in state.items() if name != "seconds"} for state in (one, other))
    assert all(one.pop(name) == other.pop(name) for name in ("config",))
    torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the directory of the same run by one process."""
    directory = tmp_path_factory.mktemp("alone") / "run"
    training.start(from_toml(SETTINGS, "test", Config()), directory).train()
    return directory


def scalars(directory: Path) -> dict[str, list[float]]:
    """Returns TensorBoard's scalars, except durations."""
    events = EventAccumulator(str(directory))
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(("charts/", "time/"))]
    return {tag: [event.value for event in events.Scalars(tag)] for tag in tags}


@pytest.mark.campaign
def test_two_ranks_follow_one(done: tuple[Path, str, list[str]], alone: Path) -> None:
    directory = done[0] / "whole"
    one, other = state(alone), state(directory)
    assert all(torch.equal(a, b) for a, b in zip(one["generators"], other["generators"], strict=True))
    assert_close(one, other, TOLERANCE)
    assert scalars(alone) == {
        tag: pytest.approx(values, rel=1e-4, abs=1e-5) for tag, values in scalars(directory).items()
    }
    ours, theirs = ((d / "evaluations.jsonl").read_text().splitlines() for d in (directory, alone))
    assert [json.loads(line)["interactions"] for line in ours] == [48]
    assert len(ours) == len(theirs)


@pytest.mark.campaign
def test_a_signal_to_one_rank_stops_all_and_they_continue_bit_for_bit(
    done: tuple[Path, str, list[str]],
) -> None:
    directory, out, _ = done
    assert out.count("stopped after 24 interactions") == 1
    assert_close(state(directory / "whole"), state(directory / "stopped"), 0.0)
    assert scalars(directory / "whole") == scalars(directory / "stopped")


@pytest.mark.campaign
def test_a_lost_rank_leaves_one_line_and_a_checkpoint_that_one_process_continues(
    done: tuple[Path, str, list[str]], alone: Path
) -> None:
    directory, _, (err, _) = done
    path = directory / "lost" / "checkpoint.pt"
    line = err.splitlines()[-1]
    assert line.startswith("error: update 3: another rank ended (")
    assert line.endswith(f"; last good checkpoint: {path}")
    assert "Traceback" not in err
    run = training.resume(directory / "lost")
    assert run.update == 2
    run.train()
    assert_close(state(alone), state(run.directory), TOLERANCE)


def test_shares_cover_everything_once() -> None:
    for size in (1, 2, 3, 7):
        shares = [list(range(10))[Ranks(rank, size).share(10)] for rank in range(size)]
        assert list(itertools.chain(*shares)) == list(range(10))
        assert max(map(len, shares)) - min(map(len, shares)) <= 1
    with pytest.raises(ValueError, match="10 cannot be shared by 11 ranks"):
        Ranks(0, 11).share(10)


def test_the_first_rank_to_notice_an_end_speaks_for_all(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    store = HashStore()

    def train(rank: int, error: Exception) -> int:
        """Returns the exit code of a rank that stops so."""

        def ended(given: object) -> None:
            raise error

        monkeypatch.setattr("ppo.distributed.ranks", lambda: Ranks(rank, 3, store))
        monkeypatch.setitem(main.COMMANDS, "train", ended)
        return main.main(["train"])

    previous = signal.getsignal(signal.SIGTERM)
    assert train(2, NonFiniteError("update 3: loss is not finite (seed 7)")) == 1
    assert [train(rank, RankLostError(f"another rank ended ([::1]:{rank})")) for rank in (0, 1)] == [1, 1]
    signal.signal(signal.SIGTERM, previous)
    assert capsys.readouterr().err == "\nerror: training stopped at update 3: loss is not finite (seed 7)\n"


if __name__ == "__main__":
    job(Path(sys.argv[1]))

"""Two ranks under torchrun: equal networks, a stop and a continuation bit for bit, seeds as alone, and a lost rank."""

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import main
from inspection import initial_state
from ppo import checkpoint
from ppo.distributed import Ranks, ranks
from settings import InputError, from_toml, load
from study.config import Config, StudyConfig
from study.training import session as training
from study.training import study

SETTINGS = """
[train]
num_envs = 6
rollout_steps = 4
interactions = 72
jump_start = 24
evaluation_interval = 48
evaluation_episodes = 2
checkpoint_interval = 24
final_episodes = 2
compile = "off"
device = "cpu"
[rta]
period = 1.0
[inspection]
action_period = 1.0
max_time = 3.0 # s; every episode ends within each update
[ppo]
epochs = 4
minibatch_size = 8
"""
STUDY = '[study]\nseeds = 3\narms = ["no_rta"]\n' + SETTINGS.replace("72", "48")
POOL = 16  # initial states drawn at once, so that more are drawn in the midst of a run


def job(directory: Path) -> None:
    """Runs on each of two ranks under torchrun; rank 1 ends early."""
    torch.set_num_threads(1)
    initial_state.POOL = POOL
    number = torch.tensor([float(ranks().rank)])
    ranks().average([number])
    assert number == 0.5
    after_update = training.Run.after_update
    settings = directory / "train.toml"
    train = ["train", "--config", str(settings), "--run-dir"]

    def end(signal_number: int, update: int) -> None:
        """Lets rank 1 signal itself at the end of an update."""

        def ending(self: training.Run, statistics: dict[str, float]) -> None:
            after_update(self, statistics)
            if ranks().rank == 1 and self.update == update:
                os.kill(os.getpid(), signal_number)

        training.Run.after_update = ending

    def say(arguments: list[str], expected: int) -> None:
        assert main.main(arguments) == expected

    training.start(from_toml(SETTINGS, "test", Config()), directory / "whole").train()
    end(signal.SIGTERM, update=2)
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


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, str]]:
    """Returns the job's directory, what its ranks printed, and the first rank's stderr."""
    directory = tmp_path_factory.mktemp("ranks")
    (directory / "train.toml").write_text(SETTINGS)
    (directory / "study.toml").write_text(STUDY)
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    command = [*torchrun, "--log-dir", str(directory / "logs"), "--redirects", "3", __file__, str(directory)]
    environment = os.environ | {"PYTHONPATH": str(Path(main.__file__).parent), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    logs = next((directory / "logs").glob("*/attempt_0"))
    out = "".join((logs / str(rank) / "stdout.log").read_text() for rank in (0, 1))
    errors = (logs / "0" / "stderr.log").read_text()
    assert process.returncode == 1, errors
    assert (directory / "survived").exists(), errors + (logs / "1" / "stderr.log").read_text()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial_state, "POOL", POOL)  # as in the job, for the runs of this process
        yield directory, out, errors


def state(directory: Path) -> dict[str, Any]:
    """Returns a checkpoint's tensors and counts, without the time that training took."""
    saved = checkpoint.load(directory / "checkpoint.pt", training.RESUMABLE)
    del saved["config"]
    for each in (saved, *saved.get("others", ())):
        each.pop("seconds")
    return saved


@pytest.mark.campaign
def test_ranks_take_the_same_steps_in_episodes_of_their_own(done: tuple[Path, str, str]) -> None:
    first = state(done[0] / "whole")
    (other,) = first["others"]
    for part in ("policy", "value", "optimiser"):
        torch.testing.assert_close(first[part], other[part], rtol=0.0, atol=0.0)
    assert not torch.equal(first["env"]["x"], other["env"]["x"])
    assert first["env"]["x"].shape == other["env"]["x"].shape


@pytest.mark.campaign
def test_a_signal_to_one_rank_stops_all_and_they_continue_bit_for_bit(done: tuple[Path, str, str]) -> None:
    directory, out, _ = done
    assert out.count("stopped after 48 interactions") == 1
    torch.testing.assert_close(state(directory / "whole"), state(directory / "stopped"), rtol=0.0, atol=0.0)


@pytest.mark.campaign
def test_each_seed_of_a_study_is_trained_as_alone(done: tuple[Path, str, str], tmp_path: Path) -> None:
    config = load(done[0] / "study" / "config.toml", StudyConfig())
    alone = study.train_arm(config, "no_rta", tmp_path, "")
    for seed in config.seeds:
        ours, theirs = (
            checkpoint.load(home / f"seed{seed}" / "policy.pt", ("policy",))["policy"]
            for home in (done[0] / "study" / "no_rta", alone.directory)
        )
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=0.0)


@pytest.mark.campaign
def test_a_lost_rank_leaves_one_line_and_a_checkpoint(done: tuple[Path, str, str]) -> None:
    directory, _, errors = done
    path = directory / "lost" / "checkpoint.pt"
    line = errors.splitlines()[-1]
    assert line.startswith("error: update 3: another rank ended (")
    assert line.endswith(f"; last good checkpoint: {path}")
    assert "Traceback" not in errors
    with pytest.raises(InputError, match="trained by 2 ranks; must continue with as many, not 1"):
        training.resume(directory / "lost")
    assert state(directory / "lost")["update"] == 2


def test_shares_cover_everything_once() -> None:
    for size in (1, 2, 3, 7):
        shares = [list(range(10))[Ranks(rank, size).share(10)] for rank in range(size)]
        assert list(itertools.chain(*shares)) == list(range(10))
        assert max(map(len, shares)) - min(map(len, shares)) <= 1
    with pytest.raises(ValueError, match="10 cannot be shared by 11 ranks"):
        Ranks(0, 11).share(10)


if __name__ == "__main__":
    job(Path(sys.argv[1]))

"""A run on disk: interrupted equals uninterrupted, clean signals, NaN, and what it writes."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ppo import checkpoint
from ppo.errors import NonFiniteError
from settings import InputError, override, to_toml
from study.config import Config
from study.errors import Stopped
from study.training import session as training

MAIN = Path(__file__).parents[3] / "main.py"


def tiny(
    period: float = 1.0,
    qp_solver: str = "auto",
    minibatch_size: int = 64,
    action_period: float = 10.0,
    **train: object,
) -> Config:
    """Returns a run of 6 updates that takes a few seconds; the filter's and the agent's period in s."""
    tables = {
        "train": {
            "rta": False,
            "interactions": 6 * 32 * 4,
            "num_envs": 32,
            "rollout_steps": 4,
            "evaluation_interval": 10**9,
            "compile": "on" if train.get("rta") else "off",
            "device": "cpu",
        }
        | train,
        "inspection": {"action_period": action_period},
        "rta": {"period": period, "qp_solver": qp_solver},
        "ppo": {"epochs": 2, "minibatch_size": minibatch_size},
    }
    return override(Config(), tables, "test")


def stop_after(run: training.Run, updates: int) -> None:
    """Makes the run ask itself to stop, as a signal would, once it has done so many updates."""
    after_update = run.after_update

    def interrupting(statistics: dict[str, float]) -> None:
        after_update(statistics)
        if run.update == updates:
            os.kill(os.getpid(), signal.SIGTERM)

    run.after_update = interrupting


def weights(run: training.Run) -> list[torch.Tensor]:
    return [*run.learner.policy.parameters(), *run.learner.value.parameters()]


def test_what_it_learns_from_makes_a_difference(tmp_path: Path) -> None:
    """An untrained agent that wants much more than the filter allows, so that it corrects."""
    found = {}
    for learn_from in ("desired", "applied"):
        config = tiny(action_period=1.0, rta=True, interactions=32 * 4, learn_from=learn_from)
        wild = replace(config, ppo=replace(config.ppo, initial_std=0.9))
        run = training.start(wild, tmp_path / learn_from)
        run.train()
        found[learn_from] = weights(run)
    assert not all(map(torch.equal, *found.values()))


@pytest.mark.parametrize("rta", [False, True])
def test_interrupted_and_resumed_equals_uninterrupted(tmp_path: Path, rta: bool) -> None:
    config = tiny(action_period=1.0, rta=rta, interactions=(2 if rta else 6) * 32 * 4)
    changing = {
        "inspection": {"fuel_reward": -0.5},
        "ppo": {"cost_limit": 0.1, "privileged": True},
    }  # prices that training changes, and a critic of its own
    config = override(config, changing, "test")
    whole = training.start(config, tmp_path / "whole")
    whole.train()

    first = training.start(config, tmp_path / "parts")
    stop_after(first, 1 if rta else 3)
    with pytest.raises(Stopped, match="--resume"):
        first.train()
    second = training.resume(tmp_path / "parts")
    assert second.update == (1 if rta else 3)
    second.train()

    for a, b in zip(weights(whole), weights(second), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(whole.env.x, second.env.x)
    ours, theirs = whole.state_dict(), second.state_dict()
    for part in ("cost_value", "multiplier"):
        assert all(map(torch.equal, ours[part].values(), theirs[part].values()))
    assert whole.violations_in_training() == second.violations_in_training() != []
    assert whole.env.observation().shape[1] > whole.policy.network.layers[0].weight.shape[1]


def test_an_adversary_is_not_made_to_pay_for_what_it_is_paid_for(tmp_path: Path) -> None:
    config = override(tiny(), {"train": {"adversary": ["collision"]}, "ppo": {"cost_limit": 0.1}}, "test")
    with pytest.raises(InputError, match="cost_limit"):
        training.start(config, tmp_path / "run")


def test_same_seed_gives_the_same_weights_and_another_seed_others(tmp_path: Path) -> None:
    configs = [tiny(seed=seed, interactions=2 * 32 * 4) for seed in (3, 3, 4)]
    runs = [training.start(config, tmp_path / str(i)) for i, config in enumerate(configs)]
    for run in runs:
        run.train()
    same, other = weights(runs[1]), weights(runs[2])
    assert all(torch.equal(a, b) for a, b in zip(weights(runs[0]), same, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(weights(runs[0])[::2], other[::2], strict=True))


def test_every_update_is_reported_once_with_its_learning_rate_and_its_time(tmp_path: Path) -> None:
    run, told, watched = training.start(tiny(), tmp_path / "run"), [], []
    after_update, watch = run.after_update, run.watch
    run.after_update = lambda statistics: (told.append(dict(statistics)), after_update(statistics))  # type: ignore
    run.watch = lambda transition: (watched.append(transition), watch(transition))  # type: ignore
    run.train()
    assert run.update == len(told) == 6 and len(watched) == 6 * 4
    rates = [statistics["learner/learning_rate"] for statistics in told]
    assert rates == pytest.approx([3e-4 * (1.0 - k / 6) for k in range(6)])
    spent = sum(statistics["time/rollout_s"] + statistics["time/learning_s"] for statistics in told)
    assert run.trained_s == pytest.approx(spent) and all("losses/value_loss" in each for each in told)


def test_nan_stops_with_update_tensor_and_last_good_checkpoint(tmp_path: Path) -> None:
    run = training.start(tiny(), tmp_path)
    with torch.no_grad():
        run.learner.value.network.layers[0].weight[0, 0, 0] = torch.nan
    with pytest.raises(NonFiniteError, match=r"update 1: .*advantage is not finite.*checkpoint\.pt"):
        run.train()
    assert checkpoint.load(tmp_path / "checkpoint.pt", ("update",))["update"] == 0


@pytest.mark.campaign
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_training_cleanly_and_resume_continues(tmp_path: Path, number: int) -> None:
    config = tmp_path / "tiny.toml"
    config.write_text(to_toml(tiny(interactions=10**7)))
    run = tmp_path / "run"
    command = [sys.executable, str(MAIN), "train", "--config", str(config), "--run-dir", str(run)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while "events" not in " ".join(os.listdir(run) if run.is_dir() else []) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.0)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number, err
    assert out.splitlines()[-1] == f"  python main.py train --resume {run}"
    assert "\nstopping" in err
    assert "Traceback" not in err
    assert checkpoint.load(run / "checkpoint.pt", ("update",))["update"] >= 1

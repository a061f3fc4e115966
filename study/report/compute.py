"""What a report shows beside a study's own results: other filters, classical guidance and single episodes."""

import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ppo.network import Policy
from rta.parameters import PERIODS
from study import config as configuration
from study.config import ARMS, BASELINES, TEST_CASES, Config, StudyConfig
from study.errors import MALFORMED, InputError, refusing
from study.experiment import Experiment, load_policy, make_policy
from study.files import ROOT, write_json, write_npz, write_text
from study.flight.controllers import classical
from study.flight.evaluation import play, play_controller, report
from study.flight.simulation import common_episode, simulate, starting_point
from study.paper import Results
from study.report import tables
from study.report.inputs import read_arms
from study.report.sunlight import shortest_episodes

DEMONSTRATION = ROOT / "configs" / "demonstration.json"
DEMONSTRATION_DURATION = 2000.0  # s
GUIDANCE_CASES = 1000
GUIDANCE_PERIOD = 1.0  # s between two calls of the filter
Arrays = dict[str, np.ndarray]
Work = dict[str, tuple[str, Callable[[], Results | Arrays | str]]]  # by file: what it is, what computes it


@dataclass(frozen=True)
class Arm:
    """The agents of a finished arm.

    Attributes:
        config: of its first seed; policy: of all seeds; first: of the first.
        results: of the study; digests: SHA-256 of each seed's file.
    """

    config: Config
    policy: Policy
    first: Policy
    results: Results
    digests: dict[str, str]


def compute(study: Path, device: str | None = None) -> None:
    """Writes what the directory's `report` lacks; what an earlier call has computed for the same policies is kept.

    Args:
        study: directory of a finished study, of one arm or both; device: auto, cpu or cuda; None: the study's.

    Raises:
        InputError, CheckpointError: there is no finished study, it is damaged, or nothing can be written there.
    """
    arms = load(study, device)
    directory = study / "report"
    todo = work(study, arms)
    with refusing(f"--study {study}: cannot write there", OSError):
        begin(directory, {name: arm.digests for name, arm in arms.items()}, todo)
        for name, (what, make) in todo.items():
            if not (directory / name).exists():
                print(f"{directory / name}: {what} ...", flush=True)  # a line, since bars may follow
                started = time.perf_counter()
                write(directory / name, make())
                print(f"{directory / name}: {time.perf_counter() - started:.0f} s", flush=True)


def load(study: Path, device: str | None) -> dict[str, Arm]:
    """The arms of a finished study by name."""
    path = study / "results.json"
    if not path.is_file():
        raise InputError(f"--study {study}: no finished study there (it lacks results.json)")
    arms = read_arms(study)
    if not arms:
        raise InputError(f"{path}: holds none of the arms {', '.join(ARMS)}")
    wanted = configuration.load(study / "config.toml", StudyConfig()).study.arms
    finished = {**arms, **read_arms(study, own=True)}
    if unfinished := [name for name in wanted if name not in finished]:
        print(f"--study {study}: {', '.join(unfinished)} is not finished and is left out", file=sys.stderr)
    return {name: load_arm(study / name, results, device) for name, results in arms.items()}


def load_arm(directory: Path, results: Results, device: str | None) -> Arm:
    """An arm from its seeds' policies."""
    paths = [directory / f"seed{seed}" / "policy.pt" for seed in results["seeds"]]
    loaded = [load_policy(path) for path in paths]
    policies = [policy for policy, _ in loaded]
    config = loaded[0][1]
    weights = [policy.state_dict() for policy in policies]
    together = make_policy(config, [torch.Generator() for _ in policies])
    together.load_state_dict({name: torch.cat([own[name] for own in weights]) for name in weights[0]})
    return Arm(
        config=replace(config, train=replace(config.train, device=device or config.train.device)),
        policy=together,
        first=policies[0],
        results=results,
        digests={path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths},
    )


def begin(directory: Path, digests: dict[str, dict[str, str]], todo: Work) -> None:
    """Drops what was computed for other policies than those with the given digests."""
    directory.mkdir(exist_ok=True)
    path = directory / "policies.json"
    text = json.dumps(digests, indent=2) + "\n"
    if not path.exists() or path.read_bytes() != text.encode():
        for name in todo:
            (directory / name).unlink(missing_ok=True)
        write_text(path, text)


def write(path: Path, content: Results | Arrays | str) -> None:
    """Writes results as .json, arrays as .npz (in single precision) or text, whole or not at all."""
    if path.suffix == ".json":
        write_json(path, content)
    elif path.suffix == ".npz":
        # single precision is enough for figures and replays
        single = {name: a.astype(np.float32) if a.dtype == np.float64 else a for name, a in content.items()}
        write_npz(path, single)
    else:
        write_text(path, content)


def work(study: Path, arms: dict[str, Arm]) -> Work:
    """Everything that a report on these arms needs beside the study's own results."""
    config = next(iter(arms.values())).config
    periods = ", ".join(f"{period:g}" for period in PERIODS)
    filtered = f"the agents trained with RTA, the filter called every {periods} s, a few minutes"
    guided = f"the natural-motion guidance with RTA over {GUIDANCE_CASES:,} cases, a few minutes"
    untrained = f"what is not trained ({', '.join(BASELINES)}), a few minutes"
    lit = partial(shortest_episodes, config, config.train.final_episodes, TEST_CASES)
    todo: Work = {
        "cross.json": ("every agent with the filter off and on, a few minutes", partial(cross, arms))
    }
    if "rta" in arms:
        todo["frequency.json"] = (filtered, partial(frequency, arms["rta"]))
    todo["baselines.json"] = (untrained, partial(baselines, config))
    todo["guidance.json"] = (guided, partial(guidance, config))
    todo["sunlight.json"] = ("when the Sun has lit enough of the chief, seconds", lit)
    for name, arm in arms.items():
        todo[f"episode_{name}.npz"] = (f"an episode of {name}, seconds", partial(episode, arm))
    todo["training.csv"] = ("intervals of the training curves, seconds", partial(training, study, arms))
    for name, tables_of_arm in ARMS.items():
        rta = tables_of_arm["train"]["rta"]
        what = f"the LQR+PD demonstration {'with' if rta else 'without'} RTA, seconds"
        todo[f"demonstration_{name}.npz"] = (what, partial(demonstration, config, rta))
    return todo


def cross(arms: dict[str, Arm]) -> dict[str, dict[str, Results]]:
    """Each arm's agents without filter and behind it, called as in the study."""
    return {
        name: {
            "off": evaluate(arm, rta=False, period=arm.config.rta.period),
            "on": evaluate(arm, rta=True, period=arm.config.rta.period),
        }
        for name, arm in arms.items()
    }


def frequency(arm: Arm) -> dict[str, Results]:
    """An arm's agents behind the filter called every 1, 5 and 10 s."""
    return {f"{period:g}": evaluate(arm, rta=True, period=period) for period in PERIODS}


def training(study: Path, arms: dict[str, Arm]) -> str:
    """The table of the periodic evaluations."""
    paths = {name: study / name / "evaluations.jsonl" for name in arms}
    for name, path in paths.items():
        arm = arms[name]
        if arm.results["interactions"] >= arm.config.train.evaluation_interval and not path.exists():
            raise InputError(f"{path}: missing, and with it the training curves of {name}")
    with refusing(f"--study {study}: cannot read its evaluations.jsonl", OSError, *MALFORMED):
        rows = [row for name, path in paths.items() for row in tables.training(name, path)]
    return tables.text(rows, tables.TRAINING)


def with_rta(config: Config, rta: bool, period: float) -> Config:
    """The configuration with the filter off or called every `period` s."""
    return replace(config, train=replace(config.train, rta=rta), rta=replace(config.rta, period=period))


def evaluate(arm: Arm, rta: bool, period: float) -> Results:
    """The arm's agents on the study's test cases; the study's own results where it had the same filter."""
    config = with_rta(arm.config, rta, period)
    if config == arm.config:
        return arm.results
    seeds, episodes = len(arm.digests), config.train.final_episodes
    experiment = Experiment(config, seeds * episodes)
    record = play(arm.policy.to(experiment.device), experiment, episodes, TEST_CASES)
    return report(record, experiment.config, TEST_CASES, seeds)


def baselines(config: Config) -> dict[str, dict[str, Results]]:
    """Every controller of BASELINES on the study's test cases, without filter and behind it."""
    episodes = config.train.final_episodes
    experiments = {
        switch: Experiment(with_rta(config, rta, config.rta.period).unsettled(), episodes)
        for switch, rta in (("off", False), ("on", True))
    }

    def flown(name: str, experiment: Experiment) -> Results:
        record = play_controller(name, experiment, episodes, TEST_CASES)
        return report(record, experiment.config, TEST_CASES)

    return {
        name: {switch: flown(name, experiment) for switch, experiment in experiments.items()}
        for name in BASELINES
    }


def guidance(config: Config) -> Results:
    """The classical natural-motion guidance behind the filter."""
    experiment = Experiment(with_rta(config, True, GUIDANCE_PERIOD), GUIDANCE_CASES)
    record = play_controller("natural-motion", experiment, GUIDANCE_CASES, TEST_CASES)
    return report(record, experiment.config, TEST_CASES)


def episode(arm: Arm) -> Arrays:
    """The first seed's episode from the first test case, in the configuration of training."""
    experiment = Experiment(arm.config, 1)
    return common_episode(arm.first.to(experiment.device), experiment)


def demonstration(config: Config, rta: bool) -> Arrays:
    """A classical controller that heads for the limits, with or without the filter."""
    experiment = Experiment(with_rta(config, rta, config.rta.period), 1, DEMONSTRATION_DURATION)
    step = config.inspection.substep
    start = starting_point(str(DEMONSTRATION), experiment, TEST_CASES)
    env = experiment.env(1, decide_every=step, report_every=step)
    controller = classical("lqr-pd", config, TEST_CASES)
    return simulate(env, controller, *start, DEMONSTRATION_DURATION)

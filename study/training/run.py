"""A training run on disk: configuration, checkpoints, TensorBoard, periodic evaluation, clean interruption."""

import json
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from inspection.environment import METRICS, OUTCOMES, Correction
from inspection.observation import SIZE as OBSERVATION_SIZE
from ppo import checkpoint
from ppo.distributed import RankLostError, ranks
from ppo.learner import PPO, NonFiniteError
from ppo.network import Policy, Value
from ppo.trainer import Trainer
from rta.constraints import CONSTRAINTS
from study import config as configuration
from study import experiment as build
from study.config import Config
from study.errors import MALFORMED, InputError, refusing
from study.files import write_json, write_settings, write_text
from study.flight.evaluation import Episodes, evaluate, play, report
from study.flight.figures import episode_figure
from study.flight.simulation import common_episode
from study.flight.summary import iqm
from study.paper import tables
from study.training import shards as shard
from study.training.monitor import Monitor

RESUMABLE = ("policy", "value", "optimiser", "env", "generators", "update", "seconds", "config")
EVALUATION_SEED = 1_000_000  # periodic test cases, apart from those of the final evaluation


class Stopped(BaseException):
    """A signal ended the work early; the directory holds what is needed to continue.

    Like KeyboardInterrupt it can be raised anywhere, and nothing that handles an Exception may swallow it.
    """


class Timed:
    """A filter that adds up the seconds spent in it."""

    def __init__(self, correct: Any) -> None:
        self.correct = correct
        self.seconds = 0.0

    def __call__(self, x: Tensor, desired: Tensor) -> Correction:
        started = time.perf_counter()
        result = self.correct(x, desired)
        self.seconds += time.perf_counter() - started
        return result


@contextmanager
def on_signal(react: Callable[[], None]) -> Iterator[None]:
    """Lets SIGINT and SIGTERM call `react`."""
    previous = {
        number: signal.signal(number, lambda *_: react()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class Run:
    """The training of one seed, or of several side by side as one batch, and its directory.

    Of many ranks, each has a part of the episodes of one seed, or some of several seeds; the first one writes.

    Args:
        config: resolved configuration; directory: where everything is written.
        seeds: trained side by side, each with a directory of its own in `directory`; None: the configuration's
            only, in `directory` itself.

    Attributes:
        homes: each seed's own directory.
        shard: what of it is this rank's; env, policy and trainer are those of this part.
    """

    def __init__(self, config: Config, directory: Path, seeds: Sequence[int] | None = None) -> None:
        train = config.train
        self.config, self.directory = config, directory
        self.seeds = (train.seed,) if seeds is None else tuple(seeds)
        self.homes = [directory if seeds is None else directory / f"seed{seed}" for seed in self.seeds]
        self.device = build.resolve_device(train.device)
        self.ranks = ranks()
        if seeds is None:
            self.shard = shard.of_episodes(config, self.ranks)
        else:
            self.shard = shard.of_seeds(config, self.ranks, len(self.seeds))
        own_seeds, num_envs = self.seeds[self.shard.seeds], self.shard.num_envs
        generators = [torch.Generator(self.device).manual_seed(seed) for seed in own_seeds]
        calls_per_step = round(config.inspection.action_period / train.rta_period)
        steps = train.updates * train.rollout_steps
        self.filter_compiled = train.rta and build.wants_compile(
            train.compile, steps * calls_per_step >= build.WORTH_COMPILING_FILTER
        )
        self.compiled = build.wants_compile(train.compile, steps >= build.WORTH_COMPILING_SIMULATOR)
        self.safety = build.make_safety(
            config, train.rta, train.rta_period, self.filter_compiled, num_envs * len(own_seeds)
        )
        self.timer = Timed(self.safety.correct)
        timed = replace(self.safety, correct=self.timer) if train.rta else self.safety
        env = build.make_env(config, num_envs, generators, timed, self.compiled)
        if self.shard.learners.size > 1:
            for starts in env.starts:
                starts.turn = self.shard.learners.turn
        policy = build.make_policy(config, generators)
        value = Value(OBSERVATION_SIZE, generators)
        learner = PPO(policy, value, config.ppo, generators, self.shard.learners, self.shard.seeds.start)
        if self.compiled:
            samples = train.num_envs * train.rollout_steps
            build.compile_or_explain("learner", lambda: learner.compile(samples))
        self.policy: Policy = policy
        self.trainer = Trainer(env, learner, train.rollout_steps, train.updates, generators)
        self.monitor = Monitor(CONSTRAINTS, len(own_seeds), self.shard.seeds.start)
        self.env = env

    @property
    def checkpoint_path(self) -> Path:
        return self.directory / "checkpoint.pt"

    @property
    def interactions(self) -> int:
        """Interactions of each seed so far."""
        return self.trainer.update * self.config.train.batch

    def seconds(self) -> float:
        """Wall-clock s of training so far, of the rank that took longest; all ranks ask together."""
        return self.ranks.most(self.trainer.seconds)

    def create(self) -> None:
        """Starts the episodes and writes the first checkpoint."""
        with refusing("[inspection]", RuntimeError):
            self.env.reset()
        with refusing(f"{self.directory}: cannot write there", OSError):
            for home in self.homes:
                home.mkdir(parents=True, exist_ok=True)
            self.save()

    def resume(self) -> None:
        """Continues from the directory's checkpoint."""
        saved = checkpoint.load(self.checkpoint_path, RESUMABLE, self.device)
        with refusing(f"{self.checkpoint_path}: does not fit this run", *MALFORMED):
            self.trainer.load_state_dict(self.shard.split(saved))
        if self.ranks.first:
            self.forget_later_evaluations()

    def forget_later_evaluations(self) -> None:
        """Drops what a run that was killed had evaluated after its last checkpoint."""
        path = self.directory / "evaluations.jsonl"
        if path.is_file():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            whole = [line for line in lines if line.endswith("\n")]
            kept = [line for line in whole if json.loads(line)["interactions"] <= self.interactions]
            write_text(path, "".join(kept))

    def config_of(self, seed: int) -> Config:
        """The configuration with which `train` trains this seed alone."""
        return replace(self.config, train=replace(self.config.train, seed=seed))

    def save(self) -> None:
        """Writes the checkpoint of all ranks and each seed's policy alone."""
        states = self.ranks.collect(self.trainer.state_dict(), self.device)
        if not states:
            return
        state = self.shard.join(states)
        checkpoint.save(self.checkpoint_path, state | {"config": self.config.to_toml()})
        for k, (seed, home) in enumerate(zip(self.seeds, self.homes, strict=True)):
            own = {name: stacked[k : k + 1].clone() for name, stacked in state["policy"].items()}
            checkpoint.save(home / "policy.pt", {"policy": own, "config": self.config_of(seed).to_toml()})

    def train(self) -> None:
        """Trains to the end.

        Raises:
            Stopped: a signal came first; NonFiniteError: numbers went bad; RankLostError: another rank ended.
        """
        train = self.config.train
        folders = [self.directory, *self.homes] if len(self.homes) > 1 else [self.directory]
        self.writers = [
            SummaryWriter(str(folder), purge_step=self.interactions + 1)
            for folder in (folders if self.ranks.first else ())
        ]
        stop: list[bool] = []
        total = train.updates * train.batch
        columns = (
            "{desc}{percentage:3.0f}%|{bar}| {n:,}/{total:,} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
        )
        with (
            on_signal(lambda: stop.append(True)),  # so that the update under way can end first
            tqdm(
                total=total,
                initial=self.interactions,
                unit=" interactions",
                bar_format=columns,
                dynamic_ncols=True,
                mininterval=1.0,
                disable=not self.ranks.first,
            ) as self.bar,
        ):
            try:
                self.trainer.run(self.monitor, self.after_update, lambda: self.ranks.any(bool(stop)))
            except (NonFiniteError, RankLostError) as error:
                raise type(error)(
                    f"update {self.trainer.update + 1}: {error}; last good checkpoint: {self.checkpoint_path}"
                ) from None
            finally:
                for writer in self.writers:
                    writer.close()
        self.save()
        if self.ranks.any(bool(stop)):
            raise Stopped(
                f"stopped after {self.interactions:,} interactions; continue with --resume {self.directory}"
            )

    def after_update(self, statistics: dict[str, float]) -> None:
        """Checkpoints and evaluates when due; logs the update."""
        train = self.config.train
        statistics["time/filter_s"] = self.timer.seconds
        statistics["time/simulation_s"] = statistics["time/rollout_s"] - self.timer.seconds
        self.timer.seconds = 0.0
        for name, interval, action in (
            ("time/evaluation_s", train.evaluation_interval, self.evaluate),
            ("time/checkpoint_s", train.checkpoint_interval, self.save),
        ):
            if self.interactions // interval > (self.interactions - train.batch) // interval:
                started = time.perf_counter()
                action()
                statistics[name] = time.perf_counter() - started
        if reports := self.ranks.collect((statistics, self.monitor), self.device):
            self.log_update(reports)
        self.monitor.clear()

    def log_update(self, reports: list[tuple[dict[str, float], Monitor]]) -> None:
        """Shows the statistics and transitions of all ranks in TensorBoard and on the screen."""
        train = self.config.train
        parts, (monitor, *others) = zip(*reports, strict=True)
        for other in others:
            monitor.add(other)
        seeds = [monitor.seeds for _, monitor in reports]
        statistics = {tag: fmean((part[tag] for part in parts), seeds) for tag in parts[0]}
        for k, writer in enumerate(self.writers[1:]):
            for tag, value in monitor.charts(k).items():
                writer.add_scalar(tag, value, self.interactions)
        statistics |= monitor.scalars()
        slowest = max(part["time/rollout_s"] + part["time/learning_s"] for part in parts)
        statistics["charts/SPS"] = len(self.seeds) * train.batch / slowest
        for tag, value in statistics.items():
            self.writers[0].add_scalar(tag, value, self.interactions)
        shown = {
            label: f"{statistics[tag]:.{digits}f}"
            for label, tag, digits in (
                ("success", "charts/success", 2),
                ("reward", "charts/reward", 2),
                ("dv", "charts/delta_v_m_s", 1),
                ("violation", "charts/violation_percent", 2),
            )
            if tag in statistics
        }
        self.bar.set_postfix(shown, refresh=False)
        self.bar.update(train.batch)

    def conclude(self) -> str:
        """Evaluates the trained policy, writes evaluation.json and episode.png; returns the paper's tables."""
        config, train = self.config, self.config.train
        results = evaluate(
            self.policy, config, train.final_episodes, 0, self.device, self.safety, self.compiled
        )
        write_json(self.directory / "evaluation.json", results)
        episode = common_episode(self.policy, config, self.safety, self.device)
        episode_figure(episode, config.inspection, self.directory / "episode.png")
        return f"{tables(results)}\nWritten to {self.directory}: policy.pt, evaluation.json, episode.png"

    def play(self, episodes: int, seed: int) -> Episodes | None:
        """Deterministic episodes of every seed, in the configuration of training, from test cases drawn by `seed`.

        Of many ranks, each plays its own seeds, the first one a seed that they share; it alone gets the episodes.
        """
        record = None
        if self.shard.learners.first:
            record = play(self.policy, self.config, episodes, seed, self.device, self.safety, self.compiled)
        records = [each for each in self.ranks.collect(record, self.device) if each]
        return Episodes.join(records) if records else None

    def report(self, record: Episodes, seed: int) -> list[dict[str, Any]]:
        """Each seed's episodes in the form of `evaluate --json`."""
        train = self.config.train
        return [
            report(own, self.config_of(trained), train.rta, train.rta_period, seed)
            for trained, own in zip(self.seeds, record.split(len(self.seeds)), strict=True)
        ]

    def evaluate(self) -> None:
        """Periodic evaluation; a line per seed in evaluations.jsonl, with the metrics of every case."""
        record, seconds = self.play(self.config.train.evaluation_episodes, EVALUATION_SEED), self.seconds()
        if not record:
            return
        self.log(self.writers[0], record)
        episodes = record.split(len(self.seeds))
        for writer, own in zip(self.writers[1:], episodes, strict=False):
            self.log(writer, own)
        lines = []
        for own, results in zip(episodes, self.report(record, EVALUATION_SEED), strict=True):
            cases = dict(zip(METRICS, own.metrics.tolist(), strict=True))
            line = {"interactions": self.interactions, "seconds": seconds} | results
            lines.append(json.dumps(line | {"cases": cases}) + "\n")
        with open(self.directory / "evaluations.jsonl", "a", encoding="utf-8") as file:
            file.writelines(lines)

    def log(self, writer: SummaryWriter, record: Episodes) -> None:
        """Shows episodes in TensorBoard."""
        for name, values in zip(METRICS, record.metrics.cpu().numpy(), strict=True):
            writer.add_scalar(f"evaluation/{name}", float(iqm(values)), self.interactions)
        success = (record.outcome == OUTCOMES.index("success")).double().mean().item()
        writer.add_scalar("evaluation/success", success, self.interactions)


def check_trained_with(config: Config, path: Path) -> None:
    """Refuses a checkpoint that was trained in another configuration than config.toml's."""
    with refusing(str(path), KeyError, TypeError, AttributeError):
        trained = configuration.from_toml(checkpoint.load(path, RESUMABLE)["config"], str(path))
    if config != trained:
        raise InputError(f"{path.parent}: config.toml is not what {path.name} was trained with")


def with_solver(config: Config) -> Config:
    """The configuration with the solver settled, which is part of what determines a run's numbers."""
    return replace(config, train=replace(config.train, qp_solver=build.qp_solver(config.train)))


def start(config: Config, directory: Path) -> Run:
    """A fresh run in a directory that holds none; its solver is part of its configuration from here on."""
    config = with_solver(config)
    ranks().first_does(lambda: make_directory(directory))
    run = Run(config, directory)
    if run.ranks.first:
        with refusing(f"--run-dir {directory}: cannot write there", OSError):
            write_settings(config, directory)
    run.create()
    return run


def make_directory(directory: Path) -> None:
    """Makes the directory of a new run; refuses one that holds a run."""
    with refusing(f"--run-dir {directory}: cannot write there", OSError, ValueError):
        if any((directory / name).exists() for name in ("config.toml", "policy.pt", "checkpoint.pt")):
            raise InputError(f"--run-dir {directory}: holds a run already; continue it with --resume")
        directory.mkdir(parents=True, exist_ok=True)


def resume(directory: Path) -> Run:
    """The run in a directory, as its checkpoint left it."""
    if not (directory / "config.toml").is_file():
        raise InputError(f"--resume {directory}: no run there (it lacks config.toml)")
    config = configuration.load(directory / "config.toml")
    check_trained_with(config, directory / "checkpoint.pt")
    run = Run(config, directory)
    run.resume()
    return run


def describe(run: Run) -> str:
    """The first line a person sees."""
    train = run.config.train
    arm = f"RTA at {train.rta_period:g} s by {build.qp_solver(train)}" if train.rta else "no RTA"
    arm += ", compiled" if run.compiled or run.filter_compiled else ""
    first, *rest = run.seeds
    which = f"seeds {first} to {rest[-1]}" if rest else f"seed {first}"
    where = f"{run.ranks.size} ranks, {run.device.type}" if run.ranks.size > 1 else f"{run.device}"
    episodes = len(run.seeds) * train.num_envs
    return f"{run.directory}: {arm}, {which}, {episodes} episodes at once on {where}"

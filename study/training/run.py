"""One training run on disk: its start, checkpoints, interruption, continuation and end."""

import os
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from inspection.model.state import CONTROL_SIZE
from inspection.orbits import GUIDANCE
from inspection.transition import Transition
from ppo import checkpoint
from ppo.distributed import ALONE, ranks
from ppo.errors import NonFiniteError, RankLostError
from ppo.learner import PPO
from ppo.network import standard_deviation
from ppo.rollout import collect
from settings import InputError, to_toml
from study.config import EVALUATION_CASES, TEST_CASES, Config
from study.errors import Stopped, as_input_error
from study.experiment import Experiment
from study.files import write_json
from study.flight.evaluation import Episodes, play, report
from study.flight.figures import episode_figure
from study.flight.simulation import Recording
from study.machine import compile_or_explain
from study.paper import tables
from study.training.adversary import Adversary
from study.training.jump_start import JumpStart
from study.training.log import Log, times
from study.training.monitor import Exposure, LatestEpisodes, Monitor

CHECKPOINT = "checkpoint.pt"
LESSONS = "lessons"  # directory of the imitation phase's data, a file per batch; removed after the phase


@contextmanager
def on_signal(react: Callable[[int], None]) -> Iterator[None]:
    """Lets SIGINT and SIGTERM call `react` with their number."""
    numbers = signal.SIGINT, signal.SIGTERM
    previous = [signal.signal(number, lambda number, _: react(number)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


def say_in_a_handler(text: str) -> None:
    """Writes a line to stderr, past Python's buffers, which a signal may have interrupted."""
    with suppress(OSError, ValueError, AttributeError):  # stderr is not a file
        os.write(sys.stderr.fileno(), f"\n{text}\n".encode())


class Run:
    """Trains one seed, or several side by side as one batch, and keeps them in a directory.

    With many ranks, each rank has some of several seeds, or a part of one seed's episodes; the first rank writes.

    Args:
        config: settled, see `study.experiment.settled`; directory: receives all files.
        seeds: trained side by side, each with its own directory in `directory`; None: the configuration's seed alone,
            in `directory` itself.

    Attributes:
        seed_dirs: each seed's own directory.
        learners: the ranks that train the same seed; experiment, env and learner have this rank's part.
        update, trained_s: number of updates done, and their wall-clock s, over all sessions.
        annealing: a message about the learning rate, if the end of its annealing has moved.
    """

    annealing = ""

    def __init__(self, config: Config, directory: Path, seeds: Sequence[int] | None = None) -> None:
        train, ppo = config.train, config.ppo
        self.directory, self.ranks = directory, ranks()
        self.seeds = (train.seed,) if seeds is None else tuple(seeds)
        self.seed_dirs = [directory] if seeds is None else [directory / f"seed{seed}" for seed in seeds]
        self.learners = self.ranks if seeds is None else ALONE
        num_envs, own = train.num_envs // self.learners.size, slice(0, 1)
        if seeds is not None:
            with as_input_error(f"torchrun: [study] seeds = {len(seeds)}", ValueError):
                own = self.ranks.share(len(seeds))
        with as_input_error("torchrun", ValueError):
            for name, count in (
                ("[train] num_envs", train.num_envs),
                ("[ppo] minibatch_size", ppo.minibatch_size),
            ):
                if count % self.learners.size:
                    raise ValueError(f"{name} = {count}: must be a multiple of the {self.ranks.size} ranks")
            if ppo.minibatch_size < 2 * self.learners.size:
                raise ValueError(
                    f"[ppo] minibatch_size = {ppo.minibatch_size}: must be at least 2 for each of the ranks"
                )
        own_seeds = self.seeds[own]
        seconds = train.updates * train.rollout_steps * config.inspection.action_period
        self.experiment = Experiment(config, num_envs * len(own_seeds), seconds)
        self.config, self.device = self.experiment.config, self.experiment.device
        self.monitor = Monitor(self.experiment.safety.names, len(own_seeds), own.start)
        self.log = Log(directory, self.seed_dirs, train.batch)

        self.generators = generators = self.experiment.generators(own_seeds)
        safety = self.monitor.timed(self.experiment.safety)
        self.env = self.experiment.env(
            num_envs,
            generators,
            compiled=self.experiment.compiled,
            safety=safety,
            privileged=ppo.privileged,
        )
        self.exposure = Exposure(self.env.safety.names, num_envs * len(own_seeds), self.device)
        self.latest = LatestEpisodes(num_envs * len(own_seeds), self.device)
        self.policy = self.experiment.policy(generators)
        value = self.experiment.value(generators)
        cost_value = self.experiment.value(generators) if ppo.cost_limit < 1.0 else None
        self.learner = PPO(
            self.policy,
            value,
            replace(ppo, minibatch_size=ppo.minibatch_size // self.learners.size),
            generators,
            self.learners,
            own.start,
            cost_value,
        )
        if not self.learners.first:  # equal networks, but episodes and actions of its own
            for generator in generators:
                stream = np.random.SeedSequence((train.seed, self.learners.rank))
                generator.manual_seed(int(stream.generate_state(1)[0]))
        if self.experiment.compiled and self.device.type == "cuda":  # not faster on a CPU
            compile_or_explain("learner", lambda: self.learner.compile(num_envs * train.rollout_steps))
        self.learning_env = Adversary(self.env, train.adversary) if train.adversary else self.env
        self.update, self.trained_s = 0, 0.0
        self.imitation: JumpStart | None = None
        if train.jump_start:
            given = self.learner, train.rollout_steps, train.lessons, generators
            self.imitation = JumpStart(self.env, GUIDANCE[train.teacher], *given)
        self.last_save: dict[str, float] = {}  # statistics that the next update shows

    def __str__(self) -> str:
        """Returns the first lines that a person sees."""
        config, experiment = self.config, self.experiment
        kind = "the paper's RTA" if config.rta.filter == "paper" else "RTA"
        arm = f"{kind} at {config.rta.period:g} s by {config.rta.solver}" if config.train.rta else "no RTA"
        arm += ", compiled" if experiment.compiled or experiment.filter_compiled else ""
        first, *rest = self.seeds
        which = f"seeds {first} to {rest[-1]}" if rest else f"seed {first}"
        where = f"{self.ranks.size} ranks, {self.device.type}" if self.ranks.size > 1 else f"{self.device}"
        episodes = len(self.seeds) * config.train.num_envs
        return f"{self.directory}: {arm}, {which}, {episodes} episodes at once on {where}{self.annealing}"

    @property
    def plan(self) -> str:
        """Returns the plan: the number of interactions in whole updates, and of the test flights after them."""
        train = self.config.train
        total, size = train.updates * train.batch, f"{train.num_envs:,} * {train.rollout_steps:,}"
        why = f" ({train.interactions:,} rounded up)" if total > train.interactions else ""
        done = f"; {self.interactions:,} are done" if self.interactions else ""
        return (
            f"{total:,} interactions{why}, in updates of num_envs * rollout_steps = {size} = {train.batch:,}{done}\n"
            f"then {train.final_episodes:,} test flights, which may take minutes (--final-episodes N changes that)"
        )

    def watch(self, transition: Transition) -> None:
        """Takes in one interaction of the batch."""
        self.monitor(transition)
        self.exposure(transition)
        self.latest(transition)

    def imitate(self, imitation: JumpStart, stopped: Callable[[], bool]) -> None:
        """Runs the imitation phase in place of the first updates, and saves each batch."""
        while not imitation.done and not stopped():
            statistics = imitation.teach(self.watch)
            self.update += 1
            self.trained_s += statistics["time/rollout_s"] + statistics["time/learning_s"]
            self.show(statistics | self.last_save)
            self.last_save = {"time/checkpoint_s": seconds_of(self.save)}

    @property
    def interactions(self) -> int:
        """Returns the number of interactions of each seed so far."""
        return self.update * self.config.train.batch

    def seconds(self) -> float:
        """Returns wall-clock s of training so far, of the slowest rank; all ranks must call it together."""
        return self.ranks.most(self.trained_s)

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that this rank needs to continue exactly, except the imitation phase."""
        return self.learner.state_dict() | {
            "env": self.env.state_dict(),
            "generators": [generator.get_state() for generator in self.generators],
            "update": self.update,
            "seconds": self.trained_s,
            "training": self.exposure.state_dict() | self.latest.state_dict(),
        }

    def save(self) -> None:
        """Writes the checkpoint of all ranks, and each seed's policy in a file of its own."""
        own = self.state_dict()
        if self.imitation and self.imitation.taught > 0 and not self.imitation.done:
            own |= {"lessons": self.imitation.state_dict(), "lesson": self.imitation.latest}
        states = self.ranks.collect(own, self.device)
        if not states:
            return
        lessons = [state.pop("lesson", {}) for state in states]
        if any(lessons):
            folder = self.directory / LESSONS
            folder.mkdir(exist_ok=True)
            checkpoint.save(folder / f"{own['lessons']['taught']}.pt", {"of_ranks": lessons})
        first, *others = states
        whole = first | {"config": to_toml(self.config)}
        if others:
            whole["others"] = others
        checkpoint.save(self.directory / CHECKPOINT, whole)
        policies = []
        for state in states if self.learners is ALONE else states[:1]:
            for k in range(len(state["generators"])):
                policies.append({name: each[k : k + 1].clone() for name, each in state["policy"].items()})
        for seed, home, policy in zip(self.seeds, self.seed_dirs, policies, strict=True):
            checkpoint.save(home / "policy.pt", {"policy": policy, "config": to_toml(self.config_of(seed))})
        if "lessons" not in first:  # the phase is over, and the checkpoint says so
            shutil.rmtree(self.directory / LESSONS, ignore_errors=True)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restores the training from a checkpoint of `save`; raises various errors if the checkpoint does not fit."""
        states = [saved, *saved.get("others", ())]
        if len(states) != self.ranks.size:
            raise InputError(
                f"{self.directory}: was trained by {len(states)} ranks; must continue with as many, not "
                f"{self.ranks.size}"
            )
        own = states[self.ranks.rank]
        self.learner.load_state_dict(own)
        self.env.load_state_dict(own["env"])
        for generator, state in zip(self.generators, own["generators"], strict=True):
            generator.set_state(state.cpu())
        self.update, self.trained_s = int(own["update"]), float(own["seconds"])
        if "training" in own:  # older checkpoints lack it
            self.exposure.load_state_dict(own["training"])
            self.latest.load_state_dict(own["training"])
        if self.imitation and (state := own.get("lessons")):
            files = [self.directory / LESSONS / f"{i + 1}.pt" for i in range(int(state["taught"]))]
            batches = [checkpoint.load(file, (), self.device) for file in files]
            # files of an older run hold the data of one rank
            own_batches = [batch.get("of_ranks", [batch])[self.ranks.rank] for batch in batches]
            self.imitation.load_state_dict(state, own_batches)

    def config_of(self, seed: int) -> Config:
        """Returns the configuration with which `train` trains this seed alone."""
        return replace(self.config, train=replace(self.config.train, seed=seed))

    def written(self) -> Iterator[Path]:
        """Yields the files that training replaces repeatedly."""
        yield from (self.directory / CHECKPOINT, *(home / "policy.pt" for home in self.seed_dirs))
        yield from (self.directory / "config.toml", self.log.evaluations)

    @contextmanager
    def naming_the_checkpoint(self) -> Iterator[None]:
        """Adds the last good checkpoint to the message of an OSError that names its file."""
        try:
            yield
        except OSError as error:
            if error.filename is None:
                raise
            last = self.directory / CHECKPOINT
            left = f"last good checkpoint: {last}" if last.is_file() else "no checkpoint is left"
            raise OSError(error.errno, f"{error.strerror}; {left}", error.filename) from None

    def train(self) -> None:
        """Trains to the end.

        Raises:
            Stopped: a signal came first; NonFiniteError: numbers are not finite; RankLostError: another rank ended;
            OSError: a file could not be written. All except Stopped name the last good checkpoint.
        """
        stop: list[int] = []  # numbers of signals; the update during which one comes is finished first

        def react(number: int) -> None:
            if not stop and self.ranks.first:
                say_in_a_handler(
                    "stopping after this update or lesson, and an evaluation that is due then ..."
                )
            stop.append(number)

        def stopped() -> bool:
            return bool(self.ranks.most(bool(stop)))

        train = self.config.train
        shown = (
            self.log.open(self.interactions, train.updates * train.batch, to_toml(self.config))
            if self.ranks.first
            else nullcontext()
        )
        with self.naming_the_checkpoint():
            with on_signal(react), shown:
                try:
                    self.env.progress = self.update / train.updates
                    self.begin(stopped)
                    while self.update < train.updates and not stopped():
                        started = time.perf_counter()
                        batch = collect(
                            self.learning_env,
                            self.learner,
                            train.rollout_steps,
                            self.generators,
                            self.watch,
                            train.learn_from == "applied",
                        )
                        collected = time.perf_counter()
                        losses = self.learner.update(batch, self.update / train.updates)
                        learned = time.perf_counter()
                        self.update += 1
                        self.trained_s += learned - started
                        self.after_update(self.statistics(losses) | times(started, collected, learned))
                except (NonFiniteError, RankLostError) as error:
                    where, last = f"update {self.update + 1}", self.directory / CHECKPOINT
                    raise type(error)(f"{where}: {error}; last good checkpoint: {last}") from None
            self.save()
        if number := int(self.ranks.most(max(stop, default=0))):
            raise Stopped(
                f"stopped after {self.interactions:,} interactions; continue with\n"
                f"  python main.py train --resume {shlex.quote(str(self.directory))}",
                number,
            )

    def statistics(self, losses: dict[str, Tensor]) -> dict[str, float]:
        """Returns the statistics of an update, means over seeds, by TensorBoard's tags."""
        found = {f"losses/{name}": value.mean().item() for name, value in losses.items()}
        found["policy/std"] = standard_deviation(found["losses/entropy"], CONTROL_SIZE)
        found["learner/learning_rate"] = self.learner.optimiser.param_groups[0]["lr"]
        return found

    def begin(self, stopped: Callable[[], bool]) -> None:
        """Runs what comes before the first PPO update: the imitation phase, and evaluations before and after it."""
        early = self.config.train.early_evaluations > 1
        if early and not self.interactions and not self.ranks.agree(self.log.begun()):
            self.evaluate()
        if self.imitation and self.update < self.imitation.batches:
            self.imitate(self.imitation, stopped)
            for batch in (self.imitation.flown, self.imitation.latest):  # both are large
                batch.clear()
            if early and self.imitation.done:
                self.evaluate()

    def after_update(self, statistics: dict[str, float]) -> None:
        """Evaluates when due, logs the update, then checkpoints when due."""
        train = self.config.train
        statistics |= self.last_save
        early = self.interactions < train.evaluation_interval
        if self.due(train.evaluation_interval // (train.early_evaluations if early else 1)):
            statistics["time/evaluation_s"] = seconds_of(self.evaluate)
        self.show(statistics)
        self.last_save = {}
        if self.due(train.checkpoint_interval):  # last, so that a checkpoint includes the charts' points
            self.last_save = {"time/checkpoint_s": seconds_of(self.save)}

    def show(self, statistics: dict[str, float]) -> None:
        """Logs an update or an imitation batch of all ranks; sets the progress, with which the fuel penalty grows."""
        self.env.progress = self.update / self.config.train.updates
        self.monitor.episodes.append(self.latest.shown(self.monitor.seeds, self.monitor.first_seed))
        statistics["time/filter_s"] = self.monitor.filter_seconds
        statistics["time/simulation_s"] = statistics["time/rollout_s"] - self.monitor.filter_seconds
        if reports := self.ranks.collect((statistics, self.monitor), self.device):
            self.log.update(reports, self.interactions)
        self.monitor.clear()

    def due(self, interval: int) -> bool:
        """Tells whether the last update passed a multiple of `interval` interactions."""
        return self.interactions % interval < self.config.train.batch

    def evaluate(self) -> None:
        """Evaluates all seeds on the cases of the periodic evaluation, and logs the results."""
        record = self.play(self.config.train.evaluation_episodes, EVALUATION_CASES)
        seconds = self.seconds()
        if record:
            self.log.evaluation(record, self.reports(record, EVALUATION_CASES), self.interactions, seconds)

    def play(self, episodes: int, seed: int) -> Episodes | None:
        """Plays episodes of every seed, deterministically, in the configuration of training, from test cases of `seed`.

        With many ranks, each plays its own seeds, or the first rank plays the one that they share. The first rank gets
        all episodes, the others None.
        """
        record = play(self.policy, self.experiment, episodes, seed) if self.learners.first else None
        records = [part for part in self.ranks.collect(record, self.device) if part]
        return Episodes.join(records) if records else None

    def reports(self, record: Episodes, seed: int) -> list[dict[str, Any]]:
        """Returns each seed's episodes in the form of `evaluate --json`."""
        parts = zip(self.seeds, record.split(len(self.seeds)), strict=True)
        return [report(own, self.config_of(trained), seed) for trained, own in parts]

    def violations_in_training(self) -> list[dict[str, Any]]:
        """Returns `Exposure.report` of all ranks' seeds on the first one, else an empty list; all must call it."""
        reports = self.ranks.collect(self.exposure.report(len(self.generators)), self.device)
        return list(chain(*reports))

    def conclude(self) -> str:
        """Evaluates the trained policy, writes evaluation.json and episode.png; returns the last message for a person.

        Raises:
            Stopped: a signal came before all was evaluated.
        """

        def stop(number: int) -> None:
            again = f"python main.py train --resume {shlex.quote(str(self.directory))}"
            raise Stopped(f"trained, but not evaluated to the end; continue with\n  {again}", number)

        with on_signal(stop):
            cases = self.config.train.final_episodes
            recording = Recording()
            record = play(self.policy, self.experiment, cases, TEST_CASES, recording)
        results = report(record, self.config, TEST_CASES)
        with self.naming_the_checkpoint():
            write_json(self.directory / "evaluation.json", results)
            episode_figure(recording.arrays(), self.config.inspection, self.directory / "episode.png")
        written = f"Written to {self.directory}: policy.pt, evaluation.json, episode.png"
        return "\n".join((tables(results), written, what_next(self.directory)))


def what_next(directory: Path) -> str:
    """Returns commands that evaluate a trained agent, replay its flight and show its training curves."""
    agent, flight, page, logs = (
        shlex.quote(str(path))
        for path in (directory / "policy.pt", directory / "flight.npz", directory / "flight.html", directory)
    )
    fly = f"python main.py simulate --controller policy --checkpoint {agent} --duration 3600 --out {flight}"
    return "\n  ".join(
        (
            "Next:",
            f"python main.py evaluate --checkpoint {agent} --episodes 1000",
            f"{fly} && python main.py replay {flight} --out {page}",
            f"tensorboard --logdir {logs}",
        )
    )


def seconds_of(deed: Callable[[], None]) -> float:
    """Calls a function and returns the wall-clock s that it takes."""
    started = time.perf_counter()
    deed()
    return time.perf_counter() - started

"""One training run on disk: begun, checkpointed, interrupted, continued and concluded."""

import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from ppo import checkpoint
from ppo.distributed import RankLostError, ranks
from ppo.files import naming, temporary_beside
from ppo.learner import PPO, NonFiniteError
from ppo.trainer import Trainer
from study import config as configuration
from study.config import TEST_CASES, AnyConfig, Config
from study.errors import MALFORMED, InputError, refusing
from study.experiment import Experiment, check_clocks, compile_or_explain, resolve_device, settled
from study.files import write_json, write_text
from study.flight.evaluation import Episodes, evaluate, play, report
from study.flight.figures import episode_figure
from study.flight.simulation import common_episode
from study.paper import tables
from study.training.commands import after_training, command
from study.training.init import networks_of
from study.training.lock import alone_in
from study.training.log import Log
from study.training.monitor import Monitor
from study.training.provenance import write_settings
from study.training.shards import shard_of_episodes, shard_of_seeds

CHECKPOINT = "checkpoint.pt"
BEGUN = (
    "provenance.json",
    "config.toml",
    CHECKPOINT,
)  # in this order; before the last one, there is no run yet
RESUMABLE = ("policy", "value", "optimiser", "env", "generators", "update", "seconds", "config")
EVALUATION_CASES = 1_000_000  # seed of the periodic test cases, apart from those of the final evaluation


class Stopped(BaseException):
    """A signal ended the work early; the directory holds what is needed to continue.

    Like KeyboardInterrupt it can be raised anywhere, and nothing that handles an Exception may swallow it.
    """


@contextmanager
def on_signal(react: Callable[[], None]) -> Iterator[None]:
    """Lets SIGINT and SIGTERM call `react`."""
    numbers = signal.SIGINT, signal.SIGTERM
    previous = [signal.signal(number, lambda *_: react()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)


class Run:
    """The training of one seed, or of several side by side as one batch, and its directory.

    Of many ranks, each has a part of the episodes of one seed, or some of several seeds; the first one writes.

    Args:
        config: settled, see `settled_for_a_seed`; directory: where everything is written.
        seeds: trained side by side, each with a directory of its own in `directory`; None: the configuration's
            only, in `directory` itself.

    Attributes:
        homes: each seed's own directory.
        shard: what of it is this rank's; experiment, env and trainer are those of this part.
        annealing: what a person is told of the learning rate, if its end has moved.
    """

    annealing = ""

    def __init__(self, config: Config, directory: Path, seeds: Sequence[int] | None = None) -> None:
        train = config.train
        self.directory, self.ranks = directory, ranks()
        if seeds is None:
            self.seeds, self.homes = (train.seed,), [directory]
            self.shard = shard_of_episodes(config, self.ranks)
        else:
            self.seeds, self.homes = tuple(seeds), [directory / f"seed{seed}" for seed in seeds]
            self.shard = shard_of_seeds(config, self.ranks, len(self.seeds))
        own_seeds, num_envs = self.seeds[self.shard.seeds], self.shard.num_envs
        steps = train.updates * train.rollout_steps
        seconds = steps * config.inspection.action_period
        self.experiment = Experiment(config, num_envs * len(own_seeds), seconds, steps)
        self.config, self.device = self.experiment.config, self.experiment.device
        self.monitor = Monitor(self.experiment.safety.names, len(own_seeds), self.shard.seeds.start)
        self.log = Log(directory, self.homes, train.batch)

        generators = self.experiment.generators(own_seeds)
        self.env = self.experiment.env(num_envs, generators, compiled=self.experiment.compiled)
        self.env.put_behind(self.monitor.timed(self.env.safety))
        for starts in self.env.starts:
            starts.turn = self.shard.learners.turn
        self.policy = self.experiment.policy(generators)
        value = self.experiment.value(generators)
        learner = PPO(self.policy, value, config.ppo, generators, self.shard.learners, self.shard.seeds.start)
        if self.experiment.compiled:
            compile_or_explain("learner", lambda: learner.compile(train.batch))
        self.trainer = Trainer(self.env, learner, train.rollout_steps, train.updates, generators)
        self.last_save: dict[str, float] = {}  # statistics that the next update shows

    def __str__(self) -> str:
        """The first lines a person sees."""
        config, experiment = self.config, self.experiment
        arm = f"RTA at {config.rta.period:g} s by {config.rta.qp_solver}" if config.train.rta else "no RTA"
        arm += ", compiled" if experiment.compiled or experiment.filter_compiled else ""
        first, *rest = self.seeds
        which = f"seeds {first} to {rest[-1]}" if rest else f"seed {first}"
        where = f"{self.ranks.size} ranks, {self.device.type}" if self.ranks.size > 1 else f"{self.device}"
        episodes = len(self.seeds) * config.train.num_envs
        return f"{self.directory}: {arm}, {which}, {episodes} episodes at once on {where}{self.annealing}"

    @property
    def interactions(self) -> int:
        """Interactions of each seed so far."""
        return self.trainer.update * self.config.train.batch

    def seconds(self) -> float:
        """Wall-clock s of training so far, of the rank that took longest; all ranks ask together."""
        return self.ranks.most(self.trainer.seconds)

    def save(self) -> None:
        """Writes the checkpoint of all ranks and each seed's policy alone."""
        states = self.ranks.collect(self.trainer.state_dict(), self.device)
        if not states:
            return
        state = self.shard.join(states)
        about = {"config": self.config.to_toml(), "charts": self.log.state()}
        checkpoint.save(self.directory / CHECKPOINT, state | about)
        for k, (seed, home) in enumerate(zip(self.seeds, self.homes, strict=True)):
            own = {name: stacked[k : k + 1].clone() for name, stacked in state["policy"].items()}
            checkpoint.save(home / "policy.pt", {"policy": own, "config": self.config_of(seed).to_toml()})

    def config_of(self, seed: int) -> Config:
        """The configuration with which `train` trains this seed alone."""
        return replace(self.config, train=replace(self.config.train, seed=seed))

    def written(self) -> Iterator[Path]:
        """The files that are replaced again and again."""
        yield from (self.directory / CHECKPOINT, *(home / "policy.pt" for home in self.homes))
        yield from (self.directory / "config.toml", self.log.evaluations)

    @contextmanager
    def naming_the_checkpoint(self) -> Iterator[None]:
        """Lets an OSError that names its file name the last good checkpoint, too."""
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
            Stopped: a signal came first; NonFiniteError: numbers went bad; RankLostError: another rank ended;
            OSError: something could not be written. All but the first name the last good checkpoint.
        """
        stop: list[bool] = []  # a signal comes during an update, which can end first
        total = self.config.train.updates * self.config.train.batch
        shown = self.log.open(self.interactions, total) if self.ranks.first else nullcontext()
        with self.naming_the_checkpoint():
            with on_signal(lambda: stop.append(True)), shown:
                try:
                    self.trainer.run(self.monitor, self.after_update, lambda: self.ranks.any(bool(stop)))
                except (NonFiniteError, RankLostError) as error:
                    where, last = f"update {self.trainer.update + 1}", self.directory / CHECKPOINT
                    raise type(error)(f"{where}: {error}; last good checkpoint: {last}") from None
            self.save()
        if self.ranks.any(bool(stop)):
            raise Stopped(
                f"stopped after {self.interactions:,} interactions; continue with\n"
                f"  {command('train', '--resume', self.directory)}"
            )

    def after_update(self, statistics: dict[str, float]) -> None:
        """Evaluates when due, logs the update, then checkpoints when due."""
        train = self.config.train
        statistics["time/filter_s"] = self.monitor.filter_seconds
        statistics["time/simulation_s"] = statistics["time/rollout_s"] - self.monitor.filter_seconds
        statistics |= self.last_save
        if self.due(train.evaluation_interval):
            statistics["time/evaluation_s"] = seconds_of(self.evaluate)
        if reports := self.ranks.collect((statistics, self.monitor), self.device):
            self.log.update(reports, self.interactions)
        self.monitor.clear()
        # last, so that a checkpoint knows what has been drawn
        self.last_save = (
            {"time/checkpoint_s": seconds_of(self.save)} if self.due(train.checkpoint_interval) else {}
        )

    def due(self, interval: int) -> bool:
        """Whether the last update completed so many interactions, once more."""
        return self.interactions % interval < self.config.train.batch

    def evaluate(self) -> None:
        """Periodic evaluation."""
        record = self.play(self.config.train.evaluation_episodes, EVALUATION_CASES)
        seconds = self.seconds()
        if record:
            self.log.evaluation(record, self.reports(record, EVALUATION_CASES), self.interactions, seconds)

    def play(self, episodes: int, seed: int) -> Episodes | None:
        """Deterministic episodes of every seed, in the configuration of training, from test cases drawn by `seed`.

        Of many ranks, each plays its own seeds, the first one a seed that they share; it alone gets the episodes.
        """
        record = play(self.policy, self.experiment, episodes, seed) if self.shard.learners.first else None
        records = [part for part in self.ranks.collect(record, self.device) if part]
        return Episodes.join(records) if records else None

    def reports(self, record: Episodes, seed: int) -> list[dict[str, Any]]:
        """Each seed's episodes in the form of `evaluate --json`."""
        parts = zip(self.seeds, record.split(len(self.seeds)), strict=True)
        return [report(own, self.config_of(trained), seed) for trained, own in parts]

    def conclude(self) -> str:
        """Evaluates the trained policy, writes evaluation.json and episode.png; returns what a person sees last."""
        results = evaluate(self.policy, self.experiment, self.config.train.final_episodes, TEST_CASES)
        episode = common_episode(self.policy, self.experiment)
        with self.naming_the_checkpoint():
            write_json(self.directory / "evaluation.json", results)
            episode_figure(episode, self.config.inspection, self.directory / "episode.png")
        written = f"Written to {self.directory}: policy.pt, evaluation.json, episode.png"
        return "\n".join((tables(results), written, after_training(self.directory)))


def seconds_of(deed: Callable[[], None]) -> float:
    """The wall-clock s that it takes."""
    started = time.perf_counter()
    deed()
    return time.perf_counter() - started


def settled_for_a_seed(config: AnyConfig) -> AnyConfig:
    """The configuration with the solver settled for one seed, whatever is trained beside it and on how many ranks."""
    return settled(config, config.train.num_envs, resolve_device(config.train.device))


def check_minibatch(config: Config) -> None:
    """Refuses a minibatch that an update has not enough interactions for."""
    train, size = config.train, config.ppo.minibatch_size
    if size > train.batch:
        raise InputError(
            f"[ppo] minibatch_size = {size:,}: must be at most the batch, [train] num_envs * rollout_steps = "
            f"{train.num_envs:,} * {train.rollout_steps:,} = {train.batch:,}"
        )


@contextmanager
def starting(config: Config, directory: Path, init_from: Path | None = None) -> Iterator[Run]:
    """A fresh run, see `start`, with its directory to itself; leaves no directory where it comes to nothing."""
    with made(directory), alone_in(directory, "--run-dir"):
        yield start(config, directory, init_from)


@contextmanager
def resuming(directory: Path, configure: Callable[[Config], Config]) -> Iterator[Run]:
    """A run that goes on, see `resume`, with its directory to itself; `configure` has the last word on its settings."""
    path = directory / "config.toml"
    if not path.is_file():
        raise InputError(f"--resume {directory}: no run there (it lacks config.toml)")
    with alone_in(directory, "--resume"):
        yield resume(directory, configure(configuration.load(path)))


def start(config: Config, directory: Path, init_from: Path | None = None) -> Run:
    """A fresh run in a directory that holds none; its solver is part of its configuration from here on.

    Args:
        init_from: the file of an agent to start from, policy.pt or checkpoint.pt; None: from chance.
    """
    config = settled_for_a_seed(config)
    check_clocks(config)
    check_minibatch(config)
    networks = networks_of(init_from, config) if init_from else {}

    def begin() -> None:
        check_empty(directory)
        with refusing(f"--run-dir {directory}: cannot write there", OSError, ValueError):
            directory.mkdir(parents=True, exist_ok=True)
            write_settings(config, directory, init_from)

    ranks().first_does(begin)
    return create(config, directory, networks=networks)


@contextmanager
def made(directory: Path) -> Iterator[None]:
    """Makes a directory that is not there; takes it away again where an exception leaves no agent in it."""
    mine: list[Path] = []

    def make() -> None:
        missing = [path for path in (directory, *directory.parents) if not path.exists()]
        with suppress(FileExistsError):
            directory.mkdir(parents=True)
            mine.extend(missing)

    with refusing(f"--run-dir {directory}: cannot write there", OSError, ValueError):
        ranks().first_does(make)
    try:
        yield
    except BaseException:
        if mine and not any((directory / name).exists() for name in (CHECKPOINT, "policy.pt")):
            shutil.rmtree(directory, ignore_errors=True)
            with suppress(OSError):  # of the directories above those that hold nothing else
                for above in mine[1:]:
                    above.rmdir()
        raise


def check_empty(directory: Path) -> None:
    """Refuses the directory of a new run that holds one, or anything but what a kill at the start left."""
    with refusing(f"--run-dir {directory}: cannot write there", OSError, ValueError):
        found = {path.name for path in directory.iterdir()} if directory.exists() else set()
    if found & {CHECKPOINT, "policy.pt"}:
        raise InputError(f"--run-dir {directory}: holds a run already; continue it with --resume")
    left = {name for name in BEGUN if name in found} | {f"{name}.tmp" for name in BEGUN}
    if "provenance.json" not in found:  # which is written first
        left.discard("config.toml")
    if other := sorted(found - left):
        raise InputError(f"--run-dir {directory}: holds no run but {other[0]}; name a new directory")


def create(
    config: Config,
    directory: Path,
    seeds: Sequence[int] | None = None,
    networks: Mapping[str, dict[str, Any]] | None = None,
) -> Run:
    """A fresh `Run`: starts the episodes and writes the first checkpoint; `networks` are weights to start from."""
    run = Run(config, directory, seeds)
    for name, weights in (networks or {}).items():
        with refusing(f"--init-from: its {name} network does not fit this run", *MALFORMED):
            getattr(run.trainer.learner, name).load_state_dict(weights)
    with refusing("[inspection]", RuntimeError):
        run.env.reset()
    with refusing(f"{directory}: cannot write there", OSError):
        for home in run.homes:
            home.mkdir(parents=True, exist_ok=True)
        run.save()
    return run


def resume(directory: Path, config: Config | None = None, seeds: Sequence[int] | None = None) -> Run:
    """A `Run` as the directory's checkpoint left it; without a configuration that of its config.toml.

    The configuration of a run of one seed may want other interactions than the checkpoint's: they are then what
    config.toml wants, too.
    """
    config = config or configuration.load(directory / "config.toml")
    path = directory / CHECKPOINT
    saved = checkpoint.load(path, RESUMABLE, resolve_device(config.train.device))
    with refusing(str(path), KeyError, TypeError, ValueError, AttributeError):
        trained = configuration.from_toml(saved["config"], str(path))
        done, rate = int(saved["update"]), trained.ppo.learning_rate
    before, total = trained.train, config.train.interactions
    moved = seeds is None and total != before.interactions
    if config != (replace(trained, train=replace(before, interactions=total)) if moved else trained):
        raise InputError(f"{directory}: config.toml is not what {path.name} was trained with")
    if moved and config.train.updates <= done:
        raise InputError(
            f"--resume {directory}: {done * before.batch:,} interactions are done; --interactions must be more"
        )
    run = Run(config, directory, seeds)
    if moved:
        run.annealing = (
            f"\nlearning rate from {rate * (1 - done / before.updates):.3g} to "
            f"{rate * (1 - done / config.train.updates):.3g}, since it is annealed to 0 at {total:,} interactions now, "
            f"not at {before.interactions:,}"
        )
    with refusing(f"{path}: does not fit this run", *MALFORMED):
        run.trainer.load_state_dict(run.shard.split(saved))
        run.log.load_state(saved.get("charts", []))
    if run.ranks.first:
        with run.naming_the_checkpoint():
            for file in run.written():  # what a kill left, which may be what fills the disk
                with naming(file):
                    temporary_beside(file).unlink(missing_ok=True)
            run.log.forget_evaluations_after(run.interactions)
            if moved:  # from here on, config.toml alone says so
                write_text(directory / "config.toml", config.to_toml())
    return run

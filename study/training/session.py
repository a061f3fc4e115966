"""Start and continuation of a training run: its directory, its lock, its first networks or its checkpoint."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ppo import checkpoint
from ppo.distributed import ranks
from ppo.files import naming, temporary_beside
from settings import InputError, from_toml, load, to_toml
from study.config import Config
from study.errors import MALFORMED, as_input_error
from study.experiment import (
    check_chief,
    check_clocks,
    check_observed,
    check_plant,
    check_weights,
    load_policy,
    settled,
)
from study.files import write_text
from study.machine import LOCKS, directory_lock, resolve_device, write_settings
from study.training.run import CHECKPOINT, Run

# files that a run writes first, in this order; the run exists once the last one does
BEGUN = ("provenance.json", "config.toml", CHECKPOINT)
RESUMABLE = ("policy", "value", "optimiser", "env", "generators", "update", "seconds", "config")
# keys of [ppo] that must agree for weights to fit
FITTING = ("hidden", "log_std_bounds", "tanh_outputs", "action_power")


def check_minibatch(config: Config) -> None:
    """Raises InputError if a minibatch is larger than the interactions of an update."""
    train, size = config.train, config.ppo.minibatch_size
    if size > train.batch:
        raise InputError(
            f"[ppo] minibatch_size = {size:,}: must be at most the batch, [train] num_envs * rollout_steps = "
            f"{train.num_envs:,} * {train.rollout_steps:,} = {train.batch:,}"
        )


def check_learn_from(config: Config) -> None:
    """Raises InputError if a run cannot learn from applied actions."""
    train = config.train
    if train.learn_from == "desired":
        return
    flag = f"--learn-from ([train] learn_from) {train.learn_from}"
    if not train.rta:
        raise InputError(f"{flag}: without the filter what is applied is what was desired: must be desired")
    if train.adversary:
        raise InputError(f"{flag}: an adversary is paid for the smallest h alone: must be desired")


def check_cost_limit(config: Config) -> None:
    """Raises InputError if an agent that is rewarded for violations has a limit on their cost."""
    if config.train.adversary and config.ppo.cost_limit < 1.0:
        raise InputError(
            f"[ppo] cost_limit = {config.ppo.cost_limit:g}: must be 1 for an adversary ([train] adversary)"
        )


def check(config: Config) -> None:
    """Raises InputError for a configuration that cannot be trained, before anything is made."""
    check_clocks(config)
    check_minibatch(config)
    check_plant(config)
    check_chief(config)
    check_learn_from(config)
    check_cost_limit(config)


@contextmanager
def starting(config: Config, directory: Path, init_from: Path | None = None) -> Iterator[Run]:
    """Starts a fresh run, see `start`, and locks its directory."""
    run = built(config, directory, init_from)
    with as_input_error(f"--run-dir {directory}: cannot write there", OSError, ValueError):
        ranks().first_does(lambda: directory.mkdir(parents=True, exist_ok=True))
    with directory_lock(directory, "--run-dir"):
        begin(run, init_from)
        yield run


@contextmanager
def resuming(directory: Path, config: Config) -> Iterator[Run]:
    """Continues a run, see `resume`, and locks its directory; `config` comes from the directory's `settings`."""
    with directory_lock(directory, "--resume"):
        yield resume(directory, config)


def settings(directory: Path) -> Config:
    """Returns the configuration of the run in a directory; raises InputError if there is no run."""
    path = directory / "config.toml"
    if not path.is_file():
        raise InputError(f"--resume {directory}: no run there (it lacks config.toml)")
    return load(path, Config())


def start(config: Config, directory: Path, init_from: Path | None = None) -> Run:
    """Starts a fresh run in a directory without one.

    Args:
        init_from: the file of an agent to start from, policy.pt or checkpoint.pt; None: random weights.
    """
    run = built(config, directory, init_from)
    begin(run, init_from)
    return run


def built(config: Config, directory: Path, init_from: Path | None) -> Run:
    """Makes a fresh run, raises InputError if it cannot be trained, and writes nothing."""
    check(config)
    check_empty(directory)
    config = settled(config)
    if init_from:  # an agent that was trained before needs no imitation phase
        config = replace(config, train=replace(config.train, jump_start=0))
    return create(config, directory, networks=networks_of(init_from, config) if init_from else {})


def begin(run: Run, init_from: Path | None) -> None:
    """Writes the description of a fresh run, then its first checkpoint."""

    def describe() -> None:
        check_empty(run.directory)
        with as_input_error(f"--run-dir {run.directory}: cannot write there", OSError, ValueError):
            run.directory.mkdir(parents=True, exist_ok=True)
            write_settings(run.config, run.directory, init_from)

    ranks().first_does(describe)
    save_first(run)


def save_first(run: Run) -> None:
    """Writes the first checkpoint of a run, in the directories of its seeds."""
    with as_input_error(f"{run.directory}: cannot write there", OSError):
        for home in run.seed_dirs:
            home.mkdir(parents=True, exist_ok=True)
        run.save()


def check_empty(directory: Path) -> None:
    """Raises InputError if a directory holds a run or other files than those that a kill at the start left."""
    with as_input_error(f"--run-dir {directory}: cannot write there", OSError, ValueError):
        found = {path.name for path in directory.iterdir()} - set(LOCKS) if directory.exists() else set()
    if found & {CHECKPOINT, "policy.pt"}:
        raise InputError(f"--run-dir {directory}: holds a run already; continue it with --resume")
    left = {*BEGUN, *(f"{name}.tmp" for name in BEGUN)}
    if "provenance.json" not in found:  # provenance.json is written first
        left.discard("config.toml")
    if other := sorted(found - left):
        raise InputError(f"--run-dir {directory}: holds no run but {other[0]}; name a new directory")


def create(
    config: Config,
    directory: Path,
    seeds: Sequence[int] | None = None,
    networks: Mapping[str, dict[str, Any]] | None = None,
) -> Run:
    """Makes a fresh `Run` with started episodes; `networks` are weights to start from. Writes nothing."""
    run = Run(config, directory, seeds)
    for name, weights in (networks or {}).items():
        with as_input_error(f"--init-from: its {name} network does not fit this run", *MALFORMED):
            getattr(run.learner, name).load_state_dict(weights)
    with as_input_error("[inspection]", RuntimeError):
        run.env.reset()
    return run


def resume(directory: Path, config: Config | None = None, seeds: Sequence[int] | None = None) -> Run:
    """Returns a `Run` as the directory's checkpoint left it; `config` defaults to its config.toml.

    A run of one seed may have other `interactions` and `final_episodes` than its checkpoint; config.toml then gets the
    new ones.
    """
    config = config or load(directory / "config.toml", Config())
    path = directory / CHECKPOINT
    saved = checkpoint.load(path, RESUMABLE, resolve_device(config.train.device))
    with as_input_error(str(path), KeyError, TypeError, ValueError, AttributeError):
        trained = from_toml(saved["config"], str(path), Config())
        done, rate = int(saved["update"]), trained.ppo.learning_rate
    config, trained = (settled(each) for each in (config, trained))  # an older run may lack the mesh's digest
    before, total = trained.train, config.train.interactions
    moved = seeds is None and total != before.interactions
    free: dict[str, Any] = (
        {} if seeds is not None else {"interactions": total, "final_episodes": config.train.final_episodes}
    )
    if config != replace(trained, train=replace(before, **free)):
        raise InputError(f"{directory}: config.toml is not what {path.name} was trained with")
    if moved and config.train.updates <= done:
        raise InputError(
            f"--resume {directory}: {done * before.batch:,} interactions are done; --interactions must be more"
        )
    run = Run(config, directory, seeds)
    if moved and trained.ppo.anneal:
        run.annealing = (
            f"\nlearning rate from {rate * (1 - done / before.updates):.3g} to "
            f"{rate * (1 - done / config.train.updates):.3g}, since it is annealed to 0 at {total:,} interactions now, "
            f"not at {before.interactions:,}"
        )
    with as_input_error(f"{path}: does not fit this run", *MALFORMED):
        run.load_state_dict(saved)
    if run.ranks.first:
        with run.naming_the_checkpoint():
            for file in run.written():  # files that a kill left, which may fill the disk
                with naming(file):
                    temporary_beside(file).unlink(missing_ok=True)
            run.log.forget_evaluations_after(run.interactions)
            if config != trained:  # from now on, config.toml has the new values
                write_text(directory / "config.toml", to_toml(config))
    return run


def networks_of(path: Path, config: Config) -> dict[str, dict[str, Any]]:
    """Returns the weights of the policy and, if the file has them and they fit, of the value network.

    Args:
        path: policy.pt or checkpoint.pt of a run; config: of the new run.

    Raises:
        CheckpointError, InputError: the file is not such a file, or its networks do not fit the configuration.
    """
    _, trained = load_policy(path)
    check_observed(config, trained)
    for key in FITTING:
        values = (getattr(each.ppo, key) for each in (trained, config))
        theirs, ours = (list(value) if isinstance(value, tuple) else value for value in values)
        if theirs != ours:
            raise InputError(
                f"--init-from {path}: its [ppo] {key} = {theirs}, not {ours} as in this run; set it with --config"
            )
    content = checkpoint.load(path, ("policy",))
    networks: dict[str, dict[str, Any]] = {
        name: content[name]
        for name in ("policy", "value")
        if name in content and (name == "policy" or trained.ppo.privileged == config.ppo.privileged)
    }
    for name, weights in networks.items():
        with as_input_error(f"--init-from {path}: its {name} network is damaged", *MALFORMED):
            check_weights(weights, path)
    return networks

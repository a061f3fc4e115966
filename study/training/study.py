"""The study: trains all seeds of each arm as one batch, evaluates them, and continues where it was interrupted."""

import shlex
from dataclasses import asdict
from pathlib import Path

import numpy as np

from inspection.termination import OUTCOMES
from inspection.transition import METRICS
from ppo.distributed import ranks
from rta.names import CONSTRAINTS
from settings import InputError, load
from study.config import TEST_CASES, StudyConfig
from study.errors import MALFORMED, Stopped, as_input_error
from study.experiment import settled
from study.files import read_json, write_json, write_npz
from study.flight.evaluation import Episodes, report
from study.machine import LOCKS, directory_lock, write_settings
from study.paper import Results, tables
from study.training.run import Run, on_signal
from study.training.session import check, create, resume, save_first
from study.verified import fingerprint, warn_if_unverified

# files that a kill at the start may leave
LEFT_BY_A_KILL = (*LOCKS, "provenance.json", "provenance.json.tmp", "config.toml.tmp")


def train_and_evaluate(config: StudyConfig, directory: Path) -> str:
    """Trains and evaluates the unfinished arms of a study; returns the paper's tables.

    With many ranks, each trains some of the seeds, with the same results as alone; the first rank writes and returns.

    Raises:
        InputError: the directory holds a study with other settings; Stopped: a signal came first.
    """
    for name in config.study.arms:
        check(config.of_arm(name))
    config = settled(config)
    with as_input_error(f"--study-dir {directory}: cannot write there", OSError, ValueError):
        ranks().first_does(lambda: directory.mkdir(parents=True, exist_ok=True))
    results = {}
    again = f"continue with\n  python main.py study --study-dir {shlex.quote(str(directory))}"

    def stop(number: int) -> None:
        raise Stopped(f"stopped; {again}", number)

    check_directory(directory)  # before anything is written there
    # `stop` handles signals outside updates, where no unfinished work is kept
    with directory_lock(directory, "--study-dir"), on_signal(stop):
        ranks().first_does(lambda: begin_or_continue(config, directory))
        flown = [config.of_arm(name) for name in config.study.arms]
        for each in {fingerprint(own): own for own in flown if own.train.rta}.values():
            warn_if_unverified(each)
        for name in config.study.arms:
            path = directory / name / "results.json"
            if not ranks().agree(path.exists()):
                evaluate_arm(train_arm(config, name, directory / name, again))
            if not ranks().first:
                continue
            results[name] = read_json(path, "results of this arm")
            write_json(directory / "results.json", {"arms": results})  # of the arms so far, for `report`
    with as_input_error(f"{directory}: results.json of an arm is not of this program", *MALFORMED):
        shown = [f"{name}\n{tables(arm)}\n" for name, arm in results.items()]
        if len(results) > 1:
            shown.append(f"{overview(results)}\n")
    written = f"Written to {directory}: results.json and, for each arm, policies and episodes"
    return "\n".join(
        (*shown, written, f"Next:\n  python main.py report --study {shlex.quote(str(directory))}")
    )


def overview(results: dict[str, Results]) -> str:
    """Returns a table with a line for each arm: means over all episodes, except where the heading says otherwise."""
    headings = (
        "success %",
        "violation %",
        "reward IQM",
        "worst seed",
        "length s",
        "IQM",
        "delta v m/s",
        "IQM",
    )
    width = max(20, *map(len, results))
    lines = [" " * width + "".join(f"{heading:>13}" for heading in headings)]
    for name, arm in results.items():
        metrics = arm["metrics"]
        reward, length, delta_v = (metrics[key] for key in ("reward", "episode_length_s", "delta_v_m_s"))
        numbers = (
            f"{100 * arm['outcomes']['success']:.1f}",
            f"{arm['violations_percent']['any']:.3f}",
            f"{reward['iqm']:.3f}",
            f"{min(seed['metrics']['reward']['iqm'] for seed in arm['per_seed']):.3f}",
            *(f"{length[key]:.0f}" for key in ("mean", "iqm")),
            *(f"{delta_v[key]:.2f}" for key in ("mean", "iqm")),
        )
        lines.append(f"{name:{width}}" + "".join(f"{number:>13}" for number in numbers))
    return "\n".join(lines)


def begin_or_continue(config: StudyConfig, directory: Path) -> None:
    """Begins a study in its directory; raises InputError if it holds other files or a study with other settings."""
    before = read_settings(directory)
    before = before and settled(before)  # an older study may lack the mesh's digest
    if before is None:
        with as_input_error(f"--study-dir {directory}: cannot write there", OSError, ValueError):
            check_directory(directory)
            write_settings(config, directory)
    elif before != config:
        raise InputError(f"--study-dir {directory}: holds a study with {first_difference(before, config)}")


def check_directory(directory: Path) -> None:
    """Raises InputError if a directory holds other files than those of a study or of a kill at its start."""
    names = {path.name for path in directory.iterdir()}
    if "config.toml" not in names and (other := sorted(names - set(LEFT_BY_A_KILL))):
        raise InputError(f"--study-dir {directory}: holds no study but {other[0]}; name a new directory")


def read_settings(directory: Path) -> StudyConfig | None:
    """Returns the configuration of the study in a directory; None if the directory has no study."""
    with as_input_error(f"--study-dir {directory}: cannot read it", OSError, ValueError):
        if (directory / "checkpoint.pt").exists() or (directory / "policy.pt").exists():
            raise InputError(f"--study-dir {directory}: holds a run of train, not a study")
        begun = (directory / "config.toml").exists()
    return load(directory / "config.toml", StudyConfig()) if begun else None


def first_difference(one: StudyConfig, other: StudyConfig) -> str:
    """Returns the first setting in which two configurations differ, with both values."""
    tables, others = asdict(one), asdict(other)
    return next(
        f"[{table}] {key} = {entries.get(key)!r}, not {others[table].get(key)!r}"
        for table, entries in tables.items()
        for key in (*entries, *others[table])
        if entries.get(key) != others[table].get(key)
    )


def train_arm(config: StudyConfig, name: str, directory: Path, again: str) -> Run:
    """Trains all seeds of an arm to the end, from their checkpoint if there is one; `again` says how to continue."""
    of_arm = settled(config.of_arm(name))
    begun = (directory / "checkpoint.pt").exists()
    run = resume(directory, of_arm, config.seeds) if begun else create(of_arm, directory, config.seeds)
    if not begun:
        save_first(run)
    print(run, flush=True)
    print(run.plan, flush=True)
    try:
        run.train()
    except Stopped as stopped:
        said = f"{name} stopped after {run.interactions:,} interactions of each seed; {again}"
        raise Stopped(said, stopped.number) from None
    return run


def evaluate_arm(run: Run) -> None:
    """Plays the common test cases with every seed of a trained arm; writes episodes.npz, then results.json.

    `interactions` counts those of each seed. `wall_clock_s` is the time of rollouts and updates of all seeds together,
    on the slowest rank. `training_per_seed` has the limits violated in training.
    """
    record, seconds = run.play(run.config.train.final_episodes, TEST_CASES), run.seconds()
    training = run.violations_in_training()
    if not record:
        return
    about = {
        "seeds": list(run.seeds),
        "interactions": run.interactions,
        "wall_clock_s": seconds,
        "per_seed": run.reports(record, TEST_CASES),
        "training_per_seed": training,
    }
    together = report(record, run.config, TEST_CASES, len(run.seeds))
    with run.naming_the_checkpoint():
        write_episodes(record, run.seeds, run.directory / "episodes.npz")
        write_json(run.directory / "results.json", together | about)


def write_episodes(record: Episodes, seeds: tuple[int, ...], path: Path) -> None:
    """Writes every field of the episodes with the last axis split into seeds and cases, and the names of the rows."""
    fields = vars(record) | record.named_extremes()
    arrays = {
        name: values.unflatten(-1, (len(seeds), -1)).cpu().numpy()
        for name, values in fields.items()
        if name != "extremes"
    }
    constraints = (*CONSTRAINTS, "any")
    labels = {"metric_names": METRICS, "constraint_names": constraints, "outcome_names": OUTCOMES}
    write_npz(path, arrays | labels | {"seeds": np.array(seeds)})

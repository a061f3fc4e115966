"""Results that a report shows besides a study's own: computed once, and kept for the same policies."""

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from settings import InputError
from study.config import ARMS, BASELINES, TEST_CASES
from study.errors import MALFORMED, as_input_error
from study.files import write_json, write_npz, write_text
from study.report import flights, tables
from study.report.agents import Arm, agents_of
from study.report.sunlight import shortest_episodes

Work = dict[
    str, tuple[str, Callable[[], Any]]
]  # by file: a description, and a function that computes the content for WRITE


def compute(study: Path, device: str | None = None) -> None:
    """Writes the files that the directory's `report` lacks, and keeps files that belong to the same policies.

    Args:
        study: directory of a finished study, with any arms; device: auto, cpu or cuda; None: the study's.

    Raises:
        InputError, CheckpointError: there is no finished study, it is damaged, or its directory cannot be written.
    """
    arms = agents_of(study, device)
    directory = study / "report"
    todo = work(study, arms)
    with as_input_error(f"--study {study}: cannot write there", OSError):
        begin(directory, {name: arm.digests for name, arm in arms.items()} | {"guidance": guided_by()}, todo)
        for name, (what, make) in todo.items():
            if not (directory / name).exists():
                print(f"{directory / name}: {what} ...", flush=True)  # a whole line, since bars may follow
                started = time.perf_counter()
                WRITE[Path(name).suffix](directory / name, make())
                print(f"{directory / name}: {time.perf_counter() - started:.0f} s", flush=True)


def guided_by() -> dict[str, str]:
    """Returns by name the parameters of the guidance that a report compares agents with."""
    return {name: repr(orbit) for name, orbit in flights.GUIDANCE.items()}


def begin(directory: Path, digests: dict[str, dict[str, str]], todo: Work) -> None:
    """Deletes results that were computed for policies or guidance with other digests than the given ones."""
    directory.mkdir(exist_ok=True)
    path = directory / "policies.json"
    text = json.dumps(digests, indent=2) + "\n"
    if not path.exists() or path.read_bytes() != text.encode():
        for name in (*todo, "violation.npz"):  # violation.npz exists only if an agent violates a limit
            (directory / name).unlink(missing_ok=True)
        write_text(path, text)


def write_single(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes named arrays in single precision, which is enough for figures and replays."""
    write_npz(
        path, {name: a.astype(np.float32) if a.dtype == np.float64 else a for name, a in arrays.items()}
    )


WRITE: dict[str, Callable[[Path, Any], None]] = {
    ".json": write_json,
    ".npz": write_single,
    ".csv": write_text,
}


def work(study: Path, arms: dict[str, Arm]) -> Work:
    """Returns everything that a report on these arms needs besides the study's own results."""
    papers = {name: arm for name, arm in arms.items() if name in ARMS}
    config = next(iter(arms.values())).config
    periods = ", ".join(f"{period:g}" for period in flights.PERIODS)
    filtered = f"the agents trained with RTA, the filter called every {periods} s, a few minutes"
    untrained = f"what is not trained ({', '.join(BASELINES)}), a few minutes"
    elsewhere = f"every agent in other worlds ({', '.join(flights.WORLDS)}), a quarter of an hour or more"
    lit = partial(shortest_episodes, config, config.train.final_episodes, TEST_CASES)
    todo: Work = {
        "cross.json": ("every agent with the filter off and on, a few minutes", partial(flights.cross, arms))
    }
    if "rta" in arms:
        todo["frequency.json"] = (filtered, partial(flights.frequency, arms["rta"]))
    todo["baselines.json"] = (untrained, partial(flights.baselines, config))
    todo["front.json"] = ("the guidance from thrifty to quick, a few minutes", partial(flights.front, config))
    todo["progress.json"] = (
        "what is inspected by when, a few minutes",
        partial(flights.progress, arms, config),
    )
    todo["worlds.json"] = (elsewhere, partial(flights.worlds, arms))
    todo["sunlight.json"] = ("when the Sun has lit enough of the chief, seconds", lit)
    for name, arm in papers.items():
        todo[f"episode_{name}.npz"] = (f"an episode of {name}, seconds", partial(flights.episode, arm))
    if "no_rta" in arms and (worst := flights.worst_success(study / "no_rta" / "episodes.npz")):
        what = "an episode without the filter that violates limits, seconds"
        todo["violation.npz"] = (what, partial(flights.violation, arms["no_rta"], *worst))
    todo["training.csv"] = ("intervals of the training curves, seconds", partial(training, study, arms))
    for name, tables_of_arm in ARMS.items():
        rta = tables_of_arm["train"]["rta"]
        what = f"the LQR+PD demonstration {'with' if rta else 'without'} RTA, seconds"
        todo[f"demonstration_{name}.npz"] = (what, partial(flights.demonstration, config, rta))
    return todo


def training(study: Path, arms: dict[str, Arm]) -> str:
    """Returns the table of the periodic evaluations as CSV."""
    paths = {name: study / name / "evaluations.jsonl" for name in arms}
    for name, path in paths.items():
        arm = arms[name]
        if arm.results["interactions"] >= arm.config.train.evaluation_interval and not path.exists():
            raise InputError(f"{path}: missing, and with it the training curves of {name}")
    with as_input_error(f"--study {study}: cannot read its evaluations.jsonl", OSError, *MALFORMED):
        rows = [row for name, path in paths.items() for row in tables.training(name, path)]
    return tables.text(rows, tables.TRAINING)

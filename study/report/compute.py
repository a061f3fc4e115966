"""Results that a report shows besides a study's own: computed once, and kept for the same policies."""

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from settings import InputError
from study.config import ARMS, TEST_CASES
from study.errors import MALFORMED, as_input_error
from study.files import read_json_lines, write_json, write_npz, write_text
from study.report import flights, tables
from study.report.inputs import Arm, agents_of
from study.report.sunlight import shortest_episodes

Work = dict[str, Callable[[], Any]]  # by file: computes the content for WRITE


WRITE: dict[str, Callable[[Path, Any], None]] = {
    ".json": write_json,
    ".npz": write_npz,
    ".csv": write_text,
}


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
    made_with = {name: arm.digests for name, arm in arms.items()}
    made_with["guidance"] = {name: repr(orbit) for name, orbit in flights.GUIDANCE.items()}
    with as_input_error(f"--study {study}: cannot write there", OSError):
        begin(directory, made_with, todo)
        for name, make in todo.items():
            if not (directory / name).exists():
                print(f"{directory / name} ...", flush=True)  # a whole line, since bars may follow
                started = time.perf_counter()
                content = make()
                if name.endswith(".npz"):  # single precision is enough for figures and replays
                    content = {
                        key: array.astype(np.float32) if array.dtype == np.float64 else array
                        for key, array in content.items()
                    }
                WRITE[Path(name).suffix](directory / name, content)
                print(f"{directory / name}: {time.perf_counter() - started:.0f} s", flush=True)


def begin(directory: Path, digests: dict[str, dict[str, str]], todo: Work) -> None:
    """Deletes results that were computed for policies or guidance with other digests than the given ones."""
    directory.mkdir(exist_ok=True)
    path = directory / "policies.json"
    text = json.dumps(digests, indent=2) + "\n"
    if not path.exists() or path.read_bytes() != text.encode():
        for name in (*todo, "violation.npz"):  # violation.npz exists only if an agent violates a limit
            (directory / name).unlink(missing_ok=True)
        write_text(path, text)


def work(study: Path, arms: dict[str, Arm]) -> Work:
    """Returns everything that a report on these arms needs besides the study's own results; quick things come last."""
    config = next(iter(arms.values())).config
    todo: Work = {"cross.json": partial(flights.cross, arms)}
    if "rta" in arms:
        todo["frequency.json"] = partial(flights.frequency, arms["rta"])
    todo |= {
        "baselines.json": partial(flights.baselines, config),
        "front.json": partial(flights.front, config),
        "progress.json": partial(flights.progress, arms, config),
        "worlds.json": partial(flights.worlds, arms),
        "sunlight.json": partial(shortest_episodes, config, config.train.final_episodes, TEST_CASES),
        "training.csv": partial(training, study, arms),
    }
    for name, differences in ARMS.items():
        rta = differences["train"]["rta"]
        todo[f"demonstration_{name}.npz"] = partial(flights.demonstration, config, rta)
        if name in arms:
            todo[f"episode_{name}.npz"] = partial(flights.episode, arms[name])
    if "no_rta" in arms and (worst := flights.worst_success(study / "no_rta" / "episodes.npz")):
        todo["violation.npz"] = partial(flights.violation, arms["no_rta"], *worst)
    return todo


def training(study: Path, arms: dict[str, Arm]) -> str:
    """Returns the table of the periodic evaluations as CSV: of each evaluation and metric IQM and interval.

    An arm has no rows if its training was shorter than the interval of its evaluations.
    """
    rows: list[tables.Row] = []
    for name, arm in arms.items():
        path = study / name / "evaluations.jsonl"
        if path.exists():
            with as_input_error(f"{path}: not the evaluations of a run", OSError, *MALFORMED):
                rows += tables.training(name, read_json_lines(path, "evaluations of a run"))
        elif arm.results["interactions"] >= arm.config.train.evaluation_interval:
            raise InputError(f"{path}: missing, and with it the training curves of {name}")
    return tables.text(rows, tables.TRAINING)

"""Inputs of a report: the files of a study that `study` and `report` wrote."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from study.config import ARMS, GUIDE, StudyConfig, recorded
from study.errors import MALFORMED, as_input_error
from study.files import check_like, read_json, read_npz
from study.flight.figures import Episode
from study.paper import Results

RESULTS = "results of a study"
Curves = dict[str, dict[str, np.ndarray]]  # by metric and arm: (k, 4) interactions, IQM, low, high


@dataclass(frozen=True)
class Inputs:
    """Holds the contents of a study's files; entries for arms that the study left out are missing.

    Attributes:
        arms: final evaluation of each of the paper's arms, with `seeds`, `interactions` and `wall_clock_s`; own: of the
            study's own arms.
        provenance: machine of the training, with `device`, `ranks` and `threads`.
        front: by name, the guidance with the filter; empty if it has not been flown.
        worlds: by plant, arm and filter (off, nominal, robust): the agents in other plants; empty if they have not been
            flown there.
        progress: by arm, and "guidance": time_s and the inspected weight at this time, mean of the middle half.
        sunlight: the earliest success that the Sun allows in the test cases; empty if it is not known.
        cross: by arm, then "off" and "on": its agents without and with the filter.
        frequency: by period in s: the agents trained with the filter; empty if there are none.
        baselines: by controller that is not trained, then "off" and "on"; empty if they have not been evaluated.
        training: empty if training was shorter than the interval of its evaluations.
        violation: an episode of the agents without RTA, with its `seed` and `case`; empty if it has not been flown.
        episodes, demonstrations: by arm, in the form of `simulate`.
    """

    study: Path
    config: StudyConfig
    arms: dict[str, Results]
    own: dict[str, Results]
    provenance: dict[str, Any]
    front: dict[str, Results]
    worlds: dict[str, dict[str, dict[str, Results]]]
    progress: dict[str, dict[str, list[float]]]
    sunlight: dict[str, Any]
    cross: dict[str, dict[str, Results]]
    frequency: dict[str, Results]
    baselines: dict[str, dict[str, Results]]
    training: Curves
    violation: Episode
    episodes: dict[str, Episode]
    demonstrations: dict[str, Episode]

    @property
    def directory(self) -> Path:
        """Returns the directory of the report's figures and data."""
        return self.study / "report"

    @property
    def everyone(self) -> dict[str, Results]:
        """Returns all arms, the paper's first."""
        return self.arms | self.own

    @property
    def guidance(self) -> Results:
        """Returns the evaluation of the guidance GUIDE with the filter; empty if it has not been flown."""
        return self.front.get(GUIDE, {})

    @property
    def columns(self) -> dict[str, Results]:
        """Returns the columns of Tables 2 and 3: the paper's arms and "guidance", if it has been flown."""
        return self.arms | ({"guidance": self.guidance} if self.guidance else {})


def read_settings(study: Path) -> StudyConfig:
    """Returns the configuration of a finished study; raises InputError if it cannot be read."""
    path = study / "config.toml"
    with as_input_error(f"{path}: cannot read the configuration", OSError, ValueError):
        return recorded(path.read_text(encoding="utf-8"), str(path), StudyConfig())


def read(study: Path) -> Inputs:
    """Reads a study's files.

    Raises:
        InputError: a file cannot be read, or the study has no results yet.
    """
    report = study / "report"
    arms = read_arms(study)
    return Inputs(
        study=study,
        config=read_settings(study),
        arms=arms,
        own=read_arms(study, own=True),
        provenance=read_json(study / "provenance.json", "provenance"),
        cross=read_json(report / "cross.json", RESULTS),
        training=read_curves(report / "training.csv"),
        front=read_json_if_any(report / "front.json"),
        worlds=read_json_if_any(report / "worlds.json"),
        progress=read_json_if_any(report / "progress.json"),
        sunlight=read_json_if_any(report / "sunlight.json"),
        frequency=read_json_if_any(report / "frequency.json"),
        baselines=read_json_if_any(report / "baselines.json"),
        violation=read_episode(path) if (path := report / "violation.npz").exists() else {},
        episodes={arm: read_episode(report / f"episode_{arm}.npz") for arm in arms},
        demonstrations={arm: read_episode(report / f"demonstration_{arm}.npz") for arm in ARMS},
    )


def read_json_if_any(path: Path) -> dict[str, Any]:
    """Returns the object in a JSON file; an empty object if there is no file."""
    return read_json(path, RESULTS) if path.exists() else {}


def read_arms(study: Path, own: bool = False) -> dict[str, Results]:
    """Returns final evaluations of arms with seeds: of ARMS in their order or, if `own`, of the study's own arms."""
    path = study / "results.json"
    with as_input_error(f"{path}: not the results of a study", *MALFORMED):
        arms = read_json(path, RESULTS)["arms"]
        for arm in arms.values():
            check_like(arm, {"seeds": [], "outcomes": {}, "metrics": {}})
        names = [name for name in arms if name not in ARMS] if own else ARMS
        return {name: arms[name] for name in names if name in arms and arms[name]["seeds"]}


def read_curves(path: Path) -> Curves:
    """Reads the training curves from a table with the columns interactions, arm, metric, iqm, low and high."""
    points: dict[str, dict[str, list[list[float]]]] = {}
    with as_input_error(f"{path}: not the training curves", OSError, ValueError, KeyError):
        for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
            numbers = [float(row[column]) for column in ("interactions", "iqm", "low", "high")]
            points.setdefault(row["metric"], {}).setdefault(row["arm"], []).append(numbers)
    return {metric: {arm: np.array(rows) for arm, rows in arms.items()} for metric, arms in points.items()}


def read_episode(path: Path) -> Episode:
    """Reads an episode in the form of `simulate`."""
    return read_npz(path, "episode")

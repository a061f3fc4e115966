"""What a report shows: the files of a study that `study` and `report` wrote."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from study import config as configuration
from study.config import ARMS, StudyConfig
from study.errors import refusing
from study.flight.figures import Episode
from study.report import tables as report_tables
from study.report.tables import Results

Curves = dict[str, dict[str, np.ndarray]]  # by metric and arm: (k, 4) interactions, IQM, low, high


@dataclass(frozen=True)
class Inputs:
    """Contents of a study's files; what belongs to an arm that the study left out is missing.

    Attributes:
        arms: final evaluation of each arm, with `seeds`, `interactions` and `wall_clock_s`.
        guidance: evaluation of the classical guidance behind the filter; empty if there is none.
        sunlight: the earliest success that the Sun allows in the test cases; empty if it is not known.
        cross: by arm, then "off" and "on": its agents without and with the filter.
        frequency: by period in s: the agents trained behind the filter.
        throughput: by arm: `seeds`, `interactions`, `wall_clock_s`, `interactions_per_s`, `device`, `ranks`, `threads`.
        training: empty where training was shorter than the interval of its evaluations.
        episodes, demonstrations: by arm, in the form of `simulate`.
    """

    study: Path
    config: StudyConfig
    arms: dict[str, Results]
    guidance: Results
    sunlight: dict[str, Any]
    cross: dict[str, dict[str, Results]]
    frequency: dict[str, Results]
    throughput: dict[str, dict[str, Any]]
    training: Curves
    episodes: dict[str, Episode]
    demonstrations: dict[str, Episode]

    @property
    def missing_arms(self) -> list[str]:
        """The arms that the study left out."""
        return [arm for arm in ARMS if arm not in self.arms]


def read(study: Path) -> Inputs:
    """Reads a study's files.

    Raises:
        InputError: a file cannot be read, or the study has no results yet.
    """
    report = study / "report"
    arms = read_json(study / "results.json")["arms"]
    return Inputs(
        study=study,
        config=configuration.load(study / "config.toml", StudyConfig()),
        arms={arm: arms[arm] for arm in ARMS if arm in arms},
        training=read_curves(report / "training.csv"),
        episodes=read_episodes(report, "episode"),
        demonstrations=read_episodes(report, "demonstration"),
        **{
            name: read_json(report / f"{name}.json") if (report / f"{name}.json").exists() else {}
            for name in ("guidance", "sunlight", "cross", "frequency", "throughput")
        },
    )


def read_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file."""
    with refusing(f"{path}: cannot read it", OSError, ValueError):
        return report_tables.read(path)


def read_curves(path: Path) -> Curves:
    """The training curves, from a table with the columns interactions, arm, metric, iqm, low and high."""
    points: dict[str, dict[str, list[list[float]]]] = {}
    with refusing(f"{path}: not the training curves", OSError, ValueError, KeyError):
        for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
            numbers = [float(row[column]) for column in ("interactions", "iqm", "low", "high")]
            points.setdefault(row["metric"], {}).setdefault(row["arm"], []).append(numbers)
    return {metric: {arm: np.array(rows) for arm, rows in arms.items()} for metric, arms in points.items()}


def read_episodes(report: Path, name: str) -> dict[str, Episode]:
    """The arms' episodes of a name, those that are there."""
    episodes = {}
    for arm in ARMS:
        path = report / f"{name}_{arm}.npz"
        if path.exists():
            with (
                refusing(f"{path}: not an episode", OSError, ValueError, BadZipFile),
                np.load(path) as arrays,
            ):
                episodes[arm] = dict(arrays)
    return episodes

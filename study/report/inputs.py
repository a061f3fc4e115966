"""What a report reads: the files of a finished study, those that `compute` added, and the study's agents."""

import csv
import hashlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ppo.network import Policy
from settings import InputError
from study.config import ARMS, GUIDE, Config, StudyConfig, recorded
from study.errors import MALFORMED, as_input_error
from study.experiment import load_policy, make_policy
from study.files import check_like, read_json, read_npz
from study.flight.figures import Episode
from study.paper import Results

RESULTS = "results of a study"
COMPUTED = ("cross", "frequency", "baselines", "front", "progress", "worlds", "sunlight")  # JSON files
Curves = dict[str, dict[str, np.ndarray]]  # by metric and arm: (k, 4) interactions, IQM, low, high


@dataclass(frozen=True)
class Inputs:
    """Holds the contents of a study's files.

    Attributes:
        arms: by name, the paper's first: the final evaluation with `seeds`, `interactions` and `wall_clock_s`.
        provenance: machine of the training, with `device`, `ranks` and `threads`.
        cross: by arm, then "off" and "on": its agents without and with the filter.
        frequency: by period in s: the agents trained with the filter; empty if there are none.
        baselines: by controller that is not trained, then "off" and "on".
        front: by name, the guidance with the filter.
        progress: by arm, and "guidance": time_s and the inspected weight at this time, mean of the middle half.
        worlds: by plant, arm and filter (off, nominal, robust): the agents in other plants.
        sunlight: the earliest success that the Sun allows in the test cases.
        training: empty if training was shorter than the interval of its evaluations.
        violation: an episode of the agents without RTA, with its `seed` and `case`; empty if none violates a limit.
        episodes, demonstrations: by arm of the paper, in the form of `simulate`.
    """

    study: Path
    config: StudyConfig
    arms: dict[str, Results]
    provenance: dict[str, Any]
    cross: dict[str, dict[str, Results]]
    frequency: dict[str, Results]
    baselines: dict[str, dict[str, Results]]
    front: dict[str, Results]
    progress: dict[str, dict[str, list[float]]]
    worlds: dict[str, dict[str, dict[str, Results]]]
    sunlight: dict[str, Any]
    training: Curves
    violation: Episode
    episodes: dict[str, Episode]
    demonstrations: dict[str, Episode]

    @property
    def directory(self) -> Path:
        """Returns the directory of the report's figures and data."""
        return self.study / "report"

    @property
    def papers(self) -> dict[str, Results]:
        """Returns the paper's arms."""
        return {name: self.arms[name] for name in ARMS if name in self.arms}

    @property
    def columns(self) -> dict[str, Results]:
        """Returns the columns of Tables 2 and 3: the paper's arms, and the guidance GUIDE behind the filter."""
        return self.papers | {"guidance": self.front[GUIDE]}


def read(study: Path) -> Inputs:
    """Reads the files of a study whose report has been computed.

    Raises:
        InputError: a file cannot be read, or the study has no results yet.
    """
    report = study / "report"
    arms = read_arms(study)
    violation = report / "violation.npz"
    computed = {name: report / f"{name}.json" for name in COMPUTED if name != "frequency" or "rta" in arms}
    return Inputs(
        study=study,
        config=read_settings(study),
        arms=arms,
        provenance=read_json(study / "provenance.json", "provenance"),
        training=read_curves(report / "training.csv"),
        violation=read_npz(violation, "episode") if violation.exists() else {},
        episodes={arm: read_npz(report / f"episode_{arm}.npz", "episode") for arm in ARMS if arm in arms},
        demonstrations={arm: read_npz(report / f"demonstration_{arm}.npz", "episode") for arm in ARMS},
        **{"frequency": {}} | {name: read_json(path, RESULTS) for name, path in computed.items()},
    )


def read_settings(study: Path) -> StudyConfig:
    """Returns the configuration of a finished study; raises InputError if it cannot be read."""
    path = study / "config.toml"
    with as_input_error(f"{path}: cannot read the configuration", OSError, ValueError):
        return recorded(path.read_text(encoding="utf-8"), str(path), StudyConfig())


def read_arms(study: Path) -> dict[str, Results]:
    """Returns the final evaluations of a study's arms with seeds by name, the paper's arms first."""
    path = study / "results.json"
    with as_input_error(f"{path}: not the results of a study", *MALFORMED):
        arms = read_json(path, RESULTS)["arms"]
        for arm in arms.values():
            check_like(arm, {"seeds": [], "outcomes": {}, "metrics": {}})
        return {name: arms[name] for name in (*ARMS, *arms) if name in arms and arms[name]["seeds"]}


def read_curves(path: Path) -> Curves:
    """Reads the training curves from a table with the columns interactions, arm, metric, iqm, low and high."""
    points: dict[str, dict[str, list[list[float]]]] = {}
    with as_input_error(f"{path}: not the training curves", OSError, ValueError, KeyError):
        for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
            numbers = [float(row[column]) for column in ("interactions", "iqm", "low", "high")]
            points.setdefault(row["metric"], {}).setdefault(row["arm"], []).append(numbers)
    return {metric: {arm: np.array(rows) for arm, rows in arms.items()} for metric, arms in points.items()}


@dataclass(frozen=True)
class Arm:
    """Holds the agents of a finished arm.

    Attributes:
        config: of the first seed; policy: of all seeds.
        results: of the study; digests: SHA-256 of each seed's file.
    """

    config: Config
    policy: Policy
    results: Results
    digests: dict[str, str]

    def of_seed(self, place: int) -> Policy:
        """Returns the policy of one seed, counted from 0."""
        policy = make_policy(self.config, [torch.Generator()])
        own = {name: weights[place : place + 1] for name, weights in self.policy.state_dict().items()}
        policy.load_state_dict(own)
        return policy


def agents_of(study: Path, device: str | None) -> dict[str, Arm]:
    """Returns the arms of a finished study by name; `device`: auto, cpu or cuda; None: the study's."""
    path = study / "results.json"
    if not path.is_file():
        raise InputError(f"--study {study}: no finished study there (it lacks results.json)")
    arms = read_arms(study)
    if not arms:
        raise InputError(f"{path}: holds no finished arm")
    if old := [name for name, arm in arms.items() if "clean_success" not in arm["outcomes"]]:
        raise InputError(
            f"{path}: {', '.join(old)} was evaluated by an older revision; that one can report it"
        )
    if unfinished := [name for name in read_settings(study).study.arms if name not in arms]:
        print(f"--study {study}: {', '.join(unfinished)} is not finished and is left out", file=sys.stderr)
    return {name: load_arm(study / name, results, device) for name, results in arms.items()}


def load_arm(directory: Path, results: Results, device: str | None) -> Arm:
    """Loads an arm from its seeds' policies."""
    paths = [directory / f"seed{seed}" / "policy.pt" for seed in results["seeds"]]
    loaded = [load_policy(path) for path in paths]
    config = loaded[0][1]
    policy = make_policy(config, [torch.Generator() for _ in paths])
    weights = [of_seed.state_dict() for of_seed, _ in loaded]
    policy.load_state_dict({name: torch.cat([own[name] for own in weights]) for name in weights[0]})
    return Arm(
        config=replace(config, train=replace(config.train, device=device or config.train.device)),
        policy=policy,
        results=results,
        digests={path.parent.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths},
    )

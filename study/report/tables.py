"""The tables behind a study's report, one CSV file each, from the JSON files that the study and the report wrote."""

import csv
import io
import json
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from inspection.environment import METRICS
from rta.constraints import CONSTRAINTS
from study.config import ARMS
from study.errors import MALFORMED, refusing
from study.files import write_json, write_text
from study.flight.summary import summary_of_runs
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS

Results = dict[str, Any]  # in the form of `evaluate --json`
Row = dict[str, Any]
TRAINING = ("interactions", "arm", "metric", "iqm", "low", "high")


def write(study: Path) -> None:
    """Writes the tables of a finished study into its `report`, those aside that take time (`study.supplements`).

    Raises:
        InputError: a file that they are made from is missing or damaged, or they cannot be written.
    """
    directory = study / "report"
    with refusing(f"--study {study}: cannot read what its tables are made from", OSError, *MALFORMED):
        arms = read(study / "results.json")["arms"]
        columns = arms | {"guidance": read(directory / "guidance.json")}
        tables = {
            "table2": table2(columns),
            "table3": table3(columns),
            "cross": cross(read(directory / "cross.json")),
            "throughput": throughput(arms, read(study / "provenance.json")),
        }
        if "rta" in arms:
            tables["frequency"] = frequency(read(directory / "frequency.json"))

    with refusing(f"--study {study}: cannot write its tables", OSError):
        for name, rows in tables.items():
            write_text(directory / f"{name}.csv", text(rows, rows[0]))
        write_json(directory / "throughput.json", {row["arm"]: row for row in tables["throughput"]})


def read(path: Path) -> dict[str, Any]:
    """The content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def text(rows: list[Row], columns: Iterable[str]) -> str:
    """Rows as CSV, with all digits."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def interval(name: str, iqm: float, low: float, high: float) -> Row:
    """An IQM and its 95 % interval as three columns."""
    return {f"{name}_iqm": iqm, f"{name}_low": low, f"{name}_high": high}


def table2(columns: dict[str, Results]) -> list[Row]:
    """Table 2: for each column IQM and interval; for an arm also the paper's, and ours less the paper's IQM."""
    rows = []
    for metric, (label, _, *published) in PAPER_METRICS.items():
        paper = dict(zip(ARMS, published, strict=True))
        row: Row = {"metric": metric, "label": label}
        for name, results in columns.items():
            ours = results["metrics"][metric]
            row |= interval(name, ours["iqm"], *ours["ci95"])
            if name in paper:
                row |= interval(f"{name}_paper", *paper[name])
                row[f"{name}_difference"] = ours["iqm"] - paper[name][0]
        rows.append(row)
    return rows


def table3(columns: dict[str, Results]) -> list[Row]:
    """Table 3: for each column the mean % of steps that violate; for an arm also the paper's, and the difference."""
    rows = []
    for constraint, (label, *published) in PAPER_VIOLATIONS.items():
        paper = dict(zip(ARMS, published, strict=True))
        row: Row = {"constraint": constraint, "label": label}
        for name, results in columns.items():
            ours = results["violations_percent"][constraint]
            row[f"{name}_percent"] = ours
            if name in paper:
                row |= {f"{name}_paper_percent": paper[name], f"{name}_difference": ours - paper[name]}
        rows.append(row)
    return rows


def summary_columns(results: Results) -> Row:
    """An evaluation as one row."""
    row: Row = {}
    for metric in METRICS:
        summary = results["metrics"][metric]
        row |= interval(metric, summary["iqm"], *summary["ci95"])
    row |= {f"{name}_mean_percent": results["violations_percent"][name] for name in ("any", *CONSTRAINTS)}
    return row | {
        "success_percent": 100.0 * results["outcomes"]["success"],
        "intervention_percent": results["rta"]["intervention_percent"],
        "unsolved_programs": results["rta"]["qp_failures"],
        "episodes": results["episodes"],
    }


def cross(evaluations: dict[str, dict[str, Results]]) -> list[Row]:
    """A row per arm and filter (off or on)."""
    return [
        {"arm": arm, "filter": switch} | summary_columns(results)
        for arm, switches in evaluations.items()
        for switch, results in switches.items()
    ]


def frequency(evaluations: dict[str, Results]) -> list[Row]:
    """A row per filter period, in s."""
    return [{"period_s": period} | summary_columns(results) for period, results in evaluations.items()]


def training(arm: str, directory: Path) -> list[Row]:
    """A row per periodic evaluation and metric of an arm: IQM and interval over seeds x cases.

    None where its training was shorter than the evaluations' interval.
    """
    path = directory / "evaluations.jsonl"
    if not path.exists():
        return []
    evaluations = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    rows = []
    for interactions, of_seeds in groupby(evaluations, key=lambda line: line["interactions"]):
        cases = [line["cases"] for line in of_seeds]
        for metric in METRICS:
            result = summary_of_runs(np.array([of_seed[metric] for of_seed in cases]))
            values = (interactions, arm, metric, result["iqm"], *result["ci95"])
            rows.append(dict(zip(TRAINING, values, strict=True)))
    return rows


def throughput(arms: dict[str, Results], provenance: dict[str, Any]) -> list[Row]:
    """A row per arm: wall-clock s of its training, and interactions of all its seeds in a second of it."""
    return [
        {
            "arm": name,
            "seeds": len(arm["seeds"]),
            "interactions": arm["interactions"],
            "wall_clock_s": arm["wall_clock_s"],
            "interactions_per_s": len(arm["seeds"]) * arm["interactions"] / arm["wall_clock_s"],
            "device": provenance["device"],
            "ranks": provenance["ranks"],
            "threads": provenance["threads"],
        }
        for name, arm in arms.items()
    ]

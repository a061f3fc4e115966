"""The tables of a study's report, one CSV file each."""

import csv
import io
import math
from collections.abc import Iterable
from itertools import groupby
from typing import Any

import numpy as np
from scipy import stats

from inspection.transition import METRICS
from rta.names import CONSTRAINTS
from study.config import ARMS
from study.errors import MALFORMED, as_input_error
from study.files import write_text
from study.flight.summary import summary_of_runs
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate, Published, Results, measured
from study.report.inputs import Inputs

Row = dict[str, Any]
TRAINING = ("interactions", "arm", "metric", "iqm", "low", "high")


def write(inputs: Inputs) -> None:
    """Writes the tables of a finished study, except the training curves, which `compute` writes.

    Raises:
        InputError: the data are damaged, or the tables cannot be written.
    """
    with as_input_error(f"--study {inputs.study}: cannot read what its tables are made from", *MALFORMED):
        worlds = inputs.worlds.items()
        tables = {
            "arms": [{"arm": name} | tails(results) for name, results in inputs.arms.items()],
            "baselines": cross("controller", inputs.baselines),
            "cross": cross("arm", inputs.cross),
            "frequency": [{"period_s": s} | evaluation(results) for s, results in inputs.frequency.items()],
            "throughput": throughput(inputs.arms, inputs.provenance),
            "worlds": [{"plant": plant} | row for plant, arms in worlds for row in cross("arm", arms)],
        }
        if inputs.papers:
            tables["table2"] = comparison("metric", PAPER_METRICS, inputs.columns)
            tables["table3"] = comparison("constraint", PAPER_VIOLATIONS, inputs.columns)
        texts = {name: text(rows, rows[0]) for name, rows in tables.items() if rows}

    with as_input_error(f"--study {inputs.study}: cannot write its tables", OSError):
        for name, content in texts.items():
            write_text(inputs.directory / f"{name}.csv", content)


def text(rows: list[Row], columns: Iterable[str]) -> str:
    """Returns rows as CSV, with all digits."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def columns_of(name: str, number: Estimate) -> Row:
    """Returns an IQM and its 95 % interval as three columns, or a percentage as one."""
    if number.interval is None:
        return {f"{name}_percent": number.value}
    low, high = number.interval
    return {f"{name}_iqm": number.value, f"{name}_low": low, f"{name}_high": high}


def comparison(kind: str, published: dict[str, Published], columns: dict[str, Results]) -> list[Row]:
    """Returns Table 2 or 3, a row per metric or constraint: ours and, for arms, the paper's and the difference."""
    rows = []
    for key, paper in published.items():
        row: Row = {kind: key, "label": paper.label}
        for name, results in columns.items():
            ours = measured(results, key)
            row |= columns_of(name, ours)
            if name in ARMS:
                theirs = paper.by_arm[name]
                row |= columns_of(f"{name}_paper", theirs)
                row[f"{name}_difference"] = ours.value - theirs.value
        rows.append(row)
    return rows


def evaluation(results: Results) -> Row:
    """Returns an evaluation as one row."""
    row: Row = {}
    for metric in METRICS:
        row |= columns_of(metric, measured(results, metric))
    row |= {f"{name}_mean_percent": results["violations_percent"][name] for name in ("any", *CONSTRAINTS)}
    return row | {
        "success_percent": measured(results, "success").value,
        "intervention_percent": results["rta"]["intervention_percent"],
        "unsolved_programs": results["rta"]["qp_failures"],
        "episodes": results["episodes"],
    }


def tails(results: Results) -> Row:
    """Returns in one row what an IQM hides: success and violations, mean, tails, and every seed's IQM, lowest first."""
    row: Row = {
        "clean_success_percent": 100.0 * results["outcomes"]["clean_success"],
        "success_percent": 100.0 * results["outcomes"]["success"],
        "any_percent_of_steps": results["violations_percent"]["any"],
        "any_percent_of_seconds": results["violations_percent_of_seconds"]["any"],
    }
    for metric in ("reward", "episode_length_s", "delta_v_m_s"):
        row |= {
            f"{metric}_{name}": results["metrics"][metric][name]
            for name in ("iqm", "mean", "p5", "p95", "max")
        }
        seeds = of_seeds(results, metric)
        row[f"{metric}_of_seeds"] = " ".join(f"{value:.4g}" for value in sorted(seeds))
        row[f"{metric}_seeds_low"], row[f"{metric}_seeds_high"] = over_seeds(results, metric)
    return row


def of_seeds(results: Results, metric: str) -> list[float]:
    """Returns every seed's IQM."""
    return [seed["metrics"][metric]["iqm"] for seed in results["per_seed"]]


def over_seeds(results: Results, metric: str) -> tuple[float, float]:
    """Returns Student's 95 % interval of the mean of the seeds' IQMs; NaN for a single seed.

    The stratified bootstrap draws seeds anew for every case, so that differences between whole seeds average out. Here
    they do not.
    """
    values = of_seeds(results, metric)
    if len(values) < 2:
        return math.nan, math.nan
    spread = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    return float(np.mean(values) - spread), float(np.mean(values) + spread)


def cross(kind: str, evaluations: dict[str, dict[str, Results]]) -> list[Row]:
    """Returns a row per arm or controller, as `kind` names the column, and filter (off or on)."""
    return [
        {kind: flown, "filter": switch} | evaluation(results)
        for flown, switches in evaluations.items()
        for switch, results in switches.items()
    ]


def training(arm: str, evaluations: list[dict[str, Any]]) -> list[Row]:
    """Returns a row per periodic evaluation and metric of an arm: IQM and interval over seeds x cases."""
    rows = []
    for interactions, seeds in groupby(evaluations, key=lambda line: line["interactions"]):
        cases = [line["cases"] for line in seeds]
        for metric in METRICS:
            result = summary_of_runs(np.array([of_seed[metric] for of_seed in cases]))
            values = (interactions, arm, metric, result["iqm"], *result["ci95"])
            rows.append(dict(zip(TRAINING, values, strict=True)))
    return rows


def throughput(arms: dict[str, Results], provenance: dict[str, Any]) -> list[Row]:
    """Returns a row per arm: wall-clock s of its training, and interactions of all its seeds per second."""
    return [
        {
            "arm": name,
            "seeds": len(arm["seeds"]),
            "interactions": arm["interactions"],
            "wall_clock_s": arm["wall_clock_s"],
            "interactions_per_s": len(arm["seeds"]) * arm["interactions"] / arm["wall_clock_s"],
            **{name: provenance[name] for name in ("device", "ranks", "threads")},
        }
        for name, arm in arms.items()
    ]

"""What agents learn from behind the filter: desired, applied or priced actions (docs/results/learning.md).

    python -m study.results.learn_from --study runs/learn_from --out runs/reference/learn_from

Flies the agents of a finished study of configs/sweeps/learn_from.toml with the filter and without, and draws how they
learned. Takes a few minutes.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from study.files import write_json, writing
from study.flight.figures import BLUE, GREEN, ORANGE
from study.report.agents import agents_of
from study.report.flights import evaluate
from study.results.arguments import of_a_study

KEPT = ("reward", "delta_v_m_s", "episode_length_s")
ENOUGH = 0.99  # of a seed's cases, to have learned
CURVES = {
    "success": "success (%)",
    "reward": "reward",
    "delta_v_m_s": "delta v (m/s)",
    "corrected": "calls corrected (%)",
}


def summary(results: dict[str, Any]) -> dict[str, Any]:
    """What the page shows of an evaluation."""
    kept = {name: {key: results["metrics"][name][key] for key in ("iqm", "mean")} for name in KEPT}
    return {
        "outcomes": results["outcomes"],
        "metrics": kept,
        "violations_percent": results["violations_percent"]["any"],
        "corrected_percent": results["rta"]["intervention_percent"],
    }


def curves(path: Path) -> dict[str, list[Any]]:
    """The periodic evaluations, each quantity a row per point of time and a column per seed."""
    by_time: dict[int, list[dict[str, Any]]] = {}
    for text in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(text)
        by_time.setdefault(row["interactions"], []).append(row)
    rows = [sorted(each, key=lambda row: row["seed"]) for each in by_time.values()]
    return {
        "interactions": list(by_time),
        "success": [[100.0 * row["outcomes"]["success"] for row in each] for each in rows],
        "reward": [[row["metrics"]["reward"]["mean"] for row in each] for each in rows],
        "delta_v_m_s": [[row["metrics"]["delta_v_m_s"]["mean"] for row in each] for each in rows],
        "corrected": [[row["rta"]["intervention_percent"] for row in each] for each in rows],
    }


def learned_at(curve: dict[str, list[Any]]) -> list[int | None]:
    """Of each seed, interactions at the first evaluation from which on enough cases succeed; None: not at the end."""
    found = []
    for column in np.array(curve["success"]).T:
        last = max(np.flatnonzero(column < 100.0 * ENOUGH), default=-1)
        found.append(curve["interactions"][last + 1] if last + 1 < len(column) else None)
    return found


def figure(results: dict[str, Any], path: Path) -> None:
    """Medians over the seeds of the periodic evaluations, and the range of the middle half of them."""
    from study.drawing import Figure

    drawn = Figure(figsize=(11, 6), layout="constrained")
    for axis, (name, text) in zip(drawn.subplots(2, 2).flat, CURVES.items(), strict=True):
        for (arm, each), colour in zip(results.items(), (BLUE, ORANGE, GREEN), strict=True):
            values, x = np.array(each["curves"][name]), np.array(each["curves"]["interactions"]) / 1e6
            low, middle, high = np.percentile(values, (25, 50, 75), axis=1)
            axis.plot(x, middle, "o-", ms=3, color=colour, label=arm)
            axis.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
        axis.set(xlabel="interactions of a seed (million)", ylabel=text)
        axis.grid(alpha=0.3)
    drawn.axes[0].legend(title="learns from", fontsize=8)
    with writing(path) as file:
        drawn.savefig(file, dpi=85, format="png")


def main(argv: list[str] | None = None) -> None:
    arguments = of_a_study("learn_from", "results.json and figure.png").parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    found: dict[str, Any] = {}
    for name, arm in agents_of(arguments.study, "cpu").items():
        own = curves(arguments.study / name / "evaluations.jsonl")
        found[name] = {
            "seeds": len(arm.digests),
            "interactions": arm.results["interactions"],
            "jump_start": arm.config.train.jump_start,
            "learned_at": learned_at(own),
            "with_filter": summary(arm.results),
            "without": summary(evaluate(arm, rta=False, period=arm.config.rta.period)),
            "curves": own,
        }
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "results.json", found)
    figure(found, arguments.out / "figure.png")


if __name__ == "__main__":
    main()

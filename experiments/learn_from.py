"""Compares what agents learn from behind the filter: desired, applied or priced actions (docs/results/learning.md).

    python -m experiments.learn_from --study runs/learn_from --out runs/reference/learn_from

Flies the agents of a finished study of configs/sweeps/learn_from.toml with the filter and without, and draws how they
learned. Takes a few minutes.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.field import curves, summary
from settings import Parser
from study.files import write_json, writing
from study.flight.figures import BLUE, GREEN, ORANGE
from study.machine import set_threads
from study.report.agents import agents_of
from study.report.flights import evaluate

ENOUGH = 99.0  # % of a seed's cases, to have learned
SHOWN = {
    "success": "success (%)",
    "reward": "reward",
    "delta_v_m_s": "delta v (m/s)",
    "corrected": "calls corrected (%)",
}


def learned_at(curve: dict[str, list[Any]]) -> list[int | None]:
    """Returns the interactions of each seed from which on enough cases succeed at every evaluation; None: never."""
    found = []
    for column in np.array(curve["success"]).T:
        last = max(np.flatnonzero(column < ENOUGH), default=-1)
        found.append(curve["interactions"][last + 1] if last + 1 < len(column) else None)
    return found


def figure(results: dict[str, Any], path: Path) -> None:
    """Draws medians over the seeds of the periodic evaluations, and the range of the middle half of them."""
    drawn = Figure(figsize=(11, 6), layout="constrained")
    for axis, (name, text) in zip(drawn.subplots(2, 2).flat, SHOWN.items(), strict=True):
        for (arm, found), colour in zip(results.items(), (BLUE, ORANGE, GREEN), strict=True):
            values, x = np.array(found["curves"][name]), np.array(found["curves"]["interactions"]) / 1e6
            low, middle, high = np.percentile(values, (25, 50, 75), axis=1)
            axis.plot(x, middle, "o-", ms=3, color=colour, label=arm)
            axis.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
        axis.set(xlabel="interactions of a seed (million)", ylabel=text)
        axis.grid(alpha=0.3)
    drawn.axes[0].legend(title="learns from", fontsize=8)
    with writing(path) as file:
        drawn.savefig(file, dpi=85, format="png")


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m experiments.learn_from", description=__doc__.splitlines()[0])
    parser.add_argument("--study", type=Path, required=True, help="directory of a finished study")
    parser.add_argument("--out", type=Path, required=True, help="directory for results.json and figure.png")
    given = parser.parse_args(argv)
    set_threads(None)
    found: dict[str, Any] = {}
    for name, arm in agents_of(given.study, "cpu").items():
        over_time = curves(given.study / name / "evaluations.jsonl")
        found[name] = {
            "seeds": len(arm.digests),
            "interactions": arm.results["interactions"],
            "jump_start": arm.config.train.jump_start,
            "learned_at": learned_at(over_time),
            "with_filter": summary(arm.results),
            "without": summary(evaluate(arm, rta=False, period=arm.config.rta.period)),
            "curves": over_time,
        }
    given.out.mkdir(parents=True, exist_ok=True)
    write_json(given.out / "results.json", found)
    figure(found, given.out / "figure.png")


if __name__ == "__main__":
    main()

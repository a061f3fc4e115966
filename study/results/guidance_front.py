"""The guidance by its names, on cases that nobody has seen (docs/results/learning.md).

    python -m study.results.guidance_front --out runs/reference/guidance

Flies each of `GUIDANCE` with a decision every 10 s and without the filter, as it teaches but for its roll, then with
one every second, without the filter and behind it. Takes ten minutes.
"""

import os
from pathlib import Path
from typing import Any

import torch

from inspection.orbits import GUIDANCE
from settings import Parser, positive_integer
from study.experiment import paper_task, test_cases
from study.files import write_json
from study.flight.controllers import classical
from study.flight.evaluation import report, run_episodes

UNSEEN_CASES = 3703  # seed of the cases; those of the search are others
WAYS = {
    "teaching": (False, 10.0),
    "without": (False, 1.0),
    "with": (True, 1.0),
}  # the filter, s between decisions
METRICS = ("reward", "episode_length_s", "delta_v_m_s")
KEPT = ("mean", "iqm", "ci95", "p5", "p95", "max")


def flown(name: str, rta: bool, every: float, cases: int) -> dict[str, Any]:
    """What the pages show of a guidance that decides every so many s."""
    experiment, env = paper_task(cases, UNSEEN_CASES + 1, rta, decide_every=every)
    controller = classical(name, env, UNSEEN_CASES, every)
    record = run_episodes(env, controller, *test_cases(experiment.config, cases, UNSEEN_CASES))
    results = report(record, experiment.config, UNSEEN_CASES)
    return {
        "outcomes": results["outcomes"],
        "violating_episodes": int((record.violation_seconds[-1] > 0.0).sum()),
        "drifting_successes": round(cases * results["outcomes"]["success"]) - int(record.clear.sum()),
        "metrics": {name: {key: results["metrics"][name][key] for key in KEPT} for name in METRICS},
        "violations_percent_of_seconds": results["violations_percent_of_seconds"]["any"],
        "worst_constraint_value": results["worst_constraint_value"],
        "extremes": results["extremes"],
        "corrected_percent": results["rta"]["intervention_percent"],
    }


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m study.results.guidance_front")
    parser.add_argument("--out", type=Path, required=True, help="directory for guidance.json")
    parser.add_argument("--cases", type=positive_integer, default=1000, help="unseen (default: 1000)")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    arguments.out.mkdir(parents=True, exist_ok=True)
    found = {
        name: {way: flown(name, *how, arguments.cases) for way, how in WAYS.items()} for name in GUIDANCE
    }
    write_json(
        arguments.out / "guidance.json", {"cases": arguments.cases, "seed": UNSEEN_CASES, "guidance": found}
    )


if __name__ == "__main__":
    main()

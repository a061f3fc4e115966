"""Flies each guidance by its name through unseen cases (experiments/learning_log.md).

    python -m experiments.guidance --out runs/reference/guidance

It decides every 10 s without the filter, as when agents imitate it, except for its roll; then every second, without
and with the filter. Takes ten minutes.
"""

from pathlib import Path
from typing import Any

from inspection.orbits import GUIDANCE
from settings import Parser, positive_integer
from study.experiment import paper_task, test_cases
from study.files import write_json
from study.flight.controllers import classical
from study.flight.evaluation import report, run_episodes
from study.machine import set_threads

UNSEEN_CASES = 3703  # seed of the cases; the guidance was tuned on other cases
WAYS = {
    "teaching": (False, 10.0),
    "without": (False, 1.0),
    "with": (True, 1.0),
}  # the filter, s between decisions
METRICS = ("reward", "episode_length_s", "delta_v_m_s")
KEPT = ("mean", "iqm", "ci95", "p5", "p95", "max")


def flown(name: str, rta: bool, every: float, cases: int) -> dict[str, Any]:
    """Flies a guidance that decides every `every` s; returns the numbers that the pages show."""
    experiment, env = paper_task(cases, UNSEEN_CASES + 1, rta, decide_every=every)
    controller = classical(name, env, UNSEEN_CASES, every)
    record = run_episodes(env, controller, test_cases(experiment.config, cases, UNSEEN_CASES))
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
    parser = Parser(prog="python -m experiments.guidance", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="directory for guidance.json")
    parser.add_argument("--cases", type=positive_integer, default=1000, help="(default: 1000)")
    given = parser.parse_args(argv)
    set_threads(None)
    given.out.mkdir(parents=True, exist_ok=True)
    found = {name: {way: flown(name, *how, given.cases) for way, how in WAYS.items()} for name in GUIDANCE}
    write_json(given.out / "guidance.json", {"cases": given.cases, "seed": UNSEEN_CASES, "guidance": found})


if __name__ == "__main__":
    main()

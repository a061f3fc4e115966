"""A study's agents behind the filter, led to free flights that stay clear of the chief (docs/results/learning.md).

    python -m study.results.keep_clear --study runs/reference/study --out runs/reference/keep_clear

Flies all agents of the arm with RTA through the study's test cases with `[train] keep_clear`; takes ten minutes.
"""

import os
from dataclasses import replace
from pathlib import Path

import torch

from study.command_line.flags import Parser
from study.config import TEST_CASES
from study.experiment import Experiment
from study.files import write_json
from study.flight.evaluation import play, report
from study.paper import Results
from study.report.agents import Arm, load

ARM = "rta"


def led(arm: Arm) -> Results:
    """What the agents of an arm do with `keep_clear`, as the study's own results say it."""
    train = replace(arm.config.train, keep_clear=True)
    config = replace(arm.config.unsettled(), train=train)
    seeds, cases = arm.policy.seeds, train.final_episodes
    experiment = Experiment(config, seeds * cases)
    record = play(arm.policy.to(experiment.device), experiment, cases, TEST_CASES)
    clean = [100.0 * own.clean.double().mean().item() for own in record.split(seeds)]
    return report(record, experiment.config, TEST_CASES, seeds) | {"clean_percent_of_seeds": clean}


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m study.results.keep_clear")
    parser.add_argument("--study", type=Path, required=True, help="directory of a finished study")
    parser.add_argument("--out", type=Path, required=True, help="directory for keep_clear.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    results = led(load(arguments.study, "cpu")[ARM])
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "keep_clear.json", results)


if __name__ == "__main__":
    main()

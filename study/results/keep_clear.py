"""A study's agents behind the filter, led to free flights that stay clear of the chief (docs/results/learning.md).

    python -m study.results.keep_clear --study runs/reference/study --out runs/reference/keep_clear

Flies all agents of the arm with RTA through the study's test cases with `[train] keep_clear`; takes ten minutes.
"""

import os
from dataclasses import replace

import torch

from study.files import write_json
from study.paper import Results
from study.report.agents import Arm, agents_of
from study.report.flights import flown_with
from study.results.arguments import of_a_study

ARM = "rta"


def led(arm: Arm) -> Results:
    """What the agents of an arm do with `keep_clear`, as the study's own results say it."""
    return flown_with(arm, replace(arm.config, train=replace(arm.config.train, keep_clear=True)))


def main(argv: list[str] | None = None) -> None:
    arguments = of_a_study("keep_clear", "keep_clear.json").parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    results = led(agents_of(arguments.study, "cpu")[ARM])
    arguments.out.mkdir(parents=True, exist_ok=True)
    write_json(arguments.out / "keep_clear.json", results)


if __name__ == "__main__":
    main()

"""Flies a study's agents with `[train] keep_clear`, so that free flight misses the chief (docs/results/learning.md).

    python -m experiments.keep_clear --study runs/reference/from_nothing --out runs/reference/keep_clear

All agents of the arm with RTA fly the study's test cases; takes ten minutes.
"""

from dataclasses import replace
from pathlib import Path

from settings import Parser
from study.files import write_json
from study.machine import set_threads
from study.report.flights import flown_with
from study.report.inputs import agents_of


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m experiments.keep_clear", description=__doc__.splitlines()[0])
    parser.add_argument("--study", type=Path, required=True, help="directory of a finished study")
    parser.add_argument("--out", type=Path, required=True, help="directory for keep_clear.json")
    given = parser.parse_args(argv)
    set_threads(None)
    arm = agents_of(given.study, "cpu")["rta"]
    led = replace(arm.config, train=replace(arm.config.train, keep_clear=True))
    given.out.mkdir(parents=True, exist_ok=True)
    write_json(given.out / "keep_clear.json", flown_with(arm, led))


if __name__ == "__main__":
    main()

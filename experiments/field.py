"""Compares methods against violations: penalties, PPO-Lagrangian, and filters in training, after it or both.

    python main.py study --config configs/from_nothing.toml --config configs/field.toml --study-dir runs/filtered
    python main.py study --config configs/from_nothing.toml --config configs/field.toml --seeds 10 \\
        --arms plain,prices,lagrangian --study-dir runs/unfiltered
    python -m experiments.field --study runs/unfiltered runs/filtered --out runs/reference/field

Reads which limits the arms of these studies violated in training, flies their agents and the guidance with and without
the filter, and draws the training curves. Takes a few minutes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from settings import InputError, Parser
from study.config import EVALUATION_CASES, TEST_CASES, Config
from study.experiment import Experiment
from study.files import read_json_lines, write_json, writing
from study.flight.evaluation import Episodes, play_controller, report
from study.machine import set_threads
from study.report.flights import flights_with, with_rta
from study.report.inputs import Arm, agents_of

KEPT = ("reward", "delta_v_m_s", "episode_length_s")
CLASSICAL = ("quick", "even")  # settings of the guidance
REFERENCE = "even"  # the setting whose fuel and reward the figure shows
SWITCHES = {"off": False, "on": True}
SHOWN = {
    "success": "success (%)",
    "violations": "steps beyond a limit (%)",
    "delta_v_m_s": "delta v (m/s)",
    "reward": "reward",
}

# labels of arms in the figure; arms of other studies are shown by their names
LABELS = {
    "plain": "no filter",
    "prices": "no filter, penalty near limits",
    "lagrangian": "no filter, PPO-Lagrangian",
    "rta_desired": "filter, learns from the desired action",
    "rta_applied": "filter, learns from the applied action",
    "rta_penalty": "filter, penalty on corrections",
    "rta_5s": "the same, every 5 s",
    "rta_10s": "the same, every 10 s",
    "rta_paper": "the paper's filter, learns from the desired action",
}


def summary(record: Episodes, config: Config, seeds: int = 1) -> dict[str, Any]:
    """Returns the numbers of the page for the flights of `seeds` seeds, and some of them for each seed."""
    results = report(record, config, TEST_CASES, seeds)
    each = [report(own, config, TEST_CASES) for own in record.split(seeds)]
    return {
        "episodes": results["episodes"],
        "outcomes": results["outcomes"],
        "metrics": {name: {key: results["metrics"][name][key] for key in ("iqm", "mean")} for name in KEPT},
        "violations_percent": results["violations_percent"]["any"],
        "violating_episodes": int((record.violation_seconds[-1] > 0.0).sum()),
        "corrected_percent": results["rta"]["intervention_percent"],
        "per_seed": {
            "reward": [own["metrics"]["reward"]["iqm"] for own in each],
            "success": [own["outcomes"]["success"] for own in each],
            "corrected_percent": [own["rta"]["intervention_percent"] for own in each],
        },
    }


def exposure(results: dict[str, Any]) -> dict[str, Any]:
    """Returns for all seeds of an arm together the steps in training, those with violations, and the smallest h.

    Raises:
        InputError: the violations were not counted.
    """
    seeds = results.get("training_per_seed")
    if not seeds:
        raise InputError(
            "an arm was trained by an older revision, which did not count what was broken in training"
        )
    percent = {
        name: [seed["violations_percent"][name] for seed in seeds] for name in seeds[0]["violations_percent"]
    }
    steps = [seed["interactions"] for seed in seeds]
    return {
        "steps": sum(steps),
        "violated": {name: round(float(np.dot(steps, shares)) / 100.0) for name, shares in percent.items()},
        "smallest_h": {
            name: min(seed["smallest_h"][name] for seed in seeds) for name in seeds[0]["smallest_h"]
        },
    }


def curves(path: Path) -> dict[str, list[Any]]:
    """Returns the periodic evaluations, each quantity a row per point of time and a column per seed.

    Raises:
        InputError: some seed was not evaluated at some of the times.
    """
    lines = read_json_lines(path, "evaluations of a run")
    times = sorted({line["interactions"] for line in lines})
    rows = [[line for line in lines if line["interactions"] == time] for time in times]
    if len({len(row) for row in rows}) > 1:
        raise InputError(f"{path}: not every seed was evaluated at every time; was the study cut off?")
    return {
        "interactions": times,
        "success": [[100.0 * line["outcomes"]["success"] for line in row] for row in rows],
        "violations": [[line["violations_percent"]["any"] for line in row] for row in rows],
        "delta_v_m_s": [[line["metrics"]["delta_v_m_s"]["mean"] for line in row] for row in rows],
        "reward": [[line["metrics"]["reward"]["mean"] for line in row] for row in rows],
    }


def flown(arm: Arm, rta: bool) -> dict[str, Any]:
    """Returns the summary of an arm's agents with the filter off or on."""
    config = with_rta(arm.config, rta, arm.config.rta.period)
    record, config = flights_with(arm, config, config.train.final_episodes)
    return summary(record, config, len(arm.digests))


def guided(config: Config, name: str, cases: int, rta: bool, seed: int = TEST_CASES) -> dict[str, Any]:
    """Returns the summary of a guidance, which decides every second, with the filter off or on."""
    experiment = Experiment(with_rta(config, rta, config.rta.period), cases)
    return summary(play_controller(name, experiment, cases, seed), experiment.config)


def figure(results: dict[str, Any], beside: dict[str, Any], path: Path) -> None:
    """Draws medians and ranges over the seeds of the periodic evaluations, and the guidance's means."""
    drawn = Figure(figsize=(11, 7), layout="constrained")
    for axis, (name, text) in zip(drawn.subplots(2, 2).flat, SHOWN.items(), strict=True):
        for number, (arm, found) in enumerate(results.items()):
            values, x = np.array(found["curves"][name]), np.array(found["curves"]["interactions"]) / 1e6
            low, middle, high = np.percentile(values, (0, 50, 100), axis=1)
            style = "-" if found["filtered"] else "--"
            axis.plot(x, middle, style, color=f"C{number % 10}", lw=1.5, label=LABELS.get(arm, arm))
            axis.fill_between(x, low, high, color=f"C{number % 10}", alpha=0.15, lw=0)
        if name in KEPT:
            axis.axhline(
                beside["metrics"][name]["mean"],
                color="black",
                ls=":",
                lw=1.5,
                label=f"guidance ({REFERENCE})",
            )
        axis.set(xlabel="interactions of a seed (million)", ylabel=text)
        axis.grid(alpha=0.3)
        if name == "violations":
            axis.set_yscale("symlog", linthresh=0.01)
        if name == "delta_v_m_s":  # at first many times its final value
            axis.set(yscale="log", ylim=(0.5, None))
            axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    lines = {str(line.get_label()): line for axis in drawn.axes for line in axis.lines}
    drawn.legend(list(lines.values()), list(lines), loc="outside right center", fontsize=8)
    with writing(path) as file:
        drawn.savefig(file, dpi=85, format="png")


def main(argv: list[str] | None = None) -> None:
    parser = Parser(prog="python -m experiments.field", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--study", type=Path, nargs="+", required=True, help="directories of finished studies"
    )
    parser.add_argument("--out", type=Path, required=True, help="directory for results.json and figure.png")
    given = parser.parse_args(argv)
    set_threads(None)
    try:
        write(given.study, given.out)
    except InputError as error:
        parser.error(str(error))


def write(studies: Sequence[Path], out: Path) -> None:
    """Writes results.json and figure.png of finished studies.

    Raises:
        InputError: a study is not finished, shares an arm's name with another one, flew another number of cases, or was
        trained by an older revision.
    """
    arms: dict[str, Arm] = {}
    evaluations: dict[str, Path] = {}
    for study in studies:
        own = agents_of(study, "cpu")
        if twice := [name for name in own if name in arms]:
            raise InputError(f"--study {study}: its arm {twice[0]} is in a study before it, too")
        arms |= own
        flights = [
            (arm.config.train.evaluation_episodes, arm.config.train.final_episodes) for arm in arms.values()
        ]
        if len(set(flights)) > 1:
            raise InputError(
                f"--study {study}: its evaluation_episodes or final_episodes differ from those before it"
            )
        evaluations |= {name: study / name / "evaluations.jsonl" for name in own}
    training = {name: exposure(arm.results) for name, arm in arms.items()}  # may raise InputError
    found: dict[str, Any] = {
        name: {
            "seeds": len(arm.digests),
            "interactions": arm.results["interactions"],
            "filtered": arm.config.train.rta,
            "training": training[name],
            "flown": {switch: flown(arm, rta) for switch, rta in SWITCHES.items()},
            "curves": curves(evaluations[name]),
        }
        for name, arm in arms.items()
    }
    plain = next(iter(arms.values())).config
    out.mkdir(parents=True, exist_ok=True)
    cases = plain.train.final_episodes
    classical = {
        name: {switch: guided(plain, name, cases, rta) for switch, rta in SWITCHES.items()}
        for name in CLASSICAL
    }
    write_json(out / "results.json", {"arms": found, "guidance": classical})
    beside = guided(plain, REFERENCE, plain.train.evaluation_episodes, rta=True, seed=EVALUATION_CASES)
    figure(found, beside, out / "figure.png")


if __name__ == "__main__":
    main()

"""Commands for a person to paste into a shell, and the names in them that lead to files."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from inspection.orbits import GUIDANCE
from study.config import TEST_CASES

CHECKPOINT, LEARNED = FILES = (
    "checkpoint:",
    "learned:",
)  # begin an agent's file where other policies have names

INSTALLED = "rta-inspection"  # the package, and the command that comes with it
RUNS = "runs"  # below the working directory: what commands write
EPISODE = 3600  # s, about as long as an agent takes


def in_file(name: str) -> str:
    """A policy's name without what begins it where an agent's file follows."""
    return name.removeprefix(CHECKPOINT).removeprefix(LEARNED)


def called() -> str:
    """What this program was called by: the installed command, or main.py."""
    return INSTALLED if Path(sys.argv[0]).stem == INSTALLED else "main.py"


def command(*words: str | Path) -> str:
    """A call of this program as it was called, its words quoted."""
    source = sys.argv[0] if Path(sys.argv[0]).name == "main.py" else "main.py"
    program = [INSTALLED] if called() == INSTALLED else ["python", source]
    return shlex.join([*program, *map(str, words)])


def after_training(directory: Path) -> str:
    """What to do with a trained agent: measure it, watch it fly, see its course."""
    agent, flight, page = (directory / name for name in ("policy.pt", "flight.npz", "flight.html"))
    fly = command(
        "simulate",
        "--controller",
        "policy",
        "--checkpoint",
        agent,
        "--duration",
        f"{EPISODE}",
        "--out",
        flight,
    )
    return "\n".join(
        (
            "Next:",
            "  " + command("evaluate", "--checkpoint", agent, "--episodes", "1000"),
            "  " + fly + " && " + command("replay", flight, "--out", page),
            "  " + shlex.join(["tensorboard", "--logdir", str(directory)]),
        )
    )


def after_evaluation(
    results: dict[str, Any], checkpoint: str | None, controller: str | None, settings: Sequence[str]
) -> str:
    """The commands that show the first episode of an evaluation of an agent's file or of a controller.

    Args:
        results: in the form of `evaluate --json`; settings: flags with their values.
    """
    who = ["policy", "--checkpoint", checkpoint] if checkpoint else [controller]
    task = results["config"]["inspection"]
    calls = results["rta"]["period_s"] or task["substep"]
    every = {"random": task["action_period"]} | dict.fromkeys(GUIDANCE, calls)
    if controller in every:
        who += ["--step", f"{every[controller]:g}"]
    if results["seed"] != TEST_CASES:
        who += ["--seed", str(results["seed"])]
    length = "--duration", f"{EPISODE}"
    begin = "" if Path(RUNS).is_dir() else f"mkdir {RUNS} && "
    flight, page = f"{RUNS}/flight.npz", f"{RUNS}/flight.html"
    fly = command("simulate", "--controller", *who, *settings, *length, "--out", flight)
    return f"Watch one: {begin}{fly} && {command('replay', flight, '--out', page)}"

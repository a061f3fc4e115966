"""Commands for a person to paste into a shell, and the names in them that lead to files."""

import shlex
import sys
from pathlib import Path

CHECKPOINT, LEARNED = FILES = (
    "checkpoint:",
    "learned:",
)  # begin an agent's file where other policies have names

EPISODE = 3600  # s, about as long as an agent takes


def in_file(name: str) -> str:
    """A policy's name without what begins it where an agent's file follows."""
    return name.removeprefix(CHECKPOINT).removeprefix(LEARNED)


def command(*words: str | Path) -> str:
    """A call of this program as it was called, its words quoted."""
    program = sys.argv[0] if Path(sys.argv[0]).name == "main.py" else "main.py"
    return shlex.join(["python", program, *map(str, words)])


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

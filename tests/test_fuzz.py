"""Hostile calls: each ends within seconds in success or in one line and exit code 2, and no input changes.

Calls are drawn from a seed: a call that works, then one to three things in it made hostile: a flag's value, a file, a
key of the configuration, or its words. `python -m tests.test_fuzz SEED COUNT` draws others.
"""

import argparse
import contextlib
import io
import json
import os
import random
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

import main
from study.config import StudyConfig
from tests.test_main import STATE, write_inputs

ROOT = Path(main.__file__).parent
LONGEST = 60  # s of a call
SHORT = {  # tables of a configuration in which everything is short
    "inspection": {"max_time": "10.0", "num_points": "20"},
    "train": {
        **{"num_envs": "2", "rollout_steps": "2", "interactions": "4", "compile": '"off"'},
        **{"evaluation_episodes": "1", "final_episodes": "1"},
    },
    "ppo": {"minibatch_size": "2", "epochs": "1"},
}

# Calls that work in the directory of `files`, and take a second at most.
BASES = (
    "train --config c.toml --no-rta --run-dir new",
    "evaluate --checkpoint p.pt --config c.toml --episodes 1 --no-rta --json e.json",
    "evaluate --controller natural-motion --config c.toml --episodes 1 --json e.json",
    "simulate --controller zero --config c.toml --duration 2 --no-rta --out o.npz --figure o.png",
    "simulate --controller policy --checkpoint p.pt --config c.toml --duration 2 --initial-state s.json --out o.npz",
    "simulate --controller recorded --actions u.npy --initial-state s.json --duration 2 --no-rta --out o.npz",
    "filter --states x.npz --out o.npz",
    "replay r.npz r.npz --out o.html",
    "export --checkpoint p.pt --out o.onnx",
    "export --checkpoint p.pt --c code",
    "verify --policy random --episodes 1 --duration 1 --json v.json",
    "refly x.npz",
    "report --study directory",
    "study --config c.toml --study-dir study --seeds 1",
    "benchmark --batches 2,x --json directory",
)
TEXTS = (
    "", " ", "-1", "0", "0.0", "nan", "inf", "-inf", "1e400", "1e-320", "abc", "½", "\uff11", "0x10",
    "1_000_", "9" * 400, "None", "True", "[]", "{}", "1,2", ",", "-", "--", "--help=", "a\nb", "$(id)",
    "../..", "%s%n", "checkpoint:", "é",
)  # fmt: skip
PATHS = (
    "", ".", "/", "/dev/null", "/dev/full", "/proc/self/mem", "nowhere/x", "x" * 300, "a\0b",
    "directory", "empty", "garbage", "latin1", "loop", "dangling", "p.pt", "c.toml", "s.json", "u.npy",
    "x.npz", "r.npz", "deep.toml", "deep.json", "objects.npz", "complex.npy", "link", "a\nb",
    "checkpoint:p.pt", "~", "--", "sparse", "half.pt",
)  # fmt: skip
VALUES = (  # TOML
    "-1", "0", "1", "-0.0", "1e300", "-1e300", "1e-300", "nan", "inf", "-inf", "9223372036854775807",
    "1" + "0" * 30, '""', '"text"', "true", "[]", "[1.0]", "[1.0, 2.0, 3.0]", "[-1.0, nan]", "[[1]]",
    "{a = 1}", "1979-05-27",
)  # fmt: skip
INPUTS = ("p.pt", "c.toml", "s.json", "u.npy", "x.npz", "r.npz")


def make_files() -> None:
    """Inputs of every kind, whole and hostile, in the working directory."""
    write_inputs(Path())
    Path("half.pt").write_bytes(Path("p.pt").read_bytes()[:5000])
    Path("c.toml").write_text(toml(SHORT))
    np.save("complex.npy", np.zeros((20, 6), dtype=complex))
    np.savez("objects.npz", state=np.array([{}], dtype=object), control_desired=np.zeros((1, 6)))
    Path("empty").touch()
    Path("garbage").write_bytes(bytes(range(256)) * 40)
    Path("latin1").write_bytes("[train] # \xe9\n".encode("latin1"))
    Path("deep.toml").write_text("x = " + "[" * 5000 + "]" * 5000)
    Path("deep.json").write_text("[" * 100_000)
    Path("directory").mkdir()
    Path("directory", "thesis.tex").write_text("years of work")
    Path("loop").symlink_to("loop")
    Path("dangling").symlink_to("nowhere")
    Path("link").symlink_to("s.json")
    with open("sparse", "wb") as file:
        file.truncate(2**42)


def flags_of(command: str) -> list[argparse.Action]:
    """Returns a command's flags, less --help, and its positional arguments."""
    commands = main.build_parser()._subparsers._group_actions[0].choices
    return [action for action in commands[command]._actions if action.dest != "help"]


def is_output(flag: argparse.Action) -> bool:
    """Tells whether a flag names a file that is written."""
    return getattr(flag.type, "__qualname__", "").startswith("to_write")


def values_of(words: list[str], flag: argparse.Action) -> list[int]:
    """Returns the places of a flag's values among the words of a call."""
    if not flag.option_strings:
        return [1]
    return [i + 1 for i, word in enumerate(words[:-1]) if word in flag.option_strings]


def hostile_flag(draw: random.Random, words: list[str]) -> None:
    """Gives one of the command's flags a hostile value."""
    flag = draw.choice(flags_of(words[0]))
    if flag.nargs == 0:
        name = draw.choice(flag.option_strings)
        words.append(draw.choice((name, f"{name}=1")))
        return
    is_path = is_output(flag) or str(flag.metavar or "")[:1] in ("F", "D", "G", "R")
    value = draw.choice(PATHS if is_path and draw.random() < 0.9 else TEXTS)
    places = values_of(words, flag)
    if places:
        words[places[-1]] = value
    else:
        words += [flag.option_strings[0], value]


def hostile_words(draw: random.Random, words: list[str]) -> None:
    """Drops, doubles or adds a word."""
    at = draw.randrange(1, len(words) + 1)
    choice = draw.randrange(3)
    if choice == 0 and at < len(words):
        del words[at]
    elif choice == 1 and at < len(words):
        words.insert(at, words[at])
    else:
        words.insert(at, draw.choice((*TEXTS, *PATHS, "--nonsense", "train", "--config")))


def hostile_output(draw: random.Random, words: list[str]) -> None:
    """Lets an output be one of the inputs."""
    outputs = [flag for flag in flags_of(words[0]) if is_output(flag)]
    if outputs:
        flag = draw.choice(outputs)
        words += [flag.option_strings[0], draw.choice([word for word in words if word in INPUTS] or INPUTS)]


def toml(tables: dict[str, dict[str, str]]) -> str:
    """Tables as text."""
    return "".join(
        f"[{name}]\n" + "".join(f"{key} = {value}\n" for key, value in table.items())
        for name, table in tables.items()
    )


def hostile_key(draw: random.Random, words: list[str]) -> None:
    """Writes a configuration with a hostile key or two."""
    known = {name: list(getattr(part, "__dict__", ())) for name, part in vars(StudyConfig()).items()} | {
        "nonsense": []
    }
    tables = {name: dict(table) for name, table in SHORT.items()}
    for _ in range(draw.randrange(1, 3)):
        table = draw.choice(list(known))
        tables.setdefault(table, {})[draw.choice([*known[table], "nonsense"])] = draw.choice(VALUES)
    Path("hostile.toml").write_text(toml(tables))
    words += ["--config", "hostile.toml"]


def hostile_file(draw: random.Random, words: list[str]) -> None:
    """Writes a state file, states or a checkpoint with hostile content."""
    name = draw.choice([word for word in words if word in INPUTS] or ["s.json"])
    numbers = (np.nan, np.inf, -1.0, 0.0, 1e300, 1e7, 1e-300)
    hostile = f"hostile-{name}"
    if name == "s.json":
        value = draw.choice([*numbers, None, "x", [], [1e300] * 3, [0.0] * 4, {}, True])
        Path(hostile).write_text(json.dumps(STATE | {draw.choice([*STATE, "priority_vector", "x"]): value}))
    elif name == "p.pt":
        content = torch.load(name, weights_only=True)
        key = draw.choice([*content, *content["policy"]])
        value = draw.choice([None, 3, "x", {}, [], torch.zeros(2), torch.full((1, 2), torch.nan)])
        (content if key in content else content["policy"])[key] = value
        torch.save(content, hostile)
    elif name in ("x.npz", "r.npz"):
        with np.load(name) as arrays:
            content = dict(arrays)
        key = draw.choice(list(content))
        change = draw.choice((0, 1, 2, 3))
        if change == 0:
            del content[key]
        elif change == 1:
            content[key] = content[key].astype(draw.choice(("complex64", "U8", "bool", "int8", "float16")))
        elif change == 2:
            content[key] = content[key][..., None] if draw.random() < 0.5 else content[key].ravel()[:3]
        elif content[key].dtype.kind == "f":
            content[key] = np.full_like(content[key], draw.choice(numbers))
        np.savez(hostile, **content)
    else:
        np.save(hostile, np.full(draw.choice([(20, 6), (1, 6), (0, 6), (6,), ()]), draw.choice(numbers)))
        os.replace(hostile + ("" if hostile.endswith(".npy") else ".npy"), hostile)
    words[:] = [hostile if word == name else word for word in words]


def hostile_call(draw: random.Random) -> list[str]:
    """Returns the words of one call; what files it needs are in the working directory."""
    words = draw.choice(BASES).split()
    kinds = (hostile_flag, hostile_flag, hostile_words, hostile_output, hostile_key, hostile_file)
    for _ in range(draw.choice((1, 1, 2, 3))):
        draw.choice(kinds)(draw, words)
    return words


class TooLong(BaseException):
    """Signals that a call has not ended within LONGEST."""


@contextlib.contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raises TooLong afterwards."""

    def end(*_: object) -> None:
        raise TooLong(f"longer than {seconds} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def contents() -> dict[str, bytes]:
    """Returns the inputs, those in directories among them."""
    return {name: Path(name).read_bytes() for name in (*INPUTS, "garbage", "directory/thesis.tex")}


def complaint(words: list[str]) -> str:
    """Returns what is wrong with a call's end, empty if nothing is."""
    before = contents()
    if words[0] == "simulate":  # simulate may replace this run, which it does not read
        del before["r.npz"]
    out, err = io.StringIO(), io.StringIO()
    try:
        with at_most(LONGEST), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main.main(words)
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    if contents() | before != contents():
        return "an input has changed"
    if code not in (0, 2):
        return f"exit code {code}: {err.getvalue()}"
    lines = err.getvalue().strip().splitlines()
    if code == 2 and not (lines and lines[-1].startswith("error: ")):
        return f"no reason: {lines}"
    if code == 2 and len([line for line in lines if line.startswith("error: ")]) > 1:
        return f"several reasons: {lines}"
    if "Traceback" in err.getvalue():
        return f"a traceback: {err.getvalue()[-300:]}"
    return ""


def complaints(seed: int, count: int) -> Iterator[str]:
    """Yields the calls, out of a number of them, that end badly, in a directory of their own."""
    draw, here = random.Random(seed), os.getcwd()
    # --cache-dir sets a variable, which tests that follow would build with
    with tempfile.TemporaryDirectory() as directory, mock.patch.dict(os.environ):
        os.chdir(directory)
        try:
            make_files()
            for _ in range(count):
                words = hostile_call(draw)
                if wrong := complaint(words):
                    text = Path("hostile.toml").read_text() if "hostile.toml" in words else ""
                    yield f"{words}: {wrong}\n{text}"
        finally:
            os.chdir(here)


@pytest.mark.parametrize(
    ("seed", "count"),
    [(0, 15), *(pytest.param(seed, 60, marks=pytest.mark.campaign) for seed in (0, 1, 2, 3))],
)
def test_hostile_calls_end_well(seed: int, count: int) -> None:
    assert list(complaints(seed, count)) == []


if __name__ == "__main__":
    for bad in complaints(int(sys.argv[1]), int(sys.argv[2])):
        print(bad, flush=True)

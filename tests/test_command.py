"""The command as a person calls it: bare, from elsewhere, and what it calls itself."""

import sys
import tomllib
from pathlib import Path

import pytest

import main
from study.command_line.arguments import version
from study.command_line.commands import COMMANDS
from study.commands import command

ROOT = Path(main.__file__).parent


def ending(words: list[str]) -> int:
    """The exit code of a call that argparse may end."""
    try:
        return main.main(words)
    except SystemExit as end:
        return int(end.code or 0)


def test_a_bare_call_prints_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert ending([]) == 0
    bare = capsys.readouterr()
    assert ending(["--help"]) == 0
    assert bare == capsys.readouterr() and not bare.err
    for name, each in COMMANDS.items():
        assert name in bare.out and each.about.split()[0] in bare.out


def test_the_version_is_that_of_the_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert ending(["--version"]) == 0
    assert capsys.readouterr().out == f"rta-inspection {wanted}\n"
    monkeypatch.setattr("study.command_line.arguments.ROOT", tmp_path)  # as installed
    monkeypatch.setattr("importlib.metadata.version", {"rta-inspection": "3.2.1"}.get)
    assert version() == "3.2.1"


@pytest.mark.parametrize(
    ("called", "again"),
    [
        ("main.py", "python main.py train --resume 'a b'"),
        ("../code/main.py", "python ../code/main.py train --resume 'a b'"),
        ("/usr/bin/rta-inspection", "rta-inspection train --resume 'a b'"),
        ("pytest", "python main.py train --resume 'a b'"),
    ],
)
def test_what_to_call_next_is_called_as_this_was(
    called: str, again: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [called])
    assert command("train", "--resume", "a b") == again
    assert ending(["train", "--help"]) == 0
    name = "rta-inspection" if "rta" in called else "main.py"
    assert capsys.readouterr().out.startswith(f"usage: {name} train ")

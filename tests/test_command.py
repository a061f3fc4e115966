"""The command as a person calls it: bare, installed, and with an output that cannot be written."""

import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import inspection
import kernels
import main
import ppo
import rta
import study
from study.command_line.arguments import version
from study.command_line.commands import COMMANDS
from study.commands import command

ROOT = Path(main.__file__).parent


def test_a_bare_call_prints_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main([]) == 0
    bare = capsys.readouterr()
    assert main.main(["--help"]) == 0
    assert bare == capsys.readouterr() and not bare.err
    for name, each in COMMANDS.items():
        assert name in bare.out and each.about.split()[0] in bare.out


def test_the_version_is_that_of_the_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert main.main(["--version"]) == 0
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
    assert main.main(["train", "--help"]) == 0
    name = "rta-inspection" if "rta" in called else "main.py"
    assert capsys.readouterr().out.startswith(f"usage: {name} train ")


# Three calls that print: help by argparse, a refusal on standard error, and results after work.
HELP, REFUSED = "--help", "train --threads 9999999"
WORKS = "simulate --controller zero --no-rta --duration 2 --threads 1 --out {out}/o.npz"


def shell(words: str, redirected: str, tmp_path: Path, unbuffered: str = "") -> tuple[int, str]:
    """Exit code and standard error of a call in a shell."""
    line = f"{shlex.quote(sys.executable)} {main.__file__} {words.format(out=tmp_path)} {redirected}"
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(line, shell=True, env=environment, stderr=subprocess.PIPE, text=True)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("words", "redirected", "unbuffered", "said"),
    [
        (HELP, ">&-", "", "standard output is closed"),
        (WORKS, ">&-", "", "standard output is closed"),
        (HELP, ">/dev/full", "", "standard output: No space left on device"),
        (HELP, ">/dev/full", "1", "standard output: No space left on device"),
        (WORKS, ">/dev/full", "", "standard output: No space left on device"),
        (WORKS, ">/dev/full", "1", "standard output: No space left on device"),
        (REFUSED, ">/dev/full", "", "--threads 9999999: must be"),
    ],
)
def test_an_output_that_cannot_be_written_is_one_line(
    words: str, redirected: str, unbuffered: str, said: str, tmp_path: Path
) -> None:
    code, err = shell(words, redirected, tmp_path, unbuffered)
    errors = [line for line in err.splitlines() if "seconds ..." not in line]  # of a step that took long
    assert code == 2 and len(errors) == 1, err
    assert errors[0].startswith(f"error: {said}")


def test_a_reader_that_has_left_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, main.__file__, HELP], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


def test_an_error_output_that_is_closed_goes_into_no_file(tmp_path: Path) -> None:
    assert shell(WORKS, "2>&- >/dev/null", tmp_path) == (0, "")
    assert np.load(tmp_path / "o.npz")["time"].tolist() == [0.0, 1.0, 2.0]


def test_help_does_not_wait_for_pytorch() -> None:
    """That takes seconds: neither help of any command nor a mistake imports it, while a call that works does."""
    calls = [[], ["--version"], ["trian"], ["train", "--sed", "3"], *([name, "--help"] for name in COMMANDS)]
    code = f"import sys, main\nfor words in {calls}:\n    main.main(words)\n"
    loaded = "print([name for name in ('torch', 'scipy', 'matplotlib') if name in sys.modules])\n"
    works = "main.main(['evaluate', '--checkpoint', 'nowhere.pt'])\n"
    program = code + loaded + works + loaded
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert lines[-2] == "[]" and "torch" in lines[-1], done.stderr


def test_a_package_offers_what_it_lists_and_no_more() -> None:
    for package in (inspection, kernels, ppo, rta, study):
        for name in package.__all__:
            offered = getattr(package, name)
            assert getattr(offered, "__module__", package.__name__).startswith(package.__name__)
        with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'nothing'"):
            _ = package.nothing


@pytest.mark.parametrize(
    "name", ["kernels.build", "study.command_line.arguments", "torch", "inspection.sight"]
)
def test_ctrl_c_while_the_installed_command_imports_is_one_line(name: str, tmp_path: Path) -> None:
    """Its program as pip writes it, and before it what interrupts when a module is looked for."""
    program = tmp_path / "rta-inspection"
    program.write_text(
        f"""import os, signal, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
from main import program
sys.exit(program())
"""
    )
    words = ["simulate", "--controller", "zero", "--no-rta", "--duration", "2", "--out", "o.npz"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, program, *words], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
    assert not (tmp_path / "o.npz").exists()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"rta-inspection": "main:program"}

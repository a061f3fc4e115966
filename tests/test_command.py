"""The command as a person calls it: bare, installed, and with an output that nobody reads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import main

ROOT = Path(main.__file__).parent


def test_a_bare_call_prints_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main([]) == 0
    bare = capsys.readouterr()
    assert main.main(["--help"]) == 0
    assert bare == capsys.readouterr() and not bare.err
    assert all(name in bare.out for name in main.COMMANDS)


def test_a_reader_that_has_left_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, main.__file__, "--help"], stdout=write, stderr=subprocess.PIPE)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


def test_help_does_not_wait_for_pytorch() -> None:
    """That takes seconds: neither help of any command nor a mistake imports it, while a call that works does."""
    calls = [
        [],
        ["--version"],
        ["trian"],
        ["train", "--sed", "3"],
        *([name, "--help"] for name in main.COMMANDS),
    ]
    code = f"import sys, main\nfor words in {calls}:\n    main.main(words)\n"
    loaded = "print([name for name in ('torch', 'scipy', 'matplotlib') if name in sys.modules])\n"
    works = "main.main(['evaluate', '--checkpoint', 'nowhere.pt'])\n"
    program = code + loaded + works + loaded
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert lines[-2] == "[]" and "torch" in lines[-1], done.stderr


def test_figures_do_not_ask_for_the_backend_that_a_notebook_names(tmp_path: Path) -> None:
    words = ["simulate", "--controller", "zero", "--no-rta", "--duration", "2", "--compile", "off"]
    words += ["--out", str(tmp_path / "o.npz"), "--figure", str(tmp_path / "o.png")]
    environment = os.environ | {"MPLBACKEND": "module://matplotlib_inline.nowhere"}
    done = subprocess.run([sys.executable, main.__file__, *words], env=environment, capture_output=True)
    assert done.returncode == 0 and (tmp_path / "o.png").exists(), done.stderr

"""Files: written whole or not at all, refused in one line."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ppo import checkpoint
from study.files import check_writable, load_arrays, write_json, write_npz, write_text, writing

ROOT = Path(checkpoint.__file__).parents[1]


def python(code: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"a": [1, 2]})
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": [1, 2]}
    write_npz(str(tmp_path / "x.npz"), {"a": np.arange(3.0), "b": np.array("text")})
    arrays = load_arrays(str(tmp_path / "x.npz"), ("a", "b"), "run", "")
    assert arrays["a"].tolist() == [0.0, 1.0, 2.0] and str(arrays["b"]) == "text"
    write_text(tmp_path / "x.txt", "Δv")
    assert (tmp_path / "x.txt").read_bytes() == "Δv".encode()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.json", "x.npz", "x.txt"]


@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError, SystemExit])
@pytest.mark.parametrize("existed", [False, True])
def test_an_exception_midway_leaves_the_old_file_and_nothing_else(
    failure: type[BaseException], existed: bool, tmp_path: Path
) -> None:
    path = tmp_path / "x.json"
    if existed:
        path.write_text("old")
    with pytest.raises(failure), writing(path) as file:
        file.write(b"half of the ne")
        file.flush()
        raise failure
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == (
        {"x.json": "old"} if existed else {}
    )


def test_a_kill_midway_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    write_text(path, "old")
    code = (
        "import os, signal, sys\n"
        "from study.files import writing\n"
        "with writing(sys.argv[1]) as file:\n"
        "    file.write(b'half of the ne')\n"
        "    file.flush()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert python(code, str(path)).returncode == -signal.SIGKILL
    assert path.read_text() == "old"
    write_text(path, "new")  # the kill's remains do not matter
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["x.json"]


def test_standard_output_is_written_in_place() -> None:
    code = (
        "from pathlib import Path\nfrom study.files import check_writable, write_json\n"
        "check_writable(Path('/dev/stdout'))\n"
        "print('a table')\n"
        "write_json('/dev/stdout', {'a': 1})\n"
    )
    done = python(code)
    assert done.returncode == 0, done.stderr
    table, _, rest = done.stdout.partition("\n")
    assert table == "a table" and json.loads(rest) == {"a": 1}
    assert Path("/dev/stdout").is_symlink()


@pytest.mark.parametrize("path", ["nowhere/x.json", "/proc/nothing", "x" * 300, "a\0b", "."])
def test_what_cannot_be_written_is_refused(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((OSError, ValueError)):
        check_writable(Path(path))
    assert os.listdir() == []

"""Files: written whole or not at all, refused in one line."""

import json
import math
import os
import signal
import stat
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from ppo import checkpoint
from settings import InputError
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


def test_a_list_of_numbers_is_one_line_and_a_text_as_it_is(tmp_path: Path) -> None:
    content = {"x": [1, -2.5, 3e-05], "of": [[1, 2], ["[ 1,  2\n]"]], "none": [], "nan": [math.nan, 1.0]}
    write_json(tmp_path / "x.json", content)
    text = (tmp_path / "x.json").read_text()
    assert '"x": [1, -2.5, 3e-05],' in text and "[1, 2]" in text
    assert repr(json.loads(text)) == repr(content)


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
    write_text(path, "new")  # what the kill left is in nobody's way
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["x.json"]


def test_a_checkpoint_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(AttributeError, match="local"):
        checkpoint.save(tmp_path / "checkpoint.pt", {"update": lambda: None})  # cannot be pickled
    assert os.listdir(tmp_path) == []


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


def test_a_pipe_is_written_in_place_and_its_check_ends_nothing(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(path.read_text()), daemon=True)
    reader.start()
    check_writable(path)
    write_text(path, "through")
    reader.join(timeout=30)
    assert read == ["through"]
    assert stat.S_ISFIFO(path.stat().st_mode) and os.listdir(tmp_path) == ["pipe"]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "x.json").symlink_to(tmp_path / "elsewhere" / "y.json")
    (tmp_path / "elsewhere" / "y.json").write_text("old and longer")
    write_text(tmp_path / "x.json", "new")
    assert (tmp_path / "x.json").is_symlink()
    assert (tmp_path / "elsewhere" / "y.json").read_text() == "new"


@pytest.mark.parametrize("path", ["nowhere/x.json", "/proc/nothing", "x" * 300, "a\0b", "."])
def test_what_cannot_be_written_is_refused(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises((OSError, ValueError)):
        check_writable(Path(path))
    assert os.listdir() == []


@pytest.mark.parametrize("existed", [False, True])
def test_the_check_leaves_everything_as_it_was(existed: bool, tmp_path: Path) -> None:
    if existed:
        (tmp_path / "x.json").write_text("old")
    check_writable(tmp_path / "x.json")
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == (
        {"x.json": "old"} if existed else {}
    )


def test_the_file_is_named_that_a_full_disk_does_not_take() -> None:
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_json("/dev/full", {"a": 1})
    assert caught.value.filename == "/dev/full"


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), (b"garbage", "not a .npz file"), (b"", "not a .npz file")],
)
def test_damaged_arrays_are_refused(content: bytes | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=f"cannot read the states: {words}"):
        load_arrays(str(path), ("a",), "states", "")


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    write_npz(tmp_path / "x.npz", {"a": np.zeros(2)})
    with pytest.raises(InputError, match=r"x\.npz: b is missing; write it$"):
        load_arrays(str(tmp_path / "x.npz"), ("a", "b"), "states", "; write it")

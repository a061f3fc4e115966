"""Whatever is wrong with the cache or the compiler, there is a library and one line, or one line and none."""

import getpass
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from kernels import build
from kernels.build import NoCompilerError
from kernels.compiled import Compiled

SOURCE = {"one": "int three(void) { return 3; }", "other": "int four(void) { return 4; }"}
# what another process runs: only this module, which needs no PyTorch
ELSEWHERE = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("build", {build.__file__!r})
build = importlib.util.module_from_spec(spec)
spec.loader.exec_module(build)
print(build.library({SOURCE!r}).three())
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Sets a cache of its own, and a temporary directory in which no file may be left."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv(build.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.delenv("CC", raising=False)
    build.say.cache_clear()
    yield tmp_path / "cache"
    left = [path.name for path in (tmp_path / "tmp").iterdir()]
    assert left in ([], [f"torchinductor_{getpass.getuser()}"])  # which PyTorch makes when it is first used


def files(cache: Path) -> list[Path]:
    return sorted(cache.iterdir()) if cache.is_dir() else []


def works() -> bool:
    found = build.library(SOURCE)
    return (found.three(), found.four()) == (3, 4)


def lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    out, err = capsys.readouterr()
    assert not out
    return err.splitlines()


def unbuildable(*_: object) -> None:
    raise AssertionError("it was to be taken from the cache")


def test_a_library_is_built_once(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert works()
    (path,) = files(cache)
    assert re.fullmatch(r"[0-9a-f]{32}\.[0-9a-f]{16}\.so", path.name)
    monkeypatch.setattr(build, "built", unbuildable)
    assert works() and not lines(capsys)


@pytest.mark.parametrize(
    "damage",
    [lambda whole: whole[: len(whole) // 2], lambda whole: b"", lambda whole: os.urandom(len(whole))],
    ids=["truncated", "empty", "garbage"],
)
def test_a_damaged_library_is_built_anew(
    damage: Callable[[bytes], bytes], cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert works()
    (path,) = files(cache)
    whole = path.read_bytes()
    path.unlink()  # it is in use
    path.write_bytes(damage(whole))
    assert works()
    (line,) = lines(capsys)
    assert "damaged, compiled anew" in line and str(path) in line
    assert works() and not lines(capsys) and len(files(cache)) == 1


@pytest.mark.parametrize("kind", ["a file", "below a file", "not writable"])
def test_a_cache_that_cannot_be_written_is_done_without(
    kind: str, cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.write_text("")
    where = {"a file": cache, "below a file": cache / "below", "not writable": Path("/proc/nowhere")}[kind]
    monkeypatch.setenv(build.VARIABLE, str(where))
    assert works() and works()
    (line,) = lines(capsys)
    assert line.startswith(f"{where}: ") and line.endswith("; what is compiled is not kept")


# processes


def elsewhere(**environment: str) -> subprocess.Popen[str]:
    """Starts another process that builds the same library."""
    return subprocess.Popen(
        [sys.executable, "-c", ELSEWHERE],
        env=os.environ | {"TMPDIR": str(tempfile.tempdir)} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_processes_may_build_the_same_at_once(cache: Path) -> None:
    processes = [elsewhere() for _ in range(4)]
    assert [process.communicate(timeout=60) for process in processes] == [("3\n", "")] * 4
    assert len(files(cache)) == 1


# the compiler


def script(path: Path, text: str) -> Path:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize(
    ("compiler", "words"),
    [
        ("nonexistent", r"\$CC is nonexistent: there is no such compiler"),
        ("nonexistent -O3", r"\$CC is nonexistent -O3: there is no such compiler"),
        ('"', r"\$CC is \": there is no such compiler"),
        ("/bin/false", r"/bin/false failed \(1\)"),
        ("{tmp}/text", r"text"),
        ("{tmp}/broken", r"broken failed \(3\): broken: internal error"),
    ],
)
def test_a_compiler_that_does_not_work_is_named_in_one_line(
    compiler: str, words: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "text").write_bytes(b"\x7fELF")
    (tmp_path / "text").chmod(0o755)
    script(
        tmp_path / "broken", "[ $1 = --version ] && exit 0; echo one; echo broken: internal error >&2; exit 3"
    )
    monkeypatch.setenv("CC", compiler.format(tmp=tmp_path))
    with pytest.raises(NoCompilerError, match=words) as error:
        build.library(SOURCE)
    assert "\n" not in str(error.value) and error.value.strerror == str(error.value)
    assert not files(cache)


def test_without_any_compiler_those_that_were_looked_for_are_named(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NoCompilerError, match=r"no C compiler was found \(clang, gcc, cc\)"):
        build.library(SOURCE)


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_product_is_fused_with_a_sum_and_a_root_is_one_instruction(
    compiler: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for tool in (compiler, "objdump"):
        if not shutil.which(tool):
            pytest.skip(f"{tool} is not installed")
    monkeypatch.setenv("CC", compiler)
    x = torch.ones(3, 1, dtype=torch.float64)
    Compiled(lambda x: [(x[0] * x[1] + x[2] - x[1] * x[2]).sqrt()], x)
    (path,) = files(cache)
    text = subprocess.run(["objdump", "-d", str(path)], capture_output=True, text=True, check=True).stdout
    body = text[text.index("<run_batch>:") :].split("\n\n")[0]
    assert "mul" in body and "sqrt" in body
    assert not re.search(r"fn?m(add|sub|la|ls)|call.*sqrt", body)

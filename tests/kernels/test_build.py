"""Whatever is wrong with the cache or the compiler, there is a library and one line, or one line and none."""

import errno
import getpass
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
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
    """A cache of its own, and a temporary directory that nothing may be left in."""
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


def test_a_foreign_library_is_not_taken(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Under the name of this one, with a digest that is right, but nothing that can be loaded."""
    assert works()
    (path,) = files(cache)
    text = cache / "text"
    text.write_text("a list of things to buy")
    foreign = text.rename(cache / f"{path.name.split('.')[0]}.{build.digest(text)}.so")
    path.unlink()
    assert works()
    (line,) = lines(capsys)
    assert str(foreign) in line and "compiled anew" in line
    assert files(cache) == [path]


def test_a_directory_of_that_name_is_left(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert works()
    (path,) = files(cache)
    path.unlink()
    foreign = cache / f"{path.name.split('.')[0]}.0.so"
    foreign.mkdir()
    assert works()
    (line,) = lines(capsys)
    assert str(foreign) in line and files(cache) == [foreign, path]


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_cache_is_done_without(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build.os, "replace", full)
    assert works() and works()
    (line,) = lines(capsys)
    assert line == f"{cache}: No space left on device; what is compiled is not kept"
    assert not files(cache)


def test_a_cache_that_fills_up_while_compiling_is_done_without(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    compile_ = build.output

    def output(command: list[str], work: Path | None = None) -> str:
        if work and work.is_relative_to(cache):
            raise NoCompilerError("cc failed (1): error: one.o: No space left on device")
        return compile_(command, work)

    monkeypatch.setattr(build, "output", output)
    assert works()
    (line,) = lines(capsys)
    assert "No space left on device; what is compiled is not kept" in line


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


def test_a_directory_that_may_only_be_read_is_read(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert works()
    for module, name in ((os, "mkdir"), (os, "replace"), (os, "unlink")):
        monkeypatch.setattr(module, name, full)
    assert works() and not lines(capsys)


def test_without_a_home_nothing_is_kept(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in (build.VARIABLE, "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", home)
    assert works() and works()
    (line,) = lines(capsys)
    assert "no home directory" in line and build.VARIABLE in line


def test_the_cache_is_the_users_unless_another_is_chosen(
    cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert build.cache_dir() == cache
    monkeypatch.delenv(build.VARIABLE)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert build.cache_dir() == tmp_path / ".cache" / "rta-inspection"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert build.cache_dir() == tmp_path / "own" / "rta-inspection"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the standard has it ignored
    assert build.cache_dir() is None


# processes


def elsewhere(**environment: str) -> subprocess.Popen[str]:
    """Another process that builds the same library."""
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


def test_what_is_left_by_a_process_that_was_killed_is_cleared_away(
    cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slow = script(
        tmp_path / "slow", f"[ $1 = --version ] || {{ touch {tmp_path}/begun; sleep 60; }}; exec cc $@"
    )
    process = elsewhere(CC=str(slow))
    for _ in range(600):
        if (tmp_path / "begun").exists():
            break
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    (left,) = files(cache)
    assert left.name.startswith(build.WORK)
    assert works() and left.exists()  # it may be another's that is at work
    os.utime(left, (0.0, 0.0))
    for path in cache.glob("*.so"):
        path.unlink()
    assert works() and not left.exists() and not lines(capsys)


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


@pytest.mark.parametrize("compiler", ["cc -O1", "{tmp}/wrapper cc -DX=1", "{tmp}/a wrapper"])
def test_a_compiler_may_have_arguments(
    compiler: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script(tmp_path / "wrapper", f'touch {tmp_path}/called; exec "$@"')
    script(tmp_path / "a wrapper", 'exec cc "$@"')
    monkeypatch.setenv("CC", compiler.format(tmp=tmp_path))
    assert works() and len(files(cache)) == 1
    assert (tmp_path / "called").exists() == ("/wrapper" in compiler)


def test_a_compiler_that_does_not_know_the_processor_compiles_for_any(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = 'case "$*" in *=native*) echo "error: bad value for -march=" >&2; exit 1;; esac; exec cc "$@"'
    monkeypatch.setenv("CC", str(script(tmp_path / "old", refusal)))
    assert works()


def test_what_cannot_be_loaded_is_no_library(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in directories that nothing may be executed in."""

    def cannot(_: str) -> None:
        raise OSError("failed to map segment from shared object")

    monkeypatch.setattr(build.ctypes, "CDLL", cannot)
    with pytest.raises(NoCompilerError, match="cannot be loaded: failed to map segment"):
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

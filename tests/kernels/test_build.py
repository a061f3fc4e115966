"""Whatever is wrong with the cache or the compiler, there is a library and one line, or one line and none."""

import os
import re
import shutil
import subprocess
import sys
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
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a cache of its own."""
    monkeypatch.setenv(build.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.delenv("CC", raising=False)
    build.say.cache_clear()
    return tmp_path / "cache"


def works() -> bool:
    found = build.library(SOURCE)
    return (found.three(), found.four()) == (3, 4)


def test_a_library_is_built_once_and_a_damaged_one_anew(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert works()
    (path,) = cache.iterdir()
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], b"", os.urandom(len(whole))):
        path.unlink()  # it is in use
        path.write_bytes(damaged)
        assert works()
        assert capsys.readouterr().err == f"{path}: damaged, made anew\n"
        build.say.cache_clear()
        (path,) = cache.iterdir()
    monkeypatch.setattr(build, "built", None)  # cannot be called
    assert works() and not capsys.readouterr().err


@pytest.mark.parametrize("name", ["file", "file/below", "/proc/nowhere"])
def test_a_cache_that_cannot_be_written_is_done_without(
    name: str,
    cache: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(build.VARIABLE, str(tmp_path / name))
    assert works() and works()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{tmp_path / name}: ") and line.endswith("; what is compiled is not kept")


def test_processes_may_build_the_same_at_once(cache: Path) -> None:
    command = [sys.executable, "-c", ELSEWHERE]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    processes = [subprocess.Popen(command, text=True, **pipes) for _ in range(4)]
    assert [process.communicate(timeout=60) for process in processes] == [("3\n", "")] * 4
    assert len(list(cache.iterdir())) == 1


BROKEN = "#!/bin/sh\n[ $1 = --version ] && exit 0; echo one; echo broken: internal error >&2; exit 3\n"


@pytest.mark.parametrize(
    ("compiler", "words"),
    [
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
    for name, text in (("text", b"\x7fELF"), ("broken", BROKEN.encode())):
        (tmp_path / name).write_bytes(text)
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("CC", compiler.format(tmp=tmp_path))
    with pytest.raises(NoCompilerError, match=words) as error:
        build.library(SOURCE)
    assert "\n" not in str(error.value) and error.value.strerror == str(error.value)
    assert not cache.exists() or not list(cache.iterdir())


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
    (path,) = cache.iterdir()
    text = subprocess.run(["objdump", "-d", str(path)], capture_output=True, text=True, check=True).stdout
    body = text[text.index("<run_batch>:") :].split("\n\n")[0]
    assert "mul" in body and "sqrt" in body
    assert not re.search(r"fn?m(add|sub|la|ls)|call.*sqrt", body)

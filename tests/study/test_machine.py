"""Threads, locks and what takes long: what a person wants, what a run was begun with, else the default."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from kernels import compiled
from settings import InputError
from study import machine
from study.machine import directory_lock, set_threads


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Undoes what a test sets; two threads, of which OMP_NUM_THREADS says nothing, on a machine with three."""
    before = torch.get_num_threads()
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(machine, "processors", lambda: 3)
    monkeypatch.setattr(compiled, "most_threads", None)
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("wanted", "recorded", "number", "of_printed"),
    [(1, 2, 1, None), (2, None, 2, None), (None, 2, 2, 3), (None, 1, 1, 3), (None, None, 1, 3)],
)
def test_a_person_comes_before_the_record_and_that_before_the_default(
    wanted: int | None, recorded: int | None, number: int, of_printed: int | None, two_threads: None
) -> None:
    set_threads(wanted, recorded)
    assert torch.get_num_threads() == number and compiled.most_threads == of_printed


def test_the_environment_decides_before_the_default_and_the_load_never(
    two_threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.perf_counter", lambda: pytest.fail("measured"))
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    set_threads(None)
    assert torch.get_num_threads() == 2 and compiled.most_threads is None


def test_a_directory_is_one_process_s_at_a_time(tmp_path: Path) -> None:
    theirs = FileLock(tmp_path / machine.LOCK)
    theirs.acquire()
    with pytest.raises(InputError, match="another process"), directory_lock(tmp_path, "--run-dir"):
        pass
    theirs.release()
    with directory_lock(tmp_path, "--run-dir"):
        pass
    with pytest.raises(InputError, match="No such file"), directory_lock(tmp_path / "nowhere", "--run-dir"):
        pass


@pytest.fixture(params=sorted(machine.WITHOUT_LOCKS))
def without_locks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Simulates a file system without locks, such as NFS or Lustre; returns its error."""

    def refuse(*_: object) -> None:
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(fcntl, "lockf", refuse)
    return request.param


def test_a_directory_without_locks_is_one_process_s_at_a_time(without_locks: int, tmp_path: Path) -> None:
    with directory_lock(tmp_path, "--run-dir"):
        with (
            pytest.raises(InputError, match=r"another process; if none is, delete .*\.lock\.held$"),
            directory_lock(tmp_path, "--run-dir"),
        ):
            pass
        assert set(os.listdir(tmp_path)) <= set(machine.LOCKS)
    with directory_lock(tmp_path, "--run-dir"):
        pass
    assert not (tmp_path / machine.HELD).exists()


def test_what_a_dead_process_held_is_taken_over_and_of_another_machine_only_by_hand(
    without_locks: int, tmp_path: Path
) -> None:
    code = (
        "import os, sys, signal\n"
        "from filelock import SoftFileLock\n"
        "lock = SoftFileLock(sys.argv[1], timeout=0)\n"
        "lock.acquire()\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    held = tmp_path / machine.HELD
    assert subprocess.run([sys.executable, "-c", code, str(held)]).returncode == -signal.SIGKILL
    assert held.exists()
    with directory_lock(tmp_path, "--resume"):
        pass
    held.write_text("1\nanother-machine\n")
    with pytest.raises(InputError, match=r"delete .*\.lock\.held$"), directory_lock(tmp_path, "--resume"):
        pass
    held.unlink()
    with directory_lock(tmp_path, "--resume"):
        pass


def test_a_lock_that_cannot_be_made_names_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError) as error, directory_lock(tmp_path, "--run-dir"):
        pass
    assert error.value.filename == str(tmp_path / machine.LOCK)

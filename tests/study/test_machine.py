"""Threads, locks and what takes long: what a person wants, what a run was begun with, else the default."""

import os
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
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2}, raising=False)
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

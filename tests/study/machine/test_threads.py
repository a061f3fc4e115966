"""The number of threads: what a person wants, what a run was begun with, else one, whatever the load."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from kernels import compiled
from settings import InputError
from study.machine.provenance import recorded_threads
from study.machine.threads import Threads


@pytest.fixture(autouse=True)
def afterwards(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
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
    wanted: int | None, recorded: int | None, number: int, of_printed: int | None
) -> None:
    own = Threads()
    own.ask(wanted)
    own.recorded = recorded
    own.settle()
    assert torch.get_num_threads() == number and compiled.most_threads == of_printed
    torch.set_num_threads(2)
    own.settle()  # once is enough
    assert torch.get_num_threads() == 2


def test_nothing_changes_where_the_environment_decides_or_nobody_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Threads().settle()
    assert torch.get_num_threads() == 2 and compiled.most_threads is None
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    own = Threads()
    own.ask(None)
    own.settle()
    assert torch.get_num_threads() == 2 and compiled.most_threads is None


def test_the_load_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """No clock is asked, by which a measurement could choose."""
    monkeypatch.setattr("time.perf_counter", lambda: pytest.fail("measured"))
    own = Threads()
    own.ask(None)
    own.settle()
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize(("processors", "wanted"), [(2, 3), (2, 100_000), (None, 2), (64, 20_000)])
def test_more_threads_than_processors_are_refused(
    processors: int | None, wanted: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: processors)
    own = Threads()
    with pytest.raises(
        InputError, match=f"--threads {wanted}: must be at most {processors or 1}, .*processors"
    ):
        own.ask(wanted)
    own.settle()
    assert torch.get_num_threads() == 2  # nothing was asked for
    own.ask(processors or 1)


@pytest.mark.parametrize(("written", "read"), [(8, 8), (100_000, None), (0, None), (True, None), ("2", None)])
def test_a_record_of_impossible_threads_is_none(written: object, read: int | None, tmp_path: Path) -> None:
    (tmp_path / "provenance.json").write_text(json.dumps({"threads": written}))
    assert recorded_threads(tmp_path) == read

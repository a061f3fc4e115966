"""The number of threads: what a person wants, what a run was begun with, else what is fastest."""

import json
from pathlib import Path

import pytest
import torch

from study.errors import InputError
from study.machine import threads
from study.machine.provenance import recorded_threads
from study.machine.threads import Threads, fastest, measured, said


@pytest.fixture(autouse=True)
def afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undoes what a test sets; two threads, of which OMP_NUM_THREADS says nothing."""
    before = torch.get_num_threads()
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("times", "number"),
    [({1: 1.0, 2: 0.5}, 2), ({1: 1.0, 2: 0.95}, 1), ({1: 1.0, 2: 14.0}, 1), ({1: 1.0, 2: 0.6, 4: 0.59}, 2)],
)
def test_more_threads_are_taken_only_where_they_pay(times: dict[int, float], number: int) -> None:
    assert fastest(times) == number
    assert said(times).startswith(f"threads: {number} of {max(times)}, ")


@pytest.mark.parametrize(("wanted", "recorded", "number"), [(1, 2, 1), (None, 1, 1), (None, None, 2)])
def test_a_person_comes_before_the_record_and_that_before_a_measurement(
    wanted: int | None,
    recorded: int | None,
    number: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(threads, "measured", lambda most: {1: 1.0, most: 0.5})
    own = Threads()
    own.ask(wanted)
    own.recorded = recorded
    own.settle()
    assert torch.get_num_threads() == number
    assert ("measurement" in capsys.readouterr().err) == (wanted is None and recorded is None)
    torch.set_num_threads(2)
    own.settle()  # once is enough
    assert torch.get_num_threads() == 2 and not capsys.readouterr().err


def test_nothing_is_measured_where_the_environment_decides_or_nobody_asked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(threads, "measured", lambda most: pytest.fail("measured"))
    Threads().settle()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    own = Threads()
    own.ask(None)
    own.settle()


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


def test_each_number_of_threads_is_measured() -> None:
    times = measured(2)
    assert set(times) == {1, 2} and min(times.values()) > 0.0

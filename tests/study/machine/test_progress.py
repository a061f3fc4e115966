"""What takes long says so, and what does not is silent."""

import os
import re
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from study.machine import progress

LINE = r"ours: \d of 4 cases \(\d+ %\)(, [\d.]+/s, 0:00:\d\d left)?, so far well\n"


def heard(capsys: pytest.CaptureFixture[str], least: int) -> str:
    """What is said within a minute, once it has so many lines."""
    said, deadline = "", time.monotonic() + 60.0
    while said.count("\n") < least and time.monotonic() < deadline:
        time.sleep(0.01)
        said += capsys.readouterr().err
    return said


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], str]]:
    """Makes stderr a terminal, which says that it has 0 columns; what reads there, within a minute."""
    ours, theirs = os.openpty()

    def read() -> str:
        assert select.select([ours], [], [], 60.0)[0], "nothing is shown"
        return os.read(ours, 10_000).decode()

    with open(theirs, "w", encoding="utf-8") as shown:
        monkeypatch.setattr(sys, "stderr", shown)
        yield read
    os.close(ours)


def test_a_long_step_says_what_it_does_and_how_long_it_took(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    with progress.step("compiling, about a minute"):
        said = heard(capsys, 1)
    assert said == "compiling, about a minute ...\n"
    assert re.fullmatch(r"compiling, about a minute \.\.\. \d+ s\n", capsys.readouterr().err)


def test_on_a_terminal_a_long_step_has_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    with terminal(monkeypatch) as read:
        with progress.step("compiling"):
            said = read()
            assert said == "compiling ..."
        while "\n" not in said:
            said += read()
    assert re.fullmatch(r"compiling \.\.\. \d+ s\r\n", said)


def test_a_short_step_is_silent_even_where_it_fails(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError), progress.step("compiling"):
        raise ValueError
    assert capsys.readouterr().err == ""


def test_a_terminal_without_a_size_shows_bars_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    with terminal(monkeypatch) as read:
        with progress.bar(2, "episodes") as episodes:
            episodes.update(2)
        said = ""
        while "2/2" not in said:
            said += read()


def test_a_log_has_plain_lines_also_while_nothing_moves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.02)
    monkeypatch.setattr(progress, "INTERVAL", 0.02)
    with progress.bar(4, "cases", initial=1, desc="ours", bar_format="{bar}") as shown:
        shown.set_postfix_str("so far well", refresh=False)
        shown.update(2)
        said = heard(capsys, 3)
    said += capsys.readouterr().err
    assert re.fullmatch(f"({LINE})+", said)
    assert said.splitlines()[-1].startswith("ours: 3 of 4 cases (75 %), ")
    time.sleep(0.1)
    assert capsys.readouterr().err == ""  # once it is closed


def test_of_two_bars_in_a_log_the_inner_one_speaks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.01)
    monkeypatch.setattr(progress, "INTERVAL", 0.01)
    with progress.bar(4, "outer"), progress.bar(4, "inner", leave=False):
        said = heard(capsys, 4).splitlines()
    assert sum("outer" in line for line in said) <= 1  # before there was an inner one
    assert sum("inner" in line for line in said) >= 3
    with progress.bar(4, "outer"):
        assert "outer" in heard(capsys, 1)


def test_the_rate_of_a_run_that_goes_on_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    with progress.bar(507_904, "interactions", initial=4_684) as shown:
        now += 10.0
        assert str(shown) == "4,684 of 507,904 interactions (1 %)"
        shown.update(11_700)
        shown.set_postfix_str("learning from the guidance", refresh=False)
        # (507,904 - 16,384) / 1,170 = 420.1 s
        assert str(shown) == (
            "16,384 of 507,904 interactions (3 %), 1,170/s, 0:07:00 left, learning from the guidance"
        )


def test_short_work_is_silent_and_items_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    shown = progress.bar(3, "items", iterable="abc")
    assert [(each, shown.n) for each in shown] == [("a", 0), ("b", 1), ("c", 2)]
    assert shown.n == 3 and not shown.teller.is_alive()
    assert capsys.readouterr().err == ""


def test_of_many_ranks_the_first_one_speaks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    monkeypatch.setenv("RANK", "1")
    with progress.bar(3, "items"), progress.step("compiling"):
        time.sleep(0.1)
    assert capsys.readouterr().err == ""

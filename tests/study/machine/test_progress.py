"""What takes long says so, and what does not is silent."""

import os
import re
import sys
import time

import pytest

from study.machine import progress


def test_a_long_step_says_what_it_does_and_how_long_it_took(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    said, waited = "", 0.0
    with progress.step("compiling, about a minute"):
        while not said and (waited := waited + 0.01) < 60.0:
            time.sleep(0.01)
            said = capsys.readouterr().err
    assert said == "compiling, about a minute ..."
    assert re.fullmatch(r" \d+ s\n", capsys.readouterr().err)


def test_a_short_step_is_silent_even_where_it_fails(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError), progress.step("compiling"):
        raise ValueError
    assert capsys.readouterr().err == ""


def test_a_terminal_without_a_size_shows_bars_too(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = os.openpty()  # says 0 columns
    with open(theirs, "w", encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        monkeypatch.setattr(progress, "PATIENCE", 0.0)
        with progress.bar(2, "episodes") as shown:
            shown.update(2)
        terminal.flush()
        assert "2/2" in os.read(ours, 10_000).decode()
    os.close(ours)

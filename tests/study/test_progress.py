"""What takes long says so, and what does not is silent."""

import re
import time

import pytest

from study import progress


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

"""The commands that are printed for a person to paste."""

import os
import shlex
from pathlib import Path

import pytest

import main
from study.commands import after_evaluation


def test_an_evaluation_is_watched_by_the_commands_that_it_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an empty directory, at whose top they leave nothing; the one for runs is made if it is not there."""
    results = {
        "config": {"inspection": {"substep": 1.0, "action_period": 10.0}},
        "rta": {"period_s": 1.0},
        "seed": 7,
    }
    monkeypatch.chdir(tmp_path)
    said = after_evaluation(results, None, "zero", ["--no-rta"]).removeprefix("Watch one: ")
    make, fly, show = (shlex.split(each) for each in said.split(" && "))
    assert make[0] == "mkdir"
    os.mkdir(make[1])
    assert main.main(["60" if word == "3600" else word for word in fly[2:]]) == 0
    assert main.main(show[2:]) == 0
    assert [each.name for each in tmp_path.iterdir()] == ["runs"]
    assert {each.suffix for each in (tmp_path / "runs").iterdir()} == {".npz", ".html"}
    assert "mkdir" not in after_evaluation(results, None, "zero", [])

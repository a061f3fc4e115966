"""Files of another shape than a command expects: each ends in one line that names the file, and exit code 2."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from inspection.chief import mesh
from inspection.model.parameters import InspectionParameters
from ppo.errors import CheckpointError
from settings import InputError
from study.config import Config
from study.experiment import load_policy
from study.files import read_json, read_json_lines
from study.flight.state_files import read_actions, read_states
from study.verification import findings
from study.verification.counter_examples import refly_file
from study.verification.findings import Campaign, empty_report, report_in
from study.web import replay
from study.web.replay import ROWS
from tests.test_main import assert_refused, run, write_inputs

__all__ = ["run"]  # a fixture

# Calls that read F.json before they do anything that takes long.
READERS = (
    "evaluate --controller zero --episodes 1 --no-rta --json F.json",
    "verify --policy random --episodes 1 --duration 1 --compile off --json F.json",
    "break-points --episodes 1 --duration 1 --json F.json",
    "benchmark --json F.json",
    "simulate --controller zero --no-rta --duration 10 --out x.npz --initial-state F.json",
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns an own working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("words", READERS, ids=lambda words: words.split()[0])
def test_json_of_another_shape_is_refused(words: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("3", '"metrics, campaign, position"', "[" * 100_000):
        Path("F.json").write_text(text)
        assert_refused(words.split(), ["F.json"], capsys)
        assert Path("F.json").read_text() == text


def test_what_a_json_file_must_hold_is_said(here: Path) -> None:
    for text, said in (
        ("3", "must hold a JSON object, not a number"),
        ("-3", "not a number"),
        ("[]", "not a list"),
        ("null", "not null"),
        ("1" * 5000, "the limit (4300 digits)"),
        ("[" * 100_000, "recursion"),
        ("1e999", "not a number"),
        ('"metrics"', "not a text"),
        ('{"metrics": ', "Expecting value"),
        ("\udce9", "can't decode"),
    ):
        Path("F.json").write_text(text, errors="surrogateescape")
        for read in (read_json, read_json_lines):
            with pytest.raises(InputError) as refused:
                read("F.json", "report")
            assert str(refused.value).startswith("F.json: cannot read the report: ") and said in str(
                refused.value
            )
            assert "sys." not in str(refused.value)
    with pytest.raises(InputError, match=r"no\.json: cannot read the report: No such file"):
        read_json("no.json", "report")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"episodes": -5}, "episodes: must be a count, not a negative integer"),
        ({"violating_steps": []}, "violating_steps: must be an object, not a list"),
        ({"violating_steps": {}}, "is missing"),
        ({"upper_bound_95": None}, "upper_bound_95: must be a number, not null"),
    ],
)
def test_a_report_is_checked_to_its_depth_before_it_is_continued(
    change: dict[str, Any], said: str, here: Path
) -> None:
    campaign, config = Campaign("random", 1.0, 1, 0, 8), Config()
    whole = empty_report(campaign, config)
    whole["worst_value"] = dict.fromkeys(whole["worst_value"], 0.5)
    path = here / "F.json"
    path.write_text(json.dumps(whole))
    assert report_in(path, campaign, config, findings.table)["worst_value"] == whole["worst_value"]
    path.write_text(json.dumps(whole | change))
    with pytest.raises(InputError) as refused:
        report_in(path, campaign, config, findings.table)
    assert said in str(refused.value) and "F.json" in str(refused.value)


EXAMPLE = (
    "state",
    "control_desired",
    "control_applied",
    "constraint",
    "value",
    "period",
    "check_every",
    "config",
)
ARRAYS = {
    "number": np.array(3.0),
    "text": np.array(["a"] * 16),
    "complex": np.zeros((20, 6), complex),
    "empty": np.zeros((0, 6)),
    "truth": np.zeros((20, 6), bool),
    "times": np.zeros((20, 6), "datetime64[s]"),
    "records": np.zeros(20, [("a", float)]),
    "objects": np.array([{}], object),
}


ARCHIVES = {  # what each file must hold at least, and what reads it
    "states.npz": (("state", "control_desired"), lambda path: read_states(path, InspectionParameters())),
    "run.npz": ((*ROWS, "inspected", "intervened", "parameters"), replay.read),
    "mesh.npz": (("triangles", "points", "normals", "areas"), mesh.read),
    "example.npz": (EXAMPLE, refly_file),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays_of_another_shape_are_refused(kind: str, here: Path) -> None:
    np.save("a.npy", ARRAYS[kind])
    with pytest.raises(InputError, match=r"^a\.npy: "):
        read_actions("a.npy", (1.0,) * 6, 1)
    for name, (keys, read) in ARCHIVES.items():
        np.savez(name, **dict.fromkeys(keys, ARRAYS[kind]))
        with pytest.raises(ValueError, match=re.escape(name)):
            read(name)
        Path(name).write_bytes(Path("a.npy").read_bytes())  # one array, not an archive
        with pytest.raises(ValueError, match=re.escape(name)):
            read(name)


def test_checkpoints_of_another_shape_are_refused(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = torch.load(write_inputs(here)["p.pt"], weights_only=True)
    names = list(whole["policy"])
    for content in (
        *(3, [1], None, "policy config"),
        *(whole | {"policy": weights} for weights in (3, [1], {"a": 3}, dict.fromkeys(names), {3: torch.zeros(1)})),
        *(whole | {"policy": dict.fromkeys(names, torch.tensor(1.0))},),
        *(whole | {"config": config} for config in (3, [1], None, "x = " + "1" * 5000)),
    ):  # fmt: skip
        torch.save(content, "b.pt")
        with pytest.raises((CheckpointError, InputError), match=r"^b\.pt: "):
            load_policy("b.pt")
    for words in (
        "evaluate --checkpoint b.pt --no-rta --episodes 1",
        "train --init-from b.pt --run-dir q --no-rta --compile off",
        "verify --policy checkpoint:b.pt --episodes 1 --duration 1",
    ):
        assert_refused(words.split(), ["b.pt"], capsys)


def test_a_run_with_evaluations_of_another_shape_is_not_resumed(
    run: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = here / "run"
    copy.mkdir()
    for path in run.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    for text in ("3\n", '{"interactions": "a"}\n', "{}\n", "[" * 100_000 + "\n"):
        (copy / "evaluations.jsonl").write_text(text)
        words = ["train", "--resume", str(copy), "--interactions", "1_000_000"]
        assert_refused(words, ["evaluations.jsonl"], capsys)

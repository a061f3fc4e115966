"""The programs behind pages of results: what they write is what is shipped, in form and where that is cheap."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments import guidance, learn_from
from inspection.orbits import GUIDANCE
from study.config import TEST_CASES
from study.files import ROOT


def shipped(name: str) -> Any:
    return json.loads((ROOT / "runs/reference" / name).read_text(encoding="utf-8"))


@pytest.mark.campaign
def test_the_guidance_flies_cases_of_its_own_in_every_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guidance, "GUIDANCE", {"quick": GUIDANCE["quick"]})
    guidance.main(["--out", str(tmp_path), "--cases", "2"])
    found, reference = json.loads((tmp_path / "guidance.json").read_text()), shipped("guidance/guidance.json")
    assert found["seed"] == reference["seed"] != TEST_CASES
    assert list(reference["guidance"]) == list(GUIDANCE) and reference["cases"] == 1000
    for way, results in found["guidance"]["quick"].items():
        assert list(results) == list(reference["guidance"]["quick"][way])
        assert results["outcomes"]["clean_success"] == 1.0


def test_a_seed_has_learned_from_where_on_enough_cases_succeed() -> None:
    for found in shipped("learn_from/results.json").values():
        assert learn_from.learned_at(found["curves"]) == found["learned_at"]
    curve = {
        "interactions": [1, 2, 3],
        "success": [[100.0, 99.0, 0.0], [98.0, 99.0, 0.0], [99.0, 99.0, 98.0]],
    }
    assert learn_from.learned_at(curve) == [3, 1, None]


def test_curves_have_a_row_for_a_time_and_a_column_for_a_seed() -> None:
    path = ROOT / "runs/reference/study/rta/evaluations.jsonl"
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    found = learn_from.curves(path)
    assert len(found["reward"]) == len(found["interactions"]) == 4
    for time, row in zip(found["interactions"], found["reward"], strict=True):
        then = [line["metrics"]["reward"]["mean"] for line in lines if line["interactions"] == time]
        assert row == then and len(row) == 10

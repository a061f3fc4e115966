"""The program behind the page on the guidance: what it writes is what is shipped, in form and where that is cheap."""

import json
from pathlib import Path
from typing import Any

import pytest

from experiments import guidance
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

"""The README's results are those of the study's files."""

import json
from pathlib import Path
from typing import Any

import pytest

import main
from study.tables import PAPER_METRICS, PAPER_VIOLATIONS

ROOT = Path(main.__file__).parent
STUDY = ROOT / "runs/reference/study"
ARMS = json.loads((STUDY / "results.json").read_text(encoding="utf-8"))["arms"]
GUIDANCE = json.loads((STUDY / "report/guidance.json").read_text(encoding="utf-8"))


def row(label: str) -> list[str]:
    """The cells of the README's row that begins with the label."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith(f"| {label} |"))
    return [cell.strip() for cell in line.strip("|").split("|")[1:]]


def interval(results: dict[str, Any], metric: str, digits: int) -> str:
    values = results["metrics"][metric]
    low, high = values["ci95"]
    return f"{values['iqm']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@pytest.mark.parametrize("metric", PAPER_METRICS)
def test_table_2_is_the_studys(metric: str) -> None:
    label, digits, *published = PAPER_METRICS[metric]
    paper = [f"{iqm:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]" for iqm, low, high in published]
    no_rta, rta, guidance = (interval(each, metric, digits) for each in (*ARMS.values(), GUIDANCE))
    assert row(label) == [no_rta, paper[0], rta, paper[1], guidance]


@pytest.mark.parametrize("constraint", PAPER_VIOLATIONS)
def test_table_3_is_the_studys(constraint: str) -> None:
    label, *paper = PAPER_VIOLATIONS[constraint]
    ours = [f"{arm['violations_percent'][constraint]:.3f}" for arm in ARMS.values()]
    assert row(label) == [ours[0], f"{paper[0]:.3f}", ours[1], f"{paper[1]:.3f}"]

"""The results in the README and in docs are those of the study's files."""

import json
from pathlib import Path
from typing import Any

import pytest

import main
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS

ROOT = Path(main.__file__).parent
STUDY = ROOT / "runs/reference/study"
ARMS = json.loads((STUDY / "results.json").read_text(encoding="utf-8"))["arms"]
GUIDANCE, CROSS, FREQUENCY = (
    json.loads((STUDY / f"report/{name}.json").read_text(encoding="utf-8"))
    for name in ("guidance", "cross", "frequency")
)


def row(label: str, page: str = "README.md") -> list[str]:
    """The cells of the page's row that begins with the label."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    (line,) = (line for line in lines if line.startswith(f"| {label} |"))
    return [cell.strip() for cell in line.strip("|").split("|")[1:]]


def interval(results: dict[str, Any], metric: str, digits: int) -> str:
    values = results["metrics"][metric]
    return with_interval(values["iqm"], *values["ci95"], digits)


def with_interval(iqm: float, low: float, high: float, digits: int) -> str:
    return f"{iqm:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@pytest.mark.parametrize("metric", PAPER_METRICS)
def test_table_2_is_the_studys(metric: str) -> None:
    published = PAPER_METRICS[metric]
    paper = [
        with_interval(each.value, *each.interval, published.digits) for each in published.by_arm.values()
    ]
    no_rta, rta, guidance = (interval(each, metric, published.digits) for each in (*ARMS.values(), GUIDANCE))
    assert row(published.label) == [no_rta, paper[0], rta, paper[1], guidance]


@pytest.mark.parametrize("constraint", PAPER_VIOLATIONS)
def test_table_3_is_the_studys(constraint: str) -> None:
    published = PAPER_VIOLATIONS[constraint]
    paper = [f"{published.by_arm[arm].value:.3f}" for arm in ARMS]
    ours = [f"{arm['violations_percent'][constraint]:.3f}" for arm in ARMS.values()]
    assert row(published.label) == [ours[0], paper[0], ours[1], paper[1]]


def test_success_and_violations_are_the_studys() -> None:
    columns = (*ARMS.values(), GUIDANCE)
    paper = [f"{each.value:.3f}" for each in PAPER_VIOLATIONS["any"].by_arm.values()]
    no_rta, rta, guidance = (success(each) for each in columns)
    assert row("Success (%)") == [no_rta, "", rta, "", guidance]
    no_rta, rta, guidance = (violation(each) for each in columns)
    assert row("Any violation (mean % of steps)") == [no_rta, paper[0], rta, paper[1], guidance]


def success(results: dict[str, Any]) -> str:
    return f"{100.0 * results['outcomes']['success']:.1f}"


def violation(results: dict[str, Any]) -> str:
    return f"{results['violations_percent']['any']:.3f}"


def corrected(results: dict[str, Any]) -> str:
    return f"{results['rta']['intervention_percent']:.1f}" if results["rta"]["period_s"] else "-"


@pytest.mark.parametrize("arm", ["no_rta", "rta"])
@pytest.mark.parametrize("switch", ["off", "on"])
def test_the_cross_evaluation_is_the_studys(arm: str, switch: str) -> None:
    results = CROSS[arm][switch]
    words = {"no_rta": "without RTA", "rta": "with RTA", "off": "without", "on": "with"}
    assert row(f"{words[arm]} | {words[switch]}", "docs/results/results.md")[1:] == [
        violation(results),
        corrected(results),
        success(results),
        interval(results, "reward", 4),
        interval(results, "delta_v_m_s", 3),
        interval(results, "episode_length_s", 1),
    ]


@pytest.mark.parametrize("period", FREQUENCY)
def test_the_filters_periods_are_the_studys(period: str) -> None:
    results = FREQUENCY[period]
    lines = (ROOT / "docs/results/safety.md").read_text(encoding="utf-8").splitlines()
    cells = [
        period,
        violation(results),
        corrected(results),
        interval(results, "delta_v_m_s", 3),
        interval(results, "torque_n_m", 4),
        interval(results, "reward", 4),
    ]
    assert f"| {' | '.join(cells)} |" in lines

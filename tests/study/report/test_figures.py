"""The report's figures draw what the files hold."""

import csv
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from study.paper import PAPER_METRICS
from study.report import inputs as files
from study.report.figures import TRAINING, cross_figure, front_figure, save, training_panel
from study.report.inputs import Inputs


@pytest.fixture(scope="module")
def inputs(shipped_study: Path) -> Inputs:
    return files.read(shipped_study)


@pytest.mark.parametrize("metric", ["reward", "violation_percent"])
def test_training_curves(shipped_study: Path, inputs: Inputs, metric: str) -> None:
    ax = Figure().subplots()
    training_panel(ax, inputs.training[metric], metric, inputs.arms)
    with (shipped_study / "report/training.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["metric"] == metric]
    lines = {line.get_label(): line for line in ax.lines}
    for arm, label in (("no_rta", "no RTA"), ("rta", "RTA")):
        own = [row for row in rows if row["arm"] == arm]
        assert lines[label].get_xdata() == pytest.approx([float(row["interactions"]) / 1e6 for row in own])
        assert lines[label].get_ydata() == pytest.approx([float(row["iqm"]) for row in own])
        if metric == "violation_percent":  # the paper prints only its mean
            assert f"paper, {label}" not in lines
        else:
            assert set(lines[f"paper, {label}"].get_ydata()) == {PAPER_METRICS[metric].by_arm[arm].value}
    assert TRAINING.keys() == inputs.training.keys()


def test_equal_figures_are_equal_files(inputs: Inputs, tmp_path: Path) -> None:
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        save(cross_figure(inputs.cross), tmp_path / name / "cross")
    for name in ("cross.png", "cross.svg"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


def test_the_front_sets_agents_beside_the_guidance(inputs: Inputs) -> None:
    ax = front_figure(inputs).axes[0]
    drawn = {line.get_label(): list(zip(*line.get_data(), strict=True)) for line in ax.lines}
    metrics = inputs.arms["rta"]["metrics"]
    assert drawn["agents, RTA"] == [(metrics["episode_length_s"]["iqm"], metrics["delta_v_m_s"]["iqm"])]
    flown = [each["metrics"] for each in inputs.front.values()]
    expected = [(each["episode_length_s"]["iqm"], each["delta_v_m_s"]["iqm"]) for each in flown]
    assert drawn["classical guidance"] == expected
    assert [text.get_text() for text in ax.texts] == [*inputs.front]

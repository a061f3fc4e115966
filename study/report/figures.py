"""Figures of a study's report: training curves, one common episode of both arms, the cross evaluation."""

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from inspection.parameters import InspectionParameters
from study.errors import refusing
from study.files import writing
from study.flight.figures import (
    BLUE,
    GREEN,
    ORANGE,
    Episode,
    constraint_figure,
    effort,
    pointing,
    speeds,
    trajectory,
)
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Results, measured
from study.report.inputs import Curves, Inputs

ARM_LABELS = {"no_rta": "no RTA", "rta": "RTA"}
COLOURS = {"no_rta": BLUE, "rta": ORANGE}
MARKERS = {"no_rta": "o", "rta": "s"}
DPI = 120

# what the training curves show; the paper's IQM of the violation is not printed, its mean is
TRAINING = PAPER_METRICS | {
    "violation_percent": replace(PAPER_VIOLATIONS["any"], label="Violation (% of steps)")
}
# panels of the cross evaluation: axis and what is measured
CROSS = {
    "Any violation (% of steps)": "any",
    "Success (%)": "success",
    "Total reward": "reward",
    "Delta v (m/s)": "delta_v_m_s",
}


def draw(inputs: Inputs) -> None:
    """Draws every figure for which there is material into the report's directory.

    Raises:
        InputError: nothing can be written there.
    """
    with refusing(f"--study {inputs.study}: cannot write its report", OSError):
        if inputs.training:
            draw_training(inputs.training, inputs.directory)
        draw_episodes(inputs)
        save(cross_figure(inputs.cross), inputs.directory / "cross")


def draw_episodes(inputs: Inputs) -> None:
    """The common episode of the arms, and the demonstrations."""
    c, directory = inputs.config.inspection, inputs.directory
    top_speed = max(speeds(episode).max() for episode in inputs.episodes.values())
    for arm, episode in inputs.episodes.items():
        trajectory_figure(episode, c, top_speed, directory / f"trajectory_{arm}.png")
        constraint_figure(episode, c, directory / f"constraints_{arm}.png")
    save(behaviour_figure(inputs.episodes, c), directory / "behaviour")
    for arm, episode in inputs.demonstrations.items():
        constraint_figure(episode, c, directory / f"demonstration_{arm}.png")


def draw_training(curves: Curves, directory: Path) -> None:
    """The six training curves in one figure and each alone."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    for ax, metric in zip(figure.subplots(2, 3).flat, TRAINING, strict=True):
        training_panel(ax, curves[metric], metric)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    save(figure, directory / "training")
    for metric in TRAINING:
        figure = Figure(figsize=(4.4, 3.1), layout="constrained")
        ax = figure.subplots()
        training_panel(ax, curves[metric], metric)
        figure.legend(
            *ax.get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False, fontsize=8
        )
        save(figure, directory / f"training_{metric}")


def save(figure: Figure, stem: Path) -> None:
    """Writes a figure as PNG and as SVG; equal figures become equal files."""
    with writing(stem.with_suffix(".png")) as file:
        figure.savefig(file, dpi=DPI, format="png")
    with writing(stem.with_suffix(".svg")) as file, matplotlib.rc_context({"svg.hashsalt": stem.name}):
        figure.savefig(file, metadata={"Date": None}, format="svg")


def training_panel(ax: Axes, curves: dict[str, np.ndarray], metric: str) -> None:
    """By arm: IQM with its 95 % band over the interactions of each seed, and the paper's final values dotted."""
    paper = TRAINING[metric]
    for arm, rows in curves.items():
        interactions, iqm, low, high = rows[rows[:, 0].argsort()].T
        style = {"color": COLOURS[arm], "marker": MARKERS[arm], "ms": 3.5, "lw": 1.4}
        ax.plot(1e-6 * interactions, iqm, label=ARM_LABELS[arm], **style)
        ax.fill_between(1e-6 * interactions, low, high, color=COLOURS[arm], alpha=0.25, lw=0)
        ax.axhline(
            paper.by_arm[arm].value, color=COLOURS[arm], ls=":", lw=1.1, label=f"paper, {ARM_LABELS[arm]}"
        )
    ax.set(xlabel="interactions of a seed (millions)", ylabel=paper.label, xlim=(0, None))
    ax.grid(alpha=0.3)


def trajectory_figure(episode: Episode, c: InspectionParameters, top_speed: float, path: Path) -> None:
    """One episode's path around the chief as a PNG, coloured by speed up to `top_speed` in m/s."""
    figure = Figure(figsize=(6, 4.2), layout="constrained")
    trajectory(figure.add_subplot(projection="3d"), episode, c, top_speed)
    with writing(path) as file:
        figure.savefig(file, dpi=DPI, format="png")


def behaviour_figure(episodes: dict[str, Episode], c: InspectionParameters) -> Figure:
    """Inspected weight, pointing and what was spent over time, the arms together."""
    figure = Figure(figsize=(9, 5.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for arm, episode in episodes.items():
        delta_v, torque = effort(episode, c)
        for ax, values in zip(
            axes.flat, (episode["inspected_score"], pointing(episode), delta_v, torque), strict=True
        ):
            ax.plot(episode["time"], values, color=COLOURS[arm], lw=1.2, label=ARM_LABELS[arm])
            ax.plot(episode["time"][-1], values[-1], color=COLOURS[arm], marker=MARKERS[arm], ms=5)
    score, dot, delta_v, torque = axes.flat
    score.axhline(c.success_score, color=GREEN, ls="--", lw=1, label="success")
    score.set(ylabel="Inspected weight", ylim=(0, 1.02))
    score.legend(fontsize=9, frameon=False, loc="lower right")
    dot.set(ylabel="Boresight · chief direction", ylim=(-1.05, 1.05))
    delta_v.set(xlabel="time (s)", ylabel="Delta v used (m/s)", ylim=(0, None))
    torque.set(xlabel="time (s)", ylabel="Torque used (N m)", ylim=(0, None))
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        ax.set_xlim(0, None)
    figure.align_ylabels()
    return figure


def cross_figure(cross: dict[str, dict[str, Results]]) -> Figure:
    """Each arm's agents with the filter off (hollow) and on (filled): values with 95 % intervals."""
    figure = Figure(figsize=(11, 2.9), layout="constrained")
    for ax, (label, name) in zip(figure.subplots(1, len(CROSS)), CROSS.items(), strict=True):
        for place, (arm, evaluations) in enumerate(cross.items()):
            for shift, (switch, results) in zip((-0.15, 0.15), evaluations.items(), strict=True):
                number = measured(results, name)
                x, colour = place + shift, COLOURS[arm]
                ends = number.interval or (number.value, number.value)
                ax.plot([x, x], ends, color=colour, marker="_", ms=8, lw=1.4)
                face = colour if switch == "on" else "white"
                ax.plot(x, number.value, color=colour, marker=MARKERS[arm], mfc=face, ms=7)
        ax.set(xlabel="trained with", ylabel=label, xlim=(-0.5, len(cross) - 0.5))
        ax.set_xticks(range(len(cross)), [ARM_LABELS[arm] for arm in cross])
        ax.grid(axis="y", alpha=0.3)
        ax.margins(y=0.15)
    handles = [
        Line2D([], [], color="black", marker="o", ls="", mfc=face, label=f"flown with the filter {switch}")
        for switch, face in (("off", "white"), ("on", "black"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure

"""Figures of a study's report: training curves, one common episode of both arms, the cross evaluation."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from inspection.model.parameters import InspectionParameters
from study.errors import as_input_error
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
from study.report.inputs import Inputs

ARM_LABELS = {"no_rta": "no RTA", "rta": "RTA"}  # of the paper's arms; other arms are shown by their names
STYLES = {"no_rta": (BLUE, "o"), "rta": (ORANGE, "s")}
# for a study's own arms in their order: each list repeats, and since their lengths differ, 35 arms look different
MORE_COLOURS = ("#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#8A7A00")
MORE_MARKERS = ("^", "D", "v", "P", "X", "*", "h")
GUIDANCE_COLOUR = "0.35"
DPI = 120

# metrics of the training curves; the paper's number for violations is a mean, which is not comparable with our IQM
TRAINING = PAPER_METRICS | {
    "violation_percent": replace(PAPER_VIOLATIONS["any"], label="Violation (% of steps, IQM)", by_arm={})
}
# panels of the cross evaluation: axis and metric
CROSS = {
    "Any violation (% of steps)": "any",
    "Success (%)": "success",
    "Total reward": "reward",
    "Delta v (m/s)": "delta_v_m_s",
}


def label(arm: str) -> str:
    """Returns the label of an arm."""
    return ARM_LABELS.get(arm, arm)


def style(arm: str, arms: Iterable[str]) -> tuple[str, str]:
    """Returns colour and marker of an arm among all arms of a study."""
    if arm in STYLES:
        return STYLES[arm]
    place = [name for name in arms if name not in STYLES].index(arm)
    return MORE_COLOURS[place % len(MORE_COLOURS)], MORE_MARKERS[place % len(MORE_MARKERS)]


def draw(inputs: Inputs) -> None:
    """Draws every figure for which there are data into the report's directory.

    Raises:
        InputError: the directory cannot be written.
    """
    with as_input_error(f"--study {inputs.study}: cannot write its report", OSError):
        if inputs.training:
            save(training_figure(inputs), inputs.directory / "training")
        save(cross_figure(inputs.cross), inputs.directory / "cross")
        save(front_figure(inputs), inputs.directory / "front")
        save(progress_figure(inputs.progress), inputs.directory / "progress")
        draw_episodes(inputs)


def draw_episodes(inputs: Inputs) -> None:
    """Draws the common episode of the arms, and the demonstrations."""
    c, directory = inputs.config.inspection, inputs.directory
    top_speed = max((speeds(episode).max() for episode in inputs.episodes.values()), default=0.0)
    for arm, episode in inputs.episodes.items():
        figure = Figure(figsize=(6, 4.2), layout="constrained")
        trajectory(figure.add_subplot(projection="3d"), episode, c, top_speed)
        with writing(directory / f"trajectory_{arm}.png") as file:
            figure.savefig(file, dpi=DPI, format="png")
        constraint_figure(episode, c, directory / f"constraints_{arm}.png")
    if inputs.violation:
        constraint_figure(inputs.violation, c, directory / "constraints_violation.png")
    if inputs.episodes:
        save(behaviour_figure(inputs.episodes, c), directory / "behaviour")
    for arm, episode in inputs.demonstrations.items():
        constraint_figure(episode, c, directory / f"demonstration_{arm}.png")


def training_figure(inputs: Inputs) -> Figure:
    """Draws the six training curves."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    for ax, metric in zip(figure.subplots(2, 3).flat, TRAINING, strict=True):
        training_panel(ax, inputs.training[metric], metric, inputs.arms)
    labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside upper center", ncols=4, frameon=False)
    return figure


def save(figure: Figure, stem: Path) -> None:
    """Writes a figure as PNG and as SVG; equal figures give equal files."""
    with writing(stem.with_suffix(".png")) as file:
        figure.savefig(file, dpi=DPI, format="png")
    with writing(stem.with_suffix(".svg")) as file, rc_context({"svg.hashsalt": stem.name}):
        figure.savefig(file, metadata={"Date": None}, format="svg")


def training_panel(ax: Axes, curves: dict[str, np.ndarray], metric: str, arms: Iterable[str]) -> None:
    """Draws by arm the IQM with its 95 % band over the interactions of each seed, and the paper's value dotted."""
    paper = TRAINING[metric]
    for arm, rows in curves.items():
        interactions, iqm, low, high = rows[rows[:, 0].argsort()].T
        colour, marker = style(arm, arms)
        ax.plot(1e-6 * interactions, iqm, color=colour, marker=marker, ms=3.5, lw=1.4, label=label(arm))
        ax.fill_between(1e-6 * interactions, low, high, color=colour, alpha=0.25, lw=0)
        if arm in paper.by_arm:
            ax.axhline(paper.by_arm[arm].value, color=colour, ls=":", lw=1.1, label=f"paper, {label(arm)}")
    ax.set(xlabel="interactions of a seed (millions)", ylabel=paper.label, xlim=(0, None))
    ax.grid(alpha=0.3)


def behaviour_figure(episodes: dict[str, Episode], c: InspectionParameters) -> Figure:
    """Draws inspected weight, pointing, delta v and torque over time, all arms together."""
    figure = Figure(figsize=(9, 5.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    for arm, episode in episodes.items():
        colour, marker = style(arm, episodes)
        delta_v, torque = effort(episode, c)
        for ax, values in zip(
            axes.flat, (episode["inspected_score"], pointing(episode), delta_v, torque), strict=True
        ):
            ax.plot(episode["time"], values, color=colour, lw=1.2, label=label(arm))
            ax.plot(episode["time"][-1], values[-1], color=colour, marker=marker, ms=5)
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
    """Draws values with 95 % intervals of each arm's agents with the filter off (hollow) and on (filled)."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    for ax, (title, name) in zip(figure.subplots(1, len(CROSS)), CROSS.items(), strict=True):
        for place, (arm, evaluations) in enumerate(cross.items()):
            colour, marker = style(arm, cross)
            for shift, (switch, results) in zip((-0.15, 0.15), evaluations.items(), strict=True):
                number = measured(results, name)
                x = place + shift
                ends = number.interval or (number.value, number.value)
                ax.plot([x, x], ends, color=colour, marker="_", ms=8, lw=1.4)
                face = colour if switch == "on" else "white"
                ax.plot(x, number.value, color=colour, marker=marker, mfc=face, ms=7)
        ax.set(xlabel="trained with", ylabel=title, xlim=(-0.5, len(cross) - 0.5))
        ax.set_xticks(range(len(cross)), [label(arm) for arm in cross], rotation=30)
        ax.grid(axis="y", alpha=0.3)
        ax.margins(y=0.15)
    handles = [
        Line2D([], [], color="black", marker="o", ls="", mfc=face, label=f"flown with the filter {switch}")
        for switch, face in (("off", "white"), ("on", "black"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


def front_figure(inputs: Inputs) -> Figure:
    """Draws delta v over length for each arm (large), its seeds (small), and the guidance from thrifty to fast."""
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    ax = figure.subplots()
    for arm, results in inputs.arms.items():
        colour, marker = style(arm, inputs.arms)
        for seed in results.get("per_seed", ()):
            ax.plot(*point(seed), color=colour, marker=marker, ms=3, alpha=0.5, ls="")
        look: dict[str, Any] = {"color": colour, "marker": marker, "ms": 9, "mec": "white", "ls": ""}
        ax.plot(*point(results), **look, label=f"agents, {label(arm)}")
    curve = [point(results) for results in inputs.front.values()]
    ax.plot(*zip(*curve, strict=True), color=GUIDANCE_COLOUR, marker=".", lw=1.2, label="classical guidance")
    for name, place in zip(inputs.front, curve, strict=True):
        ax.annotate(name, place, (4, 4), textcoords="offset points", fontsize=8, color=GUIDANCE_COLOUR)
    ax.margins(0.1)  # leaves room for the names
    ax.set(xlabel="episode length (s)", ylabel="delta v (m/s)", ylim=(0, None))
    ax.grid(alpha=0.3)
    ax.legend(frameon=False, fontsize=9)
    return figure


def point(results: Results) -> tuple[float, float]:
    """Returns the IQM of length in s and of delta v in m/s."""
    return results["metrics"]["episode_length_s"]["iqm"], results["metrics"]["delta_v_m_s"]["iqm"]


def progress_figure(progress: dict[str, dict[str, list[float]]]) -> Figure:
    """Draws the inspected weight over time of every arm's agents and of the guidance."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    ax = figure.subplots()
    arms = [name for name in progress if name != "guidance"]
    for name, curve in progress.items():
        colour, line = (GUIDANCE_COLOUR, "--") if name == "guidance" else (style(name, arms)[0], "-")
        who = "classical guidance" if name == "guidance" else f"agents, {label(name)}"
        ax.plot(curve["time_s"], curve["weight"], color=colour, ls=line, lw=1.4, label=who)
    ax.axvline(500.0, color="0.6", ls=":", lw=1)
    ax.set(xlabel="time (s)", ylabel="inspected weight", xlim=(0, None), ylim=(0, 1.02))
    ax.grid(alpha=0.3)
    ax.legend(frameon=False, fontsize=9, loc="lower right")
    return figure

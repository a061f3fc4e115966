"""Time against fuel of the paper, the guidance, the study's agents, the best flights found and the bound."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from study.config import ARMS
from study.drawing import Figure, NullFormatter, StrMethodFormatter
from study.files import ROOT, writing
from study.flight.figures import BLUE, GREEN, GREY, ORANGE
from study.paper import PAPER_METRICS

AGENTS, FRONT = (ROOT / f"runs/reference/{study}/results.json" for study in ("study", "teachers"))
GUIDED = ROOT / "runs/reference/study/report/front.json"  # the guidance on the agents' cases
RED = "#D55E00"
METRICS = "episode_length_s", "delta_v_m_s"
NAMES = {"no_rta": "without RTA", "rta": "with RTA"}


def solved(found: dict[str, Any]) -> list[int]:
    """The cases with a clean flight in each of the times."""
    rows = [flights["delta_v_m_s"] for flights in found["times"]]
    return [case for case, fuel in enumerate(zip(*rows, strict=True)) if None not in fuel]


def mean(values: list[float], cases: list[int]) -> float:
    """Of these cases."""
    return float(np.mean([values[case] for case in cases]))


def draw(found: dict[str, Any], path: Path) -> None:
    """Draws the content of optimum.json."""
    drawn = Figure(figsize=(8, 6), layout="constrained")
    axis = drawn.subplots()
    cases, times = solved(found), found["times"]
    agents, thriftier = (json.loads(path.read_text(encoding="utf-8"))["arms"] for path in (AGENTS, FRONT))
    guided = json.loads(GUIDED.read_text(encoding="utf-8"))

    def line(of: dict[str, Any]) -> Iterator[tuple[float, ...]]:
        """Times and fuel, from thrifty to quick."""
        return zip(*([each["metrics"][name]["iqm"] for name in METRICS] for each in of.values()), strict=True)

    axis.plot(
        *line({**thriftier, "quick": agents["rta"]}),
        "D-",
        color=ORANGE,
        ms=5,
        label="our agents, by their teacher",
    )
    axis.plot(*line(guided), "o--", color=BLUE, ms=5, label="guidance that leads the Sun, the same cases")
    for arm, marker in zip(ARMS, "sD", strict=True):
        own = [agents[arm]["metrics"][name]["iqm"] for name in METRICS]
        papers = [PAPER_METRICS[name].by_arm[arm].value for name in METRICS]
        axis.plot(*papers, marker, color=GREY, ms=8, label=f"the paper's agents, {NAMES[arm]}")
        axis.plot(*own, marker, color=ORANGE, ms=8, label=f"our agents, {NAMES[arm]}")
    for rows, colour, label in (
        (list(found["guidance"].values()), BLUE, "guidance, the cases of the best found"),
        (times, GREEN, "best found, case known in advance"),
    ):
        points = ([mean(row[name], cases) for row in rows] for name in ("time_s", "delta_v_m_s"))
        axis.plot(*points, "o-", color=colour, label=label)
    bounded = [case for case in cases if case < len(times[0]["bound_m_s"])]
    proven = [mean(row["bound_m_s"], bounded) for row in times]
    axis.plot(
        [row["allowed_s"] for row in times], proven, "v--", color=RED, label="nobody needs less: proven"
    )
    axis.set(xlabel="time to success (s)", ylabel="delta v (m/s), logarithmic", yscale="log")
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axis.set_yticks([0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0])
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.3)
    drawn.legend(fontsize=9, loc="outside lower center", ncols=2)
    with writing(path) as file:
        drawn.savefig(file, dpi=100, format="png")

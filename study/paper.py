"""The paper's Tables 2 and 3, and the same numbers from an evaluation of ours."""

import math
from dataclasses import dataclass
from typing import Any

from rta.names import OWN

Results = dict[str, Any]  # in the form of `evaluate --json`
Numbers = tuple[float, float, float]


@dataclass(frozen=True)
class Estimate:
    """Holds a number and, if known, its 95 % interval (low, high)."""

    value: float
    interval: tuple[float, float] | None = None

    def text(self, digits: int) -> str:
        """Returns "value [low, high]", or the value alone; an empty text if there is no value (NaN)."""
        if math.isnan(self.value):
            return ""
        if self.interval is None:
            return f"{self.value:.{digits}f}"
        low, high = self.interval
        return f"{self.value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


@dataclass(frozen=True)
class Published:
    """Holds a row of Table 2 or 3: the paper's numbers, printed with `digits` decimals."""

    label: str
    digits: int
    by_arm: dict[str, Estimate]  # keys are the study's names of the arms


def iqms(label: str, digits: int, no_rta: Numbers, rta: Numbers) -> Published:
    """Makes a row of Table 2 from the IQM, low and high of either arm."""
    arms = {"no_rta": no_rta, "rta": rta}
    return Published(
        label, digits, {arm: Estimate(iqm, (low, high)) for arm, (iqm, low, high) in arms.items()}
    )


def means(label: str, no_rta: float, rta: float) -> Published:
    """Makes a row of Table 3."""
    return Published(label, 3, {"no_rta": Estimate(no_rta), "rta": Estimate(rta)})


# Table 2, IQM [95 % confidence interval] over 10 seeds x 100 cases: without RTA, with RTA
PAPER_METRICS = {
    "inspected_score": iqms("Inspected points score", 4, (0.9552, 0.9549, 0.9556), (0.9573, 0.9568, 0.9578)),
    "reward": iqms("Total reward", 4, (2.1486, 2.1444, 2.1527), (2.0235, 2.0175, 2.0293)),
    "episode_length_s": iqms(
        "Episode length (s)", 1, (3031.3, 3018.34, 3044.86), (3263.76, 3237.74, 3291.22)
    ),
    "delta_v_m_s": iqms("Delta v (m/s)", 3, (10.8898, 10.7006, 11.086), (15.9381, 15.6616, 16.2219)),
    "torque_n_m": iqms("Torque (N m)", 4, (0.019, 0.0186, 0.0194), (0.0607, 0.0591, 0.0623)),
}

# Table 3, mean percentage of steps: without RTA, with RTA
PAPER_VIOLATIONS = {
    "any": means("Any constraint", 4.736, 0.215),
    "collision": means("Safe separation", 0.144, 0.0),
    "dynamic_speed": means("Dynamic speed", 4.242, 0.001),
    "keep_in_zone": means("Keep in zone", 0.003, 0.0),
    "passive_safety": means("PSM", 0.989, 0.0),
    "velocity_x": means("x velocity limit", 0.0, 0.067),
    "velocity_y": means("y velocity limit", 0.0, 0.079),
    "velocity_z": means("z velocity limit", 0.0, 0.061),
    "attitude_exclusion": means("Attitude exclusion", 0.496, 0.0),
    "temperature": means("Temperature", 0.0, 0.007),
    "battery": means("Power", 0.0, 0.0),
    "angular_velocity_x": means("omega_x limit", 0.0, 0.0),
    "angular_velocity_y": means("omega_y limit", 0.0, 0.0),
    "angular_velocity_z": means("omega_z limit", 0.0, 0.0),
}
PAPER_VIOLATIONS |= {name: means(name.replace("_", " "), math.nan, math.nan) for name in OWN}


def measured(results: Results, name: str) -> Estimate:
    """Returns an evaluation's number for a metric (IQM), or in % for a violation (mean) or "success"."""
    if name == "success":
        return Estimate(100.0 * results["outcomes"]["success"])
    if name in results["violations_percent"]:
        return Estimate(results["violations_percent"][name])
    summary = results["metrics"][name]
    low, high = summary["ci95"]
    return Estimate(summary["iqm"], (low, high))


def tables(results: Results) -> str:
    """Returns both tables as text for the results of one evaluation, at most 100 columns wide."""
    lines = [
        f"Table 2: interquartile mean (the mean of the middle half) over {results['episodes']:,} episodes",
        "[95 % confidence interval]",
        *rows(results, PAPER_METRICS, (29, 24, 24)),
        "",
        "Table 3: mean safety violation, % of steps; PSM is passive safety",
        *rows(results, PAPER_VIOLATIONS, (16, 16, 16)),
    ]
    outcomes = ", ".join(
        f"{100 * share:.3g} % {name.replace('_', ' ')}"
        for name, share in results["outcomes"].items()
        if share
    )
    lines += ["", f"Outcomes: {outcomes}"]
    rta = results["rta"]
    if rta["period_s"] is not None:
        lines.append(
            f"RTA at {rta['period_s']:g} s: corrected {rta['intervention_percent']:.2f} % of its calls, "
            f"{rta['qp_failures']} unsolved problems"
        )
    else:
        lines.append("RTA: off")
    return "\n".join(lines)


def rows(results: Results, published: dict[str, Published], widths: tuple[int, int, int]) -> list[str]:
    """Returns a table's lines: its heading, and our numbers beside the paper's columns."""
    lines: list[tuple[str, ...]] = [("", "this one", "paper, no RTA", "paper, RTA")]
    for name, paper in published.items():
        numbers = (measured(results, name), *paper.by_arm.values())
        lines.append((paper.label, *(number.text(paper.digits) for number in numbers)))
    return [
        f"{label:23}" + "".join(f"{text:>{width}}" for text, width in zip(texts, widths, strict=True))
        for label, *texts in lines
    ]

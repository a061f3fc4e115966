"""The paper's Tables 2 and 3 with its columns beside ours."""

from typing import Any

# Table 2, IQM [95 % confidence interval] over 10 seeds x 100 cases: label, digits, no RTA, RTA
PAPER_METRICS = {
    "inspected_score": ("Inspected points score", 4, (0.9552, 0.9549, 0.9556), (0.9573, 0.9568, 0.9578)),
    "reward": ("Total reward", 4, (2.1486, 2.1444, 2.1527), (2.0235, 2.0175, 2.0293)),
    "episode_length_s": ("Episode length (s)", 1, (3031.3, 3018.34, 3044.86), (3263.76, 3237.74, 3291.22)),
    "delta_v_m_s": ("Delta v (m/s)", 3, (10.8898, 10.7006, 11.086), (15.9381, 15.6616, 16.2219)),
    "torque_n_m": ("Torque (N m)", 4, (0.019, 0.0186, 0.0194), (0.0607, 0.0591, 0.0623)),
}

# Table 3, mean percentage of steps: label, no RTA, RTA
PAPER_VIOLATIONS = {
    "any": ("Any constraint", 4.736, 0.215),
    "collision": ("Safe separation", 0.144, 0.0),
    "dynamic_speed": ("Dynamic speed", 4.242, 0.001),
    "keep_in_zone": ("Keep in zone", 0.003, 0.0),
    "passive_safety": ("PSM", 0.989, 0.0),
    "velocity_x": ("x velocity limit", 0.0, 0.067),
    "velocity_y": ("y velocity limit", 0.0, 0.079),
    "velocity_z": ("z velocity limit", 0.0, 0.061),
    "attitude_exclusion": ("Attitude exclusion", 0.496, 0.0),
    "temperature": ("Temperature", 0.0, 0.007),
    "battery": ("Power", 0.0, 0.0),
    "angular_velocity_x": ("omega_x limit", 0.0, 0.0),
    "angular_velocity_y": ("omega_y limit", 0.0, 0.0),
    "angular_velocity_z": ("omega_z limit", 0.0, 0.0),
}


def interval(iqm: float, low: float, high: float, digits: int) -> str:
    """iqm [low, high]."""
    return f"{iqm:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def tables(results: dict[str, Any]) -> str:
    """Both tables as text for the results of one evaluation."""
    lines = [
        f"Table 2: IQM [95 % confidence interval] over {results['episodes']} episodes",
        f"{'':24}{'this agent':>32}{'paper, no RTA':>32}{'paper, RTA':>32}",
    ]
    for name, (label, digits, *paper) in PAPER_METRICS.items():
        metric = results["metrics"][name]
        columns = [(metric["iqm"], *metric["ci95"]), *paper]
        lines.append(f"{label:24}" + "".join(f"{interval(*column, digits):>32}" for column in columns))
    lines += ["", "Table 3: mean safety violation, % of steps"]
    lines.append(f"{'':24}{'this agent':>16}{'paper, no RTA':>16}{'paper, RTA':>16}")
    for name, (label, *paper) in PAPER_VIOLATIONS.items():
        columns = [results["violations_percent"][name], *paper]
        lines.append(f"{label:24}" + "".join(f"{column:>16.3f}" for column in columns))
    outcomes = ", ".join(
        f"{100 * share:.0f} % {name.replace('_', ' ')}"
        for name, share in results["outcomes"].items()
        if share
    )
    lines += ["", f"Outcomes: {outcomes}"]
    rta = results["rta"]
    if rta["period_s"] is not None:
        lines.append(
            f"RTA at {rta['period_s']:g} s: intervened at {rta['intervention_percent']:.2f} % of its calls, "
            f"{rta['qp_failures']} unsolved problems"
        )
    else:
        lines.append("RTA: off")
    return "\n".join(lines)

"""What Basilisk makes of our physics, agents and filter."""

from collections.abc import Iterator
from typing import Any

from study.results.numbers.evidence import POLICIES, Row, calls, read

PAGE = "docs/results/basilisk.md"
MODELS = (
    "as the paper: gravity linear, Hill's frame at rest",
    "`hill_rotation = true`",
    '`hill_rotation = true`, `orbit = "two-body"`',
)  # in the order of the file
WORLDS = {
    "own": "ours",
    "basilisk": "Basilisk",
    "basilisk, J2 and drag": "with J2 and drag",
    "basilisk, wheels and pulses": "with wheels and pulses",
}
METRICS = {"reward": 3, "episode_length_s": 0, "delta_v_m_s": 3}  # and their digits


def basilisk() -> Any:
    """What `experiments.basilisk` found."""
    return read("basilisk/basilisk.json")


def coasting() -> Iterator[Row]:
    """The difference that is left after the coast, with more and more of the physics in our model."""
    for label, errors in zip(MODELS, basilisk()["coasting"]["models"].values(), strict=True):
        last = {name: values[-1] for name, values in errors.items()}
        position = f"{last['position_m']:.2g} ({last['position_median_m']:.2g})"
        yield label, position, f"{last['attitude_deg']:.2g}", f"{last['rate_rad_s']:.1g}"


def agents() -> Iterator[Row]:
    """The agents in both simulators."""
    for arm, label in (("no_rta", "without RTA"), ("rta", "with RTA")):
        for world, place in WORLDS.items():
            found = basilisk()["agents"][arm][world]
            cells = []
            for name, digits in METRICS.items():
                mean, apart = f"{found['mean'][name]:,.{digits}f}", found["difference"][name]
                if world != "own":
                    mean += f" ({apart['mean']:+.{digits}f} ± {apart['standard_error']:.{digits}f})"
                cells.append(mean)
            shares = f"{found['success_percent']:.1f}", f"{found['clean_percent']:.1f}"
            yield label, place, f"{found['episodes']}", *shares, f"{found['violating_episodes']}", *cells


def campaigns() -> Iterator[Row]:
    """The filter with U1's bounds."""
    for policy in (*POLICIES, "lookahead"):
        report = read(f"basilisk/u1_{policy}.json")
        worst = report["worst_value"]
        yield (
            policy,
            f"{report['episodes']:,}, {report['campaign']['duration']:,}",
            f"{report['violating_episodes']['any']}",
            f"{worst['keep_in_zone']:.2f}",
            f"{worst['passive_safety']:.1f}",
            f"{report['filter_calls']['slack']:,}",
            f"{100.0 * report['backup_calls'] / calls(report):.0f}",
        )


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    coasted = basilisk()["coasting"]
    one, many = coasted["one_alone_times_real_time"], coasted["times_real_time"]
    yield PAGE, f"flies {one:,.0f} times as fast as real time, a hundred at once {many:,.0f} times"
    random, adversarial, ahead = (read(f"basilisk/u1_{policy}.json") for policy in (*POLICIES, "lookahead"))
    long = f"There, {random['episodes'] + adversarial['episodes']:,} episodes of {random['campaign']['duration']:,} s"
    short = f"{ahead['episodes']:,} of {ahead['campaign']['duration']:,} s"
    yield "README.md", f"{long}, and {short} against an adversary that looks ahead"
    moved = coasted["perturbed"]["J2"]
    typical, most = moved["position_median_m"], moved["position_m"]
    yield PAGE, f"deputy by {typical:.1f} m in the median and {most:.1f} m at most"

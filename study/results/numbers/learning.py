"""How early agents learn, and from what."""

import math
import statistics
from collections.abc import Iterator
from typing import Any

import numpy as np

from inspection.orbits import GUIDANCE
from study.config import ARMS
from study.flight.summary import iqm
from study.paper import Results
from study.results.numbers.evidence import (
    LABELS,
    Row,
    arms,
    corrected,
    middle,
    read,
    report,
    success,
    violation,
)

README, RESULTS = "README.md", "docs/results/results.md"
EARLY = (0, 65_536, 163_840, 311_296, 507_904, 1_015_808, 2_015_232)  # interactions of the table's rows


def evaluations(study: str, arm: str, interactions: int) -> list[dict[str, Any]]:
    """The seeds' evaluations of an arm after so many interactions."""
    lines = read(f"{study}/{arm}/evaluations.jsonl")
    return [line for line in lines if line["interactions"] == interactions]


def succeeded(seeds: list[dict[str, Any]]) -> float:
    """The share of the seeds' cases with success, in %."""
    return 100.0 * float(np.mean([seed["outcomes"]["success"] for seed in seeds]))


def middle_of_cases(seeds: list[dict[str, Any]], metric: str) -> float:
    """The interquartile mean over the seeds' cases."""
    return float(iqm(np.concatenate([seed["cases"][metric] for seed in seeds])))


def papers_learner() -> Iterator[Row]:
    """The paper's learner from scratch, without RTA and with it by turns."""
    for interactions in EARLY:
        both = [evaluations("paper", arm, interactions) for arm in ARMS]
        yield (
            f"{interactions:,}",
            *(f"{succeeded(seeds):.0f}" for seeds in both),
            *(f"{middle_of_cases(seeds, 'inspected_score'):.2f}" for seeds in both),
            *(f"{middle_of_cases(seeds, 'delta_v_m_s'):.1f}" for seeds in both),
        )


def after_500_s(arm: str) -> float:
    """The weight that trained agents have inspected after 500 s."""
    curve = report("progress")[arm]
    return float(np.interp(500.0, curve["time_s"], curve["weight"]))


def early() -> Iterator[Row]:
    """The study's arms before training, after the lessons and at the end, on the cases of the evaluations."""
    for arm in (*ARMS, "rta_5s", "rta_10s"):
        before, lessons, end = (evaluations("study", arm, when) for when in (0, 294_912, 507_904))

        def cell(seeds: list[dict[str, Any]]) -> str:
            reward = np.mean([seed["cases"]["reward"] for seed in seeds])
            fuel, time = (middle_of_cases(seeds, name) for name in ("delta_v_m_s", "episode_length_s"))
            return f"{succeeded(seeds):.1f}, {reward:.3f}, {fuel:.2f}, {time:,.0f}"

        untaught = f"{middle_of_cases(before, 'inspected_score'):.2f}, {succeeded(before):.1f}"
        yield LABELS[arm], untaught, cell(lessons), cell(end), f"{after_500_s(arm):.2f}"


def learned_from() -> Iterator[Row]:
    """What PPO learns from behind the filter."""
    for name, found in read("learn_from/results.json").items():
        on, off, at = found["with_filter"], found["without"], found["learned_at"]
        reward = on["metrics"]["reward"]
        typical = statistics.median(math.inf if each is None else each for each in at)
        yield (
            name,
            success(on),
            f"{reward['iqm']:.3f} ({reward['mean']:.3f})",
            f"{middle(on, 'delta_v_m_s'):.1f}",
            f"{on['corrected_percent']:.1f}",
            f"{typical:,.0f} ({sum(each is not None for each in at)} of {found['seeds']})",
            success(off),
            f"{off['violations_percent']:.2f}",
        )


def guidance_knobs() -> Iterator[Row]:
    """The guidance by its names, from the program itself."""
    for name, orbit in GUIDANCE.items():
        lead = orbit.lead
        phase = scores = ""
        if lead:
            phase = f"{math.degrees(-lead.behind):.0f} to {math.degrees(lead.ahead):.0f}"
            scores = f"{lead.begin:.2f} to {lead.end:.2f}"
        approach = f"{100.0 * orbit.approach:.0f}" if math.isfinite(orbit.approach) else ""
        numbers = f"{orbit.semi_minor:.1f}", f"{orbit.out_of_plane:.1f}", f"{1e3 * orbit.tracking:.1f}"
        yield name, *numbers, f"{math.degrees(orbit.look_ahead):.0f}", approach, phase, scores


def guidance_flown() -> Iterator[Row]:
    """The guidance on unseen cases, as a teacher and as it is flown."""
    found = read("guidance/guidance.json")
    flown = {
        "teaching": "every 10 s, no filter",
        "without": "every second, no filter",
        "with": "every second, filter",
    }
    for name, ways in found["guidance"].items():
        for way, label in flown.items():
            results = ways[way]

            def cell(metric: str, digits: int, results: Results = results) -> str:
                own = results["metrics"][metric]
                return "{} ({}), {}".format(*(f"{own[key]:,.{digits}f}" for key in ("iqm", "mean", "p95")))

            counts = results["violating_episodes"], results["drifting_successes"]
            cells = cell("episode_length_s", 0), cell("delta_v_m_s", 2)
            yield (
                name,
                label,
                success(results),
                success(results, "clean_success"),
                *map(str, counts),
                *cells,
            )


def how_far() -> Iterator[Row]:
    """The guidance, the best flights found and the bound, in the first common cases."""
    found = read("optimum/optimum.json")

    def mean(values: list[float | None], digits: int = 2) -> str:
        return f"{np.mean([value for value in values if value is not None]):,.{digits}f}"

    for name, way in found["guidance"].items():
        cells = mean(way["time_s"], 0), mean(way["delta_v_m_s"])
        yield f"guidance, {name}", "", f"{way['clean']} of {found['cases']}", *cells, "", "", ""
    for flights in found["times"]:
        bound, length = flights["bound_m_s"], flights["length_m_s"]
        both = [i for i in range(len(bound)) if length[i] is not None]
        yield (
            "best found",
            f"{flights['allowed_s']:,.0f}",
            f"{sum(each is not None for each in length)} of {found['cases']}",
            mean(flights["time_s"], 0),
            mean(flights["delta_v_m_s"]),
            mean(length),
            f"{mean([length[i] for i in both])} ({len(both)})",
            mean([bound[i] for i in both], 3),
        )


def kept_clear() -> Iterator[Row]:
    """The study's agents with RTA, as they are and led to free flights that stay clear."""
    led = read("keep_clear/keep_clear.json")
    for label, found in (("as in the study", arms()["rta"]), ("with `keep_clear`", led)):
        fuel, time, reward = (
            found["metrics"][name] for name in ("delta_v_m_s", "episode_length_s", "reward")
        )
        yield (
            label,
            success(found),
            success(found, "clean_success"),
            violation(found),
            f"{time['iqm']:,.0f} ({time['mean']:,.0f})",
            f"{fuel['iqm']:.2f} ({fuel['mean']:.2f})",
            f"{reward['iqm']:.3f} ({reward['mean']:.3f})",
            corrected(found, 2),
        )


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    ways = read("guidance/guidance.json")["guidance"]
    thrifty, even, quick = (
        f"{middle(ways[name]['with'], 'delta_v_m_s'):.1f} m/s in "
        f"{round(middle(ways[name]['with'], 'episode_length_s'), -2):,.0f} s"
        for name in ("thrifty", "even", "quick")
    )
    yield README, f"its settings run from {thrifty} over {even} to {quick}"

    without, behind = (f"{succeeded(evaluations('paper', arm, 311_296)):.0f}" for arm in ARMS)
    yield README, f"succeeds in {behind} % of the episodes with RTA, and in {without} % without"
    said = f"{behind} % succeed after 0.31 million interactions with RTA, where {without} % do without"
    yield RESULTS, said

    led = read("keep_clear/keep_clear.json")
    fuel, time = (middle(led, metric) for metric in ("delta_v_m_s", "episode_length_s"))
    clean = f"{success(led, 'clean_success')} % of the episodes of the same agents with RTA are clean"
    yield README, f"{clean}, for {fuel:.2f} m/s in {time:,.0f} s"

    trained = [arms("paper")[arm] for arm in ARMS]
    without, behind = (f"{middle(each, 'delta_v_m_s'):.1f}" for each in trained)
    yield RESULTS, f"in the end, {behind} against {without} m/s"
    yield RESULTS, f"order of fuel: {without} m/s without and {behind} m/s with RTA"
    without, behind = (f"{100.0 * each['outcomes']['clean_success']:.0f}" for each in trained)
    yield RESULTS, f"Without the filter {without} % are clean in the end, with it {behind} %"

    yield RESULTS, f"they have {after_500_s('robust'):.2f} after 500 s when trained"
    without, behind = (f"{100.0 * after_500_s(arm):.0f}" for arm in ARMS)
    yield RESULTS, f"the mean of the middle half is {without} % without and {behind} % with RTA"

"""The study's agents, the classical guidance and the paper's agents."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from study.config import ARMS, GUIDE
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Results
from study.report.tables import of_seeds, over_seeds
from study.results.numbers.evidence import (
    LABELS,
    REFERENCE,
    Row,
    arms,
    corrected,
    interval,
    middle,
    report,
    success,
    violation,
)

README, RESULTS = "README.md", "docs/results/results.md"
SWITCHES = {"off": "without", "on": "with"}  # the filter


def guidance() -> Results:
    """The classical guidance behind the filter, on the study's test cases."""
    return report("baselines")[GUIDE]["on"]


def fuel_and_time(results: Results) -> tuple[float, float]:
    """Delta v in m/s, and the length of an episode in s."""
    return middle(results, "delta_v_m_s"), middle(results, "episode_length_s")


def front() -> Iterator[Row]:
    """The front page's table."""
    flown = {
        "agents trained and flown without RTA": arms()["no_rta"],
        "agents trained and flown with RTA": arms()["rta"],
        "agents of an imperfect world, with robust RTA": arms()["robust"],
        "classical guidance with RTA": guidance(),
    }
    for label, results in flown.items():
        fuel, time = fuel_and_time(results)
        shares = success(results), success(results, "clean_success")
        yield label, *shares, f"{fuel:.2f}", f"{time:,.0f}", violation(results)
    fuel, time = (PAPER_METRICS[name].by_arm["rta"].value for name in ("delta_v_m_s", "episode_length_s"))
    any_limit = PAPER_VIOLATIONS["any"].by_arm["rta"].value
    yield "*the paper's agents with RTA*", "", "", f"{fuel:.2f}", f"{time:,.0f}", f"{any_limit:.3f}"


def performance() -> Iterator[Row]:
    """Table 2: ours, the paper's, and the guidance."""

    def ours(label: str, cell: Callable[[Results], str], paper: Row = ("", "")) -> Row:
        without, behind = (cell(arms()[arm]) for arm in ARMS)
        return label, without, paper[0], behind, paper[1], cell(report("guidance"))

    for metric, published in PAPER_METRICS.items():
        paper = [published.by_arm[arm].text(published.digits) for arm in ARMS]
        yield ours(published.label, partial(interval, metric=metric), paper)
    yield ours("Torque, summed over seconds (N m s)", lambda each: f"{10.0 * middle(each, 'torque_n_m'):.4f}")
    yield ours("Success (%)", success)
    yield ours("Clean success (%)", lambda each: success(each, "clean_success"))
    paper = [PAPER_VIOLATIONS["any"].by_arm[arm].text(3) for arm in ARMS]
    yield ours("Any violation (mean % of steps)", violation, paper)
    label = "Any violation (mean % of seconds)"
    yield ours(label, lambda each: f"{each['violations_percent_of_seconds']['any']:.3f}")


def violations() -> Iterator[Row]:
    """Table 3: ours beside the paper's."""
    for constraint, published in PAPER_VIOLATIONS.items():
        without, behind = (violation(arms()[arm], constraint) for arm in ARMS)
        paper = [published.by_arm[arm].text(published.digits) for arm in ARMS]
        yield published.label, without, paper[0], behind, paper[1]


def all_arms() -> Iterator[Row]:
    """Each arm with the intervals over seeds, the means and the tails."""
    for arm, label in LABELS.items():
        results = arms()[arm]

        def cell(metric: str, digits: int, results: Results = results) -> str:
            low, high = over_seeds(results, metric)
            numbers = middle(results, metric), low, high, results["metrics"][metric]["mean"]
            return "{} [{}, {}], {}".format(*(f"{each:,.{digits}f}" for each in numbers))

        length, fuel = (results["metrics"][name] for name in ("episode_length_s", "delta_v_m_s"))
        yield (
            label,
            success(results, "clean_success"),
            violation(results),
            cell("reward", 3),
            f"{min(of_seeds(results, 'reward')):.3f}",
            cell("episode_length_s", 0),
            f"{length['p5']:,.0f} to {length['p95']:,.0f}, {length['max']:,.0f}",
            cell("delta_v_m_s", 2),
            f"{fuel['p5']:.2f} to {fuel['p95']:.2f}, {fuel['max']:.2f}",
        )


def time_against_fuel() -> Iterator[Row]:
    """The guidance from thrifty to quick."""
    for name, flown in report("front").items():
        fuel, time = fuel_and_time(flown)
        yield name, f"{time:,.0f}", f"{fuel:.2f}", success(flown, "clean_success")


def thrifty_to_quick() -> Iterator[Row]:
    """Agents by the guidance that taught them: those of the front, then the study's."""
    for teacher, flown in {**arms("teachers"), GUIDE: arms()["rta"]}.items():
        fuel, time = fuel_and_time(flown)
        shares = success(flown), success(flown, "clean_success")
        longest = f"{flown['metrics']['episode_length_s']['max']:,.0f}"
        yield (
            teacher,
            f"{len(flown['per_seed'])}",
            f"{time:,.0f}",
            longest,
            f"{fuel:.2f}",
            *shares,
            violation(flown),
        )


def baselines() -> Iterator[Row]:
    """The test cases flown without learning."""
    flown_by = {
        "untrained": "untrained agent",
        "random": "random controls",
        "zero": "no control (coasting)",
        "natural-motion": "guidance natural-motion",
        GUIDE: f"guidance {GUIDE}",
    }
    for name, label in flown_by.items():
        for switch, filtered in SWITCHES.items():
            results = report("baselines")[name][switch]
            metrics = (interval(results, each) for each in ("reward", "delta_v_m_s", "episode_length_s"))
            yield label, filtered, success(results), violation(results), *metrics


def hidden() -> Iterator[Row]:
    """What the interquartile means hide: counts over all episodes."""
    columns = []
    for arm in LABELS:
        with np.load(REFERENCE / "study" / arm / "episodes.npz") as episodes:
            metrics = dict(zip(episodes["metric_names"], episodes["metrics"], strict=True))
            violated = dict(zip(episodes["constraint_names"], episodes["violation_seconds"], strict=True))
            succeeded = episodes["outcome"] == list(episodes["outcome_names"]).index("success")
            drift = "succeed, but would drift into the chief within two days if thrust stopped at the end"
            counts = {
                "succeed": succeeded,
                drift: succeeded & ~episodes["clear"],
                "violate a limit in some second": violated["any"] > 0.0,
                "last longer than 4,500 s": metrics["episode_length_s"] > 4500.0,
            }
            column = {label: f"{found.sum():,}" for label, found in counts.items()}
            farthest = episodes["max_distance_m"].max()
            columns.append(column | {"farthest from the chief (m); the limit is 800": f"{farthest:.2f}"})
    for label in columns[0]:
        yield label, *(column[label] for column in columns)


def dependence() -> Iterator[Row]:
    """Each arm with the filter off and on."""
    for arm, label in LABELS.items():
        for switch, filtered in SWITCHES.items():
            results = report("cross")[arm][switch]
            yield (
                label,
                filtered,
                success(results),
                success(results, "clean_success"),
                violation(results),
                corrected(results),
                interval(results, "reward", 3),
                interval(results, "delta_v_m_s", 2),
                interval(results, "episode_length_s", 0),
            )


def worlds() -> Iterator[Row]:
    """Each arm in plants that differ from the model."""
    for plant, flown in report("worlds").items():
        for arm, label in LABELS.items():
            cells = (
                f"{success(each)}, {violation(each)}, {middle(each, 'reward'):.3f}"
                for each in flown[arm].values()
            )
            yield plant, label, *cells


def panels_on_plus_x() -> Iterator[Row]:
    """The study with the panels where the paper's text has them."""
    columns = arms("study_plus_x").values()
    for metric, published in PAPER_METRICS.items():
        yield f"{published.label} (IQM [95 % interval])", *(interval(each, metric) for each in columns)
    yield "Success (%)", *map(success, columns)
    yield "Any violation (mean % of steps)", *map(violation, columns)
    for limit in ("attitude_exclusion", "temperature", "battery", "dynamic_speed", "passive_safety"):
        yield PAPER_VIOLATIONS[limit].label, *(violation(each, limit) for each in columns)


def sentences() -> Iterator[tuple[str, str]]:
    """Pages and the sentences that they have."""
    for who, results in ((f"`{GUIDE}` spends", guidance()), ("agents with RTA spend", arms()["rta"])):
        fuel, time = fuel_and_time(results)
        yield README, f"{who} {fuel:.1f} m/s in {round(time, -1):,.0f} s"
    off = report("cross")["rta"]["off"]
    shares = success(off), success(off, "clean_success")
    yield README, f"succeed without it in {shares[0]} % of the episodes ({shares[1]} % clean)"
    yield README, f"a limit in {off['violations_percent']['any']:.3f} % of the steps"

    minutes = sum(each["wall_clock_s"] for each in arms().values()) / 60.0
    yield RESULTS, f"Training took {minutes:.0f} minutes"
    without, behind = (f"{middle(arms()[arm], 'episode_length_s'):,.0f}" for arm in ARMS)
    paper = [f"{each.value:,.0f}" for each in PAPER_METRICS["episode_length_s"].by_arm.values()]
    yield RESULTS, f"take {behind} and {without} s against {paper[1]} and {paper[0]} s"
    lit = report("sunlight")["earliest_success_s"]
    low, high = lit["ci95"]
    yield RESULTS, f"it takes {lit['iqm']:,.0f} s [{low:,.0f}, {high:,.0f}] until"

"""Writes the rows of the tables on the pages (README.md, docs/, experiments/) from the files in runs/reference/.

    python -m docs.tables

A comment above a table names an entry of TABLES here: `<!-- rows: boundary -->`. The heading is the page's own.
Prose quotes no number that one of these files has: it points to a table.
"""

import csv
import functools
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np

from rta.names import UNITS
from study.config import ARMS, GUIDE
from study.files import ROOT, write_text
from study.flight.summary import iqm
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Published, Results, measured
from study.report.tables import of_seeds, over_seeds

REFERENCE = ROOT / "runs/reference"
PAGES = (
    "README.md",
    "experiments/learning_log.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
)
MARK = "<!-- rows:"
TABLE = re.compile(rf"(?m)^({MARK} (\w+) -->\n(?:\|.*\n){{2}})(?:\|.*\n)*")  # the mark, the heading; the rows

Rows = Iterable[Iterable[str]]  # of cells
Column = Callable[[Any], str]  # from what a file says of something to a cell
# what the pages call a study's arms, vehicles and chiefs
LABELS = {
    "no_rta": "without RTA",
    "rta": "with RTA",
    "rta_5s": "with RTA every 5 s",
    "rta_10s": "with RTA every 10 s",
}
VEHICLES = {"3u": "3U, 4 kg", "12u": "12U, 20 kg", "espa": "ESPA-class, 180 kg"}
CHIEFS = {"box": "box between panels, fixed", "satellite": "satellite, tumbling"}
POLICIES = ("random", "adversarial")  # of the campaigns
DIGITS = {"reward": 3, "episode_length_s": 0, "delta_v_m_s": 2, "torque_n_m": 4}


def renewed(text: str) -> str:
    """Returns a page's text with the rows of its marked tables.

    Raises:
        ValueError: a mark names no table here, or no table follows it.
    """

    def rows(found: re.Match[str]) -> str:
        heading, name = found.groups()
        if name not in TABLES:
            raise ValueError(f"{MARK} {name} -->: docs/tables.py has no such table")
        return heading + "".join(f"| {' | '.join(row)} |\n" for row in TABLES[name]())

    text, count = TABLE.subn(rows, text)
    if count != text.count(MARK):
        raise ValueError(f"{text.count(MARK)} marks '{MARK} NAME -->', but {count} tables after one")
    return text


def main() -> None:
    """Renews every page and says which changed."""
    for name in PAGES:
        old = (ROOT / name).read_text(encoding="utf-8")
        try:
            new = renewed(old)
        except ValueError as error:
            raise SystemExit(f"error: {name}: {error}") from None
        if new != old:
            write_text(ROOT / name, new)
            print(f"{name}: renewed")


# files


@functools.cache
def read(path: str) -> Any:
    """Returns a .json or .jsonl file of runs/reference; of the latter a list of its lines."""
    text = (REFERENCE / path).read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()] if path.endswith("l") else json.loads(text)


def report(name: str) -> Any:
    """Returns a file that `report` wrote about the agents from nothing."""
    return read(f"from_nothing/report/{name}.json")


def arms(study: str) -> dict[str, Results]:
    """Returns the results of a study's arms, by their names."""
    return read(f"{study}/results.json")["arms"]


def labelled(found: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what is said of a study's arms by what the pages call these."""
    return {LABELS[arm]: each for arm, each in found.items()}


def campaign(name: str, period: int = 1) -> Any:
    """Returns a report of `verify` or `boundary`, with the filter called every so many s."""
    return read(f"verification/{name}.json" if period == 1 else f"frequency/{name}_{period}s.json")


# columns


def rows(found: Mapping[Any, Any], *columns: Column) -> Rows:
    """Yields a row for each entry: its key, a cell or several, then what the columns say of its value."""
    for key, value in found.items():
        yield *([key] if isinstance(key, str) else key), *(column(value) for column in columns)


def number(path: str, form: str = ",") -> Column:
    """Returns the column of the number under these keys, "violating_episodes/any"."""
    return lambda found: format(functools.reduce(lambda part, key: part[key], path.split("/"), found), form)


def metric(name: str, pattern: str = "{iqm}") -> Column:
    """Returns the column of a metric's numbers in a pattern of iqm, mean, p5, p95 and max."""

    def cell(results: Results) -> str:
        numbers = {key: value for key, value in results["metrics"][name].items() if key != "ci95"}
        return pattern.format(**{key: f"{value:,.{DIGITS[name]}f}" for key, value in numbers.items()})

    return cell


def interval(name: str) -> Column:
    """Returns the column of IQM [95 % interval], with as many digits as the paper's."""
    return lambda results: measured(results, name).text(PAPER_METRICS[name].digits)


def share(name: str) -> Column:
    """Returns the column of the share of "success" or "clean_success", in %."""
    return lambda results: f"{100.0 * results['outcomes'][name]:.1f}"


def corrected(results: Results) -> str:
    """Returns the share of the filter's calls that it corrects, in %."""
    return f"{results['rta']['intervention_percent']:.2f}" if results["rta"]["period_s"] else "-"


def over_the_seeds(name: str) -> Column:
    """Returns the column of IQM [its interval over seeds], mean."""

    def cell(results: Results) -> str:
        found = results["metrics"][name]
        numbers = found["iqm"], *over_seeds(results, name), found["mean"]
        return "{} [{}, {}], {}".format(*(f"{each:,.{DIGITS[name]}f}" for each in numbers))

    return cell


def violating(*campaigns: Any) -> str:
    """Returns how many episodes of campaigns violated a limit."""
    broken = sum(each["violating_episodes"]["any"] for each in campaigns)
    return f"{broken:,} of {sum(each['episodes'] for each in campaigns):,}"


def calls(found: Any) -> int:
    """Returns the filter calls of a campaign."""
    return sum(found["filter_calls"].values())


def backup(found: Any) -> str:
    """Returns the share of a campaign's calls in which the backup decided, in %."""
    percent = 100.0 * found["backup_calls"] / calls(found)
    return f"{percent:.1f}" if percent >= 10.0 else f"{percent:.2g}"


TIME, FUEL, REWARD = (metric(name) for name in ("episode_length_s", "delta_v_m_s", "reward"))
SUCCESS, CLEAN = share("success"), share("clean_success")
VIOLATION = number("violations_percent/any", ".3f")


def agents(found: Mapping[Any, Results]) -> Rows:
    """Yields: success and clean success (%), steps with a violation (%), calls corrected (%), reward, time, fuel."""
    return rows(found, SUCCESS, CLEAN, VIOLATION, corrected, REWARD, TIME, FUEL)


def campaigns(found: Mapping[Any, Any]) -> Rows:
    """Yields: episodes with a violation, its probability below, h of zone and PSM, calls with slack, by the backup."""
    smallest = number("worst_value/keep_in_zone", ".3f"), number("worst_value/passive_safety", ".2f")
    return rows(
        found, violating, number("upper_bound_95", ".2g"), *smallest, number("filter_calls/slack"), backup
    )


def both(label: str, name: str) -> dict[tuple[str, str], Any]:
    """Returns the campaigns of random and of adversarial controls, by label and policy; `name` has {} for these."""
    return {(label, policy): campaign(name.format(policy)) for policy in POLICIES}


# tables


def front() -> Rows:
    for arm in ARMS:
        reward, time, fuel = (
            PAPER_METRICS[name].by_arm[arm].value for name in ("reward", "episode_length_s", "delta_v_m_s")
        )
        any_limit = f"{PAPER_VIOLATIONS['any'].by_arm[arm].value:.3f}"
        yield (
            f"*the paper's agents {LABELS[arm]}*",
            *("", "", any_limit),
            *(f"{reward:.3f}", f"{time:,.0f}", f"{fuel:.2f}"),
        )
    learners = {"our_learner": "our learner, the paper's task", "from_nothing": "ours, from nothing"}
    ours = {"no_rta": "without RTA", "rta": "with our filter"}
    found = {
        **{f"{name}, {ours[arm]}": arms(study)[arm] for study, name in learners.items() for arm in ARMS},
        "agents taught by the guidance, with our filter": arms("study")["rta"],
        "classical guidance with our filter": report("baselines")[GUIDE]["on"],
    }
    yield from rows(found, SUCCESS, CLEAN, VIOLATION, REWARD, TIME, FUEL)


def kept() -> Rows:
    basilisk = [read(f"basilisk/u1_{policy}.json") for policy in (*POLICIES, "lookahead")]
    for label, *flown in (
        ("every second, random and adversarial controls", *both("", "{}").values()),
        (
            "every 5 or 10 s, random and adversarial",
            *(campaign(each, s) for each in POLICIES for s in (5, 10)),
        ),
        (
            "every 1, 5 or 10 s, an adversary that looks ahead",
            *(campaign("lookahead", s) for s in (1, 5, 10)),
        ),
        (
            "every second, all errors at once, drawn anew each second, their bounds given",
            *both("", "u1_{}").values(),
        ),
        ("the same in Basilisk, also against an adversary that looks ahead", *basilisk),
    ):
        yield label, violating(*flown), f"{sum(map(calls, flown)) / 1e6:,.1f} million"


def beside_the_paper(label: str, column: Column, published: Published | None = None) -> Iterator[str]:
    """Yields a row of the paper's study: of each arm our number, then the paper's of the arms that it has."""
    yield label
    for arm, results in arms("our_learner").items():
        yield column(results)
        if arm in ARMS:
            yield published.by_arm[arm].text(published.digits) if published else ""


OPEN_SETTINGS = {
    "base": "nothing: a standard deviation of 0.1 at the start",
    "std_003": "0.03 at the start",
    "std_03": "0.3 at the start",
    "std_1": "1 at the start, at most e, and a tanh on the log standard deviation, too",
    "no_kl": "no price on the divergence of an update",
    "annealed": "a rate that falls to 0",
    "faster": "a rate of 3e-4",
    "linear": "no tanh on the outputs",
    "episodes": "5 episodes by 300 decisions in a batch",
    "scales": "our scales of the observations",
}


def open_settings() -> Rows:
    """Yields what the paper's agents without RTA fly, then those with one setting of the learner each."""
    names = "reward", "episode_length_s", "delta_v_m_s", "torque_n_m"
    papers = [f"{PAPER_METRICS[name].by_arm['no_rta'].value:,.{DIGITS[name]}f}" for name in names]
    yield "*the paper's agents*", "", f"{PAPER_VIOLATIONS['any'].by_arm['no_rta'].value:.3f}", *papers
    found = {label: arms("learner")[name] for name, label in OPEN_SETTINGS.items() if name in arms("learner")}
    both = [metric(name, "{iqm} ({mean})") for name in names]
    yield from rows(found, SUCCESS, VIOLATION, *both)


def performance() -> Rows:
    for name, published in PAPER_METRICS.items():
        yield beside_the_paper(published.label, interval(name), published)
    yield beside_the_paper("Success (%)", SUCCESS)
    yield beside_the_paper("Clean success (%)", CLEAN)
    yield beside_the_paper("Any violation (mean % of steps)", VIOLATION, PAPER_VIOLATIONS["any"])
    seconds = number("violations_percent_of_seconds/any", ".3f")
    yield beside_the_paper("Any violation (mean % of seconds)", seconds)


def violations() -> Rows:
    for name, published in PAPER_VIOLATIONS.items():
        yield beside_the_paper(published.label, number(f"violations_percent/{name}", ".3f"), published)


def spread(found: Mapping[Any, Results]) -> Rows:
    """Yields: clean success and steps with a violation (%), reward, time and fuel with their spread and tails."""
    worst = lambda each: f"{min(of_seeds(each, 'reward')):.3f}"  # noqa: E731
    tails = {name: metric(name, "{p5} to {p95}, {max}") for name in ("episode_length_s", "delta_v_m_s")}
    columns = [over_the_seeds("reward"), worst]
    for name, tail in tails.items():
        columns += [over_the_seeds(name), tail]
    return rows(found, CLEAN, VIOLATION, *columns)


def longer() -> Rows:
    """Yields what agents from nothing fly with RTA after 5 and after 50 million interactions."""
    found = {"10 seeds, 5 million": arms("from_nothing")["rta"], "1 seed, 50 million": arms("long")["rta"]}
    tail = "{iqm}, {p5} to {p95}, {max}"
    columns = metric("episode_length_s", tail), metric("delta_v_m_s", tail)
    return rows(found, SUCCESS, CLEAN, metric("reward", "{iqm}, {mean}"), *columns)


def hidden(study: str) -> Rows:
    """Yields counts over all episodes of a study's arms."""
    columns = []
    for arm in arms(study):
        with np.load(REFERENCE / study / arm / "episodes.npz") as episodes:
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
            edge = "come within 1 m of the zone's edge, 800 m out, or leave it"
            counts[edge] = episodes["max_distance_m"] > 799.0
            column = {label: f"{found.sum():,}" for label, found in counts.items()}
            column["most delta v (m/s)"] = f"{metrics['delta_v_m_s'].max():.2f}"
            column["farthest from the chief (m)"] = f"{episodes['max_distance_m'].max():.0f}"
            columns.append(column)
    return ([label, *(column[label] for column in columns)] for label in columns[0])


def switched(found: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], Any]:
    """Returns what is said of flights with the filter off and on, by label and "without" or "with"."""
    ways = {"without": "off", "with": "on"}
    return {(label, way): each[key] for label, each in found.items() for way, key in ways.items()}


def of_arms(cross: Mapping[str, Mapping[str, Results]]) -> Rows:
    """Yields what `agents` does of arms flown without and with the filter."""
    return agents(switched(labelled(cross)))


def our_dependence() -> Rows:
    yield from of_arms(report("cross"))
    yield from agents({(LABELS["rta"], "with, and `keep_clear`"): read("keep_clear/keep_clear.json")})


def baselines() -> Rows:
    names = {
        "untrained": "untrained agent",
        "random": "random controls",
        "natural-motion": "guidance natural-motion",
        GUIDE: f"guidance {GUIDE}",
    }
    found = report("baselines")
    return agents(switched({label: found[name] for name, label in names.items()}))


def worlds() -> Rows:
    for plant in ("u1", "harsh"):
        flown = report("worlds")[plant]
        for arm in ARMS:
            cells = (
                f"{SUCCESS(each)}, {CLEAN(each)}, {VIOLATION(each)}, {REWARD(each)}"
                for each in flown[arm].values()
            )
            yield plant, LABELS[arm], *cells


def middle_of_cases(seeds: list[Any], name: str) -> float:
    """Returns the interquartile mean over the cases of evaluations."""
    return float(iqm(np.concatenate([seed["cases"][name] for seed in seeds])))


def evaluated(study: str, arm: str, interactions: int) -> dict[str, float]:
    """Returns means over the seeds' evaluations of an arm after so many interactions."""
    lines = read(f"{study}/{arm}/evaluations.jsonl")
    seeds = [line for line in lines if line["interactions"] == interactions]
    found = {
        name: middle_of_cases(seeds, name) for name in ("inspected_score", "delta_v_m_s", "episode_length_s")
    }
    found["success"] = 100.0 * float(np.mean([seed["outcomes"]["success"] for seed in seeds]))
    return found | {"reward": float(np.mean([seed["cases"]["reward"] for seed in seeds]))}


def learned(study: str, *times: int, among: Iterable[str] = ARMS) -> Rows:
    """Yields what the agents of a study's arms had learned after so many interactions."""
    with open(REFERENCE / study / "report/training.csv", newline="", encoding="utf-8") as file:
        found = {
            (row["interactions"], row["arm"], row["metric"]): float(row["iqm"])
            for row in csv.DictReader(file)
        }
    forms = {"inspected_score": ".2f", "reward": ".3f", "delta_v_m_s": ".2f", "episode_length_s": ",.0f"}
    for when in times:
        cells = (f"{found[f'{when}', arm, name]:{form}}" for name, form in forms.items() for arm in among)
        yield f"{when:,}", *cells


def early() -> Rows:
    trained = "{success:.1f}, {reward:.3f}, {delta_v_m_s:.2f}, {episode_length_s:,.0f}"
    forms = {0: "{inspected_score:.2f}, {success:.1f}", 294_912: trained, 507_904: trained}
    for arm in ARMS:
        yield LABELS[arm], *(form.format(**evaluated("study", arm, when)) for when, form in forms.items())


def field_trained() -> Rows:
    limits = (
        "battery",
        "attitude_exclusion",
        "dynamic_speed",
        "keep_in_zone",
        "temperature",
        "passive_safety",
    )
    for name, found in read("field/results.json")["arms"].items():
        steps, broken = found["training"]["steps"], found["training"]["violated"]
        shares = (f"{100.0 * broken[limit] / steps:.2f}" for limit in ("any", *limits))
        worst = (f"{found['training']['smallest_h'][limit]:.2g}" for limit in ("collision", "keep_in_zone"))
        yield f"`{name}`", f"{found['seeds']}", f"{broken['any']:,}", *shares, *worst


def field_flown() -> Rows:
    found = read("field/results.json")
    flown = {f"`{name}`": arm["flown"] for name, arm in found["arms"].items()}
    flown |= {f"guidance `{name}`": each for name, each in found["guidance"].items()}

    def of_seeds(name: str, form: str, factor: float = 1.0) -> Column:
        """Returns the column of [least, most] over the seeds."""

        def cell(results: Results) -> str:
            seeds = [factor * value for value in results["per_seed"][name]]
            return f"[{min(seeds):{form}}, {max(seeds):{form}}]"

        return cell

    beside = {
        SUCCESS: of_seeds("success", ".0f", 100.0),
        number("corrected_percent", ".1f"): of_seeds("corrected_percent", ".1f"),
        metric("reward", "{iqm} ({mean})"): of_seeds("reward", ".3f"),
    }
    success, corrections, reward = (
        lambda results, value=value, seeds=seeds: f"{value(results)} {seeds(results)}"
        for value, seeds in beside.items()
    )
    broken = lambda results: f"{results['violating_episodes']} of {results['episodes']:,}"  # noqa: E731
    shares = CLEAN, broken, number("violations_percent", ".3f")
    return rows(switched(flown), success, *shares, corrections, reward, TIME, FUEL)


def guidance_flown() -> Rows:
    ways = ("every 10 s, no filter", "every second, no filter", "every second, filter")
    for name, flown in read("guidance/guidance.json")["guidance"].items():
        found = {(name, way): results for way, results in zip(ways, flown.values(), strict=True)}
        counts = number("violating_episodes"), number("drifting_successes")
        means = (metric(each, "{iqm} ({mean}), {p95}") for each in ("episode_length_s", "delta_v_m_s"))
        yield from rows(found, SUCCESS, CLEAN, *counts, *means)


def papers_filter() -> Rows:
    """Yields what the paper's filter lets through: by period and controls, episodes, steps, limits, slack, unsolved."""
    for period, policy in product((1, 5, 10), POLICIES):
        found = read(f"paper_filter/{policy}_{period}s.json")
        broken = {
            name: count for name, count in found["violating_episodes"].items() if count and name != "any"
        }
        limits = [
            f"{name.replace('_', ' ')} {count:,} ({found['worst_value'][name]:.2g} {UNITS[name]})"
            for name, count in sorted(broken.items(), key=lambda item: -item[1])
        ]
        steps = 100.0 * found["violating_steps"]["any"] / found["steps"]
        slack = 100.0 * found["filter_calls"]["slack"] / calls(found)
        yield (
            *(f"{period}", policy, violating(found), f"{steps:.1f}", ", ".join(limits)),
            *(f"{slack:.1f}", f"{found['unsolved']:,}"),
        )


def flown() -> Rows:
    found = [campaign(policy) for policy in POLICIES]
    for limit, unit in UNITS.items():
        label = f"{PAPER_VIOLATIONS[limit].label} ({unit.replace('^2', '²').replace('deg ', '°')})"
        smallest = (
            f"{each['worst_value'][limit]:.3g} at {each['worst_case'][limit]['time_s']:g} s" for each in found
        )
        broken = (f"{each['violating_episodes'][limit]:,}" for each in found)
        yield label, next(broken), next(smallest), next(broken), next(smallest)
    for label, column in {
        "any: episodes violated": violating,
        "probability that an episode violates any, below": number("upper_bound_95", ".2g"),
        "calls of the filter": lambda each: f"{calls(each):,}",
        "of these unsolved": number("filter_calls/unsolved"),
        "of these with slack": number("filter_calls/slack"),
        "in which the backup decided (%)": backup,
        "states that keep every limit and are no starts": lambda each: (
            # of older reports by margins
            f"{each.get('starts_rejected', each.get('starts_rejected_by_margin')):,}"
        ),
    }.items():
        random, adversarial = map(column, found)
        yield label, random, "", adversarial, ""


def adversaries() -> Rows:
    learned = {"motion": "motion", "passive": "passive safety", "attitude": "attitude, temperature, energy"}
    names = {
        ("the model", "adversarial"): "adversarial_between",
        ("the model", "lookahead"): "lookahead",
        **{("the model", f"learned: {label}"): f"learned_{name}" for name, label in learned.items()},
        ("U1", "lookahead, 8 for two calls"): "u1_lookahead",
        **{("U1", f"learned: {label}"): f"u1_learned_{name}" for name, label in learned.items()},
    }
    found = {label: campaign(name) for label, name in names.items()}
    return campaigns(
        {(*label, f"{each['campaign']['check_every']:g}"): each for label, each in found.items()}
    )


def told_worlds() -> Rows:
    steady, worst = "U1, every error steady at a corner", "U1, the worst errors at every call"
    names = {
        (steady, "pressing"): "u1_steady_pressing",
        (steady, "adversarial"): "u1_steady_adversarial",
        (worst, "pressing"): "u1_worst_pressing",
        (worst, "adversarial"): "u1_worst_adversarial",
        (worst, "lookahead"): "u1_worst_lookahead",
        (worst, "random"): "u1_worst_random",
        ("U1, minimum impulse", "adversarial"): "u1_minimum_thrust",
        ("U1, quanta", "adversarial"): "u1_thrust_quantum",
    }
    found = {label: campaign(name) for label, name in names.items()}
    yield from campaigns(both("U1", "u1_{}") | found)


def barely() -> Rows:
    found = {
        (f"{vehicle}, {period} s", demand): read(f"measure/{prefix}barely_{demand}_{period}s.json")
        for vehicle, prefix, periods in (("the paper's", "", (1, 5, 10)), ("ESPA", "espa_", (10,)))
        for period in periods
        for demand in ("opposite", "full", "lookahead")
    }
    shares = number("moved_by_check_percent", ".2f"), number("unverified_percent", ".3g")
    return rows(found, number("calls"), *shares, number("measured/episodes"), number("broken_episodes"))


def changed() -> Rows:
    """What the filter makes of a demand, by period."""
    groups = [f"{change}_of_{group}" for change in ("change", "chatter") for group in ("thrust", "torque")]
    forms = {"corrected_percent": ".2f"} | dict.fromkeys(groups, ".4f") | {"moved_by_check_percent": ".2f"}
    for demand in ("random", "waypoints", "agent"):
        for period in (1, 5, 10):
            found = read(f"measure/{demand}_{period}s.json")
            cells = (f"{found[name]:{form}}" for name, form in forms.items())
            yield demand, f"{period}", *cells


def coasting() -> Rows:
    labels = (
        "as the paper: gravity linear, Hill's frame at rest",
        "`hill_rotation = true`",
        "Basilisk itself with J2",
        "Basilisk itself with drag",
    )
    found = read("basilisk/basilisk.json")["coasting"]
    last = [{key: values[-1] for key, values in errors.items()} for errors in found["models"].values()]
    names = {"position_m": ".2g", "position_median_m": ".2g", "attitude_deg": ".2g", "rate_rad_s": ".1g"}
    for label, error in zip(labels, [*last, *found["perturbed"].values()], strict=True):
        yield label, *(f"{error[name]:{form}}" for name, form in names.items())


def agents_in_basilisk() -> Rows:
    places = "ours", "Basilisk", "with J2 and drag", "with wheels and pulses"
    for arm, worlds in read("basilisk/basilisk.json")["agents"].items():
        for place, found in zip(places, worlds.values(), strict=True):
            cells = [number("episodes")(found), number("violating_episodes")(found)]
            cells[1:1] = [number(name, ".1f")(found) for name in ("success_percent", "clean_percent")]
            for name, digits in {"reward": 3, "episode_length_s": 0, "delta_v_m_s": 3}.items():
                apart = found["difference"][name]
                beside = f" ({apart['mean']:+.{digits}f} ± {apart['standard_error']:.{digits}f})"
                cells.append(f"{found['mean'][name]:,.{digits}f}" + (beside if place != "ours" else ""))
            yield LABELS[arm], place, *cells


def speed() -> Iterator[tuple[str, str, str]]:
    b = read("benchmark.json")

    def per_s(name: str) -> str:
        rates = b[name].values() if isinstance(b[name], dict) else [b[name]]
        return " / ".join(f"{rate:,.0f}" for rate in rates) + " per s"

    def latency(name: str) -> str:
        return f"{b[name]['median']:.3f} ms, 99 % below {b[name]['p99']:.3f} ms"

    yield "decisions of 10 s, no RTA", per_s("simulator_steps_per_s"), "53 per s"
    yield "decisions of 10 s, with RTA at 1 / 5 / 10 s", per_s("closed_loop_steps_per_s"), "8 per s at 1 s"
    yield "filter calls", per_s("filter_calls_per_s"), "2,000 to 2,600 per s"
    starts = "from the paper's starts", "from the edge of the zone", "from the paper's starts in U1"
    for where, us, (low, high) in zip(
        starts, b["random_call_us"].values(), b["min_max"]["random_call_us"].values(), strict=True
    ):
        yield f"a filter call under random demands, {where}", f"{us:.1f} µs [{low:.1f}, {high:.1f}]", ""
    yield "filter calls, with U1's bounds", per_s("told_filter_calls_per_s"), ""
    every, third = (f"{rate:,.0f}" for rate in b["paper_filter_calls_per_s"].values())
    yield "calls of the paper's filter: each has a program, every third has", f"{every} / {third} per s", ""
    yield "through Gymnasium, no RTA, NumPy / PyTorch", per_s("gymnasium_steps_per_s"), ""
    yield "one filter call alone, NumPy in and out", latency("single_filter_latency_ms"), "0.36 to 0.49 ms"
    yield "one filter call alone, with U1's bounds", latency("told_filter_latency_ms"), ""
    yield "one call of the paper's filter alone", latency("paper_filter_latency_ms"), ""
    part = f"{100 * b['learner_matmul_share']:.0f} % of the float32 matrix-product rate"
    learner = f"{per_s('learner_samples_per_s')}, {part} ({b['matmul_gflops']:.0f} Gflop/s)"
    yield "samples learned, 1,024 at once", learner, ""
    yield "peak memory, up to 65,536 episodes", f"{b['peak_memory_mb']:,.0f} MB", ""
    for name, s in b["compile_s"].items():
        yield f"to compile the {name} for the first time", f"{s:.0f} s", ""


def parts_of_a_step() -> Rows:
    labels = (
        "whole closed loop",
        "of this: the filter",
        "integration, ten substeps",
        "point visibility and k-means",
        "agent",
        "observation, rewards, constraint values, restarts",
    )
    parts = dict(zip(labels, read("benchmark.json")["closed_loop_us"].values(), strict=True))
    return rows(parts, *(number(batch, ".1f") for batch in ("256", "1024", "4096", "65536")))


def boundary() -> Rows:
    for period in (1, 5, 10):
        found = campaign("boundary", period)
        broken = f"{found['violating_draws']['any']:,} of {found['draws']:,}"
        decided = 100.0 * found["backup_calls"] / found["filter_calls"]
        yield f"{period}", broken, f"{found['upper_bound_95']:.1e}", f"{decided:.1f}"


TABLES: dict[str, Callable[[], Rows]] = {
    **{
        table.__name__: table
        for table in (
            *(front, kept, open_settings, performance, violations, our_dependence, baselines, worlds),
            *(early, field_trained, field_flown, guidance_flown, flown),
            *(
                papers_filter,
                adversaries,
                told_worlds,
                barely,
                changed,
                boundary,
                coasting,
            ),
            *(agents_in_basilisk, speed, parts_of_a_step),
        )
    },
    "papers_learning": lambda: learned(
        "our_learner", 0, 65_536, 163_840, 311_296, 507_904, 1_015_808, 3_014_656, 5_013_504
    ),
    "our_learning": lambda: learned(
        "from_nothing", 0, 114_688, 311_296, 507_904, 1_015_808, 2_015_232, 3_014_656, 5_013_504
    ),
    "our_long": lambda: learned(
        "long",
        835_584,
        2_506_752,
        5_013_504,
        10_010_624,
        20_004_864,
        30_015_488,
        40_009_728,
        50_003_968,
        among=["rta"],
    ),
    "our_longer": longer,
    "papers_hidden": lambda: hidden("our_learner"),
    "our_hidden": lambda: hidden("from_nothing"),
    "papers_dependence": lambda: of_arms(read("our_learner/report/cross.json")),
    "our_spread": lambda: spread(labelled(arms("from_nothing"))),
    "taught": lambda: spread(labelled(arms("study"))),
    "guidance_front": lambda: agents(report("front")),
    "thrifty_to_quick": lambda: agents({**arms("teachers"), GUIDE: arms("study")["rta"]}),
    "periods_of_agents": lambda: agents(report("frequency")),
    "periods_of_campaigns": lambda: campaigns(
        {(f"{s}", each): campaign(each, s) for s in (1, 5, 10) for each in (*POLICIES, "lookahead")}
    ),
    "vehicles": lambda: campaigns(
        {key: each for name, label in VEHICLES.items() for key, each in both(label, f"{name}_{{}}").items()}
    ),
    "agents_of_vehicles": lambda: agents(
        {label: arms(f"vehicles/{name}")["rta"] for name, label in VEHICLES.items()}
    ),
    "agents_of_chiefs": lambda: agents(
        {label: arms(f"chiefs/{name}")["rta"] for name, label in CHIEFS.items()}
    ),
    "beside_the_hull": lambda: campaigns({policy: campaign(f"hull_{policy}") for policy in POLICIES}),
    "in_c": lambda: campaigns(
        both("1 s", "in_c_{}") | {("U1's bounds", "random"): campaign("u1_in_c_random")}
    ),
    "campaigns_in_basilisk": lambda: campaigns(
        {policy: read(f"basilisk/u1_{policy}.json") for policy in (*POLICIES, "lookahead")}
    ),
}

if __name__ == "__main__":
    main()

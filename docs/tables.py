"""Writes the rows of the tables on the pages (README.md, docs/, experiments/) from the files in runs/reference/.

    python -m docs.tables

A comment above a table names an entry of TABLES here: `<!-- rows: vehicles -->`. The heading is the page's own.
Prose quotes no number that one of these files has: it points to a table.

An entry has lines of columns and below these lines of rows. A column is a name of COLUMNS or METRICS, or a template of
paths into results and formats: "{metrics.reward.iqm:.3f} ({metrics.reward.mean:.3f})"; "{broken/episodes:.1%}" is a
share, without its %. A row is a label and the path of its results, "label <- file:path"; where it has {name}, there are
rows of all words of AXES["name"], and where it has {}, of all keys that the file has in this place.
"""

import functools
import json
import operator
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from rta.names import UNITS
from study.files import ROOT, write_text
from study.flight.summary import iqm
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Results
from study.report.tables import of_seeds, over_seeds

REFERENCE = ROOT / "runs/reference"
PAGES = (
    "README.md",
    "experiments/learning_log.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
)
MARK = "<!-- rows:"
TABLE = re.compile(rf"(?m)^({MARK} (\w+) -->\n(?:\|.*\n){{2}})(?:\|.*\n)*")  # the mark, the heading; the rows
FIELD = re.compile(r"{([^:}]+):?([^}]*)}")  # of a template: its path, its format

Rows = Iterable[str]  # "label | cell | cell"
Column = str | Callable[[Any], str]  # a template, or how to compute a cell from results


def renewed(text: str) -> str:
    """Returns a page's text with the rows of its marked tables.

    Raises:
        ValueError: a mark names no table here, or no table follows it.
    """

    def marked(found: re.Match[str]) -> str:
        heading, name = found.groups()
        if name not in TABLES:
            raise ValueError(f"{MARK} {name} -->: docs/tables.py has no such table")
        table = TABLES[name]
        lines = rows(table) if isinstance(table, str) else table()
        return heading + "".join(f"| {line} |\n" for line in lines)

    text, count = TABLE.subn(marked, text)
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


# results


@functools.cache
def read(path: str) -> Any:
    """Returns a JSON file of runs/reference; "paper" is what the paper says of its arms."""
    if path == "paper":
        return {arm: papers(arm) for arm in ARMS}
    return json.loads((REFERENCE / f"{path}.json").read_text(encoding="utf-8"))


def papers(arm: str) -> Results:
    """Returns the paper's numbers of an arm in the form of our results, with None for those that it lacks."""
    metrics = {name: published.by_arm[arm] for name, published in PAPER_METRICS.items()}
    return {
        "metrics": {name: {"iqm": each.value, "ci95": each.interval} for name, each in metrics.items()},
        "violations_percent": {name: each.by_arm[arm].value for name, each in PAPER_VIOLATIONS.items()},
        "violations_percent_of_seconds": {"any": None},
        "outcomes": {"success": None, "clean_success": None},
    }


def campaign(name: str) -> Any:
    """Returns the results of `verify`."""
    return read(f"verification/{name}")


def at(value: Any, path: str) -> Any:
    """Returns what is under these keys, "metrics.reward.iqm"; of a list also "min" and "max", of counts "sum"."""
    for key in filter(None, path.split(".")):
        if isinstance(value, dict):
            value = sum(value.values()) if key == "sum" else value[key]
        else:
            value = {"min": min, "max": max}[key](value) if key.isalpha() else value[int(key)]
    return value


def found(line: str) -> Iterator[tuple[str, Any]]:
    """Yields the labels of a line of rows and their results; the words of its last axis change first."""
    label, path = line.split(" <- ")
    file, _, inside = path.partition(":")
    axis = re.search(r"{(\w*)}", label)
    if not axis:
        yield label, at(read(file), inside)
        return
    words = AXES[axis[1]] if axis[1] else list(at(read(file), inside.split("{}")[0]))
    for key, word in words.items() if isinstance(words, dict) else zip(words, words, strict=True):
        yield from found(line.replace(axis[0], word, 1).replace(axis[0], key))


# cells


def filled(column: Column, results: Any) -> str:
    """Returns what a column says of results; a number that is None is an empty cell."""

    def text(field: re.Match[str]) -> str:
        value = functools.reduce(operator.truediv, (at(results, path) for path in field[1].split("/")))
        return "" if value is None else format(value, field[2]).removesuffix("%")

    return FIELD.sub(text, column) if isinstance(column, str) else column(results)


def rows(table: str) -> Rows:
    """Yields the rows of a table: each label, then what the columns above it say of its results."""
    columns: list[Column] = []
    below = False  # rows
    for line in filter(None, map(str.strip, table.splitlines())):
        if " <- " in line:
            for label, results in found(line):
                yield " | ".join([label, *(filled(column, results) for column in columns)])
        else:
            columns = [*([] if below else columns), *map(column, line.split(" | "))]
        below = " <- " in line


def across(lines: Iterable[str], *results: Any) -> Rows:
    """Yields the rows of a table with templates by label: each label and what its template says of the results."""
    for line in lines:
        label, template = line.split(" | ", 1)
        yield " | ".join([label, *(filled(template, each) for each in results)])


def column(text: str) -> Column:
    """Returns the column of these words: of a metric its IQM or, after a colon, a pattern of its numbers."""
    name, _, pattern = text.partition(": ")
    if name in METRICS:
        return metric(*METRICS[name], pattern or "{iqm}")
    return text if "{" in text else COLUMNS[text]


def metric(name: str, form: str, pattern: str) -> str:
    """Returns the template of a metric's numbers in a pattern of their names."""
    return pattern.replace("{", f"{{metrics.{name}.").replace("}", f":{form}}}")


def corrected(results: Results) -> str:
    """Returns the share of the filter's calls that it corrects, in %."""
    return f"{results['rta']['intervention_percent']:.2f}" if results["rta"]["period_s"] else "-"


def over_the_seeds(name: str) -> Column:
    """Returns the column of a metric's IQM [its interval over seeds], mean."""

    def cell(results: Results) -> str:
        key, form = METRICS[name]
        low, high = over_seeds(results, key)
        return filled(metric(key, form, f"{{iqm}} [{low:{form}}, {high:{form}}], {{mean}}"), results)

    return cell


def backup(results: Any) -> str:
    """Returns the share of a campaign's calls in which the backup decided, in %."""
    percent = 100.0 * results["backup_calls"] / sum(results["filter_calls"].values())
    return f"{percent:.1f}" if percent >= 10.0 else f"{percent:.2g}"


def broken(results: Any) -> str:
    """Returns the limits that a campaign broke, with their episodes and worst h."""
    counts = sorted(results["violating_episodes"].items(), key=lambda item: -item[1])
    return ", ".join(
        f"{name.replace('_', ' ')} {count:,} ({results['worst_value'][name]:.2g} {UNITS[name]})"
        for name, count in counts
        if count and name != "any"
    )


ARMS = {"no_rta": "without RTA", "rta": "with RTA"}
AXES: dict[str, Any] = {  # the words of a path, and others in their place in a label
    "arm": ARMS,
    "way": {"off": "without", "on": "with"},
    "policy": ("random", "adversarial"),
    "any_policy": ("random", "adversarial", "lookahead"),
    "worst": ("pressing", "adversarial", "lookahead", "random"),
    "barely": ("opposite", "full", "lookahead"),
    "demand": ("random", "waypoints", "agent"),
    "s": ("1", "5", "10"),
    "later": ("5", "10"),
    "far": ("1", "10"),
    "pushing": ("adversarial", "pressing"),
    "learned": {"motion": "motion", "passive": "passive safety", "attitude": "attitude, temperature, energy"},
    "vehicle": {"3u": "3U, 4 kg", "12u": "12U, 20 kg", "espa": "ESPA-class, 180 kg"},
    "decides": {
        "teaching": "every 10 s, no filter",
        "with": "every second, filter",
    },
}
METRICS = {  # by name: its key and format
    "score": ("inspected_score", ".2f"),
    "reward": ("reward", ".3f"),
    "fuel": ("delta_v_m_s", ",.2f"),
    "time": ("episode_length_s", ",.0f"),
    "torque": ("torque_n_m", ".4f"),
}
COLUMNS: dict[str, Column] = {
    "success": "{outcomes.success:.1%}",
    "clean": "{outcomes.clean_success:.1%}",
    "violation": "{violations_percent.any:.3f}",
    "corrected": corrected,
    "violating": "{violating_episodes.any:,} of {episodes:,}",
    "probability": "{upper_bound_95:.2g}",
    "zone": "{worst_value.keep_in_zone:.3f}",
    "PSM": "{worst_value.passive_safety:.2f}",
    "slack": "{filter_calls.slack:,}",
    "backup": backup,
    "broken": broken,
    "worst seed": lambda results: f"{min(of_seeds(results, 'reward')):.3f}",
    **{f"{name} over seeds": over_the_seeds(name) for name in ("reward", "time", "fuel")},
    # with the filter off, on without bounds, on with U1's bounds
    **{
        way: "{W.outcomes.success:.1%}, {W.outcomes.clean_success:.1%}, {W.violations_percent.any:.3f}, "
        "{W.metrics.reward.iqm:.3f}".replace("W.", f"{way}.")
        for way in ("off", "nominal", "robust")
    },
    # of flights in Basilisk
    "flights": "{episodes:,} | {success_percent:.1f} | {clean_percent:.1f} | {violating_episodes:,}",
    "means": "{mean.reward:,.3f} | {mean.episode_length_s:,.0f} | {mean.delta_v_m_s:,.3f}",
    "means apart": " | ".join(
        f"{{mean.{name}:,{form}}} ({{difference.{name}.mean:+{form}}} ± {{difference.{name}.standard_error:{form}}})"
        for name, form in {"reward": ".3f", "episode_length_s": ".0f", "delta_v_m_s": ".3f"}.items()
    ),
}
AGENTS = "success | clean | violation | corrected | reward | time | fuel\n"
CAMPAIGNS = "violating | probability | zone | PSM | slack | backup\n"
SPREAD = """
    clean | violation | reward over seeds | worst seed
    time over seeds | time: {p5} to {p95}, {max} | fuel over seeds | fuel: {p5} to {p95}, {max}
    """


# tables


def kept() -> Rows:
    """Yields the episodes with a violation and the calls of the filter, of several campaigns together."""
    table = """
        every second, random and adversarial controls <- verification/{policy}
        every 5 or 10 s, random and adversarial <- frequency/{policy}_{later}s
        every 1, 5 or 10 s, an adversary that looks ahead <- verification/lookahead <- frequency/lookahead_{later}s
        every second, all errors at once, drawn anew each second, their bounds given <- verification/u1_{policy}
        the same in Basilisk, also against an adversary that looks ahead <- basilisk/u1_{any_policy}
    """
    for line in table.strip().splitlines():
        label, *paths = line.strip().split(" <- ")
        flown = [results for path in paths for _, results in found(f"{path} <- {path}")]
        numbers = "violating_episodes.any", "episodes", "filter_calls.sum"
        broken, episodes, calls = (sum(at(each, path) for each in flown) for path in numbers)
        yield f"{label} | {broken:,} of {episodes:,} | {calls / 1e6:,.1f} million"


def open_settings() -> Rows:
    """Yields what the paper's agents without RTA fly, then those with one setting of the learner each, once flown."""
    yield from rows("""
        success | violation | reward | time | fuel | torque
        *the paper's agents* <- paper:no_rta""")
    columns = "success | violation" + "".join(
        f" | {name}: {{iqm}} ({{mean}})" for name in ("reward", "time", "fuel", "torque")
    )
    for arm, label in {
        "base": "nothing: a standard deviation of 0.1 at the start",
        "std_003": "0.03 at the start",
        "std_03": "0.3 at the start",
        "std_1": "1 at the start, at most e, and a tanh on the log standard deviation, too",
        "no_kl": "no penalty on the divergence of an update",
        "annealed": "a rate that falls to 0",
        "faster": "a rate of 3e-4",
        "linear": "no tanh on the outputs",
        "episodes": "5 episodes by 300 decisions in a batch",
        "scales": "our scales of the observations",
    }.items():
        if arm in read("learner/results")["arms"]:
            yield from rows(f"{columns}\n{label} <- learner/results:arms.{arm}")


def papers_study() -> dict[str, Results]:
    """Returns the agents with the settings of the paper's authors: without RTA, and with the paper's filter."""
    return {"no_rta": read("learner/results")["arms"]["base"], "rta": read("paper/results")["arms"]["rta"]}


def beside_the_paper(lines: Iterable[str], arms: dict[str, Results]) -> Rows:
    """Returns a row for each template: of each arm our number, then the paper's of the arms that it has."""
    columns = []
    for arm, results in arms.items():
        columns += [results, papers(arm)] if arm in ARMS else [results]
    return across(lines, *columns)


def hidden(study: str) -> Rows:
    """Yields counts over all episodes of a study's arms."""
    columns = []
    for arm in read(f"{study}/results")["arms"]:
        with np.load(REFERENCE / study / arm / "episodes.npz") as episodes:
            metrics = dict(zip(episodes["metric_names"], episodes["metrics"], strict=True))
            violated = dict(zip(episodes["constraint_names"], episodes["violation_seconds"], strict=True))
            succeeded = episodes["outcome"] == list(episodes["outcome_names"]).index("success")
            far, drifts = episodes["max_distance_m"], ~episodes["clear"]
        drift = "succeed, but would drift into the chief within two days if thrust stopped at the end"
        columns.append(
            {
                drift: f"{(succeeded & drifts).sum():,}",
                "violate a limit in some second": f"{(violated['any'] > 0.0).sum():,}",
                "last longer than 4,500 s": f"{(metrics['episode_length_s'] > 4500.0).sum():,}",
                "come within 1 m of the zone's edge, 800 m out, or leave it": f"{(far > 799.0).sum():,}",
                "most delta v (m/s)": f"{metrics['delta_v_m_s'].max():.2f}",
                "farthest from the chief (m)": f"{far.max():.0f}",
            }
        )
    return (" | ".join([label, *(column[label] for column in columns)]) for label in columns[0])


def early() -> Rows:
    """Yields what the taught agents fly before the lessons, after them and at the end."""
    trained = "{success:.1%}, {reward:.3f}, {delta_v_m_s:.2f}, {episode_length_s:,.0f}"
    columns = {0: "{inspected_score:.2f}, {success:.1%}", 294_912: trained, 507_904: trained}
    for arm, label in ARMS.items():
        text = (REFERENCE / f"study/{arm}/evaluations.jsonl").read_text(encoding="utf-8")
        lines = [json.loads(line) for line in text.splitlines()]
        cells = []
        for when, template in columns.items():
            seeds = [line for line in lines if line["interactions"] == when]
            keys = "inspected_score", "reward", "delta_v_m_s", "episode_length_s"
            cases = {key: np.concatenate([seed["cases"][key] for seed in seeds]) for key in keys}
            numbers = {key: iqm(values) for key, values in cases.items()} | {"reward": cases["reward"].mean()}
            success = np.mean([seed["outcomes"]["success"] for seed in seeds])
            cells.append(filled(template, numbers | {"success": success}))
        yield " | ".join([label, *cells])


def flown() -> Rows:
    """Returns what campaigns of random and of adversarial controls flew: by limit, then of all."""
    of_limit = "{violating_episodes.LIMIT:,} | {worst_value.LIMIT:.3g} at {worst_case.LIMIT.time_s:g} s"
    lines = []
    for limit, unit in UNITS.items():
        label = f"{PAPER_VIOLATIONS[limit].label} ({unit.replace('^2', '²').replace('deg ', '°')})"
        lines.append(f"{label} | {of_limit.replace('LIMIT', limit)}")
    lines += [
        "calls of the filter | {filter_calls.sum:,} | ",
        "of these unsolved | {filter_calls.unsolved:,} | ",
        "states within all limits that are no starts | {starts_rejected:,} | ",
    ]
    return across(lines, *map(campaign, AXES["policy"]))


LATENCY = "{NAME_latency_ms.median:.3f} ms, 99 % below {NAME_latency_ms.p99:.3f} ms"
RANDOM = "{random_call_us.NAME:.1f} µs [{min_max.random_call_us.NAME.0:.1f}, {min_max.random_call_us.NAME.1:.1f}] | "
SPEED = (
    "decisions of 10 s, no RTA | {simulator_steps_per_s:,.0f} per s | 53 per s",
    "decisions of 10 s, with RTA at 1 / 5 / 10 s | {closed_loop_steps_per_s.1:,.0f}"
    " / {closed_loop_steps_per_s.5:,.0f} / {closed_loop_steps_per_s.10:,.0f} per s | 8 per s at 1 s",
    "filter calls | {filter_calls_per_s:,.0f} per s | 2,000 to 2,600 per s",
    "a filter call under random controls, from the paper's starts | " + RANDOM.replace("NAME", "paper"),
    "a filter call under random controls, from the edge of the zone | " + RANDOM.replace("NAME", "edge"),
    "a filter call under random controls, from the paper's starts in U1 | " + RANDOM.replace("NAME", "u1"),
    "filter calls, with U1's bounds | {told_filter_calls_per_s:,.0f} per s | ",
    "calls of the paper's filter: each has a program, every third has"
    " | {paper_filter_calls_per_s.every:,.0f} / {paper_filter_calls_per_s.third:,.0f} per s | ",
    "through Gymnasium, no RTA, NumPy / PyTorch"
    " | {gymnasium_steps_per_s.numpy:,.0f} / {gymnasium_steps_per_s.torch:,.0f} per s | ",
    f"one filter call alone, NumPy in and out | {LATENCY.replace('NAME', 'single_filter')} | 0.36 to 0.49 ms",
    f"one filter call alone, with U1's bounds | {LATENCY.replace('NAME', 'told_filter')} | ",
    f"one call of the paper's filter alone | {LATENCY.replace('NAME', 'paper_filter')} | ",
    "samples learned, 1,024 at once | {learner_samples_per_s:,.0f} per s, {learner_matmul_share:.0%} % of the"
    " float32 matrix-product rate ({matmul_gflops:.0f} Gflop/s) | ",
    "peak memory, up to 65,536 episodes | {peak_memory_mb:,.0f} MB | ",
    "to compile for the first time: the filter, with [uncertainty], the simulator | {compile_s.filter:.0f} s,"
    " {compile_s.filter with [uncertainty]:.0f} s, {compile_s.simulator:.0f} s | ",
)

IN_BASILISK = """
    flights | means
    {label} | ours <- basilisk/basilisk:agents.{arm}.own
    flights | means apart
    {label} | Basilisk <- basilisk/basilisk:agents.{arm}.basilisk
    {label} | with J2 and drag <- basilisk/basilisk:agents.{arm}.basilisk, J2 and drag
    {label} | with wheels and pulses <- basilisk/basilisk:agents.{arm}.basilisk, wheels and pulses
    """
TABLE_2 = [
    *(
        f"{each.label} | {metric(name, f'.{each.digits}f', '{iqm} [{ci95.0}, {ci95.1}]')}"
        for name, each in PAPER_METRICS.items()
    ),
    "Success (%) | {outcomes.success:.1%}",
    "Clean success (%) | {outcomes.clean_success:.1%}",
    "Any violation (mean % of steps) | {violations_percent.any:.3f}",
    "Any violation (mean % of seconds) | {violations_percent_of_seconds.any:.3f}",
]
TABLE_3 = [
    f"{each.label} | {{violations_percent.{name}:.3f}}"
    for name, each in PAPER_VIOLATIONS.items()
    if not name.startswith("angular_velocity")  # never violated
]

TABLES: dict[str, str | Callable[[], Rows]] = {
    "front": """
        success | clean | violation | reward | time | fuel
        *the paper's agents {arm}* <- paper:{arm}
        the paper's settings, 1 million interactions, without RTA <- learner/results:arms.base
        the paper's settings, 1 million interactions, with the paper's filter <- paper/results:arms.rta
        our learner, the paper's task, without RTA <- our_learner/results:arms.no_rta
        our learner, the paper's task, with our filter <- our_learner/results:arms.rta
        ours, from nothing, without RTA <- from_nothing/results:arms.no_rta
        ours, from nothing, with our filter <- from_nothing/results:arms.rta
        agents taught by the guidance, with our filter <- study/results:arms.rta
        classical guidance with our filter <- from_nothing/report/baselines:quick.on
    """,
    "kept": kept,
    "open_settings": open_settings,
    "performance": lambda: beside_the_paper(
        TABLE_2[: len(PAPER_METRICS)], read("our_learner/results")["arms"]
    ),
    "violations": lambda: beside_the_paper(TABLE_3, read("our_learner/results")["arms"]),
    "papers_study": lambda: beside_the_paper(
        [*TABLE_2, *(TABLE_3[limit] for limit in (1, 2, 3, 4, 8))],  # those that our agents violate
        papers_study(),
    ),
    "papers_hidden": lambda: hidden("our_learner"),
    "papers_dependence": AGENTS
    + """
        {arm} | {way} <- our_learner/report/cross:{arm}.{way}
        with RTA every {later} s | {way} <- our_learner/report/cross:rta_{later}s.{way}
    """,
    "our_dependence": AGENTS
    + """
        {arm} | {way} <- from_nothing/report/cross:{arm}.{way}
        with RTA | with, and `keep_clear` <- keep_clear/keep_clear
    """,
    "our_spread": SPREAD + "{arm} <- from_nothing/results:arms.{arm}",
    "taught": SPREAD + "{arm} <- study/results:arms.{arm}",
    "our_longer": """
        success | clean | reward: {iqm}, {mean} | time: {iqm}, {p5} to {p95}, {max} | fuel: {iqm}, {p5} to {p95}, {max}
        10 seeds, 5 million <- from_nothing/results:arms.rta
        1 seed, 50 million <- long/results:arms.rta
    """,
    "guidance_front": AGENTS + "{} <- from_nothing/report/front:{}",
    "baselines": AGENTS
    + """
        untrained agent | {way} <- from_nothing/report/baselines:untrained.{way}
        random controls | {way} <- from_nothing/report/baselines:random.{way}
        guidance natural-motion | {way} <- from_nothing/report/baselines:natural-motion.{way}
    """,
    "worlds": """
        off | nominal | robust
        u1 | {arm} <- from_nothing/report/worlds:u1.{arm}
        harsh | {arm} <- from_nothing/report/worlds:harsh.{arm}
    """,
    "early": early,
    "periods_of_agents": AGENTS + "{} <- from_nothing/report/frequency:{}",
    "thrifty_to_quick": AGENTS
    + """
        {} <- teachers/results:arms.{}
        quick <- study/results:arms.rta
    """,
    "agents_of_vehicles": AGENTS + "{vehicle} <- vehicles/{vehicle}/results:arms.rta",
    "agents_of_chiefs": AGENTS
    + """
        box between panels, fixed <- chiefs/box/results:arms.rta
        satellite, tumbling <- chiefs/satellite/results:arms.rta
    """,
    "guidance_flown": """
        success | clean | {violating_episodes:,} | {drifting_successes:,}
        time: {iqm} ({mean}), {p95} | fuel: {iqm} ({mean}), {p95}
        {} | {decides} <- guidance/guidance:guidance.{}.{decides}
    """,
    "field_trained": """
        {seeds} | {training.violated.any:,}
        {training.violated.any/training.steps:.2%} | {training.violated.battery/training.steps:.2%}
        {training.violated.attitude_exclusion/training.steps:.2%} | {training.violated.dynamic_speed/training.steps:.2%}
        {training.violated.keep_in_zone/training.steps:.2%} | {training.violated.temperature/training.steps:.2%}
        {training.violated.passive_safety/training.steps:.2%}
        {training.smallest_h.collision:.2g} | {training.smallest_h.keep_in_zone:.2g}
        `{}` <- field/results:arms.{}
    """,
    "field_flown": """
        {outcomes.success:.1%} [{per_seed.success.min:.0%}, {per_seed.success.max:.0%}] | clean
        {violating_episodes} of {episodes:,} | {violations_percent:.3f}
        {corrected_percent:.1f} [{per_seed.corrected_percent.min:.1f}, {per_seed.corrected_percent.max:.1f}]
        {metrics.reward.iqm:.3f} ({metrics.reward.mean:.3f}) [{per_seed.reward.min:.3f}, {per_seed.reward.max:.3f}]
        time | fuel
        `{}` | {way} <- field/results:arms.{}.flown.{way}
    """,
    "papers_filter": """
        violating | {violating_steps.any/steps:.1%} | broken | {filter_calls.slack/filter_calls.sum:.1%} | {unsolved:,}
        {s} | {policy} <- paper_filter/{policy}_{s}s
    """,
    "flown": flown,
    "periods_of_campaigns": CAMPAIGNS
    + """
        1 | {any_policy} <- verification/{any_policy}
        {later} | {any_policy} <- frequency/{any_policy}_{later}s
    """,
    "adversaries": """
        {campaign.check_every:g} | violating | probability | zone | PSM | slack | backup
        the model | adversarial <- verification/adversarial_between
        the model | lookahead <- verification/lookahead
        the model | learned: {learned} <- verification/learned_{learned}
        U1 | lookahead, 8 for two calls <- verification/u1_lookahead
        U1 | learned: {learned} <- verification/u1_learned_{learned}
    """,
    "told_worlds": CAMPAIGNS
    + """
        U1 | {policy} <- verification/u1_{policy}
        U1, every error steady at a corner | pressing <- verification/u1_steady_pressing
        U1, every error steady at a corner | adversarial <- verification/u1_steady_adversarial
        U1, the worst errors at every call | {worst} <- verification/u1_worst_{worst}
        U1, smallest thrust | adversarial <- verification/u1_minimum_thrust
        U1, quanta | adversarial <- verification/u1_thrust_quantum
    """,
    "vehicles": CAMPAIGNS + "{vehicle} | {policy} <- verification/{vehicle}_{policy}",
    "beside_the_hull": CAMPAIGNS + "{policy} <- verification/hull_{policy}",
    "in_c": CAMPAIGNS
    + """
        1 s | {policy} <- verification/in_c_{policy}
        U1's bounds | random <- verification/u1_in_c_random
    """,
    "campaigns_in_basilisk": CAMPAIGNS + "{any_policy} <- basilisk/u1_{any_policy}",
    "next_to_limits": """
        {violating_episodes.any:,} of {episodes:,} | {upper_bound_95:.1e} | {backup_calls/filter_calls.sum:.1%}
        1 | {pushing} <- verification/limits_{pushing}
        {later} | adversarial <- frequency/limits_{later}s
    """,
    "barely": """
        {calls:,} | {moved_by_check_percent:.2f} | {unverified_percent:.3g}
        {measured.episodes:,} | {broken_episodes:,}
        the paper's, {s} s | {barely} <- measure/barely_{barely}_{s}s
        ESPA, 10 s | {barely} <- measure/espa_barely_{barely}_10s
    """,
    "changed": """
        {corrected_percent:.2f} | {change_of_thrust:.4f} | {change_of_torque:.4f}
        {chatter_of_thrust:.4f} | {chatter_of_torque:.4f} | {moved_by_check_percent:.2f}
        {demand} | {far} <- measure/{demand}_{far}s
    """,
    "coasting": """
        {position_m.-1:.2g} | {position_median_m.-1:.2g} | {attitude_deg.-1:.2g} | {rate_rad_s.-1:.1g}
        as the paper: gravity linear, Hill's frame at rest <- basilisk/basilisk:coasting.models.as the paper
        `hill_rotation = true` <- basilisk/basilisk:coasting.models.and Hill's frame turns
        {position_m:.2g} | {position_median_m:.2g} | {attitude_deg:.2g} | {rate_rad_s:.1g}
        Basilisk itself with {} <- basilisk/basilisk:coasting.perturbed.{}
    """,
    "agents_in_basilisk": "".join(IN_BASILISK.format(arm=arm, label=label) for arm, label in ARMS.items()),
    "speed": lambda: across(SPEED, read("benchmark")),
}

if __name__ == "__main__":
    main()

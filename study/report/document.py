"""The study's report: one self-contained page with every table and figure, and links to the files behind them."""

import shlex
from html import escape
from pathlib import Path

import numpy as np

from study.config import ARMS
from study.errors import refusing
from study.files import write_text
from study.flight.figures import Episode, effort
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS
from study.report import figures as report_figures
from study.report import inputs as report_inputs
from study.report import page
from study.report.figures import ARM_LABELS, TRAINING
from study.report.html_tables import (
    PAPER,
    PAPER_PERCENT,
    evaluations,
    metric,
    percent,
    success,
    table_2,
    table_3,
)
from study.report.inputs import Inputs, Results

TITLE = "Run-time-assured reinforcement learning for spacecraft inspection: the study"
AGENTS = {"no_rta": "agents trained without RTA", "rta": "agents trained with RTA"}
# what the files below a study's directory hold, by the command that writes them
STUDY_FILES = {
    "settings, revision and device": ("config.toml", "provenance.json"),
    "final evaluation, all seeds together and each alone": ("results.json", "*/results.json"),
    "its episodes": ("*/episodes.npz",),
    "evaluations during training": ("*/evaluations.jsonl",),
    "agents": ("*/seed*/policy.pt",),
}
REPORT_FILES = {
    "Tables 2 and 3": ("report/table*.csv",),
    "classical guidance": ("report/guidance.json",),
    "earliest success that the Sun allows": ("report/sunlight.json",),
    "training curves": ("report/training.csv", "report/training*.png", "report/training*.svg"),
    "common episode": (
        "report/episode_*.npz",
        "report/trajectory_*.png",
        "report/behaviour.*",
        "report/constraints_*.png",
    ),
    "demonstration": ("report/demonstration_*",),
    "filter every 1, 5 and 10 s": ("report/frequency.*",),
    "filter off and on": ("report/cross.*",),
    "wall-clock time": ("report/throughput.*",),
}


def write(study: Path) -> None:
    """Writes `report.html` and its figures from a study's files.

    Raises:
        InputError: a file is missing or damaged, or nothing can be written there.
    """
    inputs = report_inputs.read(study)
    with refusing(f"--study {study}: cannot write its report", OSError):
        report_figures.draw(inputs, study / "report")
        write_text(study / "report.html", document(inputs))


def document(inputs: Inputs) -> str:
    """The whole page; its figures have been drawn."""
    sections = {
        "tables": ("Final performance (Tables 2 and 3)", final_performance),
        "training": ("Training performance", training_performance),
        "episode": ("One initial condition, both agents", example_episode),
        "demonstration": ("The filter alone: LQR and PD against every limit", demonstration),
        "frequency": ("How often the filter is called", frequency),
        "cross": ("Each agent with the filter off and on", cross_evaluation),
        "speed": ("Wall-clock time and throughput", throughput),
        "files": ("Files, and how to make them again", files),
    }
    contents = "\n".join(f'<a href="#{name}">{escape(title)}</a>' for name, (title, _) in sections.items())
    missing = [
        page.missing(f"This study has no arm {arm}: what it would show is missing below.")
        for arm in inputs.missing_arms
    ]
    body = [page.section(name, title, *show(inputs)) for name, (title, show) in sections.items()]
    return page.page(TITLE, "\n".join((*summary(inputs), *missing, f"<nav>{contents}</nav>", *body)))


def summary(inputs: Inputs) -> list[str]:
    """The headline and a paragraph, in numbers."""
    headline = "; ".join(
        f"{AGENTS[arm]} violate a constraint in {percent(results['violations_percent']['any'])} % of their steps "
        f"(paper: {PAPER_PERCENT['any'][arm]} %)"
        for arm, results in inputs.arms.items()
    )
    text = [arm_summary(arm, results) for arm, results in inputs.arms.items()]
    if inputs.guidance:
        text.append(
            f"A classical guidance law behind the filter succeeds in {success(inputs.guidance)} % of "
            f"{inputs.guidance['episodes']:,} cases with a delta v of {metric(inputs.guidance, 'delta_v_m_s')} m/s "
            f"and a reward of {metric(inputs.guidance, 'reward')}."
        )
    return [
        f'<p class="lead">{escape(f"In the final evaluation {headline}.")}</p>',
        page.paragraph(" ".join(text)),
    ]


def arm_summary(arm: str, results: Results) -> str:
    """An arm's final performance beside the paper's."""
    seeds = len(results["seeds"])
    values = ", ".join(
        f"{text} {metric(results, name)}{unit} (paper: {PAPER[name][arm][0]:.{PAPER_METRICS[name][1]}f}{unit})"
        for name, text, unit in (
            ("reward", "a reward of", ""),
            ("episode_length_s", "a length of", " s"),
            ("delta_v_m_s", "a delta v of", " m/s"),
            ("torque_n_m", "a torque of", " N m"),
        )
    )
    return (
        f"The {AGENTS[arm]}, {seeds} {'seed' if seeds == 1 else 'seeds'} of "
        f"{1e-6 * results['interactions']:.3g} million interactions each, succeed in {success(results)} % of "
        f"{results['episodes']:,} episodes ({results['episodes'] // seeds} common test cases), with "
        f"{values} in the interquartile mean."
    )


def final_performance(inputs: Inputs) -> list[str]:
    """Tables 2 and 3 with the paper's columns and the classical guidance."""
    groups = [(ARM_LABELS[arm], 3) for arm in inputs.arms]
    columns = ["ours", "paper", "difference"] * len(inputs.arms)
    if inputs.guidance:
        groups.append(("classical guidance, RTA", 1))
        columns.append(f"{inputs.guidance['episodes']:,} cases")
    parts = [
        page.table("Table 2: interquartile mean and 95 % interval", ["", *columns], table_2(inputs), groups),
        page.paragraph(
            "Difference: ours less the paper's, bold where the two intervals do not overlap. Our intervals of an arm "
            "are stratified bootstraps over seeds and cases (Agarwal et al. 2021)."
        ),
        page.table(
            "Table 3: mean safety violation, % of an episode's steps", ["", *columns], table_3(inputs), groups
        ),
        page.paragraph(
            "A step violates a constraint if the constraint's h is negative at its end, every 10 s, without margin."
        ),
    ]
    if inputs.sunlight:
        earliest = inputs.sunlight["earliest_success_s"]
        low, high = earliest["ci95"]
        parts.append(
            page.paragraph(
                "A point counts only while the Sun lights it. In these test cases the points lit so far first weigh "
                f"enough for success after {earliest['iqm']:.0f} s [{low:.0f}, {high:.0f}], whatever one does: no "
                "agent that always succeeds can need less in the interquartile mean."
            )
        )
    if inputs.guidance:
        parts.append(
            page.paragraph(
                "Classical guidance: a proportional-derivative law towards the relative ellipse that turns with the "
                "Sun, a natural motion which costs next to no fuel, with the camera on the chief, behind the filter. "
                "It shows how far the agents' fuel is from what the task needs."
            )
        )
    else:
        parts.append(page.missing("The classical guidance has not been evaluated for this study."))
    return parts


def training_performance(inputs: Inputs) -> list[str]:
    """The six training figures."""
    if not inputs.training:
        return [page.missing("No evaluation during training: it was shorter than the interval between two.")]
    train = inputs.config.train
    return [
        page.paragraph(
            f"Every {train.evaluation_interval:,} interactions the agents played {train.evaluation_episodes} common "
            "test cases with deterministic actions, in the configuration of their training. Lines are interquartile "
            "means over seeds and cases, bands their 95 % intervals. Thin dotted lines are the paper's final values "
            "(Table 2; for the violations, whose interquartile mean the paper does not print, the mean of Table 3)."
        ),
        page.grid(*(training_figure(inputs, name) for name in TRAINING)),
    ]


def training_figure(inputs: Inputs, name: str) -> str:
    """One training figure."""
    label, digits, *paper = TRAINING[name]
    published = dict(zip(ARMS, paper, strict=True))
    ends = "; ".join(
        f"{ARM_LABELS[arm]} ends at {rows[-1, 1]:.{digits}f} (paper: {published[arm]:.{digits}f})"
        for arm, rows in inputs.training[name].items()
    )
    return page.figure(
        inputs.study / "report" / f"training_{name}.svg",
        f"Line plot of {label} over interactions. {ends}.",
        f"{label}: {ends}.",
    )


def example_episode(inputs: Inputs) -> list[str]:
    """One common test case under the first seed of each arm."""
    if not inputs.episodes:
        return [page.missing("No episode has been simulated for this study.")]
    report = inputs.study / "report"
    paths = [
        page.figure(
            report / f"trajectory_{arm}.png",
            f"3-D path of the deputy around the chief, {ARM_LABELS[arm]}.",
            f"{ARM_LABELS[arm]}: {outcome(inputs, arm)}",
        )
        for arm in inputs.episodes
    ]
    limits = [
        constraint_panels(
            report / f"constraints_{arm}.png", f"{ARM_LABELS[arm]}, the same episode. {violated(episode)}"
        )
        for arm, episode in inputs.episodes.items()
    ]
    return [
        page.paragraph(
            "The first seed's agent of each arm from the first common test case, each in the configuration of its "
            "training. Path coloured by speed (light is slow), grey points are the chief, blue arrows the camera's "
            "direction, orange lines the Sun at the start (solid) and at the end (dashed)."
        ),
        page.grid(*paths),
        page.figure(
            report / "behaviour.svg",
            "Four line plots over time: inspected weight, dot product of boresight and direction to the chief, "
            "delta v used and torque used.",
            "The same two episodes over time in s, with a marker at the end of each. Inspected weight: success at the "
            "dashed line. Dot product of the camera's boresight and the direction to the chief: 1 where the camera "
            "points at it. Delta v (m/s) and torque (N m) are accumulated as in Table 2.",
            wide=True,
        ),
        *limits,
    ]


def outcome(inputs: Inputs, arm: str) -> str:
    """How an arm's episode ended."""
    episode = inputs.episodes[arm]
    delta_v, torque = effort(episode, inputs.config.inspection)
    return (
        f"after {episode['time'][-1]:.0f} s a weight of {episode['inspected_score'][-1]:.4f} is inspected, with "
        f"{delta_v[-1]:.3f} m/s of delta v and {torque[-1]:.4f} N m of torque."
    )


def violated(episode: Episode) -> str:
    """The constraints that an episode violates at some row, with their share of its time."""
    shares = {name[2:]: 100.0 * np.mean(h < 0.0) for name, h in episode.items() if name.startswith("h_")}
    broken = [f"{PAPER_VIOLATIONS[name][0]} {percent(share)} %" for name, share in shares.items() if share]
    return f"Violated, in % of the time: {', '.join(broken)}." if broken else "No constraint is violated."


def constraint_panels(path: Path, caption: str) -> str:
    """The nine panels of the paper's constraint figures."""
    return page.figure(
        path,
        "Nine plots over time: distance, speed, velocity, Sun angle, temperature, energy, body rates, thrust and "
        f"torque, with their limits. {caption}",
        f"{caption} Green is safe, red is not, dotted lines are the limits; the orange line in (a) is the nearest "
        "point of the next 500 s if thrust were cut off.",
        wide=True,
    )


def demonstration(inputs: Inputs) -> list[str]:
    """The paper's demonstration of the filter."""
    if not inputs.demonstrations:
        return [page.missing("The demonstration has not been simulated for this study.")]
    report = inputs.study / "report"
    return [
        page.paragraph(
            "A linear-quadratic regulator for the translation and a proportional-derivative law for the attitude head "
            "for every limit in turn. A simulation goes on after a crash and with an empty battery."
        ),
        *(
            constraint_panels(report / f"demonstration_{arm}.png", f"{ARM_LABELS[arm]}. {violated(episode)}")
            for arm, episode in reversed(inputs.demonstrations.items())
        ),
    ]


def frequency(inputs: Inputs) -> list[str]:
    """The filter at 1, 5 and 10 s."""
    if not inputs.frequency:
        return [page.missing("Only agents trained with RTA are flown at other periods; this study has none.")]
    rows = {f"every {period} s": results for period, results in inputs.frequency.items()}
    return [
        evaluations("The agents trained with RTA, by the period of the filter", "filter called", rows),
        page.paragraph(
            f"All were trained with the filter called every {inputs.config.train.rta_period:g} s; "
            "interquartile means with 95 % intervals, violations and success as means."
        ),
    ]


def cross_evaluation(inputs: Inputs) -> list[str]:
    """Whether an agent has come to depend on the filter."""
    if not inputs.cross:
        return [page.missing("The agents have not been flown with the filter off and on for this study.")]
    rows = {
        f"{ARM_LABELS[arm]}, filter {switch}": results
        for arm, switches in inputs.cross.items()
        for switch, results in switches.items()
    }
    changes = [
        f"The {AGENTS[arm]} succeed in {success(switches['off'])} % without the filter and in "
        f"{success(switches['on'])} % with it, and violate a constraint in "
        f"{percent(switches['off']['violations_percent']['any'])} % and "
        f"{percent(switches['on']['violations_percent']['any'])} % of steps."
        for arm, switches in inputs.cross.items()
    ]
    return [
        page.paragraph(" ".join(changes)),
        evaluations("All seeds on the common test cases", "trained with, flown with", rows),
        page.figure(
            inputs.study / "report" / "cross.svg",
            "Dot plots of violation, success, reward and delta v for each arm with the filter off and on.",
            "Filter off (hollow) and on (filled) by arm: violation in % of steps, success in % of episodes, reward, "
            "and delta v in m/s, little where episodes end early; bars are 95 % intervals of interquartile means.",
            wide=True,
        ),
    ]


def throughput(inputs: Inputs) -> list[str]:
    """What training took."""
    return [
        page.table(
            "Training, rollouts and updates of all seeds of an arm together",
            [
                "",
                "seeds",
                "interactions of each",
                "wall-clock (s)",
                "interactions of all per s",
                "device",
                "ranks",
                "threads of each",
            ],
            [
                [
                    ARM_LABELS[arm],
                    str(row["seeds"]),
                    f"{row['interactions']:,}",
                    f"{row['wall_clock_s']:,.0f}",
                    f"{row['interactions_per_s']:,.0f}",
                    escape(row["device"]),
                    str(row["ranks"]),
                    str(row["threads"]),
                ]
                for arm, row in inputs.throughput.items()
            ],
        ),
        page.paragraph("An interaction is one step of an agent, 10 s of one episode."),
    ]


def files(inputs: Inputs) -> list[str]:
    """Links to everything behind the page, and the commands that write it."""
    study = shlex.quote(inputs.study.as_posix())
    first = inputs.config.train.seed
    single = [
        f"python main.py evaluate --checkpoint {study}/{arm}/seed{first}/policy.pt --{other} --json evaluation.json"
        for arm, other in (("no_rta", "rta"), ("rta", "no-rta"))
        if arm in inputs.arms
    ]
    single += [
        f"python main.py simulate --controller lqr-pd --{switch} --rta-period {inputs.config.train.rta_period:g} "
        f"--solar-panel-axis {inputs.config.inspection.solar_panel_axis} --initial-state configs/demonstration.json "
        "--duration 2000 --out demonstration.npz --figure demonstration.png"
        for switch in ("rta", "no-rta")
    ]
    return [
        page.paragraph("The study, which the same command continues after an interruption, writes"),
        page.commands([f"python main.py study --config {study}/config.toml --study-dir {study}"]),
        links(inputs.study, STUDY_FILES),
        page.paragraph("and the report, this page and"),
        page.commands([f"python main.py report --study {study}"]),
        links(inputs.study, REPORT_FILES),
        page.paragraph("One agent alone with the other setting of the filter, and the demonstration alone:"),
        page.commands(single),
    ]


def links(study: Path, contents: dict[str, tuple[str, ...]]) -> str:
    """A list of the files that match the patterns, by what they hold."""
    found = {
        what: [path for pattern in patterns for path in sorted(study.glob(pattern))]
        for what, patterns in contents.items()
    }
    items = [
        f"<li>{escape(what)}: {', '.join(page.link(path.relative_to(study).as_posix()) for path in paths)}</li>"
        for what, paths in found.items()
        if paths
    ]
    return f"<ul>{''.join(items)}</ul>"

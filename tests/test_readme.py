"""The numbers, links and commands of the README and of docs are those of the repository's files."""

import json
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import main
from study.command_line.arguments import COMMANDS, build_parser, join_axis
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate
from study.verification import break_points

ROOT = Path(main.__file__).parent
REFERENCE = ROOT / "runs/reference"
STUDY = REFERENCE / "study"
RESULTS, SAFETY, SPEED, COMMANDS_PAGE = (
    f"docs/{name}.md" for name in ("results/results", "results/safety", "results/speed", "reference/commands")
)
PAGES = ("README.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")))


def read(path: str) -> Any:
    """A JSON file of runs/reference."""
    return json.loads((REFERENCE / path).read_text(encoding="utf-8"))


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


ARMS = read("study/results.json")["arms"]
GUIDANCE, CROSS, FREQUENCY = (
    read(f"study/report/{name}.json") for name in ("guidance", "cross", "frequency")
)
BENCHMARK = read("benchmark.json")


def row(label: str, page: str, section: str) -> list[str]:
    """The cells of the row that begins with the label, in the page's section of this title."""
    (content,) = re.findall(rf"(?ms)^## {re.escape(section)}\n(.*?)(?=^## |\Z)", text(page))
    (line,) = (line for line in content.splitlines() if line.startswith(f"| {label} |"))
    return [cell.strip() for cell in line.removeprefix(f"| {label} |").strip("|").split("|")]


def interval(results: dict[str, Any], metric: str, digits: int) -> str:
    values = results["metrics"][metric]
    return Estimate(values["iqm"], tuple(values["ci95"])).text(digits)


def success(results: dict[str, Any]) -> str:
    return f"{100.0 * results['outcomes']['success']:.1f}"


def violation(results: dict[str, Any], constraint: str = "any") -> str:
    return f"{results['violations_percent'][constraint]:.3f}"


def corrected(results: dict[str, Any]) -> str:
    return f"{results['rta']['intervention_percent']:.1f}" if results["rta"]["period_s"] else "-"


# the front page


def front(results: dict[str, Any]) -> list[str]:
    """A row of the README's table."""
    fuel, time = (results["metrics"][name]["iqm"] for name in ("delta_v_m_s", "episode_length_s"))
    return [success(results), f"{fuel:.2f}", f"{time:,.0f}", violation(results)]


@pytest.mark.parametrize(
    ("label", "arm"),
    [("trained without RTA, flown without", "no_rta"), ("trained with RTA, flown with", "rta")],
)
def test_the_agents_on_the_front_page_are_the_studys(label: str, arm: str) -> None:
    assert row(label, "README.md", "Results") == front(ARMS[arm])


@pytest.mark.parametrize(
    ("label", "controller"),
    [
        ("classical guidance with RTA", "natural-motion"),
        ("random controls with RTA", "random"),
        ("an untrained agent with RTA", "untrained"),
    ],
)
def test_the_baselines_on_the_front_page_are_the_reports(label: str, controller: str) -> None:
    assert row(label, "README.md", "Results") == front(read("study/report/baselines.json")[controller]["on"])


@pytest.mark.parametrize(
    ("label", "arm"), [("without RTA", "no_rta"), ("with RTA", "rta")], ids=["without", "with"]
)
def test_the_papers_agents_on_the_front_page_are_the_papers(label: str, arm: str) -> None:
    fuel, time = (PAPER_METRICS[name].by_arm[arm].value for name in ("delta_v_m_s", "episode_length_s"))
    any_violation = PAPER_VIOLATIONS["any"].by_arm[arm].value
    cells = ["", f"{fuel:.2f}", f"{time:,.0f}", f"{any_violation:.3f}"]
    assert row(f"*the paper's agents {label}*", "README.md", "Results") == cells


def test_random_controls_succeed_behind_the_filter_with_a_hundred_times_the_fuel() -> None:
    random = read("study/report/baselines.json")["random"]["on"]
    assert random["outcomes"]["success"] == 1.0
    most = max(arm["metrics"]["delta_v_m_s"]["iqm"] for arm in ARMS.values())
    assert random["metrics"]["delta_v_m_s"]["iqm"] > 100.0 * most


def test_the_sentences_of_the_front_page_have_the_files_numbers() -> None:
    said = " ".join(text("README.md").split())
    baselines = read("study/report/baselines.json")
    guidance = baselines["natural-motion"]["on"]["metrics"]
    fuel, time = (guidance[name]["iqm"] for name in ("delta_v_m_s", "episode_length_s"))
    assert f"about {fuel:.1f} m/s and takes about {round(time, -2):,.0f} s" in said
    fuel, time = (ARMS["no_rta"]["metrics"][name]["iqm"] for name in ("delta_v_m_s", "episode_length_s"))
    assert f"spend {fuel:.1f} m/s and more, and take about {round(time, -2):,.0f} s" in said
    assert f"succeed in {float(success(CROSS['rta']['off'])):.0f} % of the episodes only" in said
    reports = [read(f"verification/{policy}.json") for policy in ("random", "adversarial")]
    episodes, calls = (sum(numbers) for numbers in zip(*map(episodes_and_filter_calls, reports), strict=True))
    assert f"{episodes:,} episodes, half of them" in said and f"{calls / 1e6:.0f} million calls" in said
    assert all(report["upper_bound_95"] < 1e-4 for report in reports)
    told = [read(f"verification/u1_{policy}.json") for policy in ("random", "adversarial")]
    assert f"held every limit in {sum(report['episodes'] for report in told):,} episodes" in said
    assert not any(report["violating_episodes"]["any"] for report in told)
    free, filtered = BENCHMARK["simulator_steps_per_s"], BENCHMARK["closed_loop_steps_per_s"]["1"]
    assert f"{round(free, -4):,.0f} decisions of 10 s per second, and {round(filtered, -3):,.0f} with" in said


def episodes_and_filter_calls(report: dict[str, Any]) -> tuple[int, int]:
    return report["episodes"], sum(report["filter_calls"].values())


def test_the_front_page_is_short() -> None:
    assert len(text("README.md").splitlines()) <= 150


# the results


@pytest.mark.parametrize("metric", PAPER_METRICS)
def test_table_2_is_the_studys(metric: str) -> None:
    published = PAPER_METRICS[metric]
    paper = [each.text(published.digits) for each in published.by_arm.values()]
    no_rta, rta, guidance = (interval(each, metric, published.digits) for each in (*ARMS.values(), GUIDANCE))
    assert row(published.label, RESULTS, "Performance") == [no_rta, paper[0], rta, paper[1], guidance]


@pytest.mark.parametrize("constraint", PAPER_VIOLATIONS)
def test_table_3_is_the_studys(constraint: str) -> None:
    published = PAPER_VIOLATIONS[constraint]
    paper = [f"{published.by_arm[arm].value:.3f}" for arm in ARMS]
    ours = [violation(arm, constraint) for arm in ARMS.values()]
    assert row(published.label, RESULTS, "Violations") == [ours[0], paper[0], ours[1], paper[1]]


def test_success_and_violations_are_the_studys() -> None:
    columns = (*ARMS.values(), GUIDANCE)
    paper = [f"{each.value:.3f}" for each in PAPER_VIOLATIONS["any"].by_arm.values()]
    no_rta, rta, guidance = (success(each) for each in columns)
    assert row("Success (%)", RESULTS, "Performance") == [no_rta, "", rta, "", guidance]
    no_rta, rta, guidance = (violation(each) for each in columns)
    cells = [no_rta, paper[0], rta, paper[1], guidance]
    assert row("Any violation (mean % of steps)", RESULTS, "Performance") == cells


def tail(arm: str) -> list[str]:
    """What the interquartile means hide, in the order of the page's rows."""
    with np.load(STUDY / arm / "episodes.npz") as episodes:
        metrics = dict(zip(episodes["metric_names"], episodes["metrics"], strict=True))
        succeeded = episodes["outcome"] == list(episodes["outcome_names"]).index("success")
        violated = dict(zip(episodes["constraint_names"], episodes["violations"], strict=True))["any"] > 0.0
        farthest = episodes["max_distance_m"].max()
    reward, length, fuel = (metrics[name] for name in ("reward", "episode_length_s", "delta_v_m_s"))
    # +1 and -1 of the success reward leave nothing in between
    assert not (succeeded & (reward > 0.5) & (reward < 1.5)).any()
    counts = (succeeded, succeeded & (reward < 1.0), violated, length > 5000.0)
    return [
        *(f"{each.sum():,}" for each in counts),
        f"{length.max():,.0f}",
        f"{length.mean():,.0f}",
        f"{reward.mean():.3f}",
        f"{fuel.mean():.3f}",
        f"{fuel.max():.3f}",
        f"{farthest:.2f}",
    ]


def test_what_the_means_hide_is_in_the_episodes() -> None:
    labels = (
        "succeed",
        "succeed, but would drift into the chief within two days if thrust stopped at the end",
        "have a violation in some step",
        "last longer than 5,000 s",
        "longest (s)",
        "mean length (s)",
        "mean reward",
        "mean delta v (m/s)",
        "largest delta v (m/s)",
        "farthest from the chief (m); the limit is 800",
    )
    for label, *cells in zip(labels, tail("no_rta"), tail("rta"), strict=True):
        assert row(label, RESULTS, "What these numbers hide") == cells


@pytest.mark.parametrize("switch", ["off", "on"])
@pytest.mark.parametrize(
    ("label", "controller"),
    [
        ("untrained agent", "untrained"),
        ("random controls", "random"),
        ("no control (coasting)", "zero"),
        ("classical guidance", "natural-motion"),
    ],
)
def test_the_baselines_are_the_reports(label: str, controller: str, switch: str) -> None:
    results = read("study/report/baselines.json")[controller][switch]
    assert row(f"{label} | {'with' if switch == 'on' else 'without'}", RESULTS, "Baselines") == [
        success(results),
        violation(results),
        interval(results, "reward", 4),
        interval(results, "delta_v_m_s", 3),
        interval(results, "episode_length_s", 1),
    ]


@pytest.mark.parametrize("arm", ["no_rta", "rta"])
@pytest.mark.parametrize("switch", ["off", "on"])
def test_the_cross_evaluation_is_the_studys(arm: str, switch: str) -> None:
    results = CROSS[arm][switch]
    words = {"no_rta": "without RTA", "rta": "with RTA", "off": "without", "on": "with"}
    label = f"{words[arm]} | {words[switch]}"
    assert row(label, RESULTS, "Does an agent come to depend on the filter?") == [
        violation(results),
        corrected(results),
        success(results),
        interval(results, "reward", 4),
        interval(results, "delta_v_m_s", 3),
        interval(results, "episode_length_s", 1),
    ]


def columns(section: str, metrics: list[str], constraints: list[str], *results: dict[str, Any]) -> None:
    """Asserts that a section's table has these rows, and these evaluations as its columns."""
    for metric in metrics:
        published = PAPER_METRICS[metric]
        cells = [interval(each, metric, published.digits) for each in results]
        assert row(f"{published.label} (IQM [95 % interval])", RESULTS, section) == cells
    assert row("Success (%)", RESULTS, section) == [success(each) for each in results]
    assert row("Any violation (mean % of steps)", RESULTS, section) == [violation(each) for each in results]
    for name in constraints:
        cells = [violation(each, name) for each in results]
        assert row(PAPER_VIOLATIONS[name].label, RESULTS, section) == cells


def test_the_discounts_are_the_two_studies() -> None:
    other = read("study_discount_0.998/results.json")["arms"]
    metrics = [name for name in PAPER_METRICS if name != "inspected_score"]
    by_arm = (study[arm] for arm in ARMS for study in (other, ARMS))
    columns("Time or fuel: the discount", metrics, [], *by_arm)


def test_the_panels_as_the_text_has_them_are_the_studys() -> None:
    constraints = ["attitude_exclusion", "temperature", "battery", "dynamic_speed", "passive_safety"]
    arms = read("study_plus_x/results.json")["arms"].values()
    columns("The panels as the text has them", list(PAPER_METRICS), constraints, *arms)


# safety


@pytest.mark.parametrize("constraint", [name for name in PAPER_VIOLATIONS if name != "any"])
def test_the_verified_constraints_are_the_reports(constraint: str) -> None:
    cells = []
    for policy in ("random", "adversarial"):
        report = read(f"verification/{policy}.json")
        worst, when = report["worst_value"][constraint], report["worst_case"][constraint]["time_s"]
        cells += [f"{report['violating_episodes'][constraint]:,}", f"{worst:.3g} at {when:g} s"]
    label = PAPER_VIOLATIONS[constraint].label
    (line,) = (line for line in text(SAFETY).splitlines() if line.startswith(f"| {label} ("))
    assert [cell.strip() for cell in line.strip("|").split("|")[1:]] == cells


def test_the_yielded_calls_are_the_reports() -> None:
    section = "When limits contradict each other"
    reports = [read(f"verification/{policy}.json") for policy in ("random", "adversarial")]
    calls = [f"{report['filter_calls']['slack']:,}" for report in reports]
    assert row("any", SAFETY, section) == calls
    labels = {
        "temperature": "temperature",
        "battery": "battery",
        "keep-in zone, inside its margin": "keep_in_zone",
    }
    for label, name in labels.items():
        assert row(label, SAFETY, section) == [f"{report['yielded_calls'][name]:,}" for report in reports]
    never = (
        "collision",
        "passive_safety",
        "attitude_exclusion",
        "dynamic_speed",
        *(f"velocity_{i}" for i in "xyz"),
    )
    assert not any(report["yielded_calls"][name] for report in reports for name in never)


@pytest.mark.parametrize("period", FREQUENCY)
def test_the_filters_periods_are_the_studys(period: str) -> None:
    results = FREQUENCY[period]
    cells = [
        period,
        violation(results),
        corrected(results),
        interval(results, "delta_v_m_s", 3),
        interval(results, "torque_n_m", 4),
        interval(results, "reward", 4),
    ]
    assert f"| {' | '.join(cells)} |" in text(SAFETY).splitlines()
    places = "verification/{}.json" if period == "1" else f"frequency/{{}}_{period}s.json"
    reports = [read(places.format(policy)) for policy in ("random", "adversarial")]
    shares = [f"{report['violating_episodes']['any']:,} of {report['episodes']:,}" for report in reports]
    assert f"| {' | '.join((period, *shares))} |" in text(SAFETY).splitlines()


def came_of(report: dict[str, Any]) -> list[str]:
    """The cells of a campaign's row that say what came of it: violations, their bound, the smallest h."""
    worst = report["worst_value"]
    return [
        f"{report['violating_episodes']['any']:,}",
        f"{report['upper_bound_95']:.2g}",
        f"{worst['keep_in_zone']:.3f}, {worst['passive_safety']:.2f}",
    ]


WORLDS = {
    "u1_random": ("U1", "random"),
    "u1_adversarial": ("U1", "adversarial"),
    "u1_minimum_thrust": ("U1, minimum impulse", "adversarial"),
    "u1_thrust_quantum": ("U1, quanta", "adversarial"),
}


@pytest.mark.parametrize("name", WORLDS)
def test_the_worlds_that_are_told_of_are_the_reports(name: str) -> None:
    report = read(f"verification/{name}.json")
    cells = [
        *WORLDS[name],
        f"{report['episodes']:,}, {report['campaign']['duration']:,}",
        *came_of(report),
    ]
    assert f"| {' | '.join(cells)} |" in text(SAFETY).splitlines()


TRIED = {
    "adversarial_between": ("the model", "adversarial"),
    "lookahead": ("the model", "lookahead"),
    "learned_motion": ("the model", "learned: motion"),
    "learned_passive": ("the model", "learned: passive safety"),
    "learned_attitude": ("the model", "learned: attitude, temperature, energy"),
    "u1_lookahead": ("U1", "lookahead, 8 for two calls"),
    "u1_learned_motion": ("U1", "learned: motion"),
    "u1_learned_passive": ("U1", "learned: passive safety"),
    "u1_learned_attitude": ("U1", "learned: attitude, temperature, energy"),
}


@pytest.mark.parametrize("name", TRIED)
def test_what_the_adversaries_reached_is_the_reports(name: str) -> None:
    report = read(f"verification/{name}.json")
    flown = report["campaign"]
    cells = [
        *TRIED[name],
        f"{report['episodes']:,}",
        f"{flown['check_every']:g}",
        *came_of(report),
    ]
    assert flown["duration"] == 2000 and report["unsolved"] == 0
    assert f"| {' | '.join(cells)} |" in text(SAFETY).splitlines()


def test_the_single_calls_are_the_reports() -> None:
    report, said = read("verification/boundary.json"), " ".join(text(SAFETY).split())
    inside = report["within_margins"]["any"]
    assert f"{report['violating_draws']['any']:,} of {report['draws']:,} draws went below zero" in said
    assert f"below {report['upper_bound_95']:.2g} with 95 % confidence" in said
    assert f"All but {inside['violating']} of them" in said and f"Of the {inside['draws']:,} draws" in said
    assert f"these are {inside['violating']} (below {inside['upper_bound_95']:.0e} with 95 %)" in said
    names = {"passive_safety": "passive safety", "dynamic_speed": "dynamic speed", "collision": "separation"}
    for name, count in report["violating_draws"].items():
        if count and name != "any":
            label = names.get(name, f"{name[-1]} velocity" if name.startswith("velocity") else name)
            assert f"{label} {count:,} (down to {report['worst_value'][name]:.1g} " in said


def test_the_break_points_are_the_reports() -> None:
    report = read("verification/break_points.json")
    lines = text(SAFETY).splitlines()
    for effect in dict.fromkeys(world["effect"] for world in report["worlds"]):
        said = [break_points.said(report, effect, told) for told in (False, True)]
        unit = break_points.EFFECTS[effect].unit or "share"
        assert f"| {' | '.join((effect, unit, *said))} |" in lines
    assert f"in each of the {len(report['worlds'])} worlds" in " ".join(lines)


def test_the_agents_in_u1_are_the_evaluations() -> None:
    study = read("study/rta/results.json")["per_seed"]
    found = sorted((REFERENCE / "u1").glob("seed*.json"))
    assert found
    for path in found:
        results, seed = json.loads(path.read_text()), int(path.stem.removeprefix("seed"))
        cells = [
            f"{seed}",
            f"{100 * results['outcomes']['success']:g}",
            f"{results['violations_percent']['any']:.3f}",
            f"{results['metrics']['reward']['iqm']:.4f}",
            f"{study[seed]['metrics']['reward']['iqm']:.4f}",
            f"{results['metrics']['delta_v_m_s']['iqm']:.2f}",
            f"{study[seed]['metrics']['delta_v_m_s']['iqm']:.2f}",
        ]
        assert f"| {' | '.join(cells)} |" in text(SAFETY).splitlines()


# speed


def test_the_speeds_are_the_benchmarks() -> None:
    def measured(label: str) -> str:
        (line,) = (line for line in text(SPEED).splitlines() if line.startswith(f"| {label} |"))
        return line.split("|")[2].strip()

    loop, qp, call = (
        BENCHMARK[key] for key in ("closed_loop_steps_per_s", "qp_us", "single_filter_latency_ms")
    )
    assert measured("environment steps of 10 s, no RTA") == f"{BENCHMARK['simulator_steps_per_s']:,.0f} per s"
    rates = " / ".join(f"{loop[period]:,.0f}" for period in ("1", "5", "10"))
    assert measured("with RTA at 1 / 5 / 10 s") == f"{rates} per s"
    assert measured("filter calls") == f"{BENCHMARK['filter_calls_per_s']:,.0f} per s"
    told, late = BENCHMARK["told_filter_calls_per_s"], BENCHMARK["told_filter_latency_ms"]
    assert measured("filter calls, told of U1") == f"{told:,.0f} per s"
    alone = f"{late['median']:.2f} ms, 99 % below {late['p99']:.2f} ms"
    assert measured("one filter call alone, told of U1") == alone
    share = f"makes {100 * told / BENCHMARK['filter_calls_per_s']:.0f} % of the calls"
    assert share in " ".join(text(SPEED).split())
    problem = "one optimisation problem of the filter, PIQP / batched solver, 1,024 at once"
    assert measured(problem) == f"{qp['piqp']:.1f} / {qp['batched']:.2f} µs"
    alone = f"{call['median']:.2f} ms, 99 % below {call['p99']:.2f} ms"
    assert measured("one filter call alone, with PIQP") == alone
    assert measured("learner, 1,024 samples at once") == (
        f"{BENCHMARK['learner_samples_per_s']:,.0f} samples per s, {100 * BENCHMARK['learner_matmul_share']:.0f} % "
        f"of the float32 matrix-product rate ({BENCHMARK['matmul_gflops']:.0f} Gflop/s)"
    )
    assert measured("peak memory, up to 65,536 episodes") == f"{BENCHMARK['peak_memory_mb']:,.0f} MB"


def test_the_parts_of_a_step_are_the_benchmarks() -> None:
    lines = [line for line in text(SPEED).splitlines() if re.search(r"(\| \d+\.\d ){4}\|$", line)]
    counts = ("256", "1024", "4096", "65536")
    parts = [[f"{part[n]:.1f}" for n in counts] for part in BENCHMARK["closed_loop_us"].values()]
    assert [[cell.strip() for cell in line.strip("|").split("|")[1:]] for line in lines] == parts


# links and commands


def anchors(page: Path) -> set[str]:
    """The names that GitHub gives to a page's titles."""
    titles = re.findall(r"(?m)^#+ (.*)$", page.read_text(encoding="utf-8"))
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", text(page)):
        if link.startswith(("http:", "https:")):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_index_has_every_page() -> None:
    linked = set(re.findall(r"\]\(([^)#]+)\)", text("docs/README.md")))
    pages = {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}
    assert pages - {"README.md"} <= linked


def test_every_page_that_the_code_names_is_there() -> None:
    folders = ("inspection", "rta", "ppo", "interfaces", "study", "configs", "docs", "tests")
    for folder in folders:
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".toml", ".j2", ".slurm"):
                content = path.read_text(encoding="utf-8")
                for page in re.findall(r"\bdocs/[\w/]+\.\w+", content):
                    assert (ROOT / page).exists(), f"{path}: {page}"


def commands(page: str) -> Iterator[list[str]]:
    """The words of every command on a page, and of every line of a program there, in their order."""
    for line in text(page).splitlines():
        for command in line.split("&&"):
            if re.match(r"\s*(python (?!-m timeit)|torchrun |tensorboard )", command):
                yield shlex.split(command, comments=True)
            elif found := re.search(r"np\.(load|savez?)\(\"([^\"]+)\"", command):
                yield [found[1], found[2]]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_parses(page: str) -> None:
    parser = build_parser(main.HANDLERS)
    for words in commands(page):
        if "main.py" in words:
            parser.parse_args(join_axis(words[words.index("main.py") + 1 :]))


READ = (
    *("load", "replay", "--config", "--checkpoint", "--actions", "--initial-state", "--states", "--study"),
    *("--resume", "--init-from", "--logdir", "-r"),
)
WRITTEN = ("save", "savez", "--out", "--json", "--figure", "--run-dir", "--study-dir")


@pytest.mark.parametrize("page", ["README.md", COMMANDS_PAGE])
def test_every_file_of_a_command_is_there_or_was_written_before(page: str) -> None:
    """In the order of the page, from a fresh clone."""
    written: set[Path] = set()
    for words in commands(page):
        named = [(flag, Path(name)) for flag, name in pairwise(words)]
        for flag, path in named:
            if flag in READ:
                assert (ROOT / path).exists() or written & {path, *path.parents}, words
        written |= {path for flag, path in named if flag in WRITTEN}


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_of_commands_has_every_flag(command: str) -> None:
    sections = re.split(r"(?m)^## (.*)\n", text(COMMANDS_PAGE))
    section = dict(zip(sections[1::2], sections[2::2], strict=True))
    content = section[command]
    if "common flags" in content:
        content += section["Common flags"]
    said = {name for name in re.findall(r"`(--[a-z-]+)", content) if name != "--no-rta"}
    assert said == {each.name for each in COMMANDS[command].flags if each.name.startswith("--")}

"""The report as a browser would get it: self-contained, complete, and with the numbers of the files behind it."""

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from jinja2 import UndefinedError

from settings import InputError
from study.config import BASELINES
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS, Estimate
from study.report import figures, inputs, page, tables
from tests.study.web.browser import Browser, asks_nothing, chromium

__all__ = ["chromium"]  # a fixture

VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Collects what a page embeds, links to and says in its tables; checks that every element is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.images: list[dict[str, str]] = []
        self.links: list[str] = []
        self.names: list[str] = []
        self.resources: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            self.images.append(attributes)
        if tag == "a":
            self.links.append(attributes["href"])
        elif "href" in attributes or tag in ("script", "iframe", "object"):
            self.resources.append(tag)
        if "id" in attributes:
            self.names.append(attributes["id"])
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "table" in self.open and self.open[-1] not in ("table", "thead", "tbody", "tr", "caption"):
            self.tables[-1][-1][-1] += f" {data}" if self.open[-1] == "small" else data


@pytest.fixture(scope="module")
def study(made_up_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with its report."""
    directory = tmp_path_factory.mktemp("reported") / "study"
    shutil.copytree(made_up_study, directory)
    found = inputs.read(directory)
    tables.write(found)
    figures.draw(found)
    page.write(found)
    return directory


@pytest.fixture(scope="module")
def text(study: Path) -> str:
    return (study / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def reader(text: str) -> Reader:
    return Reader(text)


def test_nothing_comes_from_the_network(text: str, reader: Reader) -> None:
    assert reader.resources == []
    assert re.search(r"https?://|@import|url\(", text) is None
    assert all(image["src"].startswith("data:image/") for image in reader.images)


def test_the_pages_policy_lets_no_request_out(text: str) -> None:
    asks_nothing(text)


def test_a_browser_shows_it_whole_and_asks_for_nothing(chromium: Any, study: Path) -> None:
    """Report and replays, which the policy must let show their images, styles and scripts."""
    for path in (study / "report.html", *sorted((study / "report").glob("*.html"))):
        shown = Browser(chromium, path, 1000, 800)
        assert shown.errors == [] and all(each.startswith(("file:", "data:")) for each in shown.requests)
        assert sum(each.startswith("file:") for each in shown.requests) == 1  # the page itself
        assert shown.page.evaluate(
            "() => [...document.images].every(image => image.complete && image.naturalWidth > 0)"
        )
        assert shown.page.evaluate("() => getComputedStyle(document.body).maxWidth") != "none"
        shown.page.close()


def test_links_lead_somewhere(study: Path, reader: Reader) -> None:
    for target in reader.links:
        assert target[1:] in reader.names if target.startswith("#") else (study / target).is_file()


def test_every_figure_is_embedded_and_described(study: Path, reader: Reader) -> None:
    embedded = {base64.b64decode(image["src"].partition(",")[2]) for image in reader.images}
    drawn = {path for path in (study / "report").iterdir() if path.suffix in (".png", ".svg")}
    shown = {path.stem for path in drawn if path.read_bytes() in embedded}
    assert len(embedded) == len(reader.images) == 17
    assert shown == {path.stem for path in drawn} - {"training"}  # the six in one, for other uses
    assert all(len(image["alt"]) > 30 for image in reader.images)


def body(table: list[list[str]], heads: int) -> dict[str, list[str]]:
    """The rows of a table by their first cell."""
    return {label: cells for label, *cells in table[heads:]}


def test_table_2(study: Path, reader: Reader) -> None:
    arms = json.loads((study / "results.json").read_text())["arms"]
    guidance = json.loads((study / "report/guidance.json").read_text())
    rows = body(reader.tables[0], heads=2)
    assert len(rows) == len(PAPER_METRICS) + 1
    for name, published in PAPER_METRICS.items():
        expected, digits = [], published.digits
        for arm, results in arms.items():
            ours, paper = results["metrics"][name], published.by_arm[arm]
            (a, b), middle, (low, high) = ours["ci95"], paper.value, paper.interval
            expected += [
                f"{ours['iqm']:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]",
                f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]",
                f"{ours['iqm'] - middle:+.{digits}f}",
            ]
        ours, (a, b) = guidance["metrics"][name]["iqm"], guidance["metrics"][name]["ci95"]
        assert rows[published.label] == [*expected, f"{ours:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]"]
    shares = [100 * results["outcomes"]["success"] for results in (*arms.values(), guidance)]
    assert [cell for cell in rows["Success (%)"] if cell != "-"] == [f"{share:.1f}" for share in shares]


def test_table_3(study: Path, reader: Reader) -> None:
    arms = json.loads((study / "results.json").read_text())["arms"]
    rows = body(reader.tables[1], heads=2)
    assert len(rows) == len(PAPER_VIOLATIONS)
    for name, published in PAPER_VIOLATIONS.items():
        for i, (arm, results) in enumerate(arms.items()):
            ours, paper = results["violations_percent"][name], published.by_arm[arm].value
            expected = [f"{ours:.3f}", f"{paper:.3f}", f"{ours - paper:+.3f}"]
            assert rows[published.label][3 * i : 3 * i + 3] == expected


@pytest.mark.parametrize(("place", "name"), [(4, "frequency"), (5, "cross")])
def test_other_evaluations(study: Path, reader: Reader, place: int, name: str) -> None:
    content = json.loads((study / f"report/{name}.json").read_text())
    if name == "cross":
        content = {arm + switch: e for arm, switches in content.items() for switch, e in switches.items()}
    rows = reader.tables[place][1:]
    assert len(rows) == len(content)
    for (_, *cells), results in zip(rows, content.values(), strict=True):
        rta, metrics = results["rta"], results["metrics"]
        expected = [
            f"{results['violations_percent']['any']:.3f}",
            "-" if rta["period_s"] is None else f"{rta['intervention_percent']:.1f}",
            *(
                f"{metrics[m]['iqm']:.{d}f} [{metrics[m]['ci95'][0]:.{d}f}, {metrics[m]['ci95'][1]:.{d}f}]"
                for m, d in (("delta_v_m_s", 3), ("torque_n_m", 4), ("reward", 4))
            ),
            f"{100 * results['outcomes']['success']:.1f}",
        ]
        assert cells == expected


def test_baselines_stand_below_the_agents(study: Path, text: str, reader: Reader) -> None:
    """Each with the filter off and on."""
    flown = [
        (flyer, switch, results)
        for name in ("cross", "baselines")
        for flyer, switches in json.loads((study / f"report/{name}.json").read_text()).items()
        for switch, results in switches.items()
    ]
    rows = reader.tables[3][1:]
    assert [row[0] for row in rows[::2]] == ["agents, no RTA", "agents, RTA", *BASELINES]
    for (_, switch, *cells), (_, expected, results) in zip(rows, flown, strict=True):
        metrics = results["metrics"]
        assert switch == expected
        assert cells == [
            f"{100 * results['outcomes']['success']:.1f}",
            *(
                f"{metrics[m]['iqm']:.{d}f} [{metrics[m]['ci95'][0]:.{d}f}, {metrics[m]['ci95'][1]:.{d}f}]"
                for m, d in (("reward", 4), ("delta_v_m_s", 3), ("episode_length_s", 1))
            ),
            f"{results['violations_percent']['any']:.3f}",
        ]
    random = flown[-7][2]
    assert f"random controls succeed in\n{100 * random['outcomes']['success']:.1f} %" in text


def test_half_a_study(study: Path, tmp_path: Path) -> None:
    """One arm, whose training was too short for an evaluation, and no guidance."""
    half = tmp_path / "half"
    shutil.copytree(study, half)
    for name in ("results", "report/cross"):
        content = json.loads((half / f"{name}.json").read_text())
        (content["arms"] if name == "results" else content).pop("rta")
        (half / f"{name}.json").write_text(json.dumps(content))
    (half / "report/training.csv").write_text("interactions,arm,metric,iqm,low,high\n")
    others = [f"{name}.json" for name in ("frequency", "baselines", "front", "progress", "worlds")]
    for name in ("guidance.json", "episode_rta.npz", *others):
        (half / "report" / name).unlink()
    text = page.document(inputs.read(half))
    reader = Reader(text)
    # arm, training curves, baselines, guidance, front, progress, worlds, frequency
    assert text.count('class="missing"') == 8
    assert len(reader.images) == 7
    assert {len(row) for row in reader.tables[0][1:]} == {4}


def test_what_files_say_stays_text(study: Path, tmp_path: Path) -> None:
    tagged = tmp_path / "a <b> & 'c'"
    shutil.copytree(study, tagged)
    (tagged / "provenance.json").write_text(json.dumps({"device": "<i>x</i>", "ranks": 1, "threads": 2}))
    (tagged / "report/demonstration_<s>.npz").touch()
    text = page.document(inputs.read(tagged))
    reader = Reader(text)
    assert not any(tag in text for tag in ("<i>", "<b>", "<s>"))
    assert "report/demonstration_<s>.npz" in reader.links
    assert [row[5] for row in reader.tables[7][1:]] == ["<i>x</i>"] * 2
    assert "python main.py report --study &#39;" in text


def test_the_page_without_one_of_its_values_fails(study: Path) -> None:
    with pytest.raises(UndefinedError, match="is undefined"):
        page.render("report/page.html.j2", filters=page.FILTERS, inputs=inputs.read(study))


def test_a_page_that_cannot_be_written_is_refused(study: Path, tmp_path: Path) -> None:
    occupied = tmp_path / "occupied"
    shutil.copytree(study, occupied)
    (occupied / "report.html").unlink()
    (occupied / "report.html").mkdir()
    with pytest.raises(InputError, match="cannot write its report"):
        page.write(inputs.read(occupied))


def test_small_violations_are_not_called_zero() -> None:
    assert [page.percent(value) for value in (0.0, 0.0004, 0.0005, 4.2364)] == [
        "0.000",
        "< 0.001",
        "0.001",
        "4.236",
    ]


def test_differences_are_bold_where_intervals_do_not_overlap() -> None:
    paper = Estimate(2.0, (1.9, 2.1))
    assert page.difference(Estimate(2.2, (2.05, 2.3)), paper, 2) == ("+0.20", False)
    assert page.difference(Estimate(2.2, (2.15, 2.3)), paper, 2) == ("+0.20", True)
    assert page.difference(Estimate(1.0, (0.9, 1.1)), paper, 2) == ("-1.00", True)
    assert page.difference(Estimate(1.999, (1.9, 2.1)), paper, 2) == ("+0.00", False)
    assert page.difference(Estimate(1.0), Estimate(2.0), 3) == ("-1.000", False)


def test_differences_are_bold_on_the_page(study: Path, text: str) -> None:
    arms = json.loads((study / "results.json").read_text())["arms"]
    expected = []
    for name, published in PAPER_METRICS.items():
        for arm, results in arms.items():
            ours, paper = results["metrics"][name], published.by_arm[arm]
            if max(ours["ci95"][0], paper.interval[0]) > min(ours["ci95"][1], paper.interval[1]):
                expected.append(f"{ours['iqm'] - paper.value:+.{published.digits}f}")
    assert expected
    assert re.findall("<strong>(.*?)</strong>", text) == expected


def test_a_studys_own_arms_stand_beside_the_papers(study: Path, tmp_path: Path) -> None:
    shutil.copytree(study, tmp_path / "study")
    path = tmp_path / "study/results.json"
    results = json.loads(path.read_text())
    own = results["arms"]["squared"] = json.loads(json.dumps(results["arms"]["rta"]))
    own["metrics"]["reward"] |= {"iqm": 2.5, "ci95": [2.4, 2.6]}
    path.write_text(json.dumps(results))
    found = inputs.read(tmp_path / "study")
    assert list(found.arms) == ["no_rta", "rta"] and list(found.own) == ["squared"]
    reader = Reader(page.document(found))
    rows = body(reader.tables[2], heads=1)
    assert list(rows) == ["no RTA", "RTA", "squared"]
    assert rows["squared"][4].startswith("2.500 [") and rows["squared"][0] == rows["RTA"][0]


def test_arms_show_what_a_mean_of_the_middle_half_hides(study: Path, reader: Reader) -> None:
    arms = json.loads((study / "results.json").read_text())["arms"]
    rows = body(reader.tables[2], heads=1)
    for name, label in (("no_rta", "no RTA"), ("rta", "RTA")):
        results = arms[name]
        reward, length, delta_v = (
            results["metrics"][key] for key in ("reward", "episode_length_s", "delta_v_m_s")
        )
        assert rows[label] == [
            *(f"{100 * results['outcomes'][key]:.1f}" for key in ("clean_success", "success")),
            *(
                f"{results[key]['any']:.3f}"
                for key in ("violations_percent", "violations_percent_of_seconds")
            ),
            seeds_cell(results, "reward", 3),
            f"{reward['mean']:.3f}",
            f"{min(seed['metrics']['reward']['iqm'] for seed in results['per_seed']):.3f}",
            seeds_cell(results, "episode_length_s", 0),
            *(f"{length[key]:.0f}" for key in ("mean", "p95", "max")),
            seeds_cell(results, "delta_v_m_s", 2),
            *(f"{delta_v[key]:.2f}" for key in ("mean", "p95", "max")),
        ]


def seeds_cell(results: dict[str, Any], metric: str, digits: int) -> str:
    """An IQM and its interval over seeds."""
    low, high = tables.over_seeds(results, metric)
    return f"{results['metrics'][metric]['iqm']:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def test_worlds_show_every_agent_behind_every_filter(study: Path, reader: Reader) -> None:
    worlds = json.loads((study / "report/worlds.json").read_text())
    rows = reader.tables[6][1:]
    flown = [
        (plant, arm, switch, results)
        for plant, arms in worlds.items()
        for arm, switches in arms.items()
        for switch, results in switches.items()
    ]
    assert len(rows) == len(flown) == 12
    for row, (plant, arm, switch, results) in zip(rows, flown, strict=True):
        shown = {"no_rta": "no RTA", "rta": "RTA"}[arm]
        assert row[:3] == [plant, shown, switch]
        assert row[4] == f"{100 * results['outcomes']['clean_success']:.1f}"
        assert row[8] == f"{results['metrics']['episode_length_s']['iqm']:.0f}"


def test_a_study_without_the_papers_arms(study: Path, tmp_path: Path) -> None:
    shutil.copytree(study, tmp_path / "sweep")
    for name in ("results", "report/cross", "report/progress"):
        path = tmp_path / f"sweep/{name}.json"
        content = json.loads(path.read_text())
        arms = content["arms"] if name == "results" else content
        arms["squared"] = arms.pop("rta")
        del arms["no_rta"]
        path.write_text(json.dumps(content))
    (tmp_path / "sweep/report/training.csv").write_text("interactions,arm,metric,iqm,low,high\n")
    found = inputs.read(tmp_path / "sweep")
    for write in (tables.write, figures.draw, page.write):
        write(found)
    text = (tmp_path / "sweep/report.html").read_text()
    assert "none of the paper's arms" in text and "agents of squared" in text
    assert list(body(Reader(text).tables[0], heads=1)) == ["squared"]


def test_progress_is_read_at_the_time_that_is_asked_for() -> None:
    curve = {"time_s": [0.0, 10.0, 500.0], "weight": [0.1, 0.2, 0.7]}
    assert [page.weight_at(curve, t) for t in (10.0, 255.0, 900.0)] == pytest.approx([0.2, 0.45, 0.7])

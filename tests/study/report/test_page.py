"""The report as a browser would get it: self-contained, complete, and with the numbers of the files behind it."""

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from study.config import ARMS
from study.paper import PAPER_METRICS
from study.report import inputs, page, tables
from tests.study.web.browser import Browser, chromium

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
def study(shipped_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the shipped study, whose page is written anew."""
    directory = tmp_path_factory.mktemp("reported") / "study"
    shutil.copytree(shipped_study, directory)
    found = inputs.read(directory)
    tables.write(found)
    page.write(found)
    return directory


@pytest.fixture(scope="module")
def reader(study: Path) -> Reader:
    return Reader((study / "report.html").read_text(encoding="utf-8"))


def test_nothing_comes_from_the_network(study: Path, reader: Reader) -> None:
    assert reader.resources == []
    assert re.search(r"https?://|@import|url\(", (study / "report.html").read_text(encoding="utf-8")) is None
    assert all(image["src"].startswith("data:image/") for image in reader.images)


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
    assert len(embedded) == len(reader.images) > 10
    assert shown == {path.stem for path in drawn}
    assert all(len(image["alt"]) > 30 for image in reader.images)


def test_tables_2_and_3(study: Path, reader: Reader) -> None:
    """What differs by more than both intervals is bold."""
    found = json.loads((study / "results.json").read_text())["arms"]
    arms = {name: found[name] for name in ARMS}
    guidance = json.loads((study / "report/front.json").read_text())["quick"]
    rows, shares = ({label: cells for label, *cells in table[2:]} for table in reader.tables[:2])
    assert len(rows) == len(PAPER_METRICS) + 1
    bold = []
    for name, published in PAPER_METRICS.items():
        expected, digits = [], published.digits
        for arm, results in arms.items():
            ours, paper = results["metrics"][name], published.by_arm[arm]
            (a, b), middle, (low, high) = ours["ci95"], paper.value, paper.interval
            expected += [
                f"{ours['iqm']:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]",
                f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]",
                f"{ours['iqm'] - middle:+z.{digits}f}",
            ]
            bold += [expected[-1]] if max(a, low) > min(b, high) else []
        ours, (a, b) = guidance["metrics"][name]["iqm"], guidance["metrics"][name]["ci95"]
        assert rows[published.label] == [*expected, f"{ours:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]"]
    succeeded = [100 * results["outcomes"]["success"] for results in (*arms.values(), guidance)]
    assert [cell for cell in rows["Success (%)"] if cell != "-"] == [f"{share:.1f}" for share in succeeded]
    assert shares["Any constraint"][0] == f"{arms['no_rta']['violations_percent']['any']:.3f}"
    text = (study / "report.html").read_text(encoding="utf-8")
    assert bold and re.findall("<strong>(.*?)</strong>", text) == bold


def test_the_cross_evaluation(study: Path, reader: Reader) -> None:
    content = json.loads((study / "report/cross.json").read_text())
    flown = [results for switches in content.values() for results in switches.values()]
    for (_, *cells), results in zip(reader.tables[5][1:], flown, strict=True):
        rta, metrics = results["rta"], results["metrics"]
        assert cells == [
            f"{results['violations_percent']['any']:.3f}",
            "-" if rta["period_s"] is None else f"{rta['intervention_percent']:.1f}",
            *(
                f"{metrics[m]['iqm']:.{d}f} [{metrics[m]['ci95'][0]:.{d}f}, {metrics[m]['ci95'][1]:.{d}f}]"
                for m, d in (("delta_v_m_s", 3), ("torque_n_m", 4), ("reward", 4))
            ),
            f"{100 * results['outcomes']['success']:.1f}",
        ]


def test_what_files_say_stays_text(study: Path, tmp_path: Path) -> None:
    tagged = tmp_path / "a <b> & 'c'"
    shutil.copytree(study, tagged)
    (tagged / "provenance.json").write_text(json.dumps({"device": "<i>x</i>", "ranks": 1, "threads": 2}))
    (tagged / "report/demonstration_<s>.npz").touch()
    text = page.document(inputs.read(tagged))
    reader = Reader(text)
    assert not any(tag in text for tag in ("<i>", "<b>", "<s>"))
    assert "report/demonstration_<s>.npz" in reader.links
    assert {row[5] for row in reader.tables[7][1:]} == {"<i>x</i>"}
    assert "python main.py report --study &#39;" in text

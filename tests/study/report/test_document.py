"""The report as a browser would get it: self-contained, complete, and with the numbers of the files behind it."""

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from study.errors import InputError
from study.paper import PAPER_METRICS, PAPER_VIOLATIONS
from study.report import document as html
from study.report import inputs as report_inputs
from study.report.html_tables import difference, percent

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
    html.write(directory)
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


def test_links_lead_somewhere(study: Path, reader: Reader) -> None:
    for target in reader.links:
        assert target[1:] in reader.names if target.startswith("#") else (study / target).is_file()


def test_every_figure_is_embedded_and_described(study: Path, reader: Reader) -> None:
    embedded = {base64.b64decode(image["src"].partition(",")[2]) for image in reader.images}
    drawn = {path for path in (study / "report").iterdir() if path.suffix in (".png", ".svg")}
    shown = {path.stem for path in drawn if path.read_bytes() in embedded}
    assert len(embedded) == len(reader.images) == 14
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
    for name, (label, digits, *paper) in PAPER_METRICS.items():
        expected = []
        for results, (middle, low, high) in zip(arms.values(), paper, strict=True):
            ours = results["metrics"][name]
            a, b = ours["ci95"]
            expected += [
                f"{ours['iqm']:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]",
                f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]",
                f"{ours['iqm'] - middle:+.{digits}f}",
            ]
        ours, (a, b) = guidance["metrics"][name]["iqm"], guidance["metrics"][name]["ci95"]
        assert rows[label] == [*expected, f"{ours:.{digits}f} [{a:.{digits}f}, {b:.{digits}f}]"]
    shares = [100 * results["outcomes"]["success"] for results in (*arms.values(), guidance)]
    assert [cell for cell in rows["Success (%)"] if cell != "-"] == [f"{share:.1f}" for share in shares]


def test_table_3(study: Path, reader: Reader) -> None:
    arms = json.loads((study / "results.json").read_text())["arms"]
    rows = body(reader.tables[1], heads=2)
    assert len(rows) == len(PAPER_VIOLATIONS)
    for name, (label, *paper) in PAPER_VIOLATIONS.items():
        for i, (results, published) in enumerate(zip(arms.values(), paper, strict=True)):
            ours = results["violations_percent"][name]
            expected = [f"{ours:.3f}", f"{published:.3f}", f"{ours - published:+.3f}"]
            assert rows[label][3 * i : 3 * i + 3] == expected


@pytest.mark.parametrize(("place", "name"), [(2, "frequency"), (3, "cross")])
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


def test_half_a_study(study: Path, tmp_path: Path) -> None:
    """One arm, whose training was too short for an evaluation, and no guidance."""
    half = tmp_path / "half"
    shutil.copytree(study, half)
    for name in ("results", "report/cross", "report/throughput"):
        content = json.loads((half / f"{name}.json").read_text())
        (content["arms"] if name == "results" else content).pop("rta")
        (half / f"{name}.json").write_text(json.dumps(content))
    (half / "report/training.csv").write_text("interactions,arm,metric,iqm,low,high\n")
    for name in ("guidance.json", "frequency.json", "episode_rta.npz"):
        (half / "report" / name).unlink()
    text = html.document(report_inputs.read(half))
    reader = Reader(text)
    assert text.count('class="missing"') == 4  # arm, training curves, guidance, frequency
    assert len(reader.images) == 6
    assert {len(row) for row in reader.tables[0][1:]} == {4}


def test_damaged_files_are_refused(made_up_study: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"results\.json: cannot read it"):
        html.write(tmp_path)
    damaged = tmp_path / "damaged"
    shutil.copytree(made_up_study, damaged)
    (damaged / "report/episode_rta.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"episode_rta\.npz: not an episode"):
        html.write(damaged)


def test_small_violations_are_not_called_zero() -> None:
    assert [percent(value) for value in (0.0, 0.0004, 0.0005, 4.2364)] == [
        "0.000",
        "< 0.001",
        "0.001",
        "4.236",
    ]


def test_differences_are_bold_where_intervals_do_not_overlap() -> None:
    paper = (2.0, 1.9, 2.1)
    assert difference((2.2, 2.05, 2.3), paper, 2) == "+0.20"
    assert difference((2.2, 2.15, 2.3), paper, 2) == "<strong>+0.20</strong>"
    assert difference((1.0, 0.9, 1.1), paper, 2) == "<strong>-1.00</strong>"
    assert difference((1.999, 1.9, 2.1), paper, 2) == "+0.00"

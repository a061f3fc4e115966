"""The tables of the README and of docs/ are what the files in runs/reference/ give, and a wrong number is found."""

from pathlib import Path

import pytest

from docs import tables
from study.files import ROOT

RESULTS = "docs/results/results.md"


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", tables.PAGES)
def test_every_table_is_what_the_files_give(page: str) -> None:
    """If not: `python -m docs.tables`. Rows have the cells of their heading."""
    assert tables.renewed(text(page)) == text(page)
    for table in tables.TABLE.finditer(text(page)):
        assert len({line.count("|") for line in table[0].splitlines()[1:]}) == 1, table[1]


def test_every_table_is_on_a_page() -> None:
    marks = [name for page in tables.PAGES for _, name in tables.TABLE.findall(text(page))]
    assert set(marks) == set(tables.TABLES)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("| 4.426 [4.386, 4.467] |", "| 1.505 [4.386, 4.467] |"),
        ("| PSM | 0.019 | 0.989 |", "| PSM | 0.019 |"),
        ("| y velocity limit | 0.000 | 0.000 | 0.000 | 0.079 | 0.000 | 0.000 |\n", ""),
    ],
)
def test_a_wrong_number_is_found_and_renewed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    right: str,
    wrong: str,
) -> None:
    page = tmp_path / "page.md"
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    monkeypatch.setattr(tables, "PAGES", ("page.md",))
    assert text(RESULTS).count(right) == 1
    page.write_text(text(RESULTS).replace(right, wrong), encoding="utf-8")
    tables.main()
    assert page.read_text(encoding="utf-8") == text(RESULTS)
    tables.main()
    assert capsys.readouterr().out == "page.md: renewed\n"


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        (
            "<!-- rows: papers_hidden -->",
            "<!-- rows: absent -->",
            "absent -->: docs/tables.py has no such table",
        ),
        ("<!-- rows: papers_hidden -->\n", "<!-- rows: papers_hidden -->\n\n", "14 marks"),
    ],
)
def test_a_mark_that_leads_nowhere_is_refused(right: str, wrong: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        tables.renewed(text(RESULTS).replace(right, wrong, 1))

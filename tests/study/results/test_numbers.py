"""The numbers of the README and of docs/ are those of the files in runs/reference/, and a wrong one is found."""

from pathlib import Path

import pytest

from study.files import ROOT
from study.results.numbers import __main__ as numbers

RESULTS = "docs/results/results.md"


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", numbers.PAGES)
def test_every_number_is_the_files(page: str) -> None:
    """If not: `python -m study.results.numbers`."""
    assert numbers.renewed(page) == text(page)


def test_every_subject_writes_on_pages_that_exist() -> None:
    marks = [mark[1:] for page in numbers.PAGES for mark in numbers.TABLE.findall(text(page))]
    assert len(marks) > 25 and {subject for subject, _ in marks} == set(numbers.SUBJECTS)
    subjects = numbers.SUBJECTS.values()
    assert {page for subject in subjects for page, _ in subject.sentences()} < set(numbers.PAGES)


@pytest.mark.parametrize("page", numbers.PAGES)
def test_rows_have_the_cells_of_their_heading(page: str) -> None:
    for table in numbers.TABLE.finditer(text(page)):
        assert len({line.count("|") for line in table[0].splitlines()[1:]}) == 1, table[1]


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the page of results, the only page there is."""
    copy = tmp_path / RESULTS
    copy.parent.mkdir(parents=True)
    copy.write_text(text(RESULTS), encoding="utf-8")
    monkeypatch.setattr(numbers, "ROOT", tmp_path)
    monkeypatch.setattr(numbers, "PAGES", (RESULTS,))
    return copy


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("| 1.744 [1.734, 1.754] |", "| 1.505 [1.734, 1.754] |"),
        ("| PSM | 0.008 | 0.989 |", "| PSM | 0.008 |"),
        ("| y velocity limit | 0.000 | 0.000 | 0.000 | 0.079 |\n", ""),
        ("Training took 112 minutes", "Training took 1,067.5 minutes"),
        ("order of fuel: 5.6 m/s", "order\nof fuel: -5e-06 m/s"),
    ],
)
def test_a_wrong_number_is_found_and_renewed(
    page: Path, capsys: pytest.CaptureFixture[str], right: str, wrong: str
) -> None:
    assert numbers.main([]) == 0 and capsys.readouterr().out == ""
    assert text(RESULTS).count(right) == 1
    page.write_text(text(RESULTS).replace(right, wrong), encoding="utf-8")
    assert numbers.main([]) == 0 and capsys.readouterr().out == f"{RESULTS}: renewed\n"
    assert page.read_text(encoding="utf-8").split() == text(RESULTS).split()


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("Training took", "Learning took", "0 sentences instead of one with the words of 'Training took "),
        ("## Seeds\n", "## Seeds\n\nTraining took 1 minutes", "2 sentences instead of one"),
        (
            "<!-- rows: agents.hidden",
            "<!-- rows: agents.absent",
            "agents.absent -->: there is no such function",
        ),
        ("<!-- rows: agents.hidden -->\n", "<!-- rows: agents.hidden -->\n\n", "12 marks"),
    ],
)
def test_what_cannot_be_written_ends_in_one_line_and_exit_code_2(
    page: Path, capsys: pytest.CaptureFixture[str], right: str, wrong: str, said: str
) -> None:
    broken = text(RESULTS).replace(right, wrong, 1)
    page.write_text(broken, encoding="utf-8")
    assert numbers.main([]) == 2
    error = capsys.readouterr().err
    assert (
        error.startswith(f"error: {RESULTS}: cannot write its numbers: ")
        and said in error
        and error.count("\n") == 1
    )
    assert page.read_text(encoding="utf-8") == broken

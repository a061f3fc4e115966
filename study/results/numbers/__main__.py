"""Writes the numbers of the README and of docs/ from the files in runs/reference/.

    python -m study.results.numbers

The rows of a table come from the function that a comment above it names, `<!-- rows: MODULE.FUNCTION -->`, with MODULE
one of this package. The table's heading is the page's own. A sentence needs no comment: `sentences` of these modules
have its words as they are on the page, and only its numbers are written.
"""

import re
import sys
from itertools import zip_longest

from settings import InputError, Parser
from study.errors import MALFORMED, refusing
from study.files import ROOT, write_text
from study.results.numbers import agents, basilisk, learning, safety, speed, vehicles

SUBJECTS = {
    module.__name__.rpartition(".")[2]: module
    for module in (agents, basilisk, learning, safety, speed, vehicles)
}
PAGES = ("README.md", *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")))
MARK = "<!-- rows:"
TABLE = re.compile(
    rf"(?m)^({MARK} (\w+)\.(\w+) -->\n(?:\|.*\n){{2}})(?:\|.*\n)*"
)  # the mark, the heading; the rows
NUMBER = r"-?\d(?:[\d,]*\d)?(?:\.\d+)?(?:e[-+]?\d+)?"


def with_rows(page: str) -> str:
    """A page's text with the rows of its marked tables.

    Raises:
        ValueError: a mark names no function, or no table follows it.
    """

    def rows(table: re.Match[str]) -> str:
        heading, module, function = table.groups()
        found = getattr(SUBJECTS.get(module), function, None)
        if found is None:
            raise ValueError(f"{MARK} {module}.{function} -->: there is no such function in {__package__}")
        return heading + "".join(f"| {' | '.join(row)} |\n" for row in found())

    text, count = TABLE.subn(rows, page)
    if count != page.count(MARK):
        raise ValueError(
            f"{page.count(MARK)} marks '{MARK} MODULE.FUNCTION -->', but {count} tables after one"
        )
    return text


def with_sentence(page: str, sentence: str) -> str:
    """A page's text with the numbers of this sentence, whose words it has exactly once, in lines of any length.

    Raises:
        ValueError: it does not.
    """
    words = [r"\s+".join(map(re.escape, re.split(r"\s+", each))) for each in re.split(NUMBER, sentence)]
    found = list(re.finditer("(" + f"){NUMBER}(".join(words) + ")", page))
    if len(found) != 1:
        raise ValueError(f"{len(found)} sentences instead of one with the words of {sentence!r}")
    numbers = re.findall(NUMBER, sentence)
    written = "".join(text for pair in zip_longest(found[0].groups(), numbers, fillvalue="") for text in pair)
    return page[: found[0].start()] + written + page[found[0].end() :]


def renewed(name: str) -> str:
    """The text of a page with the numbers of the files.

    Raises:
        InputError: the page or a file cannot be read, or the page lacks a sentence, or a table after a mark.
    """
    with refusing(f"{name}: cannot write its numbers", OSError, *MALFORMED):
        page = with_rows((ROOT / name).read_text(encoding="utf-8"))
        for subject in SUBJECTS.values():
            for where, sentence in subject.sentences():
                if where == name:
                    page = with_sentence(page, sentence)
    return page


def main(argv: list[str] | None = None) -> int:
    """Renews every page and says which changed; returns the exit code."""
    Parser(prog=f"python -m {__package__}", description=__doc__.splitlines()[0]).parse_args(argv)
    try:
        for name in PAGES:
            text = renewed(name)
            if text != (ROOT / name).read_text(encoding="utf-8"):
                write_text(ROOT / name, text)
                print(f"{name}: renewed")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

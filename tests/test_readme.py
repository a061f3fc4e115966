"""The links and commands of the README and of docs lead somewhere, and what their words say of the results is true.

Their tables are written by `docs.tables`, see `tests/test_tables.py`.
"""

import argparse
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

import main
from docs.tables import PAGES, campaign
from study.files import ROOT

SAFETY, COMMANDS_PAGE = "docs/results/safety.md", "docs/reference/commands.md"


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


# statements of the pages about the results


CAMPAIGNS = sorted(path.stem for path in (ROOT / "runs/reference/verification").glob("*.json"))


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_every_campaign_kept_every_limit(name: str) -> None:
    found = campaign(name)
    assert not found["violating_episodes"]["any"] and not found["unsolved"]
    assert not found["filter_calls"]["unsolved"]
    if name.startswith(("learned", "u1_learned", "lookahead", "u1_lookahead", "adversarial_")):
        seconds = 300 if "lookahead" in name else 2000  # as safety.md says
        assert found["campaign"]["duration"] == seconds


# links and commands


def anchors(page: Path) -> set[str]:
    """Returns the names that GitHub gives to a page's titles."""
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
    folders = ("inspection", "rta", "ppo", "interfaces", "study", "experiments", "configs", "docs", "tests")
    for folder in folders:
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".toml", ".j2", ".slurm"):
                content = path.read_text(encoding="utf-8")
                for page in re.findall(r"\bdocs/[\w/]+\.\w+", content):
                    assert (ROOT / page).exists(), f"{path}: {page}"


def commands(page: str) -> Iterator[list[str]]:
    """Yields the words of every command on a page, and of every line of a program there, in their order."""
    for line in text(page).replace("\\\n", " ").splitlines():
        for command in line.split("&&"):
            if re.match(r"\s*(python (?!-m timeit)|torchrun |tensorboard )", command):
                yield shlex.split(command, comments=True)
            elif found := re.search(r"np\.(load|savez?)\(\"([^\"]+)\"", command):
                yield [found[1], found[2]]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_parses(page: str) -> None:
    parser = main.build_parser()
    for words in commands(page):
        if "main.py" in words:
            parser.parse_args(main.with_values(words[words.index("main.py") + 1 :]))


READ = (
    *(
        "load",
        "replay",
        "refly",
        "--config",
        "--checkpoint",
        "--actions",
        "--initial-state",
        "--states",
        "--study",
    ),
    *("--resume", "--init-from", "--logdir", "-r"),
)
WRITTEN = ("save", "savez", "--out", "--json", "--figure", "--filter", "--c", "--run-dir", "--study-dir")


@pytest.mark.parametrize("page", ["README.md", COMMANDS_PAGE, "docs/README.md"])
def test_every_file_of_a_command_is_there_or_was_written_before(page: str) -> None:
    """In the order of the page, from a fresh clone."""
    written = {Path(name) for name in re.findall(r"`([\w.]+)`[^`]*\n\n```toml", text(page))}
    for words in commands(page):
        named = [(flag, Path(name)) for flag, name in pairwise(words)]
        for flag, path in named:
            if flag in READ:
                assert (ROOT / path).exists() or written & {path, *path.parents}, words
        written |= {path for flag, path in named if flag in WRITTEN}


@pytest.mark.parametrize("command", main.COMMANDS)
def test_the_page_of_commands_has_every_flag(command: str) -> None:
    sections = re.split(r"(?m)^## (.*)\n", text(COMMANDS_PAGE))
    section = dict(zip(sections[1::2], sections[2::2], strict=True))
    content = section[command]
    said = {name for name in re.findall(r"`(--[a-z-]+)", content) if not name.startswith("--no-")}
    parser = main.build_parser()._subparsers._group_actions[0].choices[command]
    shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    names = {action.option_strings[0] for action in shown if action.option_strings}
    common = set(re.findall(r"`(--[a-z-]+)", section["Common flags"] + section["Flags of settings"]))
    assert said <= names and names - said <= common | {"-h"}

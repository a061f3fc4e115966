"""The table of requirements: every link leads to code, to a test and to evidence, and nothing is left out."""

import ast
import functools
import re
from pathlib import Path
from typing import NamedTuple

import pytest

from inspection.observation import components
from inspection.reward import REWARDS
from inspection.termination import OUTCOMES
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from study.files import ROOT
from tests import test_readme

anchors = functools.cache(test_readme.anchors)
PAGE = ROOT / "docs/reference/requirements.md"
LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")
NAMED = {
    "Limits": CONSTRAINTS,
    "Priorities": CONSTRAINTS,
    "Reward": REWARDS,
    "Observations": tuple(each.name for each in components()),
    "Outcomes": OUTCOMES,
}


class Row(NamedTuple):
    """A requirement, the links (text, target) to code, tests and evidence, and the section it is in."""

    section: str
    requirement: str
    code: list[tuple[str, str]]
    tests: list[tuple[str, str]]
    evidence: list[tuple[str, str]]


def rows(text: str) -> list[Row]:
    found, section = [], ""
    for line in text.splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ")
        elif line.startswith("| ") and not line.startswith("| requirement |"):
            requirement, *links = line.strip("| ").split(" | ")
            found.append(Row(section, requirement, *(LINK.findall(cell) for cell in links)))
    return found


@functools.cache
def defined(path: Path) -> set[str]:
    """The functions, classes and assigned names of a module, those of a class as CLASS.NAME."""
    names: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            names.update(prefix + each.id for each in targets if isinstance(each, ast.Name))

    visit(ast.parse(path.read_text(encoding="utf-8")).body, "")
    return names


def wrong(text: str) -> list[str]:
    """What is wrong with the page."""
    found = rows(text)
    problems = [
        f"{row.requirement}: no {kind}" for row in found for kind in row._fields[2:] if not getattr(row, kind)
    ]
    for row in found:
        for name, target in row.code + row.tests:
            path = PAGE.parent / target
            if not path.is_file() or name not in defined(path):
                problems.append(f"{row.requirement}: {name} is not in {target}")
        for name, target in row.tests:
            if not (name.startswith("test_") and "/tests/" in target):
                problems.append(f"{row.requirement}: {name} is no test")
        for _, target in row.evidence:
            path, _, anchor = target.partition("#")
            file = PAGE.parent / path
            measured = "/runs/reference/" in target or (anchor and file.is_file() and anchor in anchors(file))
            if not file.is_file() or not measured:
                problems.append(f"{row.requirement}: {target} is no evidence")
    for section, names in NAMED.items():
        said = [
            name
            for row in found
            if row.section == section
            for name in re.findall(r"`(\w+)`", row.requirement)
        ]
        problems += [
            f"{section}: {name} stands there {said.count(name)} times"
            for name in names
            if said.count(name) != 1
        ]
    return problems


def test_every_requirement_has_code_a_test_and_evidence() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert len(rows(text)) > 50
    assert not wrong(text)


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("[dynamic_speed](", "[static_speed](", "static_speed is not in"),
        ("[SafetyFilter.correct](", "[SafetyFilter.corrects](", "SafetyFilter.corrects is not in"),
        ("tests/rta/qp/test_programs.py", "tests/rta/test_pq.py", "is not in ../../tests/rta/test_pq.py"),
        (
            "[test_points_earn_their_weight](../../tests/inspection/test_observation_and_reward.py)",
            "",
            "no tests",
        ),
        (
            "../results/safety_tests.md#what-was-flown",
            "../results/safety_tests.md#what-was-sailed",
            "is no evidence",
        ),
        ("verification/random.json", "verification/absent.json", "is no evidence"),
        ("`crash`: nearer", "nearer", "Outcomes: crash stands there 0 times"),
        ("`sun_alignment`", "", "Observations: sun_alignment stands there 0 times"),
        ("`battery`: at least", "`temperature`: at least", "Limits: temperature stands there 2 times"),
    ],
)
def test_what_is_wrong_is_found(before: str, after: str, said: str) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert before in text
    assert any(said in problem for problem in wrong(text.replace(before, after)))


def test_the_priorities_are_the_filters() -> None:
    """The weights of the limits rise with the priority that the page says."""
    weights = {each.name: each.weight for group in SafetyFilter().groups for each in group.of_row}
    classes = [
        {weights[name] for name in re.findall(r"`(\w+)`", row.requirement)}
        for row in rows(PAGE.read_text(encoding="utf-8"))
        if row.requirement.startswith("Priority")
    ]
    assert [len(each) for each in classes] == [1] * 4
    assert sorted(classes, key=min) == classes and len(set.union(*classes)) == 4

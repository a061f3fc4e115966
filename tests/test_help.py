"""What --help says is so: defaults, what is changed daily first, and an example that parses."""

import argparse
import re
from collections.abc import Iterator
from typing import Any

import pytest

import main
from settings import Settings, literal, rules
from study.config import Config, StudyConfig

OF_AGENT = {"evaluate", "simulate", "play", "verify"}  # which fly an agent, in the settings of its training
DEFAULT = re.compile(r" \(default: (.*)\)$")


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Returns the parser of each command."""
    return main.build_parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr, return-value]


def flags(command: str) -> Iterator[tuple[argparse.Action, str]]:
    """Yields the flags that a command's --help shows, each with the default given there, or ""."""
    for action in parsers()[command]._actions:
        if action.help and action.help != argparse.SUPPRESS and action.dest != "help":
            found = DEFAULT.search(action.help)
            yield action, found[1] if found else ""


def settings() -> dict[str, Any]:
    """Returns the default of every setting by table and key."""
    tables = (vars(Config()) | vars(StudyConfig())).items()
    return {
        f"{name}.{key}": getattr(table, key)
        for name, table in tables
        if isinstance(table, Settings)
        for key in rules(type(table))
    }


@pytest.mark.parametrize("command", main.COMMANDS)
def test_every_default_is_the_one_that_is_said(command: str) -> None:
    usual, said = settings(), 0
    for action, shown in flags(command):
        if not shown:
            continue
        said += 1
        if action.dest in usual:
            agents = "the agent's, else " if command in OF_AGENT and action.dest != "rta.qp_solver" else ""
            assert shown == agents + literal(usual[action.dest]), action.option_strings
        elif isinstance(action.default, bool):
            assert shown == ("on" if action.default else "off"), action.option_strings
        elif isinstance(action.default, int | float):
            assert float(shown.replace(",", "")) == action.default, action.option_strings
        elif isinstance(action.default, str):
            assert shown == action.default, action.option_strings
        else:
            assert action.default is None  # described in words
    assert said >= 2 or command in ("replay", "refly", "report")


@pytest.mark.parametrize(
    ("call", "flag", "shown"),
    [
        ("evaluate", "--seed", "0"),
        ("simulate", "--step", "1"),
        ("verify", "--check-every", "1"),
        ("verify", "--keep-worst", "off"),
        ("train", "--rta", "true"),
        ("evaluate", "--rta", "the agent's, else true"),
        ("simulate", "--rta-period", "the agent's, else 1.0"),
        ("evaluate", "--qp-solver", '"auto"'),
        ("evaluate", "--episodes", "100"),
        ("verify", "--duration", "2,000"),
    ],
)
def test_defaults_that_are_easily_mistaken(call: str, flag: str, shown: str) -> None:
    assert {found for action, found in flags(call) if flag in action.option_strings} == {shown}


@pytest.mark.parametrize("command", main.COMMANDS)
def test_an_example_stands_in_the_help_and_can_be_called(command: str) -> None:
    help_of = " ".join(parsers()[command].format_help().split())
    (words,) = re.findall(r"example: python main\.py (.*)$", help_of)
    given = main.build_parser().parse_args(words.split())
    assert given.command == command


def test_what_is_changed_daily_comes_first_and_the_machine_last() -> None:
    shown = [action.option_strings[0] for action, _ in flags("train")]
    daily = ("--rta", "--rta-filter", "--rta-period", "--seed", "--interactions")
    assert shown[:4] == ["--run-dir", "--init-from", "--resume", "--config"]
    assert tuple(shown[4:9]) == daily
    assert shown[-2:] == ["--threads", "--cache-dir"]
    assert [action.option_strings[0] for action, _ in flags("evaluate")][:2] == [
        "--checkpoint",
        "--controller",
    ]

"""The links and commands of the README and of docs lead somewhere, and what their words say of the results is true.

Their tables are written by `docs.tables`, see `tests/test_tables.py`.
"""

import argparse
import re
import shlex
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import main
from docs.tables import CHIEFS, PAGES, POLICIES, VEHICLES, arms, campaign, read, report
from settings import load
from study.config import Config
from study.files import ROOT
from study.verified import fingerprint

SAFETY, COMMANDS_PAGE = "docs/results/safety.md", "docs/reference/commands.md"


def middle(results: dict[str, Any], metric: str) -> float:
    """The interquartile mean."""
    return results["metrics"][metric]["iqm"]


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def test_the_front_page_is_short() -> None:
    assert len(text("README.md").splitlines()) <= 110


# what the words say of the results


def test_random_controls_succeed_behind_the_filter_with_hundreds_of_times_the_fuel() -> None:
    random = report("baselines")["random"]["on"]
    assert random["outcomes"]["success"] == 1.0
    assert middle(random, "delta_v_m_s") > 200.0 * max(
        middle(each, "delta_v_m_s") for each in arms().values()
    )


def test_the_guidance_that_rolls_needs_less_fuel_than_agents_at_equal_time() -> None:
    names = "delta_v_m_s", "episode_length_s"
    fuel, time = ([middle(each, name) for each in reversed(report("front").values())] for name in names)
    for agents in arms().values():
        own, flown = (middle(agents, name) for name in names)
        assert 1.0 < own / np.interp(flown, time, fuel) < 1.2


def test_the_papers_learner_pays_for_the_filter_in_reward_and_not_in_torque() -> None:
    without, behind = (arms("paper")[arm] for arm in ("no_rta", "rta"))
    assert all(middle(behind, name) < middle(without, name) for name in ("reward", "torque_n_m"))
    assert middle(behind, "delta_v_m_s") > middle(without, "delta_v_m_s")


CAMPAIGNS = sorted(
    path.stem
    for path in (ROOT / "runs/reference/verification").glob("*.json")
    if path.stem not in ("boundary", "break_points")  # these report violations
)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_every_campaign_kept_every_limit(name: str) -> None:
    found = campaign(name)
    assert not found["violating_episodes"]["any"] and not found["unsolved"]
    assert not found["filter_calls"]["unsolved"]
    if name.startswith(("learned", "u1_learned", "lookahead", "u1_lookahead", "adversarial_")):
        seconds = 300 if "lookahead" in name else 2000  # as safety.md says
        assert found["campaign"]["duration"] == seconds


def test_what_breaks_the_filter_stands_beside_what_it_held() -> None:
    """On the front page, as the programs of the page on safety print it."""
    beyond = re.findall(r"(?m)^beyond the edge: (-?[\d.]+) m with errors that stay", text(SAFETY))
    (starts,) = re.findall(r"(?m)^1 s: (\d+) % of [\d,]+ states$", text(SAFETY))
    said = " ".join(text("README.md").split())
    checked, unchecked = map(float, beyond)
    assert checked < 0.0 and unchecked < 0.0 and "where the filter checks, they no longer do" in said
    assert f"states as starts**: {starts} % of those within every limit" in said


def test_both_simulators_agree_as_the_page_says() -> None:
    found = read("basilisk/basilisk.json")
    coasting = found["coasting"]
    assert coasting["times_real_time"] > 1000 > coasting["one_alone_times_real_time"] > 100
    assert coasting["perturbed"]["drag"]["position_m"] == pytest.approx(1e-3, rel=0.2)  # "a millimetre"
    names = ("reward", "episode_length_s", "delta_v_m_s")
    for worlds in found["agents"].values():
        assert not any(found["other_outcomes"] for found in worlds.values())
        for world in ("basilisk", "basilisk, J2 and drag"):  # "no mean differs by two standard errors"
            apart = worlds[world]["difference"]
            assert all(abs(apart[name]["mean"]) <= 2 * apart[name]["standard_error"] for name in names)
        pulses = worlds[
            "basilisk, wheels and pulses"
        ]  # "save a tenth of the fuel and take some seconds longer"
        apart, mean = pulses["difference"], pulses["mean"]
        assert (
            0.09 < -apart["delta_v_m_s"]["mean"] / (mean["delta_v_m_s"] - apart["delta_v_m_s"]["mean"]) < 0.13
        )
        assert 2 <= round(apart["episode_length_s"]["mean"]) <= 14


@pytest.mark.parametrize("policy", [*POLICIES, "lookahead"])
def test_the_filter_holds_in_basilisk_as_the_page_says(policy: str) -> None:
    found = read(f"basilisk/u1_{policy}.json")
    assert found["violating_episodes"]["any"] == found["unsolved"] == 0
    assert found["config"]["plant"]["simulator"] == "basilisk"


@pytest.mark.parametrize("name", [*VEHICLES, "hull"])
def test_what_was_flown_is_what_is_shipped(name: str) -> None:
    files = ("chiefs/box", "chiefs/hull") if name == "hull" else (f"vehicles/{name}",)
    task = Config()
    for file in files:
        task = load(ROOT / f"configs/{file}.toml", task)
    assert all(campaign(f"{name}_{policy}")["fingerprint"] == fingerprint(task) for policy in POLICIES)


def test_agents_of_other_vehicles_and_chiefs_succeed() -> None:
    for name in VEHICLES:
        assert arms(f"vehicles/{name}")["rta"]["outcomes"]["success"] >= 0.99
    for name in CHIEFS:
        without = read(f"chiefs/{name}/report/sunlight.json")[
            "without"
        ]  # nobody can solve these cases of 100
        assert arms(f"chiefs/{name}")["rta"]["outcomes"]["success"] == 1.0 - without / 100


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
    folders = ("inspection", "rta", "ppo", "interfaces", "study", "experiments", "configs", "docs", "tests")
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

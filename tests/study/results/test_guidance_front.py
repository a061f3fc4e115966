"""The guidance by its names is what the search has found, on cases that are not its own."""

import json
from itertools import combinations

import pytest

from inspection.orbits import GUIDANCE
from study.config import TEST_CASES
from study.files import ROOT
from study.results.guidance_front import UNSEEN_CASES, WAYS
from study.results.guidance_search import CONFIRM_CASES, SEARCH_CASES, orbit_of

FOUND = ROOT / "runs/reference/guidance"
LEADING = [name for name, orbit in GUIDANCE.items() if orbit.lead]


@pytest.mark.parametrize("name", LEADING)
def test_each_setting_is_of_the_front_and_keeps_the_margins_in_all_cases_of_the_search(name: str) -> None:
    """And in all of the 480 others but one, as the page says."""
    rows = json.loads((FOUND / "front.json").read_text(encoding="utf-8"))["front"]
    row, *_ = [row for row in rows if orbit_of(row["knobs"]) == GUIDANCE[name]]
    assert row["search"]["unclean"] == 0
    assert row["confirmed"]["unclean"] == 1


def test_what_is_shown_was_flown_by_every_guidance_on_cases_of_its_own() -> None:
    flown = json.loads((FOUND / "guidance.json").read_text(encoding="utf-8"))
    assert list(flown["guidance"]) == list(GUIDANCE)
    assert all(list(ways) == list(WAYS) for ways in flown["guidance"].values())
    assert (flown["seed"], flown["cases"]) == (UNSEEN_CASES, 1000)
    seeds = SEARCH_CASES, CONFIRM_CASES, UNSEEN_CASES, TEST_CASES
    assert all(one != other for one, other in combinations(seeds, 2))

"""The search of the guidance's knobs: its order against a definition, its front against a known one, its file."""

import json
from argparse import ArgumentTypeError
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from study.results import guidance_search
from study.results.guidance_search import (
    KNOBS,
    Candidate,
    Flights,
    front,
    knobs_at,
    place_of,
    ranks,
    search,
    searched,
)

CENTRE = 0.5  # of all knobs but the first on the known front


class Known:
    """In place of `Flights`, with a front that is known: (t, (1 - t)^2) of the first knob's place t from 0.2 on."""

    def __init__(self, candidates: int, cases: int, seed: int) -> None:
        self.candidates = candidates

    def fly(self, knobs: Sequence[tuple[float, ...]]) -> list[Candidate]:
        assert len(knobs) == self.candidates
        found = []
        for each in knobs:
            t, *others = place_of(each)
            away = float(np.square(np.array(others) - CENTRE).sum())
            unclean = 3 if t < 0.2 else 0
            found.append(Candidate(tuple(each), float(t), (1.0 - t) ** 2 + away, unclean))
        return found


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guidance_search, "Flights", Known)


def beats(one: Candidate, other: Candidate) -> bool:
    """The definition: cleaner, or as clean, nowhere worse and somewhere better."""
    if one.unclean != other.unclean:
        return one.unclean < other.unclean
    pairs = [(one.time_s, other.time_s), (one.delta_v_m_s, other.delta_v_m_s)]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def test_each_front_is_beaten_by_those_before_it_alone() -> None:
    draws = np.random.default_rng(0)
    values = zip(draws.integers(0, 6, 60), draws.integers(0, 6, 60), draws.integers(0, 3, 60), strict=True)
    candidates = [Candidate((float(i),), *map(int, each)) for i, each in enumerate(values)]
    rank = ranks(candidates)
    for each, own in zip(candidates, rank, strict=True):
        above = [r for other, r in zip(candidates, rank, strict=True) if beats(other, each)]
        assert own == 1 + max(above, default=-1)


@pytest.mark.usefixtures("known")
def test_a_known_front_is_found_within_its_clean_part(tmp_path: Path) -> None:
    candidates = search(tmp_path / "search.jsonl", 40, 40, 1)
    best = front(candidates)
    times, fuel = (np.array([getattr(each, name) for each in best]) for name in ("time_s", "delta_v_m_s"))
    assert times.min() >= 0.2 and times.min() < 0.25 and times.max() > 0.9 and len(best) > 20
    assert np.median(fuel - (1.0 - times) ** 2) < 0.02
    first = front(candidates[:40])  # of chance
    assert np.median([each.delta_v_m_s - (1.0 - each.time_s) ** 2 for each in first]) > 0.2


@pytest.mark.usefixtures("known")
def test_a_search_that_stopped_goes_on_as_if_it_had_not(tmp_path: Path) -> None:
    whole, stopped = tmp_path / "whole.jsonl", tmp_path / "stopped.jsonl"
    search(whole, 8, 4, 1)
    search(stopped, 8, 2, 1)
    with stopped.open("a", encoding="utf-8") as file:  # killed while it wrote
        file.write(whole.read_text(encoding="utf-8").splitlines()[2][:50])
    search(stopped, 8, 4, 1)
    assert stopped.read_text(encoding="utf-8") == whole.read_text(encoding="utf-8")


@pytest.mark.usefixtures("known")
def test_a_search_begins_with_an_earlier_front_from_end_to_end(tmp_path: Path) -> None:
    earlier = [knobs_at(np.full(len(KNOBS), place)) for place in np.linspace(0.2, 0.9, 15)]
    front_json = {"front": [{"knobs": dict(zip(KNOBS, each, strict=True))} for each in earlier]}
    (tmp_path / "front.json").write_text(json.dumps(front_json), encoding="utf-8")
    start = guidance_search.known(str(tmp_path / "front.json"))
    assert start == earlier
    first, second = search(tmp_path / "search.jsonl", 8, 2, 1, start)[::8]
    assert [each.knobs for each in searched(tmp_path / "search.jsonl")[0]] == earlier[::2]
    assert first.knobs == earlier[0] and second.knobs not in earlier
    with pytest.raises(ArgumentTypeError, match="not the front of a search"):
        guidance_search.known(str(tmp_path / "search.jsonl"))


@pytest.mark.usefixtures("known")
def test_knobs_stay_in_their_ranges_and_come_back_from_their_places(tmp_path: Path) -> None:
    for each in search(tmp_path / "search.jsonl", 20, 5, 1):
        for value, (low, high) in zip(each.knobs, KNOBS.values(), strict=True):
            assert low * (1 - 1e-3) <= value <= high * (1 + 1e-3)
        assert guidance_search.knobs_at(place_of(each.knobs)) == pytest.approx(each.knobs, rel=1e-3, abs=1e-9)


def test_a_candidate_beside_others_is_flown_as_it_is_alone() -> None:
    both = [
        (55.0, 30.0, 0.01, 0.5, 0.4, 0.7, 1.0, 0.3, 0.9),
        (60.0, 20.0, 0.004, 0.8, 0.3, 0.9, 0.5, 0.1, 1.0),
    ]
    together = Flights(2, 3, 5).fly(both)
    alone = Flights(1, 3, 5).fly(both[1:])
    assert together[1][1:] == pytest.approx(alone[0][1:], rel=1e-3)
    assert together[0].time_s < 5000.0 and together[0].unclean == 0 and together[0][1:3] != together[1][1:3]

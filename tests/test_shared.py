"""Filters that tests share are those that they would have had by themselves."""

from pathlib import Path

import pytest
import torch

import rta.filter
from inspection.initial_state import sample_initial_state
from inspection.model.parameters import InspectionParameters
from rta import SafetyFilter
from rta.backup import brake
from rta.parameters import RtaParameters
from tests.rta import test_actuator_groups as own_constraints
from tests.shared import SHARED, Once, draw


@pytest.fixture
def once() -> Once:
    found = Once()
    found.begin()
    return found


def made(safety_filter: SafetyFilter, *_: str) -> object:
    return object()


def test_equal_filters_are_shared_and_others_are_not(once: Once) -> None:
    one, without_check = once.call(made, SafetyFilter()), SafetyFilter()
    without_check.backup = None
    others = [
        SafetyFilter(parameters=RtaParameters(speed_gain=0.11)),
        SafetyFilter(InspectionParameters(mass=12.5)),
        SafetyFilter(extra=[own_constraints.OWN["sphere"][0]]),
        SafetyFilter(extra=[own_constraints.OWN["cone"][0]]),
        without_check,
    ]
    assert once.call(made, SafetyFilter(parameters=RtaParameters())) is one
    assert once.call(made, SafetyFilter(InspectionParameters(max_time=20.0))) is one  # no filter reads it
    assert (
        len({one, *(once.call(made, each) for each in others), once.call(made, SafetyFilter(), "float")}) == 7
    )


def test_what_one_process_has_printed_another_one_reads(tmp_path: Path) -> None:
    computed: list[float] = []

    def printed(safety_filter: SafetyFilter) -> list[float]:
        computed.append(safety_filter.period)
        return [safety_filter.period]

    told, own = RtaParameters(period=5.0), own_constraints.OWN["sphere"][0]
    for once in (Once(tmp_path), Once(tmp_path)):
        once.begin()
        assert once.call(printed, SafetyFilter(parameters=told)) == [5.0]
        assert once.call(printed, SafetyFilter()) == once.call(printed, SafetyFilter(extra=[own])) == [1.0]
    assert computed == [5.0, 1.0, 1.0, 1.0]  # a constraint of a test's own has no name that others know


@pytest.mark.parametrize(
    ("place", "name"),
    [(brake, "AT_REST"), (brake, "braked"), (SafetyFilter, "values"), (RtaParameters, "period")],
)
def test_what_a_test_puts_in_a_parts_place_is_in_its_filter_alone(
    place: object, name: str, once: Once, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = once.call(made, SafetyFilter())
    with monkeypatch.context() as patch:
        patch.setattr(place, name, 2.0)
        assert once.call(made, SafetyFilter(parameters=RtaParameters(period=1.0))) is not before
    assert once.call(made, SafetyFilter()) is before


def test_initial_states_are_drawn_once_for_equal_generators_and_filters(
    once: Once, monkeypatch: pytest.MonkeyPatch
) -> None:
    c, calls = InspectionParameters(), []
    is_safe = SafetyFilter.is_safe
    monkeypatch.setattr(SafetyFilter, "is_safe", lambda self, x: calls.append(x) or is_safe(self, x))
    once.begin()
    strict = SafetyFilter(InspectionParameters(exclusion_buffer=0.5))

    def both(seed: int, safety_filter: SafetyFilter) -> int:
        """How often the filter was asked for what is shared; that is what is drawn by itself."""
        ours, own = (torch.Generator().manual_seed(seed) for _ in range(2))
        asked = len(calls)
        found = [draw(once, 40, ours, c, safety_filter.is_safe) for _ in range(2)]  # one pool after another
        asked = len(calls) - asked
        for each in found:
            for part, expected in zip(
                each, sample_initial_state(40, own, c, safety_filter.is_safe), strict=True
            ):
                assert torch.equal(part, expected)
        assert torch.equal(ours.get_state(), own.get_state())
        return asked

    assert both(1, SafetyFilter()) and both(2, SafetyFilter()) and both(1, strict)
    assert both(1, SafetyFilter()) == both(1, strict) == 0
    monkeypatch.setattr(SafetyFilter, "correct", SafetyFilter.__call__)
    assert both(1, SafetyFilter())  # what is_safe may ask is a test's own


def test_what_is_shared_is_what_filters_call() -> None:
    assert (rta.filter, "BatchFilter") in SHARED
    for module, name in SHARED:
        assert isinstance(getattr(module, name).func.__self__, Once)

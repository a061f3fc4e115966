"""A vehicle that cannot hold a limit is refused, whatever its filter; the shipped ones hold theirs."""

from dataclasses import replace
from typing import Any

import pytest

from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from rta.vehicle import check

PAPER = InspectionParameters()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mass": 1e-300}, ["1e+300", "1e+06"]),
        ({"max_thrust": 0.1}, ["0.00833", "natural acceleration", "keep-in zone"]),
        ({"max_thrust": 0.6}, ["dynamic speed limit", "0.0475", "0.049"]),
        ({"max_thrust": 0.75}, ["across at the speed limit", "0.0506", "90%"]),
        ({"inertia": (0.3, 0.3, 0.01), "wheel_inertia": 1e-6}, ["gyroscopic", "at most half"]),
        ({"max_rate": 0.001}, ["max_rate = 0.001", "0.00103", "Sun"]),
        ({"power_draw": 25.0}, ["25 W", "22.7 W"]),
        ({"emissivity": 0.0}, ["does not cool"]),
    ],
)
def test_a_vehicle_that_cannot_hold_a_limit_is_refused_with_the_number(
    settings: dict[str, Any], words: list[str]
) -> None:
    c = replace(PAPER, **settings)
    for parameters in (RtaParameters(), RtaParameters(filter="paper"), RtaParameters(unverified=True)):
        with pytest.raises(ValueError) as refused:
            SafetyFilter(c, parameters)
        assert all(word in str(refused.value) for word in words) and "\n" not in str(refused.value)
    check(PAPER)

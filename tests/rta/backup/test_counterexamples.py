"""States on whose ways a law broke a limit that its plan kept: they are refused, or flown with nothing broken."""

import functools
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import Q
from rta.constraints.constraint import Constraint
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from settings import load
from study.config import Config

# position, velocity, attitude, rates, and temperature, charge and the Sun's angle
CAMPAIGN = pytest.mark.campaign
ALONG_THE_ZONE = {  # starts that are far out and fast, by period in s
    1.0: """396.459154 569.064568 328.658106  -3.916005 3.882933 1.568363  0.168598 0.614562 0.563901 0.525265
            -0.031032 -0.033549 0.015019  5.0 6.5 6.149597""",
    5.0: """301.22034 301.44564 -659.37797  -4.385562 -1.081647 -3.677801  -0.255119 0.050424 0.812369 0.521947
            -0.006739 0.034906 -0.000082  5.0 6.5 0.652854""",
    10.0: """-123.62049 494.86842 603.61029  -2.4820 -3.90993 3.48046  -0.595589 -0.034176 -0.769784 0.227019
             0.034906 -0.034638 0.012725  5.0 6.5 1.55096""",
}
UNEQUAL_MOMENTS = """100 0 0  0 0 0  0.326309 -0.121726 -0.936938 0.029202
                     -0.003149 -0.000305 0.002657  9.99 234 4.183952"""


def column(numbers: str) -> Tensor:
    x = torch.tensor([*map(float, numbers.split())], dtype=torch.float64)[:, None]
    x[Q] /= x[Q].norm()
    return x


@pytest.mark.parametrize("period", [*(pytest.param(period, marks=CAMPAIGN) for period in (1.0, 5.0)), 10.0])
def test_a_start_whose_way_breaks_a_limit_is_refused(period: float) -> None:
    safety = SafetyFilter(InspectionParameters(), RtaParameters(period=period))
    x = column(ALONG_THE_ZONE[period])
    assert safety.backup and (safety.values(x) >= 0.0).all()
    y, lowest = x, safety.values(x)
    for _ in range(round(70 / period)):
        u = safety.backup.law(y)
        for _ in range(round(period)):
            y = step(y, u, 1.0, safety.c)
            lowest = lowest.minimum(safety.values(y))
    assert not safety.is_safe(x).any() or (lowest >= 0.0).all()


LIMITS = {  # a velocity limit of the user's own that never yields: direction, and m/s, by period in s
    1.0: (0.5173, 0.7682, 0.3771, 1.5284),
    5.0: (0.3212, 0.474, -0.8199, 1.0741),
    10.0: (-0.279, 0.6202, 0.7332, 0.7996),
}


@functools.cache
def behind_the_filter(period: float) -> tuple[list[bool], list[bool]]:
    """Of each call with zero control desired and such a limit: it is verified; all 13 limits are kept after it."""
    *n, most = LIMITS[period]

    def own(y: Tensor) -> Tensor:
        return n[0] * y[3] + n[1] * y[4] + n[2] * y[5] - most

    mine = Constraint("mine", own, actuator="thrust", gains=(0.5,), weight=math.inf)
    safety = SafetyFilter(InspectionParameters(), RtaParameters(period=period), extra=[mine])
    safety.compile("cpu", 1)
    x = column(ALONG_THE_ZONE[period])
    verified: list[bool] = []
    kept: list[bool] = []
    for _ in range(min(10, round(50 / period))):
        answer = safety.correct(x, torch.zeros(6, 1, dtype=torch.float64))
        verified.append(bool(answer.verified))
        kept.append(True)
        for _ in range(round(period)):
            x = step(x, answer.control, 1.0, safety.c)
            kept[-1] &= bool((safety.values(x)[:13] >= 0.0).all())
    return verified, kept


@CAMPAIGN
@pytest.mark.parametrize("period", LIMITS)
def test_a_limit_of_the_users_own_does_not_lead_beyond_the_papers(period: float) -> None:
    verified, kept = behind_the_filter(period)
    assert all(kept) or not verified[0]
    assert not any(after < before for before, after in pairwise(verified))
    assert not any(said and not held for said, held in zip(verified, kept, strict=True))


def test_a_turn_with_unequal_moments_keeps_the_rates() -> None:
    config = load("vehicles/espa", Config())
    c = replace(config.inspection, saturate_rates=False)
    safety = SafetyFilter(c, replace(config.rta, period=10.0))
    x = column(UNEQUAL_MOMENTS)
    assert safety.backup
    if not safety.is_safe(x).all():
        return
    lowest = safety.values(x)
    for _ in range(20):
        u = safety.backup.law(x)
        for _ in range(10):
            x = step(x, u, 1.0, c)
            lowest = lowest.minimum(safety.values(x))
    assert (lowest >= 0.0).all()

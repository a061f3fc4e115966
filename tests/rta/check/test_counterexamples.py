"""States on whose ways a law broke a limit that its plan kept: they are refused, or flown with nothing broken."""

import functools
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.model.dynamics import step
from inspection.model.parameters import InspectionParameters, Limits
from inspection.model.state import OMEGA, TORQUE, Q
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.limits import Limit
from rta.parameters import RtaParameters
from settings import load
from study.config import Config
from tests.support.filters import Unproposed

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
    assert safety.check and (safety.values(x) >= 0.0).all()
    y, lowest = x, safety.values(x)
    for _ in range(round(70 / period)):
        u = safety.check.law(y)
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
    """Tells for each call with zero desired control and such a limit if it is verified, and keeps all 13 limits."""
    *n, most = LIMITS[period]

    def own(y: Tensor, c: Limits) -> Tensor:
        return n[0] * y[3] + n[1] * y[4] + n[2] * y[5] - most

    mine = {"mine": Limit(own, (0.5,), None)}
    safety = fast(SafetyFilter(InspectionParameters(), RtaParameters(period=period), mine))
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


# Turning at all limits of the rates, with a control at 10 s under which a plant that holds the rates keeps all limits
# in its own steps. In shorter ones they are clamped sooner and the named limit breaks, passive safety by 6.7 m. The
# check holds the rates itself: what is verified never meets the clamp.
CLAMPED = {
    "passive_safety": (
        """108.83062793259712 0.15979367526855467 -102.73916508785312  -0.8563259525965546 0.4816658868905582
           0.7439023280788077  -0.15142152428167893 -0.25818335406579923 -0.9418566454678843 0.1527044965589766
           -0.03490658503988659 0.03490658503988659 -0.03490658503988659  9.880520352243419 2.1276257418265305
           0.5976667226013289""",
        (-1.0, 1.0, -1.0, -0.0010000569, -0.0010000569, 0.0010000569),
    ),
    "keep_in_zone": (
        """-703.9936283247612 137.98702709696224 -353.48209268822797  -0.9543554533899095 -0.03335470629990248
           2.1144947978050213  -0.7540743866521811 -0.31890999047413227 -0.30687999289683504 -0.4852761145271464
           0.03490658503988659 0.03490658503988659 -0.03490658503988659  8.606916396439203 3.848895270780121
           5.421402165329955""",
        (-1.0, 1.0, -1.0, 0.0010000569, 0.0010000569, -0.0010000569),
    ),
    "velocity_x": (
        """203.54095655070523 -561.8961221931097 -289.8964444338497  4.5990946030406885 0.46260689913040753
           1.3193022541390302  -0.13537874352214357 -0.11132118913938814 -0.9842741297740111 0.022014225141295776
           -0.03490658503988659 0.03490658503988659 -0.03490658503988659  8.816460304908626 3.176202213072499
           0.07860994372960595""",
        (-1.0, 1.0, 1.0, -0.0010000569, 0.0010000569, -0.0010000569),
    ),
    "dynamic_speed": (
        """190.36682400828676 347.81999398443486 -425.29336452721407  1.8151405226998063 3.7053942409966543
           1.304115195672956  0.30300255068844145 0.3095932754845838 0.8999161019625367 -0.04992461797128228
           0.03490658503988659 -0.03490658503988659 -0.03490658503988659  7.9184429095431375 2.1575254225677196
           4.8950860213995435""",
        (-1.0, -1.0, 1.0, 0.0010000569, -0.0010000569, -0.0010000569),
    ),
}


@pytest.mark.parametrize("limit", CLAMPED)
def test_a_flight_that_is_looked_at_more_often_is_the_one_that_was_checked(limit: str) -> None:
    x, desired = column(CLAMPED[limit][0]), torch.tensor(CLAMPED[limit][1], dtype=torch.float64)[:, None]
    f = Unproposed(InspectionParameters(), RtaParameters(period=10.0))
    assert not f.is_safe(x) and not f.correct(x, desired).verified  # at its limit a rate has no room
    x[OMEGA] *= 1.0 - 1e-6
    answer = f.correct(x, desired)
    assert f.is_safe(x) and answer.verified and (answer.control != desired)[TORQUE].all()
    flown = []
    for every in (1.0, 0.1):
        env = InspectionEnv(1, f.c, [torch.Generator()], f.safety(), decide_every=10.0, report_every=every)
        env.start(x, torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64))
        holds = list(env.fly(lambda t, x: desired, 10.0))
        assert len(holds) == round(10.0 / every)
        assert all((f.values(hold.after) >= -1e-9).all() for hold in holds)
        flown.append(holds[-1].after)
    assert torch.equal(*flown)
    index, lowest = f.names.index(limit), []
    for control in (desired, answer.control):  # in a plant with shorter steps
        states = [x]
        for _ in range(1000):
            states.append(step(states[-1], control, 0.01, f.c))
        lowest.append(f.values(torch.cat(states, 1)))
    assert lowest[0][index].min() < 0.0 and (lowest[1] >= -1e-9).all()


def test_a_turn_with_unequal_moments_keeps_the_rates() -> None:
    config = load("vehicles/espa", Config())
    c = replace(config.inspection, saturate_rates=False)
    safety = SafetyFilter(c, replace(config.rta, period=10.0))
    x = column(UNEQUAL_MOMENTS)
    assert safety.check
    if not safety.is_safe(x).all():
        return
    lowest = safety.values(x)
    for _ in range(20):
        u = safety.check.law(x)
        for _ in range(10):
            x = step(x, u, 1.0, c)
            lowest = lowest.minimum(safety.values(x))
    assert (lowest >= 0.0).all()

"""The filter's settings: what is refused, the solver, and gains at the filter's period."""

import math
from typing import Any

import pytest

from inspection.model.parameters import InspectionParameters
from inspection.world.uncertainty import Uncertainty
from rta.fast.filter import fast
from rta.fast.program import FastProgram
from rta.filter import SafetyFilter
from rta.limits import PAPER
from rta.paper import PaperFilter
from rta.parameters import PERIODS, QP_SOLVERS, RtaParameters
from rta.robust.filter import RobustFilter
from study.machine import finds_compiler

C = InspectionParameters()


@pytest.mark.parametrize("period", PERIODS)
def test_gains_are_capped_at_half_the_calls_per_second(period: float) -> None:
    cap = 0.5 / period
    found = SafetyFilter(C, RtaParameters(period=period)).limits
    assert list(found) == list(PAPER)
    for name, limit in PAPER.items():
        assert found[name].gains == tuple(min(gain, cap) for gain in limit.gains)
        assert found[name].h is limit.h and found[name].weight == limit.weight
    assert (found == PAPER) == (period == 1.0)


def test_gains_are_capped_for_the_longest_hold() -> None:
    found = RobustFilter(C, uncertainty=Uncertainty(longest_hold=3.0, position=0.1))
    assert found.longest_hold == 3.0
    assert found.limits["dynamic_speed"].gains == (0.5 / 3.0,) and found.limits["collision"].gains == (0.1,)


@pytest.mark.parametrize("filter_", ["checked", "paper"])
def test_the_solver_is_the_one_that_is_named(filter_: str) -> None:
    named = {"auto": "batched" if filter_ == "checked" else "piqp", "piqp": "piqp", "batched": "batched"}
    for name in QP_SOLVERS:
        if filter_ == "paper" and name == "batched":
            with pytest.raises(ValueError, match='qp_solver = "batched": must be "piqp" or "auto"'):
                RtaParameters(filter=filter_, qp_solver=name)
            continue
        parameters = RtaParameters(filter=filter_, qp_solver=name)
        assert parameters.solver == named[name]
        made = SafetyFilter(C, parameters)
        assert type(made.program) is PaperFilter  # it is written to be read
        if finds_compiler():
            solver = FastProgram if named[name] == "batched" else PaperFilter
            assert type(fast(made).program) is solver


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"filter": "none"}, "filter"),
        ({"period": 2.0}, "period"),
        ({"period": math.nan}, "period"),
        ({"qp_solver": "quadprog"}, "qp_solver"),
        ({"unverified": 1}, "unverified"),
    ],
)
def test_what_is_no_setting_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        RtaParameters(**given)

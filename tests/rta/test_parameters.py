"""The filter's settings: what is refused, and gains at the filter's period."""

import math

import pytest
import torch

from inspection.model.parameters import InspectionParameters
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.parameters import PERIODS, QP_SOLVERS, RtaParameters
from rta.qp.active_set import ActiveSet
from rta.qp.piqp_solver import PiqpSolver
from tests.oracles import paper, states, tensor

C = InspectionParameters()
R = RtaParameters()
X = tensor(states(100))


@pytest.mark.parametrize("period", PERIODS)
def test_gains_are_capped_at_half_the_calls_per_second(period: float) -> None:
    cap = 0.5 / period
    r = RtaParameters(period=period, speed_gain=3.0, battery_gains=(2.0, 4.0))
    assert r.gain(3.0) == r.gain(math.inf) == cap
    assert r.gain(R.collision_gain) == min(R.collision_gain, cap)
    capped = RtaParameters(period=period, speed_gain=cap, battery_gains=(cap, cap))
    for rows, expected in zip(SafetyFilter(C, r).rows(X), SafetyFilter(C, capped).rows(X), strict=True):
        for name, value in vars(expected).items():
            assert torch.equal(getattr(rows, name), value)
    h = tensor(paper(X.numpy()))
    safety = SafetyFilter(C, r)
    for i, name, gains, margin in (
        (0, "collision", (R.collision_gain,), R.collision_margin),
        (1, "attitude_exclusion", R.exclusion_gains, R.exclusion_margin),
        (1, "battery", (cap, cap), R.battery_margin),
    ):
        spent = math.prod(min(gain, cap) for gain in gains) * margin
        rows, of_row = safety.rows(X)[i], safety.groups[i].of_row
        own = [row for row, each in enumerate(of_row) if each.name == name]
        (row,) = own
        within = h[CONSTRAINTS.index(name)] >= 0.0
        assert within.sum() >= 20
        added = (rows.b_no_margin - rows.b)[row, within]
        torch.testing.assert_close(added, torch.full_like(added, spent))


def test_passive_safety_segments_must_end_at_the_horizon() -> None:
    with pytest.raises(ValueError, match="horizon"):
        SafetyFilter(C, RtaParameters(passive_safety_segments=(0.0, 400.0)))


def test_the_solver_is_the_one_that_is_named() -> None:
    solvers = [type(SafetyFilter(C, RtaParameters(qp_solver=name)).solver) for name in QP_SOLVERS]
    assert solvers == [ActiveSet, PiqpSolver, ActiveSet]
    given = ActiveSet()
    assert SafetyFilter(C, RtaParameters(qp_solver="piqp"), given).solver is given


@pytest.mark.parametrize(
    ("period", "rows", "is_sampled", "is_held"),
    [
        (1.0, "auto", False, False),
        (1.0, "sampled", True, False),
        (1.0, "none", False, False),
        (10.0, "auto", True, True),
        (10.0, "paper", False, True),
        (10.0, "none", False, True),
    ],
)
def test_rows_are_sampled_where_they_are_and_not_where_a_control_is_held(
    period: float, rows: str, is_sampled: bool, is_held: bool
) -> None:
    safety = SafetyFilter(C, RtaParameters(period=period, rows=rows))
    assert (safety.is_sampled, safety.is_held) == (is_sampled, is_held)
    assert safety.safety().takes_plant_data == is_held

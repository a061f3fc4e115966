"""The paper's 13 h, one definition for everybody, against plain NumPy re-computations from the paper's final forms."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from numpy import ndarray

from inspection.model.attitude import norm
from inspection.model.orbit import closest_times, free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import P, V
from rta.filter import SafetyFilter
from rta.lie_derivatives import directional
from rta.limits import PAPER, PARTS, WEIGHT
from rta.names import PAPERS
from rta.paper import PaperFilter
from tests.oracles import PSM_TOLERANCE, C, length, orientation, paper, passive_safety, states, tensor
from tests.support.states import at_rest


def test_the_table_is_in_the_order_of_table_3() -> None:
    assert tuple(PAPER) == PAPERS
    assert [len(limit.gains) for limit in PAPER.values()] == [1] * 7 + [2] * 3 + [1] * 3
    assert [limit.weight for limit in PAPER.values()] == [None] + [WEIGHT] * 12 and WEIGHT == 1e12


@pytest.mark.parametrize("name", PAPERS)
def test_every_limit_equals_the_paper(name: str) -> None:
    x = states(1000)
    value = PAPER[name].h(tensor(x), C)
    tolerance = PSM_TOLERANCE if name == "passive_safety" else 2e-12
    np.testing.assert_allclose(value, paper(x)[PAPERS.index(name)], rtol=0, atol=tolerance)


def test_every_limit_is_tested_on_both_sides() -> None:
    share = (paper(states(1000)) < 0).mean(1)
    assert ((share > 0.01) & (share < 0.99)).all()


def test_both_filters_report_these_definitions() -> None:
    x = tensor(states(1000, seed=1))
    values = torch.stack([limit.h(x, C) for limit in PAPER.values()])
    assert torch.equal(PaperFilter(C).values(x), values)
    assert torch.equal(SafetyFilter(C).values(x), values)


def test_axes_of_panels_and_thermal_side_are_the_tasks() -> None:
    x = states(100)
    flipped = InspectionParameters(solar_panel_axis="+x")
    found = [PAPER[name].h(tensor(x), flipped) for name in ("attitude_exclusion", "temperature", "battery")]
    np.testing.assert_allclose(torch.stack(found), orientation(x, panel=1.0), rtol=0, atol=1e-12)


def test_a_spacecraft_at_rest_on_a_limit_has_finite_values_and_slopes() -> None:
    """Where a root begins its slope is infinite: it counts as zero, so that a filter has an answer there."""
    x = at_rest().repeat(1, 3)
    x[0] = torch.tensor([100.0, C.collision_radius, C.max_distance])
    for limit in PAPER.values():
        value, slope = directional(lambda y, h=limit.h: h(y, C)[None], (x,), (torch.ones_like(x),))
        assert value.isfinite().all() and slope.isfinite().all()
    assert PAPER["dynamic_speed"].h(x, C)[0] == C.docking_speed + C.speed_slope * 100.0
    assert PAPER["collision"].h(x, C)[1] == 0.0 and PAPER["keep_in_zone"].h(x, C)[2] == 0.0


def approaching(speed: float, miss: float) -> ndarray:
    """Returns 300 states 30 to 700 m away that fly straight past the centre within a miss distance."""
    x, rng = states(300, seed=3), np.random.default_rng(4)
    away = x[:3] / length(x[:3])
    side = np.cross(away, rng.standard_normal((3, 300)), axis=0)
    x[:3] = away * rng.uniform(30, 700, 300)
    path = -x[:3] + side / length(side) * rng.uniform(0, miss, 300)
    x[3:6] = speed * path / length(path)
    return x


@pytest.mark.parametrize("miss", [0.0, 20.0, 300.0])
@pytest.mark.parametrize("speed", [0.0, 0.01, 0.1, 0.5, 2.0, 6.0])
def test_infimum_equals_brute_force_when_approaching(speed: float, miss: float) -> None:
    x = approaching(speed, miss)
    found = PAPER["passive_safety"].h(tensor(x), C)
    np.testing.assert_allclose(found, passive_safety(x), rtol=0, atol=PSM_TOLERANCE)


def test_infimum_of_each_part_equals_brute_force() -> None:
    x, horizon = states(1000, seed=2), C.passive_safety_horizon
    edges = tuple(horizon * i / PARTS for i in range(PARTS + 1))
    y = tensor(x)
    found = norm(free_flight(y[P], y[V], closest_times(y, edges, C), C.mean_motion)) - C.collision_radius
    expected = [passive_safety(x, start, end) for start, end in pairwise(edges)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=PSM_TOLERANCE)

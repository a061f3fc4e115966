"""Motion, the search and the flights of its plans against the simulator and the study's own evaluation."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from inspection.environment import InspectionEnv
from inspection.guidance import natural_motion
from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THETA_S, P, Q, V
from inspection.orbits import GUIDANCE
from inspection.transition import METRICS
from rta.filter import SafetyFilter
from study.config import TEST_CASES, Config
from study.experiment import test_cases as common_cases
from study.flight.evaluation import run_episodes
from study.flight.fly import Starts
from study.optimum.__main__ import summary
from study.optimum.flights import TEACHERS, Flown, flown, guided, planned
from study.optimum.motion import Motion
from study.optimum.search import Cases, cost, searched

C = InspectionParameters()
SHORT = replace(C, substep=5.0, success_score=0.3)  # which is reached in ten minutes


def flying(count: int, c: InspectionParameters = C) -> InspectionEnv:
    """The task of a few episodes without the filter."""
    return InspectionEnv(
        count, c, [torch.Generator().manual_seed(1)], SafetyFilter(c).safety(False), c.substep
    )


@pytest.fixture(scope="module")
def cases() -> tuple[Tensor, Tensor]:
    return common_cases(Config(), 2, TEST_CASES)[:2]


def test_the_knots_are_those_of_the_simulator() -> None:
    draws = torch.Generator().manual_seed(2)
    knots, flights = 30, 4
    thrust = torch.randn(knots, 3, flights, generator=draws, dtype=torch.float64) * 0.1
    x = torch.zeros(SIZE, flights, dtype=torch.float64)
    x[P] = 60.0 * torch.randn(3, flights, generator=draws, dtype=torch.float64)
    x[V] = 0.1 * torch.randn(3, flights, generator=draws, dtype=torch.float64)
    x[Q.stop - 1] = 1.0  # the body's axes are Hill's
    found = Motion.of(knots, C.action_period, C).states(x[:6].clone(), thrust)
    for force, knot in zip(thrust, found, strict=True):
        u = torch.cat((force, torch.zeros_like(force)))
        x = integrate(x, u, C.substep, C, times=round(C.action_period / C.substep))
        assert (x[:6] - knot).abs().max() < 1e-9  # of 300 m, with RK4 of 1 s


def test_a_flight_counts_what_an_evaluation_counts(cases: tuple[Tensor, Tensor]) -> None:
    mine_in, theirs_in = flying(2, SHORT), flying(2, SHORT)
    mine = flown(mine_in, guided(mine_in, TEACHERS[-1:], 2), *cases, 1500.0)
    guidance = natural_motion(SHORT, 1.0, GUIDANCE[TEACHERS[-1]], theirs_in.sight.score)
    theirs = run_episodes(theirs_in, guidance, Starts(*cases))
    metrics = dict(zip(METRICS, theirs.metrics, strict=True))
    assert mine.succeeded.all()
    torch.testing.assert_close(mine.delta_v, metrics["delta_v_m_s"], rtol=0.0, atol=1e-12)
    assert torch.equal(mine.time, metrics["episode_length_s"])
    assert torch.equal(mine.clear, theirs.clear) and torch.equal(mine.clean, theirs.clean)
    torch.testing.assert_close(mine.worst.minimum(theirs.worst), mine.worst)  # which has the start, too
    assert (mine.least <= mine.delta_v).all() and (mine.delta_v <= math.sqrt(3) * mine.least).all()


def test_a_plan_is_flown_as_it_says(cases: tuple[Tensor, Tensor]) -> None:
    x, priority = cases
    draws = torch.Generator().manual_seed(3)
    thrust = 0.02 * torch.randn(20, 3, 2, generator=draws, dtype=torch.float64)
    start = torch.cat((x[P], x[V]))
    env = flying(2)
    found = flown(env, planned(start, thrust, C), x, priority, 200.0)
    last = Motion.of(20, C.action_period, C).states(start, thrust)[-1]
    *_, hold = env.fly(planned(start, thrust, C), 200.0)
    assert (hold.after[:3] - last[:3]).norm(dim=0).max() < 0.1  # m, of 30
    torch.testing.assert_close(found.thrust, thrust, rtol=0.0, atol=2e-3)
    length = thrust.norm(dim=1).sum(0) * C.action_period / C.mass
    torch.testing.assert_close(found.least, length, rtol=0.03, atol=0.0)


def test_the_search_goes_down_a_slope_that_differences_confirm(cases: tuple[Tensor, Tensor]) -> None:
    knots = 320
    own = Cases.of(*cases, knots, C)
    draws = torch.Generator().manual_seed(4)
    thrust = (0.002 * torch.randn(knots, 3, 2, generator=draws)).requires_grad_()
    (slope,) = torch.autograd.grad(cost(own, thrust, C, soft=10.0).sum(), thrust)
    way = slope / slope.norm()
    with torch.no_grad():
        ahead, behind = (cost(own, thrust + far * way, C, soft=10.0).sum() for far in (1e-4, -1e-4))
    assert ((ahead - behind) / 2e-4 / slope.norm() - 1.0).abs() < 0.02
    first = thrust.detach().double()
    plan = searched(own, first, C, steps=60)
    assert (cost(own, plan, C) < 0.95 * cost(own, first, C)).all()
    alone = searched(Cases.of(*(each[:, :1] for each in cases), knots, C), first[..., :1], C, steps=60)
    torch.testing.assert_close(alone, plan[..., :1], rtol=0.0, atol=1e-4)  # of 0.002, in float32


def test_suns_of_the_search_are_those_of_the_simulator(cases: tuple[Tensor, Tensor]) -> None:
    env = flying(2)
    env.start(*cases)
    *_, last = env.fly(lambda t, y: y.new_zeros(6, 2), 50.0)
    angle, sun = last.after[THETA_S], Cases.of(*cases, 5, C).suns[:, -1]
    assert (sun[0] - angle.cos()).abs().max() < 1e-6 and (sun[1] - angle.sin()).abs().max() < 1e-6


def test_only_clean_flights_are_among_the_best() -> None:
    """Of three flights of one case the cheapest violates a limit by 1e-9 and the next one drifts."""
    ones = torch.ones(3, dtype=torch.float64)
    worst = torch.full((13, 3), 0.5, dtype=torch.float64)
    worst[3, 0] = -1e-9
    clear = torch.tensor([True, False, True])
    fuel = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    found = Flown(ones > 0, clear, 3000.0 * ones, fuel, 0.6 * fuel, ones, worst, torch.zeros(1, 3, 3))
    assert summary(found, 1)["delta_v_m_s"] == [0.3]
    worst[0, 2] = -1e-9
    assert summary(found, 1)["delta_v_m_s"] == [None]
    worst[:] = 0.5
    assert summary(found, 1)["delta_v_m_s"] == [0.1]

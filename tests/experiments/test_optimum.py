"""Motion, the search and the flights of its plans against the simulator and the study's own evaluation."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure
from torch import Tensor

from experiments import optimum
from experiments.optimum import (
    Cases,
    Flown,
    cost,
    draw,
    flown,
    motion,
    planned,
    searched,
    summary,
)
from inspection.environment import InspectionEnv
from inspection.guidance import natural_motion
from inspection.model.dynamics import integrate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, P, Q, V
from inspection.orbits import GUIDANCE
from inspection.transition import METRICS
from rta.filter import SafetyFilter
from study.config import TEST_CASES, Config
from study.experiment import test_cases as common_cases
from study.files import ROOT
from study.flight.evaluation import run_episodes
from study.flight.fly import Starts

C = InspectionParameters()
SHORT = replace(C, substep=5.0, success_score=0.3)  # which is reached in ten minutes


def flying(count: int, c: InspectionParameters = C) -> InspectionEnv:
    """The task of a few episodes without the filter."""
    return InspectionEnv(
        count, c, [torch.Generator().manual_seed(1)], SafetyFilter(c).safety(False), c.substep
    )


def states(start: Tensor, thrust: Tensor) -> Tensor:
    """(p, v) at the knots, (K, 6, B)."""
    free, forced = motion(len(thrust), C.action_period, C)
    return (free @ start + forced @ thrust.flatten(0, 1)).unflatten(0, (-1, 6))


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
    for force, knot in zip(thrust, states(x[:6].clone(), thrust), strict=True):
        u = torch.cat((force, torch.zeros_like(force)))
        x = integrate(x, u, C.substep, C, times=round(C.action_period / C.substep))
        assert (x[:6] - knot).abs().max() < 1e-9  # of 300 m, with RK4 of 1 s


def test_a_flight_counts_what_an_evaluation_counts(cases: tuple[Tensor, Tensor]) -> None:
    mine_in, theirs_in = flying(2, SHORT), flying(2, SHORT)
    guidances = (
        natural_motion(SHORT, 1.0, GUIDANCE["quick"], env.sight.score) for env in (mine_in, theirs_in)
    )
    mine = flown(mine_in, next(guidances), *cases, 1500.0)
    theirs = run_episodes(theirs_in, next(guidances), Starts(*cases))
    metrics = dict(zip(METRICS, theirs.metrics, strict=True))
    assert mine.succeeded.all()
    torch.testing.assert_close(mine.delta_v, metrics["delta_v_m_s"], rtol=0.0, atol=1e-12)
    assert torch.equal(mine.time, metrics["episode_length_s"])
    assert torch.equal(mine.clean, theirs.clean)
    assert (mine.length <= mine.delta_v).all() and (mine.delta_v <= math.sqrt(3) * mine.length).all()


def test_a_plan_is_flown_as_it_says(cases: tuple[Tensor, Tensor]) -> None:
    x, priority = cases
    draws = torch.Generator().manual_seed(3)
    thrust = 0.02 * torch.randn(20, 3, 2, generator=draws, dtype=torch.float64)
    start = torch.cat((x[P], x[V]))
    env = flying(2)
    found = flown(env, planned(start, thrust, C), x, priority, 200.0)
    last = states(start, thrust)[-1]
    *_, hold = env.fly(planned(start, thrust, C), 200.0)
    assert (hold.after[:3] - last[:3]).norm(dim=0).max() < 0.1  # m, of 30
    torch.testing.assert_close(found.thrust, thrust, rtol=0.0, atol=2e-3)
    length = thrust.norm(dim=1).sum(0) * C.action_period / C.mass
    torch.testing.assert_close(found.length, length, rtol=0.03, atol=0.0)


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


def test_only_clean_flights_are_among_the_best() -> None:
    """Of three flights of one case the cheapest is not clean."""
    ones, fuel = torch.ones(3, dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    clean = torch.tensor([False, True, True])
    found = Flown(ones > 0, clean, 3000.0 * ones, fuel, 0.6 * fuel, torch.zeros(1, 3, 3))
    assert summary(found, 1)["delta_v_m_s"] == [0.2] and summary(found, 1)["clean_flights"] == 2
    assert summary(found._replace(clean=ones < 0), 1)["delta_v_m_s"] == [None]


def test_the_figure_sets_every_shipped_agent_beside_the_flights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    draw(json.loads((ROOT / "runs/reference/optimum/optimum.json").read_text()), tmp_path / "optimum.png")
    (axis,) = figures[0].axes
    drawn = {line.get_label(): list(zip(*line.get_data(), strict=True)) for line in axis.lines}
    for study, learner in (
        ("our_learner", "our learner, the paper's task"),
        ("from_nothing", "ours, from nothing"),
    ):
        arms = json.loads((ROOT / f"runs/reference/{study}/results.json").read_text())["arms"]
        for arm, name in (("no_rta", "without RTA"), ("rta", "with RTA")):
            time, fuel = (arms[arm]["metrics"][each]["iqm"] for each in ("episode_length_s", "delta_v_m_s"))
            assert drawn[f"{learner}, {name}"] == [(time, fuel)]
    long = json.loads((ROOT / "runs/reference/long/results.json").read_text())["arms"]["rta"]["metrics"]
    time, fuel = (long[each]["iqm"] for each in ("episode_length_s", "delta_v_m_s"))
    assert drawn["ours, with RTA, one seed, ten times as long"] == [(time, fuel)]
    assert len(drawn) == 12


@pytest.mark.campaign
def test_the_program_writes_what_is_shipped_for_fewer_cases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    smaller = {"SETTINGS": 3, "KEPT": 1, "TIMES": (3000.0,), "TEACHERS": ("quick",), "LONGEST": 3000.0}
    smaller["draw"] = lambda found, path: None
    for name, value in smaller.items():
        monkeypatch.setattr(optimum, name, value)
    few = ["--cases", "2", "--bounded", "1", "--steps", "3", "--rung", "0.5"]
    optimum.main(["--out", str(tmp_path), *few])
    found = json.loads((tmp_path / "optimum.json").read_text())
    shipped = json.loads((ROOT / "runs/reference/optimum/optimum.json").read_text(encoding="utf-8"))
    assert list(found) == list(shipped)
    (row,), theirs = found["times"], shipped["times"][-1]
    assert (
        list(row) == list(theirs) and row["allowed_s"] == theirs["allowed_s"] and len(row["bound_m_s"]) == 1
    )
    quick, theirs = found["guidance"]["quick"], shipped["guidance"]["quick"]
    assert quick["time_s"] == theirs["time_s"][:2] and quick["clean"] == 2
    assert quick["delta_v_m_s"] == pytest.approx(theirs["delta_v_m_s"][:2], abs=1e-4)

"""The closed loop: clocks that do not fit, holds against a plain loop by event times, flights against DOP853."""

import itertools
import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy import ndarray
from torch import Tensor

from inspection.closed_loop import Clocks, Safety, Smallest, closed_loop
from inspection.environment import InspectionEnv, effort
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, V
from inspection.world.parameters import PlantParameters
from tests.inspection.model.test_dynamics import UNEQUAL, dop853, still

DECISIONS, REPORTS, CALLS = "the controller's decisions", "the loop's reports", "the filter's calls"
LOOKS = "the looks at the chief"


@pytest.mark.parametrize(
    ("clocks", "message"),
    [
        ((10.0, 1.0, 0.3), f"substep = 0.3 s: must divide 10 s, the time between {DECISIONS}"),
        ((10.0, 1.0, 2.0, 5.0), f"substep = 2 s: must divide 5 s, the time between {CALLS}"),
        ((20.0, 1.0, 4.0, None, 10.0), f"substep = 4 s: must divide 10 s, the time between {LOOKS}"),
        ((10.0, 30.0, 1.0, 3.0), f"{DECISIONS} every 10 s: must be a multiple of 3 s, the time between {CALLS}"),
        ((3.0, 1.0, 1.0, 5.0), f"{CALLS} every 5 s: must be a multiple of 3 s, the time between {DECISIONS}"),
        ((4.0, 10.0, 1.0), f"{REPORTS} every 10 s: must be a multiple of 4 s, the time between {DECISIONS}"),
        ((10.0, 2.0, 1.0, 5.0), f"{CALLS} every 5 s: must be a multiple of 2 s, the time between {REPORTS}"),
        ((1.0, 1.0, 1.0, 5.0, 1.0), f"{CALLS} every 5 s: must divide 1 s, the time between {LOOKS}"),
    ],
)  # fmt: skip
def test_clocks_that_do_not_divide_are_refused_and_both_are_named(clocks: tuple, message: str) -> None:
    with pytest.raises(ValueError) as error:
        Clocks(*clocks)
    assert str(error.value) == message


# decision, report, substep and filter in s, and the hold and integration step that follow
SETTINGS = {
    "agent": ((10.0, 10.0, 1.0, None), (10.0, 1.0)),
    "agent_behind_the_filter": ((10.0, 10.0, 1.0, 1.0), (1.0, 1.0)),
    "reported_every_second": ((10.0, 1.0, 5.0, 5.0), (1.0, 5.0)),
    "reported_across_steps": ((10.0, 2.5, 1.0, 10.0), (2.5, 1.0)),
    "reported_within_steps": ((10.0, 0.1, 1.0, 1.0), (0.1, 1.0)),
    "slow_filter": ((10.0, 5.0, 2.5, 10.0), (5.0, 2.5)),
    "unfiltered_decisions": ((2.0, 2.0, 5.0, None), (2.0, 2.0)),
    "filter_slower_than_decisions": ((1.0, 1.0, 0.25, 5.0), (1.0, 0.25)),
    "reports_slower_than_all": ((4.0, 20.0, 1.0, 2.0), (2.0, 1.0)),
    "parts_of_a_second": ((0.3, 0.6, 0.5, 0.1), (0.1, 0.1)),
}


class Watched:
    """Acts as controller, filter and plant; its answers tell when and for what they were asked; it keeps the calls."""

    def __init__(self) -> None:
        self.decisions: list[tuple[float, Tensor]] = []
        self.calls: list[tuple[Tensor, Tensor]] = []

    def controller(self, t: float, x: Tensor) -> Tensor:
        self.decisions.append((t, x))
        return (1.0 + t) * torch.arange(1.0, 7.0)[:, None].double() + x[:6]

    def correct(self, x: Tensor, desired: Tensor) -> SimpleNamespace:
        self.calls.append((x, desired))
        return SimpleNamespace(control=0.5 * desired - 0.25 * x[6:12], call=len(self.calls))

    @staticmethod
    def integrate(x: Tensor, u: Tensor, seconds: float) -> Tensor:
        return x + 0.01 * seconds * torch.cat((u, u.flip(0), u[:4]))


def by_event_times(x: Tensor, clocks: Clocks, duration: float) -> list[dict[str, Any]]:
    """Returns the expected events from a plain loop over the union of all event times, in tenths of a second."""
    watched, end = Watched(), round(10 * duration)
    decide, report = (range(0, end, round(10 * every)) for every in (clocks.decision, clocks.report))
    call = range(0, end, round(10 * clocks.filter)) if clocks.filter else range(0)
    events = sorted({*decide, *report, *call, end})
    rows, applied = [], None
    for start, stop in itertools.pairwise(events):
        row = {"time": start / 10, "end": stop / 10, "seconds": (stop - start) / 10, "state": x}
        row |= {"decided": start in decide, "correction": None, "desired": applied}
        if row["decided"]:
            row["desired"] = watched.controller(start / 10, x)
        if start in call:
            row["correction"] = watched.correct(x, row["desired"])
            applied = row["correction"].control
        if not clocks.filter:
            applied = row["desired"]
        x = watched.integrate(x, applied, row["seconds"])
        rows.append(row | {"applied": applied, "after": x})
    return rows


@pytest.mark.parametrize(("clocks", "hold_and_step"), SETTINGS.values(), ids=SETTINGS)
def test_holds_equal_those_of_a_plain_loop(clocks: tuple, hold_and_step: tuple) -> None:
    clocks, watched = Clocks(*clocks), Watched()
    assert (clocks.hold, clocks.step) == hold_and_step
    x = torch.from_numpy(np.random.default_rng(0).standard_normal((16, 2)))
    correct = watched.correct if clocks.filter else None
    holds = list(closed_loop(x, watched.controller, correct, watched.integrate, clocks, 60.0))
    expected = by_event_times(x, clocks, 60.0)
    for hold, row in zip(holds, expected, strict=True):
        for name in ("time", "end", "seconds"):
            assert getattr(hold, name) == pytest.approx(row[name])
        for name in ("state", "desired", "applied", "after"):
            torch.testing.assert_close(getattr(hold, name), row[name], rtol=1e-12, atol=1e-12)
        assert hold.decided == row["decided"]
        assert (hold.correction and hold.correction.call) == (row["correction"] and row["correction"].call)
    decided = [hold for hold in holds if hold.decided]
    assert watched.decisions == [(hold.time, hold.state) for hold in decided]
    assert len(decided) == round(60.0 / clocks.decision)


# The environment's flights


def tumbling() -> Tensor:
    """Returns a state (16, 1) whose panels and node stay lit for a minute."""
    x = still("n_y along +x", theta_s=0.75 * math.pi)
    x[V, 0] = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    x[OMEGA, 0] = torch.tensor([0.002, -0.0015, 0.002], dtype=torch.float64)
    return x


ACTION = torch.tensor([[0.6, -0.9, 0.4, 0.02, -0.01, 0.015]])


def environment(
    c: InspectionParameters, period: float | None, report: float | None, x: Tensor, **more: Any
) -> InspectionEnv:
    """Returns an episode from x, behind a filter that halves the control."""

    def correct(x: Tensor, desired: Tensor) -> SimpleNamespace:
        return SimpleNamespace(control=desired / 2)

    safety = Safety(correct=correct, period=period) if period else None
    env = InspectionEnv(1, c, [torch.Generator()], safety, report_every=report, **more)
    env.start(x, torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64))
    return env


def reference(env: InspectionEnv, every: float) -> Iterator[ndarray]:
    """Yields the states (16,) of 20 s, ACTION every 10 s and halved at each call of the filter, by DOP853."""
    x, control, every_call = tumbling()[:, 0], env.control(ACTION)[:, 0], env.clocks.filter
    for i in range(round(20.0 / every)):
        calls = i * every % 10.0 // every_call + 1 if every_call else 0
        x = torch.from_numpy(dop853(x, control / 2**calls, every))
        yield x.numpy()


# m, m/s, ..., that RK4 strays from it in 20 s by its step in s; measured: 8e-9, 5e-8 and 6e-6
STRAY = {1.0: 1e-8, 2.5: 1e-7, 5.0: 1e-5}
FLIGHTS = {  # substep, filter and report in s
    "long_substep": (5.0, None, None),
    "filter_every_second": (1.0, 1.0, None),
    "filter_and_substep_of_5_s_reported_every_second": (5.0, 5.0, 1.0),
    "filter_every_10_s": (2.5, 10.0, 5.0),
    "read_within_steps": (2.5, 10.0, 0.5),
    "read_across_steps": (1.0, 5.0, 2.5),
}


@pytest.mark.parametrize(("substep", "period", "report"), FLIGHTS.values(), ids=FLIGHTS)
def test_flights_and_steps_follow_dop853(substep: float, period: float | None, report: float | None) -> None:
    c = InspectionParameters(inertia=UNEQUAL, saturate_rates=False, substep=substep)
    env = environment(c, period, report, tumbling())
    control, every = env.control(ACTION), min(report or substep, period or 10.0)
    holds = list(env.fly(lambda t, x: control, 20.0))
    assert [hold.end for hold in holds] == [every * (i + 1) for i in range(round(20.0 / every))]
    flown, expected = [hold.after for hold in holds], list(reference(env, every))
    stray = STRAY[env.clocks.step]
    np.testing.assert_allclose(torch.cat(flown, 1).T, np.stack(expected), rtol=0, atol=stray)
    for end in (len(flown) // 2 - 1, -1):
        step = env.step(ACTION)
        assert torch.equal(step.state, flown[end])
        assert len(step.corrections) == (10.0 / period if period else 0)
    halvings = [0.5 ** (k + 1) * period / 10.0 for k in range(round(10.0 / period))] if period else [1.0]
    assert step.metrics[3].item() == pytest.approx(2 * 1.9 / 12.0 * 10.0 * sum(halvings))
    assert step.metrics[4].item() == pytest.approx(2 * 0.045 * c.max_torque * sum(halvings))
    applied = sum(halvings) * control[:, 0] / env.limit[:, 0]
    torch.testing.assert_close(step.applied[0], applied)


CLAMPED = {  # substep, period and report in s; the last two differ in the report alone
    "paper": (1.0, 1.0, (None, 0.1, 0.25)),
    "long_substep": (5.0, 5.0, (None, 1.0, 2.5)),
    "unfiltered": (1.0, None, (None, 0.2)),
}
WORLD = PlantParameters(
    mass_factor=1.1,
    failing="thrust_x",
    failing_from=7.0,
    position_noise=0.1,
    errors="drawn",
    thrust_gain=(0.9, 1.1),
)


@pytest.mark.parametrize("plant", [None, WORLD], ids=["model", "plant"])
@pytest.mark.parametrize(("substep", "period", "reports"), CLAMPED.values(), ids=CLAMPED)
def test_looking_more_often_changes_no_bit_of_a_flight_whose_rates_are_clamped(
    substep: float, period: float | None, reports: tuple, plant: PlantParameters | None
) -> None:
    c = InspectionParameters(inertia=UNEQUAL, substep=substep)
    fast = tumbling()
    fast[OMEGA, 0] = 0.999 * c.max_rate * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    flights, counted = [], []
    for report in reports:
        env = environment(c, period, report, fast, plant=plant)
        control = env.control(torch.tensor([[0.6, -0.9, 0.4, 0.9, -0.9, 0.9]]))
        holds = list(env.fly(lambda t, x, control=control: control, 20.0))
        assert all((hold.after[OMEGA].abs() <= c.max_rate).all() for hold in holds)
        flights.append({round(hold.end, 6): hold.after for hold in holds})
        counted.append(torch.stack(effort(holds, 12.0, c)))
    for spent in counted:
        torch.testing.assert_close(spent, counted[0], rtol=1e-12, atol=0.0)
    for finer in flights[1:]:
        shared = flights[0].keys() & finer.keys()
        assert 20.0 in shared
        assert all(torch.equal(flights[0][time], finer[time]) for time in shared)


def test_the_smallest_values_so_far_and_when_and_nan_is_below_all() -> None:
    smallest = Smallest(2, torch.zeros(16, 3).double())
    assert (smallest.value == torch.inf).all()
    nan = math.nan
    checks = [[[3.0, 1.0, 2.0], [1.0, 1.0, nan]], [[2.0, 1.0, 4.0], [0.0, 2.0, 1.0]]]
    noted = [
        smallest.note(torch.tensor(h).double(), time) for time, h in zip((5.0, 6.0), checks, strict=True)
    ]
    assert smallest.value.tolist() == [[2.0, 1.0, 2.0], [0.0, 1.0, -math.inf]]
    assert smallest.when.tolist() == [[6.0, 5.0, 5.0], [6.0, 5.0, 5.0]]
    assert noted[0][1, 2] == -math.inf and noted[1].tolist() == checks[1]

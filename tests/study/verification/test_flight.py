"""A flight's record against a loop of the tests' own over the same episodes."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import torch
from numpy import ndarray

from inspection.closed_loop import Safety
from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from rta.fast.filter import batched, fast
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.parameters import RtaParameters
from study.flight.fly import Limits, Progress
from study.verification.adversaries import held_at_random
from study.verification.starts import safe_set
from tests.oracles import PSM_TOLERANCE, paper, tensor
from tests.study.verification.flown import flown
from tests.support.flights import FILTER, LIMIT, fly

C = InspectionParameters()
SECONDS, DECIDE = 24, 2  # s of an episode, and between two decisions


@functools.cache
def lax() -> SafetyFilter:
    """Returns a filter that believes in wider limits than those that are counted."""
    wide = dataclasses.replace(
        C, docking_speed=0.4, speed_slope=0.008, max_temperature=11.0, min_energy=0.5, field_of_view=0.5
    )
    return fast(SafetyFilter(wide, RtaParameters()), "cpu", 6)


@functools.cache
def six_episodes() -> SimpleNamespace:
    """Returns six episodes that decide every 2 s and are filtered every second, next to or beyond the limits."""
    safety = Safety(CONSTRAINTS, FILTER.values, None, lax().correct, 1.0)
    env = InspectionEnv(6, C, [torch.Generator().manual_seed(0)], safety, DECIDE, 1.0)
    x, priority, _ = safe_set(6, 36, FILTER)
    x[3:6] *= 1.9
    x[13], x[14] = 10.95, 0.52
    policy = held_at_random(C, torch.Generator().manual_seed(0), 6)
    return flown(env, policy, x, priority, SECONDS, first=3)


def recount(flight: SimpleNamespace, column: int) -> dict[str, ndarray]:
    """Repeats one episode, second by second, from its start and the policy's desired controls every 2 s."""
    safety, x = lax(), flight.starts.x[:, column : column + 1].numpy()
    states, statuses, backups, largest = [x], [], [], 0.0
    u = np.zeros((6, 1))
    for second in range(SECONDS):
        if second % DECIDE == 0:
            u = flight.desired[second, :, column : column + 1].numpy()
        result = safety.correct(tensor(x), tensor(u))
        u = result.control.numpy()
        statuses.append(int(result.status))
        backups.append(bool(result.backup))
        largest = max(largest, (np.abs(u) / LIMIT).max())
        x = fly(x, u, steps=1)
        states.append(x)
    h = paper(np.hstack(states)).T
    violated = h < -1e-12  # a rate at its limit is rounded either way
    return {
        "violating": np.append(violated.sum(0), violated.any(1).sum()),
        "worst": h.min(0),
        "when": h.argmin(0),
        "status": np.bincount(statuses, minlength=4),
        "backup": sum(backups),
        "excess": largest,
    }


@functools.cache
def recounted() -> list[dict[str, ndarray]]:
    """Returns each of the six episodes."""
    return [recount(six_episodes(), column) for column in range(6)]


def test_a_flight_counts_what_a_loop_of_its_own_counts() -> None:
    flight = six_episodes()
    for column, expected in enumerate(recounted()):
        actual = {name: getattr(flight, name)[..., column].numpy() for name in expected}
        np.testing.assert_array_equal(actual["violating"], expected["violating"])
        np.testing.assert_allclose(actual["worst"], expected["worst"], rtol=0, atol=PSM_TOLERANCE)
        np.testing.assert_array_equal(actual["status"], expected["status"])
        assert actual["backup"] == expected["backup"]
        np.testing.assert_allclose(actual["excess"], expected["excess"], rtol=0, atol=1e-9)
        sharp = [i for i in range(13) if i != 3 and i < 10]
        np.testing.assert_array_equal(actual["when"][sharp], expected["when"][sharp])


class Bar(SimpleNamespace):
    """Keeps what a bar shows."""

    n, text = 5.0, ""

    def update(self, more: float) -> None:
        self.n += more

    def set_postfix_str(self, text: str, refresh: bool) -> None:
        self.text = text


def test_a_bar_shows_parts_of_flights_and_the_violations_of_all() -> None:
    """Two batches of two episodes, in each of which one violates a limit, after five with one violation."""
    env = SimpleNamespace(time=torch.zeros(2), c=SimpleNamespace(action_period=10.0))
    limits = SimpleNamespace(violating=torch.tensor([[0.0, 0.0], [0.0, 3.0]]))
    shown, both = Bar(), torch.ones(2, dtype=torch.bool)
    progress = Progress(shown, 20.0, violating=1)
    for done, violating in ((5.0, 2), (7.0, 3)):
        progress.begin(env, limits)
        for end in (10.0, 20.0):
            progress.hold(SimpleNamespace(end=end), both)
            assert (shown.n, shown.text) == (done + end / 10.0, f"{end:.0f} s flown, {violating} violating")
    progress = Progress(shown)
    progress.begin(env, limits)
    progress.hold(SimpleNamespace(end=10.0), both)
    assert shown.n == 9.0
    progress.step(SimpleNamespace(done=torch.tensor([True, False]), steps=torch.tensor([3, 3])), both)
    assert (shown.n, shown.text) == (10.0, "30 s flown, 1 violating")


def test_nan_is_a_violation_without_end() -> None:
    values = torch.ones(13, 2)
    env = SimpleNamespace(x=torch.zeros(16, 2), constraint_values=lambda x: values.clone())
    limits = Limits(env)
    values[4, 1] = torch.nan
    limits.hold(SimpleNamespace(after=env.x, end=3.0), torch.ones(2, dtype=torch.bool))
    assert (limits.violating[:, 0] == 0).all() and limits.violating[[4, 13], 1].tolist() == [1, 1]
    assert limits.worst[4].tolist() == [1.0, -torch.inf] and limits.when[4, 1] == 3.0


def test_a_long_substep_is_flown_whole_however_often_it_is_checked() -> None:
    """At substep 5 and a filter every 5 s, whether checked every second or every 5 s."""
    x, priority, _ = safe_set(4, 32, FILTER)
    c = dataclasses.replace(C, substep=5.0)
    safety, flights = batched(SafetyFilter(c, RtaParameters(period=5.0))).safety(), []
    for check_every in (1.0, 5.0):
        env = InspectionEnv(4, c, [torch.Generator()], safety, 5.0, check_every)
        flights.append(flown(env, held_at_random(c, torch.Generator().manual_seed(0), 4), x, priority, 20))
    often, seldom = flights
    assert len(seldom.applied) == 4 and (seldom.status.sum(0) == 4).all()
    assert torch.equal(often.applied, seldom.applied)
    assert (often.worst <= seldom.worst).all() and (often.worst < seldom.worst).any()
    assert (often.worst < env.constraint_values(x)).any(0).all() and (often.when > 0).any()  # they move

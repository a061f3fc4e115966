"""A flight's record against a loop of the tests' own over the same episodes."""

import dataclasses
import functools

import numpy as np
import torch
from numpy import ndarray

from inspection.closed_loop import Safety, Smallest
from inspection.environment import InspectionEnv
from inspection.model.parameters import InspectionParameters
from rta.constraints.names import CONSTRAINTS
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.verification.adversaries import held_at_random
from study.verification.flight import ROUNDING, Flight, fly, note_state
from study.verification.starts import safe_set
from tests.rta import test_barrier as test_rows
from tests.rta.constraints.test_constraints import PSM_TOLERANCE, paper, tensor
from tests.rta.test_barrier import FILTER, LIMIT

C = InspectionParameters()
SECONDS, DECIDE = 24, 2  # of an episode, and between two decisions


@functools.cache
def lax() -> SafetyFilter:
    """A filter that believes in wider limits than those that are counted."""
    wide = dataclasses.replace(
        C, docking_speed=0.4, speed_slope=0.008, max_temperature=11.0, min_energy=0.5, field_of_view=0.5
    )
    safety = SafetyFilter(wide, RtaParameters())
    safety.compile("cpu", 6)
    return safety


@functools.cache
def six_episodes() -> Flight:
    """Six episodes that decide every 2 s and are filtered every second, next to the filter's limits or beyond them."""
    safety = Safety(CONSTRAINTS, FILTER.values, None, lax().correct, 1.0)
    env = InspectionEnv(6, C, [torch.Generator().manual_seed(0)], safety, DECIDE, 1.0)
    x, priority, _ = safe_set(6, 36, FILTER)
    x[3:6] *= 1.9
    x[13], x[14] = 10.95, 0.52
    policy = held_at_random(C, torch.Generator().manual_seed(0), 6)
    return fly(env, policy, x, priority, SECONDS)


def recount(flight: Flight, column: int) -> dict[str, ndarray]:
    """One episode again, second by second, from its start and what the policy desired every 2 s."""
    safety, x = lax(), flight.start[:16, column : column + 1].numpy()
    states, statuses, slacks, backups, largest = [x], [], [], [], 0.0
    u = np.zeros((6, 1))
    for second in range(SECONDS):
        if second % DECIDE == 0:
            u = flight.desired[second, :, column : column + 1].numpy()
        result = safety.correct(tensor(x), tensor(u))
        u = result.control.numpy()
        statuses.append(int(result.status))
        slacks.append(result.slack[:, 0].numpy())
        backups.append(bool(result.backup))
        largest = max(largest, (np.abs(u) / LIMIT).max())
        x = test_rows.fly(x, u, steps=1)
        states.append(x)
    h = paper(np.hstack(states)).T
    violated = h < -1e-12  # a rate at its limit is rounded either way
    return {
        "violating": np.append(violated.sum(0), violated.any(1).sum()),
        "worst": h.min(0),
        "when": h.argmin(0),
        "status": np.bincount(statuses, minlength=4),
        "yielded": (np.array(slacks) > ROUNDING).sum(0),
        "slack": np.max(slacks, 0),
        "backup": sum(backups),
        "excess": largest,
    }


@functools.cache
def recounted() -> list[dict[str, ndarray]]:
    """Each of the six episodes."""
    return [recount(six_episodes(), column) for column in range(6)]


def test_a_flight_counts_what_a_loop_of_its_own_counts() -> None:
    flight = six_episodes()
    for column, expected in enumerate(recounted()):
        actual = {name: getattr(flight, name)[..., column].numpy() for name in expected}
        np.testing.assert_array_equal(actual["violating"], expected["violating"])
        np.testing.assert_allclose(actual["worst"], expected["worst"], rtol=0, atol=PSM_TOLERANCE)
        np.testing.assert_array_equal(actual["status"], expected["status"])
        np.testing.assert_array_equal(actual["yielded"], expected["yielded"])
        assert actual["backup"] == expected["backup"]
        np.testing.assert_allclose(actual["slack"], expected["slack"], rtol=0, atol=1e-7)
        np.testing.assert_allclose(actual["excess"], expected["excess"], rtol=0, atol=1e-9)
        sharp = [i for i in range(13) if i != 3 and i < 10]
        np.testing.assert_array_equal(actual["when"][sharp], expected["when"][sharp])


def test_chosen_episodes_are_those_of_the_flight() -> None:
    flight = six_episodes()
    chosen = torch.tensor([False, True, False, True, True, False])
    part = flight[chosen]
    assert part.column.tolist() == [1, 3, 4]
    assert part.applied.shape == (SECONDS, 6, 3) and (part.worst == flight.worst[:, [1, 3, 4]]).all()
    yielded = flight.yielded[:, chosen].sum()
    assert (part.conflicts.slack > ROUNDING).sum() == yielded


def test_nan_is_a_violation_without_end() -> None:
    one = dataclasses.replace(
        six_episodes(),
        violating=torch.zeros(14, 2),
        steps=torch.zeros(2),
        worst=torch.full((13, 2), torch.inf),
        when=torch.zeros(13, 2),
    )
    h = torch.ones(13, 2)
    h[4, 1] = torch.nan
    note_state(one, Smallest(13, h), h, 3.0)
    assert (one.violating[:, 0] == 0).all() and one.violating[[4, 13], 1].tolist() == [1, 1]
    assert one.worst[4].tolist() == [1.0, -torch.inf] and one.when[4, 1] == 3.0


def test_a_long_substep_is_cut_to_the_second_between_two_checks() -> None:
    """At substep 5 and a filter every 5 s, as at substep 1."""
    x, priority, _ = safe_set(4, 32, FILTER)
    flights = []
    for substep in (1.0, 5.0):
        c = dataclasses.replace(C, substep=substep)
        safety = SafetyFilter(c, RtaParameters(period=5.0)).safety()
        env = InspectionEnv(4, c, [torch.Generator()], safety, 5.0, 1.0)
        flights.append(fly(env, held_at_random(c, torch.Generator().manual_seed(0), 4), x, priority, 20))
    short, long = flights
    assert len(long.applied) == 4 and (long.status.sum(0) == 4).all()
    for name in ("violating", "worst", "when", "applied"):
        assert torch.equal(getattr(short, name), getattr(long, name)), name
    assert (long.worst < env.constraint_values(x)).any(0).all() and (long.when > 0).any()  # they move

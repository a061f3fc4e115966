"""Thrust that is checked within bounds: whatever is asked for, no limit of motion breaks in U1's world at its worst."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from inspection.model.state import OMEGA, SIZE, THRUST, P, V
from inspection.world.uncertainty import Uncertainty
from rta.parameters import RtaParameters
from rta.robust.check import RobustCheck
from rta.robust.filter import RobustFilter
from rta.robust.motion_check import may_be_kept
from study.verification.starts import safe_set
from tests.oracles import hypercube
from tests.rta.robust.test_error_tube import accepts, beside
from tests.rta.robust.uncertain_world import (
    PERIOD,
    ROUNDED,
    U1,
    C,
    World,
    committed,
    flown,
    is_safe,
    of_thrust,
)

MOTION_CHECK = of_thrust(C, PERIOD, U1)
assert MOTION_CHECK.terminal_set
TERMINAL_SET = MOTION_CHECK.terminal_set
COUNT = 120


def starts(seed: int) -> Tensor:
    """Returns states (16, COUNT) all over the zone and beside the chief from which a backup trajectory is verified."""
    x = torch.cat((hypercube(2 * COUNT, seed, C), beside(2 * COUNT, seed + 1)), 1)
    x[OMEGA] = 0.0
    x = x[:, accepts(x)]
    return x[:, torch.linspace(0, x.shape[1] - 1, COUNT).long()]


class Demands:
    """Asks for thrust outwards, to the chief, along v or at random, and keeps the check's answers.

    Attributes:
        refused, verified, asked: how many demands were, of how many.
    """

    def __init__(self, robust_motion_check: RobustCheck | None, seed: int) -> None:
        self.robust_motion_check, self.generator = robust_motion_check, torch.Generator().manual_seed(seed)
        self.refused = self.verified = self.asked = 0

    def __call__(self, x: Tensor, torque: Tensor, bound: Tensor) -> Tensor:
        count = x.shape[1]
        random = 2 * torch.rand(3, count, generator=self.generator, dtype=torch.float64) - 1
        wanted = torch.stack((x[P], -x[P], x[V], random))[torch.arange(count) % 4, :, torch.arange(count)].T
        q = x[6:10]
        body = wanted + 2 * torch.linalg.cross(
            -q[:3], torch.linalg.cross(-q[:3], wanted, dim=0) + q[3] * wanted, dim=0
        )
        u = torch.cat((C.max_thrust * body / body.abs().amax(0).clamp(min=1e-9), torque))
        if self.robust_motion_check:
            u, kept, changed = committed(self.robust_motion_check, 0, x, u, bound)
            self.refused, self.verified = self.refused + int(changed.sum()), self.verified + int(kept.sum())
        self.asked += count
        return u[THRUST]


def test_no_limit_breaks_whatever_is_asked() -> None:
    x, demands = starts(1), Demands(MOTION_CHECK, 2)
    least, _, _ = flown(x, TERMINAL_SET, World(COUNT, 3, "worst", "always"), 12.0, 20.0, demands)
    assert (least >= 0.0).all(), least.min(1)
    assert 0.1 < demands.refused / demands.asked < 0.95 and demands.verified > demands.asked / 4


def test_thrusters_that_give_some_values_only_break_no_limit() -> None:
    """What is proposed is rounded before it is looked at, and so is what replaces it."""
    check = of_thrust(C, PERIOD, ROUNDED)
    assert check.terminal_set and check.terminal_set.uncertainty.acceleration > 0.0
    x, proposals = starts(1), Demands(None, 2)
    x, refused = x[:, check.has_backup_trajectory(x)], 0
    assert x.shape[1] > COUNT / 3

    def law(x: Tensor, torque: Tensor, bound: Tensor) -> Tensor:
        nonlocal refused
        u = torch.cat((ROUNDED.quantised(proposals(x, torque, bound), C.max_thrust), torque))
        u, _, changed = committed(check, 0, x, u, bound)
        assert torch.equal(ROUNDED.quantised(u[THRUST], C.max_thrust), u[THRUST])
        refused += int(changed.sum())
        return u[THRUST]

    world = World(x.shape[1], 3, "worst", "always", ROUNDED)
    least, _, _ = flown(x, check.terminal_set, world, 4.0, 20.0, law)
    assert (least >= 0.0).all(), least.min(1)
    assert refused > 12


def test_unchecked_the_same_demands_break_limits() -> None:
    least, _, _ = flown(
        starts(1), TERMINAL_SET, World(COUNT, 3, "steady", "random"), 100.0, 20.0, Demands(None, 2)
    )
    assert (least.min(1)[[1, 2, 3]] < 0.0).all()


def test_a_check_that_forgets_missed_calls_lets_limits_break() -> None:
    forgetful = of_thrust(C, PERIOD, replace(U1, longest_hold=1.0))
    assert forgetful.terminal_set
    world, demands = World(COUNT, 3, "worst", "always"), Demands(forgetful, 2)
    least, _, _ = flown(starts(1), forgetful.terminal_set, world, 30.0, 20.0, demands)
    assert least.min() < 0.0


@pytest.mark.parametrize("quantum", [0.0, 0.05])
def test_what_is_verified_ends_where_a_backup_trajectory_begins(quantum: float) -> None:
    """The true state after a hold that was verified has a backup trajectory, whatever the hold, wherever it began."""
    uncertainty = replace(U1, thrust_quantum=quantum)
    check = of_thrust(C, PERIOD, uncertainty)
    assert check.terminal_set
    x = starts(4)
    x = x[:, check.has_backup_trajectory(x)]
    count = x.shape[1]
    world = World(count, 5, "worst", "random", uncertainty)
    seen, bound = world.sees(x, check.terminal_set), torch.zeros(4, count, dtype=torch.float64)
    torque = torch.zeros(3, count, dtype=torch.float64)
    asked = Demands(None, 6)(seen, torque, bound)
    u = torch.cat((uncertainty.quantised(asked, C.max_thrust), torque))
    safe = is_safe(check, 0, torch.cat((seen, bound)), u)
    assert 10 < safe.sum() < count
    for calls_held in (1, 2, 3):
        world = World(count, 5, "worst", "random", uncertainty)
        world.held_for = lambda held=calls_held: held  # type: ignore[method-assign]
        world.asks_torque = lambda _: torque  # type: ignore[method-assign]
        _, end, _ = flown(x, check.terminal_set, world, float(calls_held), None, lambda *_: u[THRUST])
        assert check.has_backup_trajectory(end)[safe].all()


def test_a_limit_may_be_kept_as_far_beyond_it_as_a_state_may_be_off() -> None:
    further = torch.tensor([0.2, 0.01, 0.0, 0.0], dtype=torch.float64)[:, None]
    e_p, e_v = math.sqrt(3.0) * U1.position + 0.2, math.sqrt(3.0) * U1.velocity + 0.01
    limit = C.docking_speed + C.speed_slope * (100.0 + e_p)
    for beyond, kept in ((0.9, True), (1.1, False)):
        for distance, speed in (
            (C.collision_radius - beyond * e_p, 0.0),
            (C.max_distance + beyond * e_p, 0.0),
            (100.0, limit + beyond * e_v),
            (C.max_distance, C.max_speed + beyond * e_v),
        ):
            x = torch.zeros(SIZE, 1, dtype=torch.float64)
            x[P.start], x[V.start + 1] = distance, speed
            assert (may_be_kept(x, further, TERMINAL_SET) >= 0.0) == kept, (distance, speed)


LEFT_THE_ZONE = [-689.517, -118.445, 35.9689, -3.17297, -0.4764, -3.54167, 0.751987, -0.532918, 0.352355, -0.162358,
                 -0.0237629, 0.0284278, -0.0326149, 5.26168, 6.07567, 2.28658]  # fmt: skip


def test_starts_have_a_backup_trajectory_also_where_only_thrust_is_checked() -> None:
    """With full thrust outwards a start without one left the zone."""
    bounds = Uncertainty(rate=0.3)
    with pytest.raises(ValueError, match=r"^no check is known of attitude: .*unverified = true"):
        RobustFilter(C, uncertainty=bounds)
    safety = RobustFilter(C, RtaParameters(unverified=True), uncertainty=bounds)
    assert safety.check and safety.checked == (True, False)
    without_trajectory = torch.tensor(LEFT_THE_ZONE, dtype=torch.float64)[:, None]
    assert (safety.values(without_trajectory) >= 0.0).all() and not safety.is_safe(without_trajectory)
    x, _, _ = safe_set(200, 9, safety)
    assert safety.is_safe(x).all() and safety.check.has_backup_trajectory(x).all()

"""`RobustFilter` around the paper's program: what it asks for, what it leaves to the check, how it leads back."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, OMEGA, SIZE, THRUST, TORQUE, E, P, T, V
from inspection.world.uncertainty import Uncertainty
from rta.fast.filter import batched
from rta.filter import SafetyFilter
from rta.limits import PAPER
from rta.robust.filter import RobustFilter
from study.verification.starts import safe_set

C = InspectionParameters()
SMALL = Uncertainty(position=0.3, rate=0.01)
QUANTA = 0.25  # N
LEAST = 0.1  # N


def made(uncertainty: Uncertainty) -> RobustFilter:
    return batched(RobustFilter(C, uncertainty=uncertainty))


def desired(count: int, seed: int) -> Tensor:
    """Returns controls (6, count) up to twice the actuators' limits."""
    generator = torch.Generator().manual_seed(seed)
    limit = torch.tensor(C.control_limit, dtype=torch.float64)[:, None]
    return limit * (4.0 * torch.rand(CONTROL_SIZE, count, generator=generator, dtype=torch.float64) - 2.0)


def test_thrusters_are_asked_for_multiples_of_what_they_give() -> None:
    f = made(Uncertainty(thrust_quantum=QUANTA))
    x = safe_set(200, 0, f)[0]
    answer = f.correct(x, desired(200, 1))
    counts = answer.control[THRUST] / QUANTA
    torch.testing.assert_close(counts, counts.round(), rtol=0, atol=1e-9)
    assert len(counts.round().unique()) == 9  # from -4 to 4
    assert answer.backup.any() and answer.verified.double().mean() > 0.5


def test_thrusters_are_asked_for_nothing_or_for_as_much_as_they_give() -> None:
    f = made(Uncertainty(minimum_thrust=LEAST))
    x = safe_set(200, 0, f)[0]
    thrust = f.correct(x, 0.2 * desired(200, 1)).control[THRUST].abs()
    assert ((thrust == 0.0) | (thrust >= LEAST - 1e-12)).all()
    assert (thrust == 0.0).any() and ((thrust > 0.0) & (thrust < 2 * LEAST)).any()


def test_proposals_leave_the_rates_what_they_may_be_off_by() -> None:
    f, alone = made(SMALL), SafetyFilter(C)
    off = math.sqrt(3.0) * math.radians(SMALL.rate)
    assert f.largest_rate == pytest.approx(alone.largest_rate - off)
    x = safe_set(100, 0, f)[0]
    for largest, each in ((f.largest_rate, f), (alone.largest_rate, alone)):
        proposed = each.proposed(x, desired(100, 2))
        after = x[OMEGA] + proposed.control[TORQUE] / C.inertia[0]  # equal moments: nothing gyroscopic
        assert after.abs().amax() == pytest.approx(largest)


def test_states_that_are_not_finite_are_never_verified() -> None:
    f = made(Uncertainty(position=0.3))
    x = safe_set(16, 0, f)[0]
    u, far = torch.zeros(6, 16, dtype=torch.float64), torch.arange(0, 16, 2)
    x[E, far], x[T, far[::2]] = math.inf, -math.inf
    found = f.correct(x, u)
    assert not found.verified[far].any() and found.verified[1::2].all()


def test_a_spacecraft_that_is_surely_beyond_a_limit_follows_its_law() -> None:
    """Outside the zone thrust is the law's, and a body that is within its limits keeps its own torque."""
    f = made(Uncertainty(position=0.3))
    assert f.check
    x = torch.zeros(SIZE, 1, dtype=torch.float64)
    x[P.start], x[V.start], x[8], x[T], x[E] = C.max_distance + 5.0, 0.5, 1.0, 3.0, 7.0
    answer = f.correct(x, torch.zeros(CONTROL_SIZE, 1, dtype=torch.float64))
    seen = torch.cat((x, x.new_zeros(f.check.size - SIZE, 1)))
    torch.testing.assert_close(answer.control[THRUST], f.check.thrust(seen, answer.control[TORQUE]))
    assert answer.backup.all() and not answer.verified.any()
    assert answer.control[0] > 0.5 * C.max_thrust  # its body's x axis is at the chief
    for name in ("attitude_exclusion", "temperature", "battery"):
        assert (PAPER[name].h(x, C) > 0.0).all()
    assert (answer.control[TORQUE] == 0.0).all()


def test_a_filter_of_nil_bounds_answers_as_the_one_without() -> None:
    f, alone = (
        batched(RobustFilter(C, uncertainty=replace(SMALL, position=0.0, rate=1e-9))),
        batched(SafetyFilter(C)),
    )
    x = safe_set(50, 3, f)[0]
    u = 0.01 * desired(50, 4)
    ours, theirs = f.correct(x, u), alone.correct(x, u)
    agree = ~ours.backup & ~theirs.backup
    assert agree.sum() > 25
    torch.testing.assert_close(ours.control[:, agree], theirs.control[:, agree], rtol=0, atol=1e-9)

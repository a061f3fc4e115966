"""A thruster that is known to be dead: the body turns it off the radius in time, and nothing runs away."""

import math

import pytest
import torch
from torch import Tensor

from inspection.model.attitude import conjugate, cross, norm, rotate
from inspection.model.draws import random_quaternion
from inspection.model.dynamics import step, sun_and_earth_in_body
from inspection.model.state import THETA_S, THRUST, E, P, Q, T, V
from rta.bounds.health import NEAR, slewing
from rta.bounds.uncertainty import NO_UNCERTAINTY, Uncertainty
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from tests.rta.test_filter import C

# s that a right angle takes at the limit of the rates, and one call of 1 s and the spin-up
LONGEST_TURN = math.pi / 2 / C.max_rate + max(C.inertia) * C.max_rate / C.max_torque + 1.0


def flying_out(count: int, distance: float, speed: float, seed: int) -> Tensor:
    """States (16, count) in random attitudes, at a distance in m, flying out at a speed in m/s."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.zeros(16, count, dtype=torch.float64)
    out = torch.randn(3, count, generator=generator, dtype=torch.float64)
    out = out / out.norm(dim=0)
    x[P], x[V] = distance * out, speed * out
    x[Q] = random_quaternion(count, generator, torch.float64)
    x[T], x[E] = 5.0, 6.0
    x[THETA_S] = 2 * math.pi * torch.rand(1, count, generator=generator, dtype=torch.float64)
    return x


def without_one_axis(count: int) -> Tensor:
    """(6, count) what is left: of each spacecraft one thruster is dead."""
    left = torch.ones(6, count, dtype=torch.float64)
    left[torch.arange(count) % 3, torch.arange(count)] = 0.0
    return left


def in_body(x: Tensor) -> Tensor:
    """(3, B) the direction away from the chief."""
    return rotate(conjugate(x[Q]), x[P]) / norm(x[P])


def on_radius(x: Tensor, left: Tensor) -> Tensor:
    """(B,) of the radius, along the dead axis."""
    return ((1.0 - left[THRUST]) * in_body(x).abs()).sum(0)


def test_the_body_has_turned_in_the_time_that_is_counted_on() -> None:
    x, left = flying_out(96, 700.0, 2.0, seed=1), without_one_axis(96)
    lit = sun_and_earth_in_body(x)[0][0] > math.cos(C.field_of_view / 2 + C.exclusion_buffer)
    x, left = x[:, ~lit], left[:, ~lit]
    before, nearest = on_radius(x, left), torch.full_like(x[0], -torch.inf)
    for _ in range(math.ceil(LONGEST_TURN)):
        torque = slewing(x, torch.zeros_like(x[:3]), left, C, RtaParameters(), NO_UNCERTAINTY)
        x = step(x, torch.cat((torch.zeros_like(torque), torque)), 1.0, C)
        nearest = nearest.maximum(sun_and_earth_in_body(x)[0][0])
    assert (before > 0.9).sum() > 5
    arrived = on_radius(x, left) < 1.5 * NEAR
    assert arrived.double().mean() > 0.9  # the Sun is in the way of the others
    # past the Sun by the filter's own limit, but for what lies between two of the attitudes that are compared
    assert nearest.max() < math.cos(C.field_of_view / 2 + C.exclusion_buffer - math.radians(7.5))


def test_a_torque_is_left_alone_where_no_turn_is_needed() -> None:
    left, torque = without_one_axis(32), torch.full((3, 32), 1e-4, dtype=torch.float64)

    def kept(x: Tensor, left: Tensor) -> Tensor:
        return (slewing(x, torque, left, C, RtaParameters(), NO_UNCERTAINTY) == torque).all(0)

    far_in, outside = flying_out(32, 300.0, 1.0, seed=2), flying_out(32, 700.0, 2.0, seed=2)
    returning = torch.cat((outside[P], -outside[V], outside[Q.start :]))
    assert kept(far_in, left).all() and kept(returning, left).all()
    assert kept(outside, torch.ones_like(left)).all()  # all are healthy
    assert kept(outside, torch.full_like(left, 0.5)).all()  # or equally weak
    assert kept(outside, left.index_fill(0, torch.arange(3), 0.0)).all()  # all are dead
    assert kept(outside, left.index_fill(0, torch.tensor([4]), 0.0)).all()  # a wheel is dead, too
    assert (~kept(outside, left)).sum() > 20


@pytest.mark.campaign
def test_a_known_dead_thruster_does_not_run_away() -> None:
    """An adversary thrusts outwards and turns the dead axis onto the radius."""
    count, period = 9, 10.0
    x, left = flying_out(count, 660.0, 2.2, seed=3), without_one_axis(count)
    safety = SafetyFilter(C, RtaParameters(period=period), uncertainty=Uncertainty(health=True))
    farthest = torch.zeros(count, dtype=torch.float64)
    for _ in range(18):
        out = in_body(x)
        axis = (1.0 - left[THRUST]) * torch.where(out < 0.0, -1.0, 1.0)
        torque = C.max_torque * torch.stack(cross(axis, out)).sign()
        u = safety.correct(x, torch.cat((C.max_thrust * out.sign(), torque)), left=left).control
        x = step(x, left * u, period, C)
        farthest = farthest.maximum(norm(x[P]))
    assert farthest.max() < C.max_distance
    assert (farthest > C.max_distance - 30.0).all()  # they were on their way out


def test_a_late_state_is_predicted_by_what_dead_thrusters_gave() -> None:
    x, left = flying_out(6, 700.0, 2.0, seed=5), without_one_axis(6)
    safety = SafetyFilter(C, uncertainty=Uncertainty(health=True, latency=2))
    sent = torch.full((2, 6, 6), 1e-4, dtype=torch.float64)
    sent[:, THRUST] = 1.0
    answer = safety.correct(x, torch.zeros_like(left), sent, left)
    for u in sent:
        x = step(x, left * u, 1.0, C)
    torch.testing.assert_close(answer.h, safety.values(x))

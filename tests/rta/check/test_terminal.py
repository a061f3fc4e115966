"""The set in which flights end: the laws do not leave it, and all limits are kept in it."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.attitude import rotated_by, rotation_matrix
from inspection.model.state import OMEGA, E, P, Q, T, V
from rta.check.attitude_law import Pointing, rest_deviation
from rta.check.commit import NoCheckError
from rta.check.motion_law import Braking, field
from rta.check.nominal import NominalCheck
from rta.check.terminal_set import CALM, TerminalSet, hold_error
from tests.oracles import moved
from tests.rta.check.flights import EACH, ROUNDED, C, anywhere, backup, in_c, least_of, random, unit, vehicle
from tests.support.states import last_accepted


def inside(name: str, hold: float, saturates: bool, count: int, seed: int) -> Tensor:
    """Returns states in the set, two thirds of them at its boundary: of the cone, of the motion, of heat and charge."""
    c, b, flight = vehicle(name, saturates), backup(name, hold, saturates), in_c(name, hold, saturates)
    s, x = b.terminal, anywhere(count, seed, c)
    draw, side = random(16, count, seed), random(3, count, seed + 1)
    kind = torch.arange(count) % 3
    for _ in range(math.ceil(b.early_accept.arrives / hold)):
        x = flight(x)[0]
    rest = x.clone()
    # attitude: off the rest in any direction, with any rates, then scaled to V = R^2 (share of it)
    angle, rates = unit(draw[:3]), unit(draw[3:6]) * (1 + draw[15]) ** 2 / hold
    share = torch.where(kind == 2, (1 + draw[6]) / 2, torch.ones_like(draw[6]))

    def off_rest(scale: Tensor) -> Tensor:
        x[Q], x[OMEGA] = rotated_by(rest[Q], 0.2 * scale * angle), rest[OMEGA] + 0.2 * scale * rates
        return x

    most = (1 - share**2) * s.radius**2
    x = off_rest(last_accepted(lambda scale: s.room(off_rest(scale))[0] >= most, count, 50))
    # heat and charge
    x[T] = s.hottest - torch.where(kind == 0, 0.0, 5.0 * (1 + draw[8]))
    x[E] = s.emptiest + torch.where(kind == 0, 0.0, 2.0 * (1 + draw[9]))
    # motion
    edges = torch.tensor([s.nearest * (1 + 1e-12), s.farthest * (1 - 1e-12)], dtype=torch.float64)
    between = s.nearest + (s.farthest - s.nearest) * (1 + draw[10]) / 2
    beside = edges[(draw[10] > 0.0).long()] + torch.where(draw[10] > 0.0, -1.0, 1.0) * (1 + draw[11])
    distance = torch.where(kind == 0, edges[(draw[10] > 0.0).long()], torch.where(kind == 1, beside, between))
    x[P] = distance.clamp(*edges.tolist()) * unit(x[P])
    # towards the end that is nearer, or in any direction
    inwards = -unit(x[P]) * torch.where(distance < 100.0, 1.0, -1.0)
    x[V] = field(x[P], c) + (1 - 1e-9) * CALM * torch.where(draw[12] > 0.0, inwards, unit(side))
    return x


def least_kept(x: Tensor, name: str, hold: float, saturates: bool, holds: int) -> tuple[Tensor, Tensor]:
    """Returns the least room in the set, in units of its own, and of each limit in each of the plant's steps.

    Not by the bounds between looks, which need more room than there is at the set's edges.
    """
    flight, s = in_c(name, hold, saturates), backup(name, hold, saturates).terminal
    c = vehicle(name, saturates)
    room, limit = s.room(x), least_of(x, c, 10.0)
    for i in range(holds):
        end, _, u, _, after = flight(x)
        for _ in range(round(hold / c.substep)):
            x = moved(x, u, c.substep, c)
            limit = np.minimum(limit, least_of(x, c))
        if i % 30 == 0:
            limit = np.minimum(limit, least_of(x, c, 10.0))
        assert torch.equal(x, end)
        room = torch.minimum(room, after)
    return room, torch.from_numpy(limit)


@EACH
def test_the_laws_stay_in_it_and_keep_all_limits(name: str, hold: float, saturates: bool) -> None:
    x = inside(name, hold, saturates, 200, 1)
    s = backup(name, hold, saturates).terminal
    at_first = s.room(x)
    assert (at_first >= -ROUNDED).all()
    assert ((at_first[0] < 1e-6 * s.radius**2)[::3]).all() and (at_first[3] < 1e-9).all()
    room, limit = least_kept(x, name, hold, saturates, 40)
    assert (room >= -ROUNDED).all(), room.amin(1)
    assert (limit >= 0.0).all(), limit.amin(1)


@pytest.mark.parametrize(("what", "by"), [("hottest", 0.03), ("emptiest", -0.03), ("nearest", -1.0)])
def test_a_larger_set_would_hold_states_that_break_a_limit(what: str, by: float) -> None:
    """So the test above can fail: states at the edge of a set that is larger by this break it, now or later."""
    b = backup("paper", 5.0)
    own = b.terminal
    x = inside("paper", 5.0, True, 300, 1)
    wide = replace(own, **{what: getattr(own, what) + by})
    if what == "nearest":
        x[P] = wide.nearest * unit(x[P])
        x[V] = field(x[P], C) - CALM * unit(x[P])
    else:
        x[T if what == "hottest" else E] += by
    row = {"hottest": 1, "emptiest": 2, "nearest": 4}[what]
    assert (wide.room(x) >= -ROUNDED).all(0).any() and (own.room(x)[row, ::3] < 0.0).all()
    _, limit = least_kept(x, "paper", 5.0, True, 20)
    assert (limit < 0.0).any()


@pytest.mark.parametrize(("name", "hold"), [("paper", 10.0), ("espa", 10.0)])
def test_a_hold_of_the_law_ends_where_the_form_says_but_for_the_bounds(name: str, hold: float) -> None:
    """(a, T w) becomes M (a, T w), but for what is non-linear: the step of the proof that flights alone do not show."""
    c, b = vehicle(name), backup(name, hold)

    def coordinates(x: Tensor) -> tuple[Tensor, Tensor]:
        """Returns a and T w in the body, (3, B) each."""
        a, roll, _ = rest_deviation(x, c)
        a[0] -= roll  # about the panels' axis, -x
        return a, hold * (x[OMEGA] + c.mean_motion * rotation_matrix(x[Q])[2])

    x, z = inside(name, hold, True, 300, 7), b.pointing.kappa * hold
    (a, turn), (a_after, turn_after) = (
        coordinates(x),
        coordinates(b.hold(x, b.law(x), torch.ones_like(x[0], dtype=torch.bool))[0]),
    )
    of_a = (a_after - (1 - z / 2) * a + turn / 2).norm(dim=0)
    of_turn = (turn_after - z * a).norm(dim=0)
    angle = a.norm(dim=0).asin()
    rate = torch.maximum(turn.norm(dim=0) / hold, b.pointing.kappa * angle)
    bounds = [hold_error(b.pointing, *each)[:2] for each in zip(angle.tolist(), rate.tolist(), strict=True)]
    shares = torch.stack((of_a, of_turn)) / torch.tensor(bounds, dtype=torch.float64).T
    assert (shares <= 1.0).all(), shares.amax(1)
    if name == "paper":  # of equal moments: the bound of gyroscopic torque is zero
        assert (shares.amax(1) > torch.tensor([0.2, 0.6])).all(), shares.amax(1)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"inertia": (50.0, 50.0, 50.0)}, "rest"),  # torque does not suffice
        ({"max_temperature": -200.0}, "rest"),  # radiates less than the Earth gives
        ({"power_draw": 80.0}, "rest"),  # no light can charge the battery
        ({"max_distance": 60.0}, "zone"),
    ],
)
def test_where_the_laws_stay_nowhere_there_is_no_set(changed: dict[str, Any], reason: str) -> None:
    with pytest.raises(NoCheckError, match=reason):
        NominalCheck(replace(C, **changed), 1.0)
    with pytest.raises(NoCheckError, match="strays"):
        TerminalSet.of(Pointing.of(C, 10.0), Braking.of(C, 60.0, 0.03))

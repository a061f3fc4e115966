"""The law of thrust: the mean force of a hold, a straight way to rest, along the zone, and away from both ends."""

import numpy as np
import pytest
import torch

from inspection.model.attitude import rotate
from inspection.model.state import OMEGA, P, Q, V
from rta.check.motion_law import BESIDE, DRIFT, INSIDE, field, thrust_along
from tests.oracles import length, moved
from tests.rta.check.flights import (
    C,
    anywhere,
    backup,
    in_c,
    near_the_zone,
    random,
    turning,
    unit,
)

HOLD = 10.0  # s


@pytest.mark.parametrize(("hold", "share"), [(1.0, 1e-5), (5.0, 1e-3), (10.0, 5e-3)])
def test_the_mean_force_of_a_hold_is_the_wanted_one(hold: float, share: float) -> None:
    w, x = backup("paper", hold).braking, anywhere(300, 11)
    torque = turning(x, hold, 1)
    wanted = w.thrust * unit(
        torch.randn(3, 300, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    )
    u = torch.cat((thrust_along(wanted, x, torque, w), torque))
    assert (u[:3].abs() <= C.max_thrust).all()
    look, mean = hold / 400, torch.zeros_like(wanted)
    for i in range(401):
        mean += (0.5 if i in (0, 400) else 1.0) * rotate(x[Q], u[:3]) / C.mass / 400
        x = moved(x, u, look, C)
    off = (mean - wanted).norm(dim=0) / w.thrust
    assert off.max() < share
    assert off.max() < w.mean_error
    assert x[OMEGA].abs().max() > 0.9 * C.max_rate  # the bodies did turn


def test_a_body_that_turns_anyhow_comes_to_rest_straight_and_when_expected() -> None:
    """a T off |v| in each hold, by Clohessy and Wiltshire's plant: after |v| / (a T) holds nothing is left."""
    b = backup("paper", HOLD)
    w, x = b.braking, anywhere(300, 3)
    x[P] = (100.0 + 200.0 * random(1, 300, 1).abs()) * unit(x[P])  # where the field is zero
    x[V] = (0.1 + 3.0 * random(1, 300, 2).abs()) * unit(x[V])
    start, direction, speed = x.clone(), unit(x[V]), x[V].norm(dim=0)
    holds = (speed / (w.straight * HOLD)).ceil()
    for call in range(int(holds.max())):
        torque = turning(x, HOLD, call // 3)
        x = moved(x, torch.cat((b.thrust(x, torque), torque)), HOLD, C)
        left = (speed - (call + 1) * w.straight * HOLD).clamp(min=0.0)
        strayed = 0.01 * w.thrust * HOLD + 1e-3 * call
        assert ((x[V] - left * direction).norm(dim=0) < strayed).all(), call
    assert (x[V].norm(dim=0) < 0.01).all()
    gone = x[P] - start[P]
    along = (gone * direction).sum(0)
    assert ((gone - along * direction).norm(dim=0) < 0.5 + 0.02 * along).all()
    ideal = speed**2 / (2 * w.straight) + speed * HOLD / 2
    assert (along < ideal + 0.5).all() and (
        along > ideal - speed * HOLD / 2 - w.straight * HOLD**2 - 0.5
    ).all()


@pytest.mark.parametrize("hold", [1.0, 10.0])
def test_the_zone_is_kept_where_the_closed_form_has_a_way(hold: float) -> None:
    """Thrust turns a flight before r_max where a_max - v_t^2 / r, against v_r^2 / 2, is enough for the way there."""
    x, flight = near_the_zone(2000, 3), in_c("paper", hold)
    p, v = x[P].numpy(), x[V].numpy()
    w, a_max = backup("paper", hold).braking, C.max_acceleration
    distance = length(p)
    radial = (p * v).sum(0) / distance
    left = a_max - ((v * v).sum(0) - radial**2) / distance
    room = 0.9 * (C.max_distance - INSIDE - w.buffer - distance)
    suffices = (left > 0.05 * a_max) & (np.maximum(radial, 0.0) ** 2 / 2 < left * room) & (room > 0.0)
    x = x[:, suffices]
    assert x.shape[1] > 1000
    farthest, slowest = x[P].norm(dim=0), x[V].norm(dim=0)
    for _ in range(round(150 / hold)):
        x = flight(x)[0]
        farthest, slowest = torch.maximum(farthest, x[P].norm(dim=0)), x[V].norm(dim=0)
    assert (farthest < C.max_distance).double().mean() > 0.998
    assert (slowest < 0.03).all()


def test_the_field_leads_away_from_both_ends_and_back_from_beyond() -> None:
    x = anywhere(400, 9)
    direction = unit(x[P])
    for distance, least, most in (
        (C.collision_radius - 1.0, DRIFT, DRIFT + 0.1),
        (C.collision_radius + 0.5, DRIFT, DRIFT),
        (BESIDE * C.collision_radius - 1.0, DRIFT, DRIFT),
        (BESIDE * C.collision_radius + DRIFT / 5e-4 + 1.0, 0.0, 0.0),
        (400.0, 0.0, 0.0),
        (C.max_distance - INSIDE - DRIFT / 5e-4 - 1.0, 0.0, 0.0),
        (C.max_distance - 0.5, -DRIFT, -DRIFT),
        (C.max_distance + 20.0, -DRIFT - 0.1, -DRIFT - 1e-3),
    ):
        v = field(distance * direction, C)
        along = (v * direction).sum(0)
        assert (along >= least - 1e-12).all() and (along <= most + 1e-12).all(), distance
        assert (v - along * direction).norm(dim=0).max() < 1e-12

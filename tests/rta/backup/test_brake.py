"""The brake flown by bodies that turn anyhow: no limit of motion breaks, and the spacecraft comes to rest and stays."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.attitude import rotate
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, Q
from rta.backup import brake
from rta.backup.check import Backup
from rta.parameters import PERIODS
from tests.rta.backup.brute_force import flown, hypercube, motion, moved
from tests.rta.constraints.test_constraints import length

C = InspectionParameters()
BACKUPS = {hold: Backup(C, hold) for hold in PERIODS}
HOLDS = pytest.mark.parametrize("hold", PERIODS)
LOOK = 0.1  # s


def torques(x: Tensor, hold: float, seed: int) -> Tensor:
    """(3, B) torque towards other rates, each within its limit all the while."""
    generator = torch.Generator().manual_seed(seed)
    wanted = (
        0.99
        * C.max_rate
        * (2 * torch.rand(3, x.shape[1], generator=generator, dtype=torch.float64) - 1).sign()
    )
    inertia = torch.tensor(C.inertia, dtype=torch.float64)[:, None]
    return (inertia * (wanted - x[OMEGA]) / hold).clamp(-C.max_torque, C.max_torque)


def by_the_brake(w: brake.Braking) -> Callable[[Tensor], Tensor]:
    """The law while bodies turn anyhow."""
    calls = iter(range(10**6))

    def law(x: Tensor) -> Tensor:
        torque = torques(x, w.hold, next(calls) // 3)
        return torch.cat((brake.brake(x, torque, w), torque))

    return law


def near_the_zone(count: int, seed: int) -> Tensor:
    """States within 60 m of the zone, mostly across."""
    x, rng = hypercube(count, seed, C), np.random.default_rng(seed)
    p, v = x[:3].numpy(), rng.standard_normal((3, count))
    out = p / length(p)
    v = v - rng.uniform(0.6, 1.0, count) * (v * out).sum(0) * out
    distance = C.max_distance - rng.uniform(0.5, 60.0, count)
    speed = np.minimum(C.docking_speed + C.speed_slope * distance, C.max_speed)
    x[:3], x[3:6] = (
        torch.from_numpy(distance * out),
        torch.from_numpy(speed * rng.uniform(0.5, 1, count) * v / length(v)),
    )
    return x


def at_the_chief(count: int, seed: int) -> Tensor:
    """States that fly towards the chief, within 1 m of its centre's line."""
    x, rng = hypercube(count, seed, C), np.random.default_rng(seed)
    p = x[:3].numpy()
    p = p / length(p) * rng.uniform(20, 300, count)
    aim = rng.uniform(-1, 1, (3, count)) - p
    fast = (C.docking_speed + C.speed_slope * length(p)) * rng.uniform(0.05, 1, count)
    x[:3], x[3:6] = torch.from_numpy(p), torch.from_numpy(fast * aim / length(aim))
    return x


def anywhere(count: int, seed: int) -> Tensor:
    return hypercube(count, seed, C)


STARTS = (anywhere, near_the_zone, at_the_chief)


@HOLDS
def test_what_is_verified_keeps_every_limit_and_comes_to_rest(hold: float) -> None:
    w, accepted = BACKUPS[hold].braking, []
    for start in STARTS:
        x = start(400, 3)
        at = brake.beginning(x, w)
        once, way = brake.at_once(at, w), BACKUPS[hold].brakes(at)
        by_chord, by_look = torch.nonzero(once >= 0).flatten(), torch.nonzero(way & ~(once >= 0)).flatten()
        assert by_chord.numel() > 20
        accepted += [x[:, by_chord[once[by_chord].argsort()[:50]]], x[:, by_look[:50]]]  # the closest ones
    path = flown(torch.cat(accepted, 1), by_the_brake(w), C, hold, 160.0, LOOK)
    for i, y in enumerate(path[:1300]):
        least = motion(y[:3], y[3:6], C, spacing=10.0 if i % 50 == 0 else None)
        assert (least >= 0).all(), (i * LOOK, np.argwhere(least < 0)[:3], least.min())
    assert max(length(y[3:6]).max() for y in path[-300:]) < 0.02  # m/s
    assert length(path[-1][:3] - path[-300][:3]).max() < 0.1  # m in 30 s


@HOLDS
def test_a_way_is_found_along_the_zone_where_the_closed_form_has_one(hold: float) -> None:
    """Thrust turns a flight before r_max where a_max - v_t^2 / r, against v_r^2 / 2, is enough for the way there."""
    w, x = BACKUPS[hold].braking, near_the_zone(1500, 3)
    p, v = x[:3].numpy(), x[3:6].numpy()
    distance, a_max = length(p), C.max_acceleration
    radial = (p * v).sum(0) / distance
    left = a_max - ((v * v).sum(0) - radial**2) / distance
    room = 0.9 * (C.max_distance - brake.INSIDE - w.buffer - distance)
    suffices = (left > 0.05 * a_max) & (np.maximum(radial, 0.0) ** 2 / 2 < left * room) & (room > 0.0)
    suffices &= (motion(p, v, C, spacing=10.0) >= 0.0).all(0)
    assert suffices.sum() > 1000
    assert BACKUPS[hold].brakes(brake.beginning(x, w)).numpy()[suffices].mean() > 0.998


@HOLDS
def test_a_hold_is_never_below_what_is_told(hold: float) -> None:
    w = BACKUPS[hold].braking
    x, generator = hypercube(400, 7, C), torch.Generator().manual_seed(0)
    push = (2 * torch.rand(3, 400, generator=generator, dtype=torch.float64) - 1).sign()
    u = torch.cat((push * C.max_thrust, torques(x, hold, 0)))
    told, end = brake.held(x, u, w, w.free)
    dense, least = x, motion(x[:3].numpy(), x[3:6].numpy(), C, spacing=5.0)
    for _ in range(round(hold / LOOK)):
        dense = moved(dense, u, LOOK, C)
        least = np.minimum(least, motion(dense[:3].numpy(), dense[3:6].numpy(), C, spacing=None))
    least = np.minimum(least, motion(dense[:3].numpy(), dense[3:6].numpy(), C, spacing=5.0)).min(0)
    assert (told.numpy() <= least + 1e-9).all(), (told.numpy() - least).max()
    kept = least > 0.2
    assert np.median((least - told.numpy())[kept]) < (0.5 if hold < 5 else 1.5)
    torch.testing.assert_close(end[:6], dense[:6], rtol=0, atol=1e-3)


@pytest.mark.parametrize(("hold", "share"), [(1.0, 1e-5), (5.0, 1e-3), (10.0, 5e-3)])
def test_the_mean_force_of_a_hold_is_the_wanted_one(hold: float, share: float) -> None:
    w = BACKUPS[hold].braking
    x = hypercube(300, 11, C)
    torque = torques(x, hold, 1)
    wanted = torch.randn(3, 300, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    wanted = w.thrust * wanted / wanted.norm(dim=0)
    u = torch.cat((brake.thrust_along(wanted, x, torque, w), torque))
    assert (u[:3].abs() <= C.max_thrust).all()
    look, mean = hold / 400, torch.zeros_like(wanted)
    for i in range(401):
        mean += (0.5 if i in (0, 400) else 1.0) * rotate(x[Q], u[:3]) / C.mass / 400
        x = moved(x, u, look, C)
    off = (mean - wanted).norm(dim=0) / w.thrust
    assert off.max() < share
    assert off.max() < w.astray
    assert x[OMEGA].abs().max() > 0.9 * C.max_rate  # the bodies did turn


@HOLDS
def test_every_hold_of_a_way_counts_until_it_rests(hold: float) -> None:
    """Also where the first ones keep the limits and a later one does not."""
    backup, x = BACKUPS[hold], torch.cat([start(1500, 5) for start in STARTS], 1)
    at = brake.beginning(x, backup.braking)
    told, flies = backup.brakes(at), torch.ones_like(x[0], dtype=torch.bool)
    first, kept = torch.zeros_like(flies), torch.ones_like(flies)
    for call in range(backup.braking.holds):
        rests = at[3:6].norm(dim=0) <= brake.AT_REST
        at, least = brake.braked(at, backup.braking)
        kept &= (least >= 0.0) | ~flies
        first = kept.clone() if call == 0 else first
        flies = flies & ~rests
    assert torch.equal(told, kept & ~flies)
    assert (first & ~kept).any()


def test_a_way_that_never_rests_is_none() -> None:
    backup = BACKUPS[1.0]
    x = hypercube(50, 1, C)
    at = brake.beginning(x, backup.braking)
    at[3:6] = float("nan")
    assert not backup.brakes(at).any()

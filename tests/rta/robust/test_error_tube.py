"""The cone around a braking path, against an adversary of its recursion, sampled chords and flights in U1's world."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.state import OMEGA, P, V
from rta.robust.error_tube import Node, between, trajectory_margin
from rta.robust.terminal_set import RobustTerminalSet
from tests.oracles import hypercube, length, motion, tensor
from tests.rta.robust.uncertain_world import PERIOD, U1, C, World, flown
from tests.support.states import last_accepted

TERMINAL_SET = RobustTerminalSet.of(C, PERIOD, U1)
ROUNDING = 1e-9


def accepts(x: Tensor, w: RobustTerminalSet = TERMINAL_SET) -> Tensor:
    none = torch.zeros_like(x[0])
    return trajectory_margin(x[P], x[V], none, none, none, w) >= 0.0


def edges(x: Tensor, w: RobustTerminalSet = TERMINAL_SET) -> Tensor:
    """Returns the fastest of states (16, B) along their velocities from which a backup trajectory is accepted."""
    fast = 1.6 * x[V]
    x[V] = 0.0
    fit = accepts(x, w)
    x, fast = x[:, fit], fast[:, fit]
    x[V] = fast * last_accepted(lambda share: accepts(torch.cat((x[P], share * fast, x[6:])), w), x.shape[1])
    x[OMEGA] = 0.0
    return x


def beside(count: int, seed: int) -> Tensor:
    """Returns states (16, count) near the chief, with velocities in any direction."""
    x = hypercube(count, seed, C)
    generator = torch.Generator().manual_seed(seed)
    r = 20 + 80 * torch.rand(count, generator=generator, dtype=torch.float64)
    x[V] *= (C.docking_speed + C.speed_slope * r) / (C.docking_speed + C.speed_slope * x[P].norm(dim=0))
    x[P] *= r / x[P].norm(dim=0)
    return x


def test_no_state_within_the_strays_is_below_the_bound() -> None:
    rng, count = np.random.default_rng(2), 500
    unit = [a / length(a) for a in rng.standard_normal((5, 3, count))]
    r = rng.choice((18.0, 40.0, 300.0, 780.0), count)
    u, p, v = unit[0], r * unit[1], 0.3 * unit[2]
    speed = (C.docking_speed + C.speed_slope * r) * rng.uniform(0, 1, count)
    y = [np.concatenate((p, speed * u + v)), np.concatenate((p + 4.0 * u, 0.4 * speed * u + 0.5 * v))]
    sizes = rng.uniform(0, 1, (2, 4, count)) * np.array((5.0, 2.0, 0.1, 0.05))[None, :, None]
    nodes = [
        Node(tensor(a), *(tensor(e) for e in (s[0], s[1], s[2] + s[3], s[3], length(a[3:]) + s[2] + s[3])))
        for a, s in zip(y, sizes, strict=True)
    ]
    far = torch.full((count,), 1e6, dtype=torch.float64)
    bound = between(nodes[0], nodes[1], tensor(u), -far, far, TERMINAL_SET)[:7].numpy()
    least = np.full_like(bound, np.inf)
    for share in np.linspace(0, 1, 6):
        middle, e = y[0] + share * (y[1] - y[0]), sizes[0] + share * (sizes[1] - sizes[0])
        for k in range(24):
            side = np.cross(u, rng.standard_normal((3, count)), axis=0) if k % 2 else middle[:3]
            side = side - (side * u).sum(0) * u
            side = side / np.maximum(length(side), 1e-12) * rng.choice((-1.0, 1.0))
            place = middle[:3] + rng.choice((-1.0, 1.0)) * e[0] * u + e[1] * side
            # w by at most `ahead` more along u, all in all within the velocity's stray
            other = (unit[3] if k % 3 else -middle[:3] / length(middle[:3])) * (e[2] + e[3])
            along = (other * u).sum(0)
            other = other + (np.minimum(along, e[3]) - along) * u
            path = motion(place, middle[3:] + other, C, spacing=20.0)
            least = np.minimum(least, path)
    assert (bound <= least + ROUNDING).all(), (bound - least).max(1)
    assert np.median((least - bound)[1]) < 0.1 and np.median((least - bound)[3]) < 20.0


@pytest.mark.parametrize("quantum", [0.0, 0.05])
def test_the_fastest_that_are_accepted_keep_the_limits_of_motion(quantum: float) -> None:
    uncertainty = replace(U1, thrust_quantum=quantum)
    w = RobustTerminalSet.of(C, PERIOD, uncertainty)
    x = torch.cat((edges(hypercube(150, 3, C), w), edges(beside(150, 4), w)), 1)
    assert x.shape[1] > 90
    least, end, _ = flown(x, w, World(x.shape[1], 5, "worst", "always", uncertainty), 120.0, 20.0)
    assert (least >= 0.0).all(), least.min(1)
    r = end[P].norm(dim=0)
    assert ((end[V] - w.field(end[P])).norm(dim=0) <= w.calm(r)).all() and (r >= w.nearest).all()


def test_without_what_a_trajectory_strays_limits_break() -> None:
    """A check without error bounds, which takes thrust for stronger, accepts what the world of U1 does not keep."""
    nothing = {"across": 0.0, "seen": 0.0, "lag": 0.0, "turning": 0.0, "place": 0.0}
    trusting = replace(TERMINAL_SET, low=1.0, high=1.0, full=1.3 * TERMINAL_SET.full, **nothing)
    x = torch.cat((edges(hypercube(150, 3, C), trusting), edges(beside(150, 4), trusting)), 1)
    least, _, _ = flown(x, TERMINAL_SET, World(x.shape[1], 5, "steady", "always"), 120.0, 20.0)
    assert least.min() < -0.1, least.min(1)


def test_most_states_within_the_limits_have_a_backup_trajectory() -> None:
    x = hypercube(1500, 8, C)
    x = x[:, (tensor(motion(x[:3].numpy(), x[3:6].numpy(), C, 10.0)) >= 0.0).all(0)]
    assert accepts(x).double().mean() > 0.8

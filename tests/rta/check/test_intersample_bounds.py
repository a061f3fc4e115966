"""Bounds between two looks against paths sampled within what they stray, and their numbers against differences."""

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.spatial.transform import Rotation

from inspection.model.parameters import InspectionParameters
from rta.check.flight import CELLS
from rta.check.intersample_bounds import FreeFlight, Strays, between, strays
from tests.oracles import length, motion, tensor

C = InspectionParameters()
FREE, CLOSE = FreeFlight.of(C, *CELLS), FreeFlight.of(C, 29, 1)
ROUNDING = 1e-9


def unit(a: ndarray) -> ndarray:
    return a / length(a)


def nodes(count: int, step: float, faster: float, seed: int) -> tuple[ndarray, ndarray]:
    """Returns two nodes (6, count) up to step m and faster m/s apart, from beside the chief to beyond the zone."""
    rng = np.random.default_rng(seed)
    p, v, dp, dv = unit(rng.standard_normal((3, 4 * count))).reshape(3, 4, count).swapaxes(0, 1)
    distance = rng.choice((15.1, 30.0, 150.0, 500.0, 790.0), count) * rng.uniform(1.0, 1.02, count)
    speed = (C.docking_speed + C.speed_slope * distance) * rng.uniform(0.0, 1.05, count)
    start = np.concatenate((distance * p, speed * v))
    end = start + np.concatenate(
        (step * rng.uniform(0, 1, count) * dp, faster * rng.uniform(0, 1, count) * dv)
    )
    return start, end


@pytest.mark.parametrize("free", [CLOSE, FREE], ids=["closely", "roughly"])
@pytest.mark.parametrize(
    ("step", "faster", "e_p", "e_v"), [(0, 0, 0, 0), (3, 0.3, 0, 0), (20, 1, 2, 0.05), (2, 0.2, 0.2, 0.2)]
)
def test_no_path_within_the_strays_is_below_the_bound(
    step: float, faster: float, e_p: float, e_v: float, free: FreeFlight
) -> None:
    start, end = nodes(600, step, faster, seed=int(10 * step))
    rng = np.random.default_rng(1)
    off = [torch.full((600,), e, dtype=torch.float64) for e in (e_p, e_v, e_v)]
    bound = between(tensor(start), tensor(end), Strays(*off), C, free).numpy()
    least = np.full_like(bound, np.inf)
    for share in np.linspace(0, 1, 9):
        middle = start + share * (end - start)
        out = [
            unit(middle[:3]),
            -unit(middle[:3]),
            unit(middle[3:] + 1e-12),
            unit(rng.standard_normal((3, 600))),
        ]
        for aside in out if e_p else out[:1]:
            for swifter in out if e_v else out[:1]:
                path = motion(middle[:3] + e_p * aside, middle[3:] + e_v * swifter, C, spacing=10.0)
                least = np.minimum(least, path)
    assert (bound <= least + ROUNDING).all(), (bound - least).max(1)
    assert (least > 0).any(1).all() and (least < 0).any(1)[[0, 1, 2, 3]].all()  # both sides are met


@pytest.mark.parametrize("mean_of", ["ends", "hold"])
@pytest.mark.parametrize("seconds", [1.0, 2.5])
def test_a_body_that_turns_strays_no_farther(seconds: float, mean_of: str) -> None:
    rng = np.random.default_rng(0)
    worst = np.zeros(3)
    for _ in range(200):
        turn = rng.uniform(0, 0.0605) * rng.choice((0.1, 1.0))
        axis, push = unit(rng.standard_normal(3)), rng.uniform(0, 0.144) * unit(rng.standard_normal(3))
        v = rng.choice((0.0, 0.01, 0.3, 5.0)) * unit(rng.standard_normal(3))
        t = np.linspace(0, seconds, 401)
        force = Rotation.from_rotvec(turn * t[:, None] * axis).apply(push)
        dt = t[1]

        def summed(rate: ndarray, dt: float = dt) -> ndarray:
            return np.concatenate((np.zeros((1, 3)), np.cumsum((rate[1:] + rate[:-1]) / 2 * dt, 0)))

        speed = v + summed(force)
        place = summed(speed)
        start, end = np.r_[place[0], speed[0]], np.r_[place[-1], speed[-1]]
        mean = (force[0] + force[-1]) / 2 if mean_of == "ends" else (speed[-1] - speed[0]) / seconds
        given = [tensor(part)[:, None] for part in (start, end, mean)]
        off = strays(given[0], given[1], seconds, given[2], torch.tensor([turn], dtype=torch.float64))
        share = (t / seconds)[:, None]
        chord = start + share * (end - start)
        deviation = (
            np.linalg.norm(place - chord[:, :3], axis=1).max(),
            np.linalg.norm(speed - chord[:, 3:], axis=1).max(),
            (np.linalg.norm(speed, axis=1) - np.linalg.norm(chord[:, 3:], axis=1)).max(),
        )
        for i, (bound, found) in enumerate(zip(off, deviation, strict=True)):
            assert found <= bound.item() + 1e-8, (i, found, bound.item(), turn, push, v)
            if bound.item() > 1e-6:
                worst[i] = max(worst[i], found / bound.item())
    assert (worst > 0.3).all(), worst  # the bound is no empty one

"""What is desired is led to free flights that stay clear of the chief, by a little, before it is filtered."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.draws import isotropic, shoemake
from inspection.model.dynamics import integrate, step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THRUST, TORQUE, E, P, Q, T
from rta import keep_clear
from rta.filter import SafetyFilter
from rta.keep_clear import kept_clear, led

C = InspectionParameters()
DAYS = 172_800


def returning(count: int, seed: int) -> Tensor:
    """Returns states (16, B) that return to within 10 m of the chief after 30 min to two days, in any attitude."""
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(9, count, generator=generator, dtype=torch.float64)
    x = torch.zeros(SIZE, count, dtype=torch.float64)
    t, n = 1800.0 + (DAYS - 3600.0) * s[0], C.mean_motion
    p, v = 10.0 * s[1] * isotropic(s[2:4]), 0.02 * isotropic(s[4:6])
    # Clohessy and Wiltshire's solution, back from the pass
    x[:6] = torch.stack(
        [torch.from_numpy(solution(-float(t[i]), n)) @ torch.cat((p, v))[:, i] for i in range(count)], 1
    )
    x[Q], x[T], x[E] = shoemake(s[6:9]), C.initial_temperature[0], C.initial_energy[1]
    near = (x[P].norm(dim=0) > 40.0) & (x[P].norm(dim=0) < 700.0)
    return x[:, near]


def solution(t: float | np.ndarray, n: float) -> np.ndarray:
    """Returns Clohessy and Wiltshire's transition matrix, (6, 6) or (6, 6, times), as textbooks print it."""
    s, c, zero, one = np.sin(n * t), np.cos(n * t), np.zeros_like(t), np.ones_like(t)
    return np.array([
        [4 - 3 * c, zero, zero, s / n, 2 / n * (1 - c), zero],
        [6 * (s - n * t), one, zero, -2 / n * (1 - c), (4 * s - 3 * n * t) / n, zero],
        [zero, zero, c, zero, zero, s / n],
        [3 * n * s, zero, zero, c, 2 * s, zero],
        [-6 * n * (1 - c), zero, zero, -2 * s, 4 * c - 3, zero],
        [zero, zero, -n * s, zero, zero, c],
    ])  # fmt: skip


def nearest(x: Tensor) -> np.ndarray:
    """Returns the smallest distance in m from the chief in two days, looked at every 5 s."""
    phi = solution(np.arange(0.0, DAYS, 5.0), C.mean_motion)[:3]
    return np.array(
        [np.linalg.norm(np.einsum("ijt,j->it", phi, each), axis=0).min() for each in x[:6].T.numpy()]
    )


def desired(count: int, seed: int, largest: float) -> Tensor:
    """Returns controls (6, B) with a thrust of up to so many N."""
    generator = torch.Generator().manual_seed(seed)
    u = 2.0 * torch.rand(6, count, generator=generator, dtype=torch.float64) - 1.0
    u[THRUST] *= largest
    u[TORQUE] *= 1e-3
    return u


@pytest.mark.parametrize("period", [1.0, 10.0])
def test_what_is_led_stays_clear_and_nothing_else_is_changed(period: float) -> None:
    x = returning(800, 0)
    u = desired(x.shape[1], 1, 0.1 / period)
    asked = led(x, u, period, C)
    changed = (asked != u).any(0).numpy()
    unled, after = (nearest(integrate(x, each, 1.0, C, int(period))) for each in (u, asked))
    assert changed.sum() > 20 and (~changed).sum() > 20
    assert (unled[changed] < C.collision_radius + 2.0 * keep_clear.MARGIN).all()
    assert (unled < C.collision_radius).sum() > 20 and (after >= C.collision_radius).all()
    assert (asked[TORQUE] == u[TORQUE]).all() and (asked[THRUST].abs() <= C.max_thrust).all()


def test_once_clear_it_stays_clear_whatever_is_desired() -> None:
    """25 calls of random thrust; by itself it loses some on the way."""
    x = returning(400, 3)
    nothing = torch.zeros(6, x.shape[1], dtype=torch.float64)
    x = step(x, nothing + torch.tensor([[0.3], [0.2], [0.1], [0.0], [0.0], [0.0]]), 1.0, C)
    x = x[:, keep_clear.is_clear(x, nothing, 1.0, C)][:, :40]
    bare, lost = x, torch.zeros(x.shape[1], dtype=torch.bool)
    for i in range(25):
        u = desired(x.shape[1], 10 + i, 0.1)
        x, bare = step(x, led(x, u, 1.0, C), 1.0, C), step(bare, u, 1.0, C)
        lost |= ~keep_clear.is_clear(bare, torch.zeros_like(u), 1.0, C)
    assert (nearest(x) >= C.collision_radius).all()
    assert lost.sum() > 5


def test_the_filter_has_the_last_word() -> None:
    safety = SafetyFilter(C).safety()
    x = returning(400, 4)
    x = x[:, SafetyFilter(C).is_safe(x)]
    u = desired(x.shape[1], 5, 1.0)
    asked = led(x, u, 1.0, C)
    assert kept_clear(replace(safety, correct=None), C).correct is None
    assert safety.correct
    answer, alone = kept_clear(safety, C).correct(x, u), safety.correct(x, asked)  # type: ignore[misc]
    assert (answer.control == alone.control).all()
    assert (answer.intervened == (answer.control != u).any(0)).all() and answer.intervened.any()

"""The law with error bounds and its terminal set, against thrust summed over holds, dense samples and long drifts."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from inspection.model.state import P, Q, V
from inspection.world.uncertainty import Uncertainty
from rta.check.commit import NoCheckError
from rta.robust.terminal_set import TUNINGS, RobustTerminalSet, Tuning
from tests.oracles import length, motion
from tests.rta.robust.uncertain_world import FINE, PERIOD, ROUNDED, U1, C, World, flown

TERMINAL_SET = RobustTerminalSet.of(C, PERIOD, U1)
EVERYWHERE = np.array((18.0, 20.0, 25.0, 40.0, 80.0, 130.0, 300.0, 560.0, 790.0, 799.5))  # m from the chief


def unit(a: np.ndarray) -> np.ndarray:
    return a / length(a)


def within(w: RobustTerminalSet, count: int, seed: int, at_call: bool = False) -> torch.Tensor:
    """Returns states (16, count) on the edge of the set: |w| as large as allowed, or at a call, at all distances."""
    rng = np.random.default_rng(seed)
    x = torch.zeros(16, count, dtype=torch.float64)
    places = w.nearest, *EVERYWHERE[w.nearest < EVERYWHERE]
    r = torch.from_numpy(rng.choice(places, count))
    p, off, q = (torch.from_numpy(unit(rng.standard_normal((n, count)))) for n in (3, 3, 4))
    off[:, ::3] = -p[:, ::3]  # towards the chief
    x[P] = r * p
    most = w.calm(r) + (-1e-9 if at_call else w.stray(w.calm(r), r))
    x[V] = w.field(x[P]) + most * off
    x[Q] = q
    return x


@pytest.mark.parametrize(
    ("quantum", "tuning", "limit", "little"),
    [(0.0, TUNINGS[0], "passive safety", 3.0), (0.05, TUNINGS[1], "dynamic speed", 0.04)],
)
def test_every_limit_is_kept_in_the_set(quantum: float, tuning: Tuning, limit: str, little: float) -> None:
    terminal_set = RobustTerminalSet.of(C, PERIOD, replace(U1, thrust_quantum=quantum))
    assert terminal_set.tuning == tuning
    x = within(terminal_set, 4000, 0).numpy()
    least = motion(x[:3], x[3:6], C, spacing=5.0).min(1)
    at_its_edge = least[{"dynamic speed": 1, "passive safety": 3}[limit]]
    assert (least >= 0.0).all() and at_its_edge < little, least


@pytest.mark.parametrize(
    ("bounds", "counted", "stays"),
    [(U1, U1, True), (ROUNDED, ROUNDED, True), (ROUNDED, FINE, False)],
    ids=["U1", "rounded", "rounding forgotten"],
)
def test_nothing_leads_out_of_the_set(bounds: Uncertainty, counted: Uncertainty, stays: bool) -> None:
    """What thrusters round off that give some values only counts in the set: they leave one without it."""
    w = RobustTerminalSet.of(C, PERIOD, counted)
    x = within(w, 50, 1, at_call=True)
    x[P] *= 1 + 1e-9
    x[P] *= (C.max_distance / x[P].norm(dim=0)).clamp(max=1.0)
    least, end, states = flown(x, w, World(50, 2, "worst", "always", bounds), 100.0, None)
    assert not stays or (least >= 0.0).all()
    inside = [
        ((y[V] - w.field(y[P])).norm(dim=0) <= w.calm(r)) & (r >= w.nearest) & (r <= C.max_distance)
        for y in (*states, end)
        for r in [y[P].norm(dim=0)]
    ]
    assert torch.stack(inside).all() == stays


@pytest.mark.parametrize("hold", [1.0, 2.0, 3.0])
def test_thrust_acts_within_its_shares(hold: float) -> None:
    """Of the law's thrust, gains, tilts, a body that turns as fast as it may and an attitude that is seen elsewhere."""
    rng, worst = np.random.default_rng(5), np.zeros(2)
    tilt, gain = np.radians(U1.thrust_misalignment), U1.thrust_gain
    t = np.linspace(0.0, hold, 61)
    for k in range(1500):
        asked = unit(rng.choice((-1.0, 0.2, 1.0), 3) if k % 2 else rng.standard_normal(3))
        axis = unit(rng.standard_normal(3)) if k % 3 else unit(np.cross(asked, rng.standard_normal(3)))
        body = np.diag(1 + gain * rng.choice((-1.0, 1.0), 3))
        for i in range(3):
            aside = unit(np.cross(np.eye(3)[i], axis if k % 5 else rng.standard_normal(3)) + 1e-12)
            body[:, i] = body[i, i] * (np.cos(tilt) * np.eye(3)[i] + np.sin(tilt) * aside)
        seen = np.radians(U1.attitude + U1.rate * (TERMINAL_SET.old + TERMINAL_SET.aim)) * np.sqrt(3.0)
        turned = TERMINAL_SET.turning * (t - TERMINAL_SET.aim)
        force = Rotation.from_rotvec((seen + turned)[:, None] * axis).apply(body @ asked)
        mean = np.trapezoid(force, t, axis=0) / hold / (1 + U1.mass * rng.choice((-1.0, 1.0)))
        along = mean @ asked
        assert TERMINAL_SET.low <= along <= TERMINAL_SET.high
        across = np.linalg.norm(mean - along * asked) / along
        assert across <= TERMINAL_SET.across
        worst = np.maximum(worst, (across / TERMINAL_SET.across, along / TERMINAL_SET.high))
    assert (worst > (0.4, 0.95)).all(), worst  # the bounds are not empty


@pytest.mark.parametrize(
    "bounds",
    [
        replace(U1, velocity=0.2),
        replace(U1, thrust_gain=0.6),
        replace(U1, attitude=60.0),
        replace(U1, latency=10),
        replace(U1, position=150.0),
    ],
)
def test_bounds_that_leave_no_invariant_set_are_refused(bounds: Uncertainty) -> None:
    with pytest.raises(NoCheckError):
        RobustTerminalSet.of(C, PERIOD, bounds)

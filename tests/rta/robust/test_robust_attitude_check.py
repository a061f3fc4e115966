"""The turn to the Sun within bounds, flown in worlds at their corners: exclusion, temperature, battery, rates hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.attitude import rate_in_hill, rotated_by
from inspection.model.dynamics import Body, step, sun_and_earth_in_body
from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, TORQUE, E, Q, T
from inspection.world.uncertainty import Uncertainty
from rta.check.commit import NoCheckError
from rta.robust.attitude_check import followed, hold_bounds, law, wanted
from rta.robust.attitude_constants import heating
from rta.robust.check import RobustCheck
from rta.robust.prediction import predicted
from tests.oracles import attitude, hypercube, moved
from tests.rta.robust.uncertain_world import PERIOD, committed, of_torque

C = InspectionParameters()
U1 = Uncertainty(
    inertia=0.2,
    torque_gain=0.05,
    attitude=0.3,
    rate=0.03,
    latency=1,
    longest_hold=3.0,
    hill_rotation=True,
)
INERTIA = torch.tensor(C.inertia, dtype=torch.float64)[:, None]
SUBSTEP = 0.25  # s
ROUNDED = 1e-9


def backup(uncertainty: Uncertainty = U1) -> RobustCheck:
    return of_torque(C, PERIOD, uncertainty)


def test_a_body_that_has_the_laws_rates_keeps_them() -> None:
    """The law's torque is then the gyroscopic one alone, which is held for 0.1 s."""
    c = replace(C, inertia=(0.02, 0.04, 0.05))
    x, w = hypercube(300, 5, c), replace(backup().attitude, c=c)
    x[OMEGA], none = wanted(x, w), torch.zeros(3, 300, dtype=torch.float64)
    after = moved(x, torch.cat((none, law(x, w))), 0.1, c)
    by_itself = (moved(x, torch.cat((none, none)), 0.1, c) - x)[OMEGA].norm(dim=0)
    assert by_itself.max() > 1e-6  # rad/s
    assert ((after - x)[OMEGA].norm(dim=0) <= 0.01 * by_itself + 1e-9).all()


class World:
    """Simulates spacecraft with errors at the corners of their bounds, and with a gyro relative to the stars.

    The errors are steady in every third episode, change now and then in the next, and resist the law in the last.
    """

    def __init__(self, x: Tensor, uncertainty: Uncertainty, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.x, self.uncertainty = x, uncertainty
        count = x.shape[1]
        self.kind = torch.arange(count) % 3
        moments = INERTIA * (1 + uncertainty.inertia * self.sign(3))
        still = [torch.zeros_like(x[0])] * 3
        self.body = Body(
            torch.full_like(x[0], C.mass), moments.unbind(), still, uncertainty.hill_rotation, False
        )
        self.angle, self.gyro, self.gain = self.sign(3), self.sign(3), self.sign(3)
        self.missed = torch.zeros(count)
        self.held = torch.zeros(6, count, dtype=x.dtype)
        self.seen: Tensor | None = None

    def sign(self, rows: int) -> Tensor:
        """(rows, B) of 1 and -1."""
        return 2.0 * self.chance(rows).lt(0.5).to(self.x.dtype) - 1.0

    def chance(self, rows: int) -> Tensor:
        return torch.rand(rows, self.x.shape[1], generator=self.generator, dtype=self.x.dtype)

    def rates(self) -> Tensor:
        """Returns rates (3, B) of the body relative to Hill's frame."""
        n = C.mean_motion if self.uncertainty.hill_rotation else 0.0
        return torch.stack(rate_in_hill(self.x[Q], self.x[OMEGA], n))

    def measured(self) -> tuple[Tensor, Tensor]:
        """Returns predicted states (16, B), and by how much further they may be off (4, B)."""
        changes = self.chance(6) < torch.tensor([0.0, 0.03, 0.0])[self.kind]
        self.angle = torch.where(changes[:3], self.sign(3), self.angle)
        resists = (self.kind == 2) & (self.chance(1)[0] < 0.9)
        true = self.x.clone()
        true[OMEGA] = self.rates()
        behind = (wanted(true, self.attitude) - true[OMEGA]).sign()
        self.gyro = torch.where(resists, behind, torch.where(changes[3:], self.sign(3), self.gyro))
        seen = true.clone()
        seen[Q] = rotated_by(true[Q], math.radians(self.uncertainty.attitude) * self.angle)
        seen[OMEGA] = true[OMEGA] + math.radians(self.uncertainty.rate) * self.gyro
        none = torch.zeros(4, seen.shape[1], dtype=seen.dtype)
        before, self.seen = self.seen, seen
        if before is None or not self.uncertainty.latency:
            return seen, none
        return predicted(before, none, self.held, C, PERIOD, self.uncertainty)

    attitude = backup().attitude

    def fly(self, u: Tensor, misses: bool = True) -> list[Tensor]:
        """Flies to the next call with answer u (6, B), which may be missed; returns the states on the way."""
        longest = round(self.uncertainty.hold(PERIOD) / PERIOD)
        often = torch.tensor([0.05, 0.5, 0.9])[torch.arange(u.shape[1]) // 3 % 3]
        miss = (self.chance(1)[0] < often) & (self.missed < longest - 1) & misses
        self.missed = torch.where(miss, self.missed + 1, 0)
        self.held = torch.where(miss, self.held, u)
        # the gain that helps least, once more in the last kind
        true = self.x.clone()
        true[OMEGA] = self.rates()
        helps = self.held[TORQUE].sign() * (wanted(true, self.attitude) - true[OMEGA]).sign()
        self.gain = torch.where(self.kind == 2, -helps, self.gain)
        acts = self.held.clone()
        acts[TORQUE] *= 1 + self.uncertainty.torque_gain * self.gain
        path = []
        for _ in range(round(PERIOD / SUBSTEP)):
            self.x = moved(self.x, acts, SUBSTEP, C, self.body)
            path.append(self.x)
        return path


def starts(found: RobustCheck, count: int, seed: int) -> Tensor:
    """Returns states (16, count) with a verified backup trajectory, every other one as hot or empty as is accepted."""
    x = hypercube(6 * count, seed, C)
    x = x[:, found.has_backup_trajectory(x) & torch.from_numpy((attitude(x.numpy(), C) >= 0.0).all(0))][
        :, :count
    ]
    assert x.shape[1] == count
    for row, bad, which in ((T, C.max_temperature, 0), (E, C.min_energy, 1)):
        columns = torch.arange(count) % 4 == which
        y = x[:, columns]
        good, low, high = y[row].clone(), torch.zeros_like(y[0]), torch.ones_like(y[0])
        for _ in range(16):
            share = (low + high) / 2
            y[row] = good + share * (bad - good)
            fine = found.has_backup_trajectory(y)
            low, high = torch.where(fine, share, low), torch.where(fine, high, share)
        y[row] = good + low * (bad - good)
        x[:, columns] = y
    return x


def at_law(found: RobustCheck, x: Tensor) -> Tensor:
    return torch.cat((torch.zeros_like(x[:3]), law(x, found.attitude)))


@pytest.mark.parametrize(("latency", "held"), [(1, 1), (2, 1), (2, 2), (3, 1), (3, 2)])
def test_what_the_law_first_answers_is_off_by_no_more_than_is_counted(latency: int, held: int) -> None:
    """Torque from before the hold counts, too, where the answered state was measured before the hold began."""
    bounds = Uncertainty(torque_gain=0.05, latency=latency, longest_hold=float(held))
    w, count, none = backup(bounds).attitude, 64, torch.zeros(4, 64, dtype=torch.float64)
    sent = torch.zeros(latency + held, 6, count, dtype=torch.float64)
    draws = torch.rand(latency + 1, 3, count, generator=torch.Generator().manual_seed(latency))
    sent[: latency + 1, TORQUE] = C.max_torque * draws.double().round()
    sent[latency, :, count // 2 :] = 0.0  # no torque in the hold
    sent[latency:] = sent[latency]
    true = [hypercube(count, 3, C)]
    true[0][OMEGA] *= 0.1
    for u in sent:  # at the corner of the gains
        true.append(step(true[-1], 1.05 * u, PERIOD, replace(C, saturate_rates=False)))

    def taken_for(x: Tensor, controls: Tensor) -> tuple[Tensor, Tensor]:
        bound = none
        for u in controls:
            x, bound = predicted(x, bound, u, C, PERIOD, bounds)
        return x, bound

    x, error_bound = taken_for(true[0], sent[:latency])
    _, start = hold_bounds(x, sent[latency], error_bound, w)
    seen, _ = taken_for(true[held], sent[held:])
    rate, angle = w.measured(start.command, w.worst)
    late, late_angle = start.late
    off = (seen - true[-1])[OMEGA].abs().amax(0)
    turned = 2 * (seen[Q] * true[-1][Q]).sum(0).abs().clamp(max=1.0).arccos()
    assert (off <= rate + late + ROUNDED).all()
    assert (turned <= math.sqrt(3) * angle + late_angle + 1e-7).all()
    own = w.share * start.command * w.lag  # rate error from the torque of the hold
    assert (off > own + ROUNDED).any() == (held < latency)
    counted, without = (
        torch.stack(followed(each, w).errors) for each in (start, start._replace(late=0 * start.late))
    )
    assert (counted > without).any() == (latency > 1)  # a hold may end at its first call


@pytest.mark.parametrize("uncertainty", [U1, Uncertainty(attitude=0.1, rate=0.01)], ids=["U1", "sensors"])
def test_the_law_keeps_the_limits_from_the_edge_whatever_is_measured(uncertainty: Uncertainty) -> None:
    found = backup(uncertainty)
    assert found.attitude
    world = World(starts(found, 120, 1), uncertainty, 2)
    for k in range(200):
        for x in world.fly(at_law(found, world.measured()[0]), misses=k > 0):
            least = attitude(x.numpy(), C)
            assert (least >= -ROUNDED).all(), (k, np.argwhere(least < -ROUNDED)[:3], least.min(1))
    sun, _ = sun_and_earth_in_body(world.x)
    assert (-sun[0]).min() > math.cos(2.0 * found.attitude.angle + 0.1)  # the panels are at the Sun


def test_any_torque_is_asked_for_and_no_limit_breaks() -> None:
    found = backup()
    world = World(starts(found, 90, 3), U1, 4)
    limit, acted = C.max_torque * torch.linspace(0.02, 1.0, 90, dtype=torch.float64), 0
    torque = torch.zeros(3, 90, dtype=torch.float64)
    for k in range(10):
        if k % 5 == 0:
            torque = limit * world.sign(3)
        x, bound = world.measured()
        # towards the limit of the rates, or the camera to the Sun
        away = (x[OMEGA] - wanted(x, found.attitude)).sign() * limit
        asked = torch.where(torch.arange(90) % 2 == 0, torque, away)
        u, verified, changed = committed(found, 1, x, torch.cat((torch.zeros_like(asked), asked)), bound)
        acted += int(changed.sum())
        assert not (~verified & ~changed).any()
        for x in world.fly(u, misses=k > 0):
            least = attitude(x.numpy(), C)
            assert (least >= -ROUNDED).all(), (k, np.argwhere(least < -ROUNDED)[:3], least.min(1))
    assert 81 < acted < 873  # of 900


@pytest.mark.parametrize("slope", [0.05, 0.16, 0.3])
def test_the_limit_of_heat_is_least_in_the_end_but_for_light_of_a_dim_sun(slope: float) -> None:
    """At most as much as the surface is warmer where the panels have come to, with light from `dim`."""
    w = backup().attitude
    w = replace(w, c=replace(C, temperature_sun_slope=slope))
    angle = torch.linspace(math.pi / 2, 0.0, 20_001, dtype=torch.float64)
    pace = (w.kappa * angle.sin()).clamp(max=w.rate)
    light = (angle.sin() / pace)[:-1] * (angle[0] - angle[1])
    warmer = torch.cat((angle[:1] * 0.0, (heating(w.c)[0] * light).cumsum(0)))
    assert (warmer + slope * angle <= warmer[-1] + slope * w.dim + 1e-4).all()


BEYOND = {
    "missed calls": (replace(U1, longest_hold=0.0), replace(U1, longest_hold=6.0)),
    "errors of rates": (replace(U1, rate=0.0), replace(U1, rate=0.5)),
    "inertia": (replace(U1, inertia=0.0, torque_gain=0.0), replace(U1, inertia=0.5)),
}


@pytest.mark.parametrize("what", BEYOND)
def test_a_limit_breaks_beyond_the_bounds_of_the_check(what: str) -> None:
    bounds, true = BEYOND[what]
    found = backup(bounds)
    world = World(starts(found, 90, 1), true, 2)
    least = np.inf
    for k in range(90):
        for x in world.fly(at_law(found, world.measured()[0]), misses=k > 0):
            least = min(least, attitude(x.numpy(), C).min())
    assert least < -0.01


def test_bounds_without_a_rest_have_no_check() -> None:
    for c, wide, reason in (
        (C, {"rate": 0.5}, ""),
        (C, {"attitude": 20.0}, ""),
        (C, {"torque_gain": 0.9}, ""),
        (replace(C, solar_panel_axis="+x"), {}, "no attitude of rest"),
        (replace(C, hill_rotation=True), {}, "turning of Hill's frame"),
    ):
        with pytest.raises(NoCheckError, match=reason):
            of_torque(c, PERIOD, replace(U1, **wide))

"""The turn to the Sun flown: exclusion, temperature, battery and rates hold, and it ends where the battery charges."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.parameters import InspectionParameters
from inspection.model.state import OMEGA, E, T
from rta.backup import slew
from rta.backup.check import Backup
from rta.parameters import PERIODS
from study.config import load
from tests.rta.backup.brute_force import attitude, flown, hypercube, moved
from tests.rta.constraints.test_constraints import body_axis

PAPER = InspectionParameters()
VEHICLES = {
    "paper": PAPER,
    **{
        path.stem: load(path).inspection
        for path in sorted((Path(__file__).parents[3] / "configs/vehicles").glob("*.toml"))
    },
}
ROUNDED = 1e-9
RATES = 3  # row of what is left of them


def by_the_law(w: slew.Slewing) -> Callable[[Tensor], Tensor]:
    """The law, without thrust."""
    return lambda x: torch.cat((torch.zeros_like(x[:3]), slew.slew(x, w)))


def near_the_limits(count: int, seed: int, c: InspectionParameters) -> Tensor:
    """States of which half are next to the limits of heat and charge, and all turn fast."""
    x, generator = hypercube(count, seed, c), torch.Generator().manual_seed(seed)
    draw = torch.rand(2, count, generator=generator, dtype=torch.float64)
    half = torch.arange(count) % 2 == 0
    x[T, half] = (c.max_temperature - 2.0 * draw[0])[half]
    x[E, half] = (c.min_energy + 1.2 * draw[1] * (c.initial_energy[0] - c.min_energy))[half]
    return x


CASES = [("paper", hold) for hold in PERIODS] + [("3u", 1.0), ("12u", 10.0), ("espa", 5.0)]


def test_a_body_that_has_the_laws_rates_keeps_them() -> None:
    """The law's torque is then the gyroscopic one alone, which is held for 0.1 s."""
    c = VEHICLES["12u"]  # whose moments of inertia are not equal
    w, x = Backup(c, 1.0).slewing, hypercube(300, 5, c)
    x[OMEGA] = slew.wanted(x, w)
    after = moved(x, by_the_law(w)(x), 0.1, c)
    alone = moved(x, torch.zeros(6, 300, dtype=torch.float64), 0.1, c)
    by_itself = (alone - x)[OMEGA].norm(dim=0)
    assert by_itself.max() > 1e-5  # rad/s
    assert ((after - x)[OMEGA].norm(dim=0) <= 0.01 * by_itself + 1e-9).all()


@pytest.mark.parametrize(("vehicle", "hold"), CASES)
def test_what_is_verified_keeps_every_limit_and_ends_at_the_sun(vehicle: str, hold: float) -> None:
    c = VEHICLES[vehicle]
    w = Backup(c, hold).slewing
    assert Backup.is_there(c)
    x = near_the_limits(1000, 2, c)
    told = slew.way(x, w)
    accepted = told >= 0
    assert 0.4 < accepted.double().mean() < 0.98
    closest = told.masked_fill(~accepted, np.inf).argsort()[:120]
    path = flown(x[:, closest], by_the_law(w), c, hold, 200.0, 0.25)
    for i, y in enumerate(path):
        least = attitude(y, c)
        assert (least >= -ROUNDED).all(), (i * 0.25, np.argwhere(least < 0)[:3], least.min(1))
    last, before = path[-1], path[-41]
    sun = np.stack((np.cos(last[15]), np.sin(last[15]), np.zeros_like(last[15])))
    panels = -body_axis(last[6:10], 0)
    assert (panels * sun).sum(0).min() > np.cos(0.03)
    assert (last[13] < before[13]).all() and (last[14] > before[14]).all()


@pytest.mark.parametrize("hold", PERIODS)
@pytest.mark.parametrize("look", ["at_first_sight", "at_a_glance", "verified"])
def test_no_look_accepts_a_control_that_a_flight_shows_to_be_unsafe(look: str, hold: float) -> None:
    w = Backup(PAPER, hold).slewing
    x, generator = near_the_limits(3000, 4, PAPER), torch.Generator().manual_seed(1)
    towards = PAPER.max_rate * (2 * torch.rand(3, 3000, generator=generator, dtype=torch.float64) - 1)
    inertia = torch.tensor(PAPER.inertia, dtype=torch.float64)[:, None]
    torque = (inertia * (towards - x[OMEGA]) / hold).clamp(-PAPER.max_torque, PAPER.max_torque)
    u = torch.cat((torch.zeros_like(torque), torque))
    told = getattr(slew, look)(x, u, w)
    accepted = torch.nonzero(told >= 0).flatten()
    assert accepted.numel() > 40
    closest = accepted[told[accepted].argsort()[:100]]
    law, first = by_the_law(w), [u[:, closest]]
    path = flown(x[:, closest], lambda y: first.pop() if first else law(y), PAPER, hold, 100.0, 0.25)
    for i, y in enumerate(path):
        least = attitude(y, PAPER)
        assert (least >= -ROUNDED).all(), (i * 0.25, np.argwhere(least < 0)[:3], least.min(1))


@pytest.mark.parametrize("hold", PERIODS)
def test_a_hold_is_never_below_what_is_told(hold: float) -> None:
    c = replace(PAPER, saturate_rates=False)
    w = Backup(c, hold).slewing
    x, generator = near_the_limits(600, 6, c), torch.Generator().manual_seed(2)
    towards = 1.1 * c.max_rate * (2 * torch.rand(3, 600, generator=generator, dtype=torch.float64) - 1)
    inertia = torch.tensor(c.inertia, dtype=torch.float64)[:, None]
    torque = (inertia * (towards - x[OMEGA]) / hold).clamp(-c.max_torque, c.max_torque)
    u = torch.cat((torch.zeros_like(torque), torque))
    told, _ = slew.held(x, u, w)
    least = attitude(x.numpy(), c)
    for _ in range(round(hold / 0.05)):
        x = moved(x, u, 0.05, c)
        least = np.minimum(least, attitude(x.numpy(), c))
    bound, lowest = told.numpy(), least[:RATES].min(0)
    assert (bound <= lowest + ROUNDED).all(), (bound - lowest).max()
    assert (least[RATES][bound >= 0] >= -ROUNDED).all()  # from a start within the rates
    assert (least[RATES] < 0).mean() > 0.05 and (bound >= 0).mean() > 0.1
    tightest = (lowest < least[RATES]) & (least[RATES] > 0)  # the bound is not of the rates
    assert np.median((lowest - bound)[tightest]) < (0.1 if hold < 5 else 0.3)


def test_a_vehicle_without_an_attitude_of_rest_has_none() -> None:
    assert slew.has_rest(PAPER)
    assert not slew.has_rest(replace(PAPER, solar_panel_axis="+x"))
    assert not slew.has_rest(replace(PAPER, thermal_axis="-x"))

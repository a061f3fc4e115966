"""The law of torque: the camera recedes from the Sun, rates stay within their limits, and the rest is a cool one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from inspection.model.state import OMEGA, THETA_S, E, Q, T
from rta.backup.attitude_law import has_rest, slew, wanted
from rta.backup.nominal_check import NominalBackup
from rta.parameters import PERIODS
from tests.oracles import body_axis, moved
from tests.rta.backup.flights import (
    C,
    anywhere,
    backup,
    in_c,
    least_of,
    torque_alone,
    vehicle,
)

pytestmark = pytest.mark.usefixtures("long_flights")

CASES = [
    *(("paper", hold) for hold in PERIODS),
    ("3u", 1.0),
    ("6u", 5.0),
    ("12u", 10.0),
    ("espa", 5.0),
    ("espa", 10.0),
]
EACH = pytest.mark.parametrize(
    ("name", "hold"),
    [case if case == ("espa", 10.0) else pytest.param(*case, marks=pytest.mark.campaign) for case in CASES],
)


def to_the_sun(x: Tensor, axis: int, sign: float) -> np.ndarray:
    """The angle in rad between a body axis and the Sun."""
    y = x.numpy()
    sun = np.stack((np.cos(y[15]), np.sin(y[15]), np.zeros_like(y[15])))
    return np.arccos(np.clip(sign * (body_axis(y[6:10], axis) * sun).sum(0), -1, 1))


def test_a_body_that_has_the_laws_rates_keeps_them() -> None:
    """The law's torque is then the gyroscopic one alone, which is held for 0.1 s."""
    c, w = vehicle("12u"), backup("12u", 1.0).pointing  # whose moments of inertia are not equal
    x = anywhere(300, 5, c)
    x[OMEGA] = wanted(x, w)
    after = moved(x, torque_alone(slew(x, w)), 0.1, c)
    alone = moved(x, torque_alone(torch.zeros_like(x[:3])), 0.1, c)
    by_itself = (alone - x)[OMEGA].norm(dim=0)
    assert by_itself.max() > 1e-5  # rad/s
    assert ((after - x)[OMEGA].norm(dim=0) <= 0.01 * by_itself + 1e-9).all()


@EACH
def test_the_camera_recedes_from_the_sun_once_the_body_has_the_laws_rates(name: str, hold: float) -> None:
    c, flight, w = vehicle(name), in_c(name, hold), backup(name, hold).pointing
    x = anywhere(1000, 7, c)
    x[OMEGA] = wanted(x, w)
    x = x[:, to_the_sun(x, 0, 1.0) > 0.02]
    camera = to_the_sun(x, 0, 1.0)
    for _ in range(math.ceil(backup(name, hold).early_accept.arrives / hold)):
        x = flight(x)[0]
        after = to_the_sun(x, 0, 1.0)
        far = camera > math.pi / 2 + 0.1  # where it rolls, too
        assert ((after >= camera - 2e-4) | far).all(), (camera - after)[~far].max()
        assert (after[far] > math.pi / 2).all()
        camera = after
    assert (camera > math.pi - 0.05).all()


@EACH
def test_rates_stay_within_their_limits_where_nothing_holds_them(name: str, hold: float) -> None:
    """From the law's rates on; with full torque they would not."""
    c, flight, w = vehicle(name, False), in_c(name, hold, False), backup(name, hold, False).pointing
    x = anywhere(1000, 8, c)
    x[OMEGA] = wanted(x, w)
    assert (x[OMEGA].abs() <= c.max_rate).all() and x[OMEGA].norm(dim=0).max() <= w.fastest + 1e-12
    fastest = 0.0
    for _ in range(math.ceil(backup(name, hold).early_accept.arrives / hold)):
        x, least, u, *_ = flight(x)
        assert (u[3:].abs() <= c.max_torque).all()
        assert (least[10] >= 0.0).all(), least[10].min()
        fastest = max(fastest, x[OMEGA].abs().max().item())
    assert 0.3 * w.rate < fastest <= c.max_rate


@EACH
def test_at_rest_the_panels_face_the_sun_and_the_surface_is_in_the_dark(name: str, hold: float) -> None:
    c, flight = vehicle(name), in_c(name, hold)
    x = anywhere(400, 9, c)
    start = x.clone()
    for _ in range(math.ceil(backup(name, hold).early_accept.arrives / hold)):
        x, before = flight(x)[0], x
    axis, sign = "xyz".index(c.thermal_axis[1]), -1.0 if c.thermal_axis[0] == "-" else 1.0
    assert to_the_sun(x, 0, -1.0).max() < 0.03
    surface = body_axis(x[Q].numpy(), axis) * sign
    assert np.abs(np.abs(surface[2]) - 1.0).max() < 0.03  # along z or against it
    assert (surface[2] > 0.0).any() and (surface[2] < 0.0).any()
    assert (x[E] > before[E]).all() and (x[T] <= torch.maximum(before[T], start[T])).all()
    assert (least_of(x, c)[[7, 10]] > 0.0).all()


@pytest.mark.parametrize(
    "hold", [*(pytest.param(hold, marks=pytest.mark.campaign) for hold in (1.0, 5.0)), 10.0]
)
def test_the_body_rolls_to_the_nearer_of_both_sides(hold: float) -> None:
    """With the panels at the Sun the surface's axis goes to where it is nearer, and is there when it says."""
    flight, w = in_c("paper", hold), backup("paper", hold).pointing
    angle = torch.linspace(-math.pi, math.pi, 400, dtype=torch.float64)
    x = anywhere(400, 11)
    x[THETA_S], x[OMEGA] = 0.0, 0.0
    # d = -x of the body at the Sun, Hill's x: half a turn about z, then a roll
    x[Q] = torch.stack(
        (torch.zeros_like(angle), (angle / 2).sin(), (angle / 2).cos(), torch.zeros_like(angle))
    )
    assert to_the_sun(x, 0, -1.0).max() < 1e-7
    at_first = body_axis(x[Q].numpy(), 1)[2]
    for _ in range(math.ceil((math.pi / 2 / w.roll + 6 / w.kappa + 4 * hold) / hold)):
        x = flight(x)[0]
    at_last = body_axis(x[Q].numpy(), 1)[2]
    clear = np.abs(at_first) > 0.02
    assert (np.sign(at_last) == np.sign(at_first))[clear].all()
    assert (np.abs(at_last) > 0.999)[clear].all()


def test_a_vehicle_without_an_attitude_of_rest_has_none() -> None:
    assert has_rest(C)
    for other in (replace(C, solar_panel_axis="+x"), replace(C, thermal_axis="-x")):
        assert not has_rest(other) and NominalBackup.of(other, 1.0) is None

"""The law of torque: the camera recedes from the Sun, rates stay within their limits, and the rest is a cool one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from inspection.model.state import OMEGA, THETA_S, TORQUE, E, Q, T
from rta.check.attitude_law import slew, wanted
from rta.check.nominal import NominalCheck
from tests.oracles import body_axis, moved
from tests.rta.check.flights import (
    EACH,
    C,
    anywhere,
    backup,
    in_c,
    least_of,
    vehicle,
)

# Moments in kg m^2, rad/s^2, deg/s, s. Their law turns a rate from one limit to the other in a hold or two.
UNEQUAL = [
    ((0.0158, 0.0269, 0.0224), 0.2, 4.0, 1.0),
    ((0.195, 0.1046, 0.2055), 0.4, 4.0, 1.0),
    ((0.1793, 0.1505, 0.1613), 0.2, 2.0, 5.0),
    ((0.0158, 0.0269, 0.0224), 0.02, 2.0, 10.0),
]


def spun(omega: np.ndarray, torque: np.ndarray, hold: float, moments: np.ndarray) -> tuple[np.ndarray, float]:
    """Integrates J omega' = torque - omega x J omega over a hold; returns the rates (3, B) and the fastest one."""

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        w = y.reshape(3, -1)
        return ((torque - np.cross(w, moments * w, axis=0)) / moments).ravel()

    found = solve_ivp(
        slope, (0.0, hold), omega.ravel(), "DOP853", np.linspace(0.0, hold, 21), rtol=1e-10, atol=1e-12
    )
    return found.y[:, -1].reshape(3, -1), np.abs(found.y).max()


def to_the_sun(x: Tensor, axis: int, sign: float) -> np.ndarray:
    """Returns the angle in rad between a body axis and the Sun."""
    y = x.numpy()
    sun = np.stack((np.cos(y[15]), np.sin(y[15]), np.zeros_like(y[15])))
    return np.arccos(np.clip(sign * (body_axis(y[6:10], axis) * sun).sum(0), -1, 1))


@pytest.mark.parametrize(("inertia", "alpha", "rate", "hold"), UNEQUAL)
def test_no_hold_of_the_law_exceeds_the_rates_however_unequal_the_moments(
    inertia: tuple[float, float, float], alpha: float, rate: float, hold: float
) -> None:
    """From rates that early accept lets begin, at its border; by another integrator, and by the bounds of a hold."""
    limits = {
        "max_angular_acceleration": alpha,
        "max_wheel_acceleration": 1e6,
        "max_rate": math.radians(rate),
    }
    c = replace(C, inertia=inertia, saturate_rates=False, **limits)
    b = NominalCheck(c, hold)
    x = anywhere(1000, 7, c)
    signs = torch.randint(-1, 2, (3, 1000), generator=torch.Generator().manual_seed(1)).double()
    x[OMEGA] = (c.max_rate - b.pointing.overshoot) * signs
    for _ in range(3):
        u = torch.cat((torch.zeros_like(x[OMEGA]), slew(x, b.pointing)))
        end, least = b.hold(x, u, torch.zeros_like(x[0], dtype=torch.bool))
        assert least[-1].min() >= 0.0
        omega, fastest = spun(x[OMEGA].numpy(), u[TORQUE].numpy(), hold, np.array(inertia)[:, None])
        assert fastest <= c.max_rate
        np.testing.assert_allclose(end[OMEGA].numpy(), omega, rtol=0, atol=1e-4 * c.max_rate)
        x = end


def test_a_body_that_has_the_laws_rates_keeps_them() -> None:
    """The law's torque is then the gyroscopic one alone, which is held for 0.1 s."""
    c, w = vehicle("12u"), backup("12u", 1.0).pointing  # whose moments of inertia are not equal
    x = anywhere(300, 5, c)
    x[OMEGA] = wanted(x, w)
    none = torch.zeros_like(x[OMEGA])
    after, alone = (moved(x, torch.cat((none, torque)), 0.1, c) for torque in (slew(x, w), none))
    by_itself = (alone - x)[OMEGA].norm(dim=0)
    assert by_itself.max() > 1e-5  # rad/s
    assert ((after - x)[OMEGA].norm(dim=0) <= 0.01 * by_itself + 1e-9).all()


@EACH
def test_a_body_with_the_laws_rates_turns_its_camera_away_and_its_panels_to_the_sun(
    name: str, hold: float, saturates: bool
) -> None:
    """Where nothing holds the rates; with full torque they would not stay within their limits."""
    c, flight, b = vehicle(name, False), in_c(name, hold, False), backup(name, hold, False)
    w, x = b.pointing, anywhere(1000, 7, c)
    x[OMEGA] = wanted(x, w)
    assert (x[OMEGA].abs() <= c.max_rate).all() and x[OMEGA].norm(dim=0).max() <= w.fastest + 1e-12
    x = x[:, to_the_sun(x, 0, 1.0) > 0.02]
    camera, fastest, start = to_the_sun(x, 0, 1.0), 0.0, x
    for _ in range(math.ceil(b.early_accept.arrives / hold)):
        before = x
        x, least, u, *_ = flight(x)
        assert (u[TORQUE].abs() <= c.max_torque).all() and (least[10] >= 0.0).all()
        fastest = max(fastest, x[OMEGA].abs().max().item())
        after, far = to_the_sun(x, 0, 1.0), camera > math.pi / 2 + 0.1  # where it rolls, too
        assert ((after >= camera - 2e-4) | far).all(), (camera - after)[~far].max()
        assert (after[far] > math.pi / 2).all()
        camera = after
    assert 0.3 * w.rate < fastest <= c.max_rate
    assert (camera > math.pi - 0.03).all()
    surface = body_axis(x[Q].numpy(), "xyz".index(c.thermal_axis[1]))
    assert np.abs(np.abs(surface[2]) - 1.0).max() < 0.03  # along z or against it
    assert (surface[2] > 0.0).any() and (surface[2] < 0.0).any()
    assert (x[E] > before[E]).all() and (x[T] <= torch.maximum(before[T], start[T])).all()
    assert (least_of(x, c)[[7, 10]] > 0.0).all()


def test_the_body_rolls_to_the_nearer_of_both_sides() -> None:
    """With the panels at the Sun the surface's axis goes to where it is nearer, and is there when it says."""
    hold = 10.0
    flight, w = in_c("paper", hold), backup("paper", hold).pointing
    angle = torch.linspace(-math.pi, math.pi, 400, dtype=torch.float64)
    x = anywhere(400, 11)
    x[THETA_S], x[OMEGA] = 0.0, 0.0
    # d = -x of the body at the Sun, Hill's x: half a turn about z, then a roll
    none = torch.zeros_like(angle)
    x[Q] = torch.stack((none, (angle / 2).sin(), (angle / 2).cos(), none))
    assert to_the_sun(x, 0, -1.0).max() < 1e-7
    at_first = body_axis(x[Q].numpy(), 1)[2]
    for _ in range(math.ceil((math.pi / 2 / w.roll + 6 / w.kappa + 4 * hold) / hold)):
        x = flight(x)[0]
    at_last = body_axis(x[Q].numpy(), 1)[2]
    clear = np.abs(at_first) > 0.02
    assert (np.sign(at_last) == np.sign(at_first))[clear].all()
    assert (np.abs(at_last) > 0.999)[clear].all()

"""Checks which states a spacecraft can be in, and warns of states that are probably in other units or another order."""

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import Limits
from inspection.model.state import E, Q, T

LARGEST = 1e6  # largest number in a state, in its unit
OFF_UNIT = 1e-4  # how far a quaternion's length may be from 1, as for an estimate in float32
HOT = 150.0  # deg C above the limit: a surface within its limit, given in K, is 273 too warm
RICH = 200.0  # times the largest initial energy: J in place of kJ are a factor of 1000


def is_state(x: Tensor, c: Limits) -> Tensor:
    """Checks which states (16, B) a spacecraft can be in, (B,) bool.

    All numbers are finite and at most LARGEST in size, the quaternion has unit length, and T is above absolute zero.
    """
    room = torch.stack((OFF_UNIT - (norm(x[Q]) - 1.0).abs(), x[T] + c.zero_celsius))
    return (x.abs() <= LARGEST).all(0) & (room > 0.0).all(0)


def unit_warnings(x: Tensor, c: Limits) -> list[str]:
    """Returns a phrase for each likely mistake in finite states (16, B)."""
    most, least_energy = x.amax(1).tolist(), x[E].amin().item()
    hot, rich, found = c.max_temperature + HOT, RICH * c.initial_energy[1], []
    if most[T] > hot:
        found.append(f"temperature above {hot:g} deg C: is it in K? It must be in deg C")
    if most[E] > rich:
        found.append(f"energy above {rich:g} kJ: is it in J? It must be in kJ")
    if least_energy < 0.0:
        found.append("energy below zero, which no battery holds")
    if most[Q.start] == 1.0:
        found.append("quaternion [1, 0, 0, 0], half a turn about x: is its scalar first? It must be last")
    return found

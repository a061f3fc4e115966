"""Tells which states a spacecraft can be in, and warns of those that are probably in other units or another order."""

import torch
from torch import Tensor

from inspection.model.attitude import norm
from inspection.model.parameters import Limits
from inspection.model.state import E, Q, T

LARGEST = 1e6  # of any number in a state, in its unit
OFF_UNIT = 1e-4  # by which a quaternion's length may be off 1, as that of an estimate in float32 may
HOT = 150.0  # deg C above the limit: less than what 273 K make of a surface that keeps it
RICH = 200.0  # times what a battery begins with at most; J in place of kJ are a thousand times as many


def is_state(x: Tensor, c: Limits) -> Tensor:
    """Tells which states (16, B) a spacecraft can be in, (B,) bool.

    Numbers are finite, at most LARGEST in size, the quaternion is of unit length, and T above absolute zero.
    """
    return (x.abs() <= LARGEST).all(0) & (state_room(x, c) > 0.0).all(0)


def state_room(x: Tensor, c: Limits) -> Tensor:
    """Returns (2, B), positive where q is of unit length, and T in deg C above absolute zero."""
    return torch.stack((OFF_UNIT - (norm(x[Q]) - 1.0).abs(), x[T] + c.zero_celsius))


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

"""What the filter does for a spacecraft of which a thruster is known to be dead or weak: it turns it in time.

In every attitude the axes together give at least as much as one of them along any direction, and the keep-in zone
counts on that. With a dead axis on the radius there is nothing, and no thrust row can hold the zone. So near its edge
the torque that is asked for gives way to one that turns the dead axis across the radius.
"""

import math
from itertools import accumulate, product

import torch
from torch import Tensor

from inspection.model.attitude import conjugate, cross, norm, rotate, unit
from inspection.model.dynamics import sun_and_earth_in_body
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, THRUST, TORQUE, P, Q, V
from rta.bounds.uncertainty import Uncertainty
from rta.parameters import RtaParameters

STEP = math.radians(7.5)  # between the turns that are compared
AXES, TURNS = 26, 24  # of the turns; angles about each of them, up to half a turn
NEAR = math.sin(STEP)  # of the radius, along axes that give nothing, which is left as it is


def slewing(
    x: Tensor, torque: Tensor, left: Tensor, c: Limits, r: RtaParameters, uncertainty: Uncertainty
) -> Tensor:
    """The torque (3, B) in N m to be filtered in the place of that which is asked for.

    Thrust of the healthy axes is across the radius as far as a dead one is along it. So the body turns, as fast as its
    rates allow, until that is little, and stays there where a hold could change it. It does so only where it would
    leave the zone by coasting for as long as the farthest such turn takes, a right angle, and braking from then on:
    with the outward speed w after t of the strongest natural acceleration g, where

        |p| + v_r t + g t^2 / 2 + w^2 / (2 a_max) > r_max,    w = v_r + g t > 0.

    Args:
        x: states (16, B); torque: (3, B) as asked for, in N m.
        left: (6, B) the share that each actuator gives.
    """
    limit, hold = c.max_rate - uncertainty.rate_offset(c), uncertainty.hold(r)
    inertia = x.new_tensor(c.inertia)[:, None]
    torques = uncertainty.torque[0] * left[TORQUE].amin(0) * c.max_torque
    t = math.pi / 2 / limit + max(c.inertia) * limit / torques + hold
    natural = c.max_thrust / c.mass - c.max_acceleration
    distance = norm(x[P])
    radial = (x[P] * x[V]).sum(0) / distance
    later = radial + natural * t
    reached = distance + radial * t + natural * t**2 / 2 + later**2 / (2 * uncertainty.max_acceleration(c, r))

    outwards = rotate(conjugate(x[Q]), x[P]) / distance  # in the body's frame
    weakness = (
        left[THRUST].amax(0) - left[THRUST]
    )  # against the strongest axis, which can be turned onto the radius
    misalignment = norm(weakness * outwards)
    turned = math.sqrt(3.0) * limit * hold  # rad, in a hold at most
    weak = (misalignment > NEAR - turned) & (weakness.amax(0) > 0.0) & (torques > 0.0)
    needed = weak & (later > 0.0) & (reached > c.max_distance)
    sun, _ = sun_and_earth_in_body(x)
    axis, angle = soonest(outwards, sun, weakness, c)
    rate = axis * (limit / axis.abs().amax(0)).minimum(angle / hold)
    wanted = inertia * (rate * (misalignment > NEAR) - x[OMEGA]) / hold
    return torch.where(needed, (wanted / left[TORQUE]).clamp(-c.max_torque, c.max_torque), torque)


def soonest(outwards: Tensor, sun: Tensor, weakness: Tensor, c: Limits) -> tuple[Tensor, Tensor]:
    """The turn after which healthy axes are along the radius soonest, past the Sun where possible.

    Args:
        outwards, sun: (3, B) directions in the body's frame; weakness: (3, B) the share that each axis lacks to the
            strongest.

    Returns:
        The axis (3, B) of the turn, of length one, and its angle (B,) in rad.
    """
    whole = [axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)]
    axes = unit(sun.new_tensor(whole).T)  # (3, AXES)
    angles = sun.new_tensor([i * STEP for i in range(1, TURNS + 1)])

    def costs(about: Tensor) -> Tensor:
        """Of turns about axes (3, k, 1 or B) by all angles: (k, TURNS, B)."""
        n, cosine, sine = about[:, :, None], angles[:, None].cos(), angles[:, None].sin()

        def seen(a: Tensor) -> Tensor:
            """Directions (3, B) in the frame of a body that was turned: (3, k, TURNS, B)."""
            a = a[:, None, None]
            across = torch.stack(cross(*torch.broadcast_tensors(n, a)))
            return a * cosine - across * sine + (n * a).sum(0) * n * (1.0 - cosine)

        misalignment = norm(weakness[:, None, None] * seen(outwards))
        dark = seen(sun)[0] <= math.cos(c.field_of_view / 2 + c.exclusion_buffer)
        clear = torch.stack(list(accumulate(dark.unbind(1), torch.logical_and)), 1)  # so far
        time = angles[:, None] * n.abs().amax(0)  # each axis turns at the limit at most
        too_far = (misalignment - NEAR).clamp(min=0.0) / NEAR
        return time + (STEP * TURNS + 1.0) * (too_far + torch.where(clear, 0.0, 1.0 / NEAR))

    best = axes[:, costs(axes[:, :, None]).amin(1).argmin(0)]
    return best, angles[costs(best[:, None])[0].argmin(0)]

"""Checks thrust with error bounds: from every state within them, while it is held, and on the backup trajectory.

A backup trajectory (`rta.robust.error_tube`) has to begin at every call that may end the hold
(docs/reference/proof_with_bounds.md, *Motion*).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from columns import call, when
from inspection.model.attitude import norm, rotate
from inspection.model.state import SIZE, THRUST, P, Q, V
from rta.check.intersample_bounds import lowest, strays
from rta.robust.error_tube import Node, between, trajectory_margin
from rta.robust.prediction import predicted
from rta.robust.terminal_set import RobustTerminalSet

FAR = 1e6  # m, beyond every distance: of a hold nothing is assumed of where it leads


def has_backup_trajectory(x: Tensor, w: RobustTerminalSet) -> Tensor:
    """(B,) bool: from true states (16, B) the law keeps the limits of motion, whatever is measured."""
    none = torch.zeros_like(x[0])
    return trajectory_margin(x[P], x[V], none, none, none, w) >= 0.0


def keeps_motion(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> list[Tensor]:
    """(B,) bool: thrust of controls (6, B) keeps the limits, as the backup trajectory does; see `hold_bounds`.

    Args:
        y: states (16, B) as predicted, and by how much further than measured they may be off, (4, B).
    """
    no = torch.zeros_like(y[0], dtype=torch.bool)
    kept, state, late = call(hold_at_a_glance, y, u, w, period)
    (seen,) = when(kept, has_trajectory, [no], state, late, w, waits=True)
    (closer,) = when(kept & ~seen, closely, [no], y, u, w, period, waits=True)
    return [seen | closer]


def hold_at_a_glance(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> list[Tensor]:
    """(B,) bool: a hold keeps the limits; a state with bounds (20, B), and how late (B,), for all its ends."""
    hold = hold_bounds(y, u, w, period)
    middle = hold.x[(len(hold.x) - 1) // 2]
    shifted = [
        torch.stack(
            (bound[0] + norm(x[P] - middle[P]), bound[1] + norm(x[V] - middle[V]), bound[2], bound[3])
        )
        for x, bound in zip(hold.x, hold.error_bound, strict=True)
    ]
    widest, late = torch.stack(shifted).amax(0), torch.stack(hold.late).amax(0)
    return [hold.least >= 0.0, torch.cat((middle, widest)), late]


def closely(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> list[Tensor]:
    """(B,) bool: a hold keeps the limits, and so does the backup trajectory from each of its possible ends."""
    hold = hold_bounds(y, u, w, period)
    kept = hold.least >= 0.0
    for x, bound, late in zip(hold.x, hold.error_bound, hold.late, strict=True):
        (kept,) = when(kept, has_trajectory, [kept], torch.cat((x, bound)), late, w, waits=True)
    return [kept]


def has_trajectory(y: Tensor, late: Tensor, w: RobustTerminalSet) -> list[Tensor]:
    """(B,) bool: the backup trajectory from a possible end of a hold keeps the limits."""
    return [call(trajectory_margin_at, y, late, w, long=w.free.cells) >= 0.0]


def may_be_kept(x: Tensor, error_bound: Tensor, w: RobustTerminalSet) -> Tensor:
    """The most that the least limit of motion but passive safety can be, (B,); below zero one is broken for sure.

    States (16, B) may be off by what was measured and (4, B). From a state in which a limit is broken no backup
    trajectory begins.
    """
    c = w.c
    position, velocity, _, _ = w.uncertainty.radii
    e_p, e_v = position + error_bound[0], velocity + error_bound[1]
    distance, speed = norm(x[P]), norm(x[V])
    return lowest(
        torch.stack(
            (
                distance + e_p - c.collision_radius,
                c.max_distance - distance + e_p,
                c.docking_speed + c.speed_slope * (distance + e_p) - speed + e_v,
                c.max_speed - x[V].abs().amax(0) + e_v,
            )
        )
    )


class HoldBounds(NamedTuple):
    """What a hold leads to, call by call.

    Attributes:
        least: (B,) lower bound of the limits while it lasts.
        x, error_bound: states (16, B) and (4, B) at every call that may end it.
        late: (B,) m/s each, by which the law's first calls see v farther off then.
    """

    least: Tensor
    x: list[Tensor]
    error_bound: list[Tensor]
    late: list[Tensor]


def hold_bounds(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> HoldBounds:
    """Bounds a hold of controls (6, B), period by period, until a limit may be broken; y: as of `keeps_motion`."""
    x, error_bound = y[:SIZE], y[SIZE:]
    least, grown = torch.full_like(y[0], torch.inf), [error_bound[1]]
    found = HoldBounds(least, [], [], [])
    for k in range(calls(w)):
        given = x, u, error_bound, w, period
        x, error_bound, own = when(
            least >= 0.0, hold_period, [x, error_bound, least], *given, long=w.free.cells
        )
        least = torch.minimum(least, own)
        grown.append(error_bound[1])
        # the law's first call measures what happened until then
        before = k + 1 - w.uncertainty.latency
        found.x.append(x)
        found.error_bound.append(error_bound)
        found.late.append(error_bound[1] - grown[before] if before >= 0 else error_bound[1])
    return found._replace(least=least)


def calls(w: RobustTerminalSet) -> int:
    """For which a control may be held."""
    return round(w.longest / w.period)


def trajectory_margin_at(y: Tensor, late: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns `trajectory_margin` from states with bounds (20, B), see `hold_bounds`."""
    position, velocity, _, _ = w.uncertainty.radii
    x, error_bound = y[:SIZE], y[SIZE:]
    return trajectory_margin(x[P], x[V], position + error_bound[0], velocity + error_bound[1], late, w)


def hold_period(
    x: Tensor, u: Tensor, error_bound: Tensor, w: RobustTerminalSet, period: float
) -> tuple[Tensor, Tensor, Tensor]:
    """A period of a hold: states, error bounds after it, and a lower bound of the limits in it; see `hold_bounds`."""
    c, n, none = w.c, w.c.mean_motion, torch.zeros_like(x[0])
    position, velocity, _, _ = w.uncertainty.radii
    end, bound = predicted(x, error_bound, u, c, period, w.uncertainty)
    # natural acceleration is another at another state
    drift = (3 * n**2 * (position + bound[0]) + 2 * n * (velocity + bound[1])) * w.period
    bound = torch.stack((bound[0] + drift * w.period, bound[1] + drift, bound[2], bound[3]))
    push = (rotate(x[Q], u[THRUST]) + rotate(end[Q], u[THRUST])) / (2 * c.mass)
    push = push * (w.high * norm(u[THRUST]) / c.mass / norm(push).clamp(min=1e-12))
    off = strays(x[:6], end[:6], w.period, push, none + w.turning + 2 * n)
    nodes = []
    for y, e in ((x, error_bound), (end, bound)):
        e_p, e_v = position + e[0] + off.position, velocity + e[1] + off.velocity
        nodes.append(Node(y[:6], e_p, e_p, e_v, e_v, norm(y[V]) + e_v))
    least = lowest(between(nodes[0], nodes[1], torch.zeros_like(x[P]), none - FAR, none + FAR, w))
    return end, bound, least

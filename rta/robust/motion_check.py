"""The check of thrust with error bounds: for every state within them, in the hold, and on the backup trajectory.

A backup trajectory (`rta.robust.error_tube`) must begin at every call that may end the hold
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

FAR = 1e6  # m, beyond every distance, since a hold may lead anywhere


def has_backup_trajectory(x: Tensor, w: RobustTerminalSet) -> Tensor:
    """Checks whether the law satisfies the limits of motion from true states (16, B), whatever is measured, (B,)."""
    none = torch.zeros_like(x[0])
    return trajectory_margin(x[P], x[V], none, none, none, w) >= 0.0


def keeps_motion(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> list[Tensor]:
    """Checks whether thrust of controls (6, B) and the backup trajectory satisfy the limits, (B,) bool.

    Args:
        y: states (16, B) as predicted, and how much further off than measured they may be, (4, B).
    """
    no = torch.zeros_like(y[0], dtype=torch.bool)
    kept, state, late = call(hold_at_a_glance, y, u, w, period)
    (seen,) = when(kept, has_trajectory, [no], state, late, w, waits=True)
    (closer,) = when(kept & ~seen, closely, [no], y, u, w, period, waits=True)
    return [seen | closer]


def hold_at_a_glance(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> list[Tensor]:
    """Returns whether a hold satisfies the limits, (B,) bool, and one state with bounds for all of its ends.

    The state with bounds is (20, B); how late it is, (B,), follows.
    """
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
    """Checks whether a hold and the backup trajectory from each of its possible ends satisfy the limits, (B,) bool."""
    hold = hold_bounds(y, u, w, period)
    kept = hold.least >= 0.0
    for x, bound, late in zip(hold.x, hold.error_bound, hold.late, strict=True):
        (kept,) = when(kept, has_trajectory, [kept], torch.cat((x, bound)), late, w, waits=True)
    return [kept]


def has_trajectory(y: Tensor, late: Tensor, w: RobustTerminalSet) -> list[Tensor]:
    """Checks whether the backup trajectory from a possible end of a hold satisfies the limits, (B,) bool."""
    return [call(trajectory_margin_at, y, late, w, long=w.free.cells) >= 0.0]


def may_be_kept(x: Tensor, error_bound: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns an upper bound (B,) of the least limit of motion but passive safety; below zero a limit is violated.

    States (16, B) may be off by the measurement's error and (4, B). No backup trajectory begins at a state in which a
    limit is violated.
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
    """Holds the results of a hold, call by call.

    Attributes:
        least: (B,) lower bound of the limits in the hold.
        x, error_bound: states (16, B) and (4, B) at every call that may end it.
        late: (B,) m/s each, additional error of v at the law's first calls after that.
    """

    least: Tensor
    x: list[Tensor]
    error_bound: list[Tensor]
    late: list[Tensor]


def hold_bounds(y: Tensor, u: Tensor, w: RobustTerminalSet, period: float) -> HoldBounds:
    """Returns bounds of a hold of controls (6, B), period by period, until a limit may be violated.

    Args:
        y: as in `keeps_motion`.
    """
    x, error_bound = y[:SIZE], y[SIZE:]
    least, grown = torch.full_like(y[0], torch.inf), [error_bound[1]]
    found = HoldBounds(least, [], [], [])
    for k in range(round(w.longest / w.period)):
        given = x, u, error_bound, w, period
        x, error_bound, own = when(
            least >= 0.0, hold_period, [x, error_bound, least], *given, long=w.free.cells
        )
        least = torch.minimum(least, own)
        grown.append(error_bound[1])
        # the first call of the law answers a measurement from `latency` calls ago
        before = k + 1 - w.uncertainty.latency
        found.x.append(x)
        found.error_bound.append(error_bound)
        found.late.append(error_bound[1] - grown[before] if before >= 0 else error_bound[1])
    return found._replace(least=least)


def trajectory_margin_at(y: Tensor, late: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns `trajectory_margin` from states with bounds (20, B), see `hold_bounds`."""
    position, velocity, _, _ = w.uncertainty.radii
    x, error_bound = y[:SIZE], y[SIZE:]
    return trajectory_margin(x[P], x[V], position + error_bound[0], velocity + error_bound[1], late, w)


def hold_period(
    x: Tensor, u: Tensor, error_bound: Tensor, w: RobustTerminalSet, period: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns states and error bounds after a period of a hold, and a lower bound of the limits in it."""
    c, n, none = w.c, w.c.mean_motion, torch.zeros_like(x[0])
    position, velocity, _, _ = w.uncertainty.radii
    end, bound = predicted(x, error_bound, u, c, period, w.uncertainty)
    # natural acceleration depends on the state
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

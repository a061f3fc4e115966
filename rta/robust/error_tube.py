"""Motion with error bounds: the tube around a backup trajectory, and the limits of motion in it.

By the law of `rta.robust.terminal_set` w = S w_0 + r, from call to call. S falls from 1 to 0. |r| stays below a bound
R(S), because the law aims anew at every call. So a backup trajectory is a path of S alone, except for errors:

    w   is within R(S) of S w_0
    p   is along w_0 between two distances, as thrust is stronger or weaker, and across it within the integral of R

Each limit has a lower bound on a chord between two values of S, as in `rta.check.intersample_bounds`, with errors of
each end. The backup trajectory ends in the terminal set. docs/reference/proof_with_bounds.md, *Motion*, has the
derivation.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from inspection.model.attitude import dot, norm, unit
from inspection.model.orbit import free_flight
from inspection.model.state import P, V
from rta.check.intersample_bounds import NEAREST, braking, lowest, nearer
from rta.robust.terminal_set import Errors, RobustTerminalSet

CHORDS, DENSER = 7, 2.0  # chords of a trajectory; S at their ends is this power of evenly spaced numbers
ALMOST = 0.8  # share of the way from the errors' final |w| to the calm speed at which it may end
# Allowed deviation of a backup trajectory from its straight line: m, share of its length, factor of its first error.
# Each chord tests it.
ALLOWED = (3.0, 0.8, 3.0)
DEEPER = 1.5  # in its length: how much closer to the chief its end may be, for the calm speed at its end


class Node(NamedTuple):
    """Holds bounds of a backup trajectory at one value of S, each but y (...).

    Attributes:
        y: (6, ...) position and velocity in its middle.
        along, aside: m, errors of position along w_0 and across it.
        velocity: m/s, error of v; ahead: its largest excess along w_0.
        speed: m/s, the largest |v|.
    """

    y: Tensor
    along: Tensor
    aside: Tensor
    velocity: Tensor
    ahead: Tensor
    speed: Tensor


class Fall(NamedTuple):
    """Holds bounds of |w| and |r| as S falls from s, where they are `swift` and `wide` in m/s; each (...).

    With E for the errors' calm speed, the bound of |w| is (swift - E) (S / s)^fall + E, and the bound of |r| is
    rest (S / s)^gamma + E - slack S. Both are concave in S.
    """

    s: Tensor
    swift: Tensor
    rest: Tensor
    slack: Tensor
    gamma: Tensor
    fall: Tensor
    calm: Tensor

    @classmethod
    def of(
        cls, s: Tensor, swift: Tensor, wide: Tensor, whole: Tensor, errors: Errors, w: RobustTerminalSet
    ) -> "Fall":
        """Returns the bounds from s on.

        Args:
            whole: the largest |w_0| in m/s.
        """
        slack = errors.share / (1.0 - errors.decay) * whole
        rest = (wide - errors.calm + slack * s).clamp(min=0.0)
        swift = torch.maximum(swift, errors.calm)
        return cls(s, swift, rest, slack, power(errors.decay, w), power(errors.swift, w), errors.calm)

    def speed(self, x: Tensor) -> Tensor:
        """Returns the largest |w| in m/s at S = x."""
        return (self.swift - self.calm) * (x / self.s) ** self.fall + self.calm

    def wide(self, x: Tensor) -> Tensor:
        """Returns R in m/s at S = x."""
        return self.rest * (x / self.s) ** self.gamma + self.calm - self.slack * x

    def widens(self, x: Tensor) -> Tensor:
        """Returns dR / dS in m/s."""
        return self.rest * self.gamma / self.s * (x / self.s) ** (self.gamma - 1.0) - self.slack

    def widest(self, after: Tensor) -> Tensor:
        """Returns the largest R in m/s between s and a later S."""
        ratio = (self.slack * self.s / (self.rest * self.gamma).clamp(min=1e-30)).clamp(min=1e-30)
        return self.wide((self.s * ratio ** (1.0 / (self.gamma - 1.0))).minimum(self.s).maximum(after))


def across(along: Tensor, aside: Tensor) -> Tensor:
    """Returns the length of a vector by two right-angled parts, in operations that vectors of C have."""
    return (along**2 + aside**2).sqrt()


def power(share: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns the largest k with 1 - share x <= (1 - x)^k for all x up to `w.most`.

    A hold takes the share x of S away.
    """
    return (1.0 - w.most * share).clamp(min=1e-9).log() / math.log(1.0 - w.most)


def trajectory_margin(
    p: Tensor, v: Tensor, e_p: Tensor, e_v: Tensor, first: Tensor, w: RobustTerminalSet
) -> Tensor:
    """Returns a lower bound of the limits of motion on the backup trajectory, negative unless it ends in the set: (B,).

    The bound holds for all true positions and velocities within e_p m and e_v m/s of p and v (3, B).

    Args:
        first: m/s, additional error of v at the law's first calls, since another control was held before.
    """
    off = v - w.field(p)
    size = norm(off)
    u = off / size.clamp(min=1e-12)
    # The distances on the way are assumed here and tested on each chord.
    rough = size + e_v
    length = rough * (rough / (1.7 * w.full)).clamp(min=w.slow) / w.low
    back = (-dot(p, u)).clamp(min=0.0).minimum(length)
    allowed = ALLOWED[0] + ALLOWED[1] * length + ALLOWED[2] * e_p
    low = norm(p + back * u) - allowed
    nearest = low.clamp(min=w.c.collision_radius, max=w.ends)
    farthest = (torch.maximum(norm(p), norm(p + length * u)) + allowed).clamp(max=w.c.max_distance)

    e_w = e_v + w.steepness(nearest, farthest) * e_p
    late = first * (1.0 + 2 * w.across) * min(1.0, w.tuning.share * max(1.0, w.old / w.period))
    whole = size + e_w + late
    final = w.errors(torch.zeros_like(whole), nearest, farthest).calm
    goal = torch.maximum(w.tuning.arrived * final, w.calm((low - DEEPER * length).maximum(nearest)))
    fall = power(w.errors(whole, nearest, farthest).swift, w)
    end = (ALMOST * (goal - final) / (whole - final).clamp(min=1e-12)).clamp(max=1.0) ** (1.0 / fall)

    s, at, along, aside = torch.ones_like(size), p, e_p, e_p
    swift, wide = whole, torch.zeros_like(size)
    parts = []
    for i in range(CHORDS):
        after = (1.0 - (1.0 - end ** (1.0 / DENSER)) * ((i + 1) / CHORDS)) ** DENSER
        errors = w.errors(swift / (1.0 - w.most), nearest, farthest)  # of all calls up to here
        bounds = Fall.of(s, swift, wide, whole, errors, w)
        step, ratio, middle = s - after, (s / after).log(), (s + after) / 2
        seen = errors.seen + first

        def lasts(x: Tensor, bounds: Fall = bounds, errors: Errors = errors, seen: Tensor = seen) -> Tensor:
            """Returns an upper bound in s of S dt / dS at S = x."""
            asked = (bounds.speed(x) * (1.0 + errors.late) + seen) / w.full
            return asked.clamp(min=w.slow) / (w.low * (1.0 - w.stretch))

        slowest = lasts(s)
        mean = torch.where(bounds.speed(after) >= w.full * w.slow, lasts(middle), slowest)
        missing = (bounds.widest(after) + errors.late * bounds.speed(s)) / (1.0 - w.most) + e_w + seen
        quickest = ((after * size - missing) / w.full).clamp(min=w.slow * (1.0 - w.most))
        quickest = quickest / (w.high * (1.0 + w.stretch))
        longest, shortest = slowest * ratio, quickest * step / s  # s
        tangent = bounds.widens(middle)
        swept = slowest * ((bounds.wide(middle) - tangent * middle) * ratio + tangent * step)
        stray = w.stray(bounds.speed(s), farthest) + late
        swept = swept + stray * longest + e_w * mean * step
        steeper = bounds.fall * (bounds.swift - bounds.calm) / s  # d|w| / dS, the slope of the bound at s
        lean = bounds.swift - s * size, bounds.swift - steeper * step - after * size
        more = torch.maximum(*lean).clamp(min=0.0) * longest
        far, near = (
            size * mean * step + torch.minimum(more + stray * longest, swept),
            size * quickest * step - swept,
        )

        ref = w.field(at)
        drift, spread = norm(ref), (longest - shortest) / 2
        wander = errors.steep * (far + errors.drift * longest + along + aside) * longest + drift * spread
        then = at + (far + near) / 2 * u + (longest + shortest) / 2 * ref
        then_along, then_aside = along + (far - near) / 2 + wander, aside + swept + wander
        bent = errors.steep * norm(then - at) / 2  # the field's deviation between both ends
        sag = size * (slowest - quickest) * step / 4

        def node(
            where: Tensor,
            x: Tensor,
            m: tuple[Tensor, Tensor],
            kmh: tuple[Tensor, Tensor, Tensor],
            errors: Errors = errors,
            other: Tensor = e_w * s + stray + bent,
            sag: Tensor = sag,
        ) -> Node:
            """Returns the node at S = x and a position.

            `kmh` holds R, how much more w may be along w_0, and |w|.
            """
            there = w.field(where)
            own = other + errors.steep * (m[0] + m[1])
            return Node(
                torch.cat((where, x * off + there)), m[0] + sag, m[1],
                kmh[0] + own, kmh[1].clamp(min=0.0) + own, kmh[2] + norm(there) + own,
            )  # fmt: skip

        begins = bounds.wide(s), lean[0], bounds.swift
        last = (
            (bounds.wide(s) - bounds.widens(s) * step).clamp(min=0.0),
            lean[1],
            bounds.swift - steeper * step,
        )
        start, finish = node(at, s, (along, aside), begins), node(then, after, (then_along, then_aside), last)
        parts.append(between(start, finish, u, nearest, farthest, w))
        s, at, along, aside, swift, wide = (
            after,
            then,
            then_along,
            then_aside,
            bounds.speed(after),
            bounds.wide(after),
        )
    least = norm(at) - across(along, aside)
    arrived = torch.stack((least - w.nearest, w.calm(least) - goal, goal - swift))
    return torch.minimum(lowest(torch.cat(parts)), lowest(arrived))


def between(
    start: Node, end: Node, u: Tensor, nearest: Tensor, farthest: Tensor, w: RobustTerminalSet
) -> Tensor:
    """Returns lower bounds of the limits of motion between two nodes, and of the distance to two radii in m: (8, ...).

    As in `rta.check.intersample_bounds.between`, but the errors change linearly from node to node.

    Args:
        u: (3, ...) the direction of w_0, or zero if errors have no direction.
    """
    c, ends = w.c, (start, end)
    n = unit(start.y[P] + end.y[P])
    slant = dot(n, u).abs()
    sideways = (1.0 - slant**2).clamp(min=0.0).sqrt()
    distance = [norm(e.y[P]) for e in ends]
    close = [dot(n, e.y[P]) - slant * e.along - sideways * e.aside for e in ends]
    least, fastest = torch.minimum(*close).clamp(min=NEAREST), torch.maximum(start.speed, end.speed)
    ahead = [dot(e.y[P], u) for e in ends]
    beside = [norm(e.y[P] - a * u) for e, a in zip(ends, ahead, strict=True)]
    far = [across(a.abs() + e.along, b + e.aside) for e, a, b in zip(ends, ahead, beside, strict=True)]
    eta = norm(end.y[P] - start.y[P]) / least
    sag = (2 * norm(end.y[V] - start.y[V]) * eta + 3 * fastest * eta**2) / 8

    # the sine of the angle between p and u: it is largest where the angle is a right one, or at one of the ends
    sine = torch.maximum(*(b / d for b, d in zip(beside, distance, strict=True))).clamp(max=1.0)
    sine = torch.where(ahead[0] * ahead[1] <= 0.0, 1.0, sine)
    leaves = torch.minimum(*ahead) > 0.0
    # p may have another direction from the chief, so that v has a smaller or larger part along it
    turned = (torch.maximum(*(across(e.along, e.aside) for e in ends)) / least).clamp(max=1.0)
    stray = torch.maximum(*(e.velocity + e.ahead for e in ends))
    turned = sine * fastest * turned + fastest * turned**2 + math.sqrt(2.0) * turned * stray

    collision, zone, limit = [], [], []
    for e, d, a, b in zip(ends, distance, close, far, strict=True):
        radial = dot(e.y[V], e.y[P]) / d
        outwards = torch.where(leaves, torch.minimum(e.velocity, e.ahead + sine * e.velocity), e.velocity)
        collision.append(braking(a - c.collision_radius, c) + radial - e.velocity)
        zone.append(braking(c.max_distance - b, c) - radial - outwards)
        limit.append(c.docking_speed + c.speed_slope * a - e.speed)
    along_axes = torch.maximum(*(e.y[V].abs() + e.velocity for e in ends))
    return torch.stack(
        (
            torch.minimum(*collision) - sag - turned,
            torch.minimum(*limit),
            torch.minimum(*zone) - sag - turned,
            clearance(ends, torch.maximum(*far), fastest, w),
            *(c.max_speed - torch.minimum(along_axes, fastest)),
            torch.minimum(least - nearest, farthest - torch.maximum(*far)),
        )
    )


def clearance(ends: Sequence[Node], farthest: Tensor, fastest: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns the clearance as `rta.check.intersample_bounds.clearance`, each node with its own errors: (...) in m."""
    c, free, y = w.c, w.free, ends[0].y
    cell, times = free.times(y, c)
    corners = []
    for e in ends:
        lost = free.position * across(e.along, e.aside) + free.velocity * times[1] * e.velocity
        corners += [(free_flight(e.y[P], e.y[V], t, c.mean_motion), lost) for t in times]
    nearest = nearer(corners[0][0] + corners[2][0], corners[1][0] + corners[3][0]) / 2
    beyond = torch.full_like(nearest[0], -math.inf)
    for _ in range(1 + free.searches):
        m = unit(nearest)
        point, least = corners[0][0], dot(m, corners[0][0]) - corners[0][1]
        for other, lost in corners[1:]:
            along = dot(m, other) - lost
            point, least = torch.where(along < least, other, point), torch.minimum(along, least)
        beyond, nearest = torch.maximum(beyond, least), nearer(nearest, point)
    bend = (free.bend_position * farthest + free.bend_velocity * fastest) * cell**2 / 8
    return beyond.amin(0) - c.collision_radius - bend

"""Motion with error bounds: the braking law, the errors of its execution, and its terminal robust invariant set.

The law is a function of what is measured, as that of `rta.check.motion_law`. There is a field of velocities v_ref(p):
outwards beside the chief, inwards at the edge of the zone, none between. With w = v - v_ref(p), thrust is to give, from
each call to the next,

    G = A - f,    A = -w min(a / |w|, 1 / slow),

f being the natural acceleration. Of what is asked for, the mean over a hold acts along it by a share kappa between
`low` and `high`, and across it by the share `across` of that at most. So from call to call

    w+ = w - lambda (w + e) - c + d,    lambda = kappa hold min(a / |w + e|, 1 / slow) <= share,

where w is seen off by e, |c| <= across lambda |w + e|, and d is what else accelerates. |w| falls to what the errors
leave of it, and stays there. A spacecraft whose velocity is not known never rests: it drifts. So there is no rest to
come to, but a *terminal robust invariant set*, which it never leaves, whatever is measured,

    nearest <= |p| <= max_distance,    |v - v_ref(p)| <= calm(|p|),

since the field is faster than `calm` at both ends. Every limit of motion is kept in it: `RobustTerminalSet.of`
certifies that once, and raises where it is not so. See docs/reference/proof_with_bounds.md, *Motion*.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from inspection.model.attitude import norm, rotation_matrix
from inspection.model.dynamics import euler, step
from inspection.model.orbit import clohessy_wiltshire
from inspection.model.parameters import Limits
from inspection.model.state import P, Q, V
from inspection.world.uncertainty import Uncertainty
from rta.check.commit import NoCheckError
from rta.check.intersample_bounds import FreeFlight, least_stretch
from rta.robust.prediction import unsaturated

EDGE = 1.0  # m inside the zone, from where on the field leads inwards as fast as anywhere
CELLS = (11, 1)  # of passive safety's horizon, and searches in each; a prime, see `rta.check.flight`
ROUNDS = 40  # of the equation for the calm speed, which the field depends on, which it depends on
GRID = 4000, 100  # distances and times at which the set is looked at


@dataclass(frozen=True)
class Tuning:
    """What the law and its set are tuned by. Any values will do, with `share` below 1: `certified` decides.

    Attributes:
        share: of w, that a hold takes away at most: more leads to larger errors, less takes longer.
        outwards, inwards: the field's speed beside the chief and at the edge, by the calm speed there.
        steep: 1/s, by which the field falls off with distance.
        beside: of the radius of collision, up to which the field leads outwards as fast as anywhere.
        calmer: of what the errors leave of w, that counts as calm: a backup trajectory need not come down to it.
        rising: of the rate at which that grows with distance.
        arrived: of what the errors leave of w, to which a backup trajectory comes down at least.
    """

    share: float
    outwards: float
    inwards: float
    steep: float
    beside: float
    calmer: float
    rising: float
    arrived: float


# Each for the share of states from which a backup trajectory is verified: within U1, and within U1 with a smallest
# thrust of 0.02 N or quanta of 0.05 N. The first that leaves a set is taken.
TUNINGS = (
    Tuning(0.25, outwards=1.2, inwards=1.3, steep=5e-4, beside=4 / 3, calmer=1.5, rising=1.8, arrived=1.1),
    Tuning(0.3, outwards=1.15, inwards=1.15, steep=2e-3, beside=2.0, calmer=1.03, rising=1.1, arrived=1.02),
)


@dataclass(frozen=True)
class Errors:
    """What the law leaves of w on a backup trajectory, by its errors there, each (...); see `RobustTerminalSet.errors`.

    Attributes:
        calm: m/s, of |w| in the end.
        share: of |w| that becomes an error while it falls; decay: of this error, that is taken back meanwhile.
        swift: by which |w| itself falls. All three are per share by which w is taken away.
        seen, late: m/s and share, |e| <= seen + late |w|.
        steep, drift: 1/s and m/s, of the field.
    """

    calm: Tensor
    share: Tensor
    decay: Tensor
    swift: Tensor
    seen: Tensor
    late: float
    steep: Tensor
    drift: Tensor


@dataclass(frozen=True)
class RobustTerminalSet:
    """The law, the shares of what is not known of it, and its terminal robust invariant set.

    Attributes:
        tuning: how it is chosen.
        free: of free flight.
        period, longest: s, of a call and of a control that is held at most; old: s, of a measurement at most.
        aim: s of a hold, after which the body has the attitude that thrust is meant for.
        full, slow: a in m/s^2, and s.
        low, high: kappa; across: share of it.
        turning: rad/s, of the body at most.
        place, seen: m and m/s, by which a state is seen elsewhere.
        lag: by how much of w + e w is seen off, per share of what thrust did otherwise since the measurement.
        rounded: m/s^2, of what thrusters round off.
        out, beside, ends: m/s and m: the field's speed beside the chief, up to where, and from where on it has none.
        back, begins, edge: m/s and m, the same at the edge of the zone: from where on, and from where on all of it.
        still, rising: m/s and 1/s, the calm speed at the chief, and by how much it rises with distance.
        nearest: m from the chief's centre.
    """

    c: Limits
    uncertainty: Uncertainty
    tuning: Tuning
    free: FreeFlight
    period: float
    longest: float
    old: float
    aim: float
    full: float
    slow: float
    low: float
    high: float
    across: float
    turning: float
    place: float
    seen: float
    lag: float
    rounded: float = 0.0
    out: float = 0.0
    beside: float = 0.0
    ends: float = 1.0
    back: float = 0.0
    begins: float = 1e8
    edge: float = 1e9
    still: float = 0.0
    rising: float = 0.0
    nearest: float = 0.0

    @classmethod
    def of(cls, c: Limits, period: float, uncertainty: Uncertainty) -> "RobustTerminalSet":
        """Returns the set of the first tuning that has one; raises NoCheckError where the bounds leave none."""
        for tuning in TUNINGS[:-1]:
            with suppress(NoCheckError):
                return cls.tuned(c, period, uncertainty, tuning)
        return cls.tuned(c, period, uncertainty, TUNINGS[-1])

    @classmethod
    def tuned(cls, c: Limits, period: float, uncertainty: Uncertainty, tuning: Tuning) -> "RobustTerminalSet":
        """Returns the set of one tuning; raises NoCheckError where the bounds leave none.

        What thrusters round off the law's thrust is an acceleration that is not known.
        """
        aslant = 1.0 + math.sqrt(2.0) * math.sin(math.radians(uncertainty.thrust_misalignment))
        rounded = math.sqrt(3.0) * (1 + uncertainty.thrust_gain) * aslant * uncertainty.rounding(c.max_thrust)
        rounded /= (1 - uncertainty.mass) * c.mass
        uncertainty = replace(uncertainty, acceleration=uncertainty.acceleration + rounded)
        holds = math.ceil(uncertainty.hold(period) / period - 1e-9)
        longest, old = holds * period, uncertainty.latency * period
        aim = (longest + period) / 4
        turning = math.sqrt(3.0) * c.max_rate + uncertainty.unknown_turning(c)  # relative to Hill's frame
        position, velocity, attitude, rate = uncertainty.radii
        # rad, by which the mean attitude of a hold is another than the one predicted for its aim
        quickening = math.sqrt(3.0) * c.max_torque / min(c.inertia)
        other = uncertainty.torque_error * quickening + uncertainty.angular_acceleration(c)
        ahead = old + aim
        angle = attitude + rate * ahead + min(other * ahead**2 / 2, 2 * turning * ahead)
        faster = uncertainty.torque[1] * quickening + uncertainty.angular_acceleration(c)
        faster += math.hypot(*euler((c.max_rate,) * 3, c.inertia))
        hold = [period * (i + 1) for i in range(holds)]
        # thrust that sweeps about its mean direction gives less along it
        sweeps = angle + turning * max(math.sqrt(((t - aim) ** 3 + aim**3) / (3 * t)) for t in hold)
        angle += max(mean_misalignment(t, aim, turning, faster) for t in hold)
        # of thrust in the body: the gains of the axes, and each axis aslant
        tilt = math.radians(uncertainty.thrust_misalignment)
        least, most = (1 - uncertainty.thrust_gain) * math.cos(tilt), 1 + uncertainty.thrust_gain
        aslant, uneven = math.sqrt(2.0) * math.sin(tilt) * most, (most - least) / 2
        mixed = aslant + angle * (uneven + aslant)
        along = least - mixed - max(angle, sweeps) ** 2 / 2 * most
        if along <= 0.0:
            raise NoCheckError("thrust may act in any direction")
        low, high = along / (1 + uncertainty.mass), (most + mixed) / (1 - uncertainty.mass)
        across = (uneven + aslant + angle * (most + aslant)) / along
        slow = high * longest / tuning.share
        fastest = min(c.docking_speed + c.speed_slope * c.max_distance, math.sqrt(3.0) * c.max_speed)
        # since a measurement w has fallen by this share at most
        before = tuning.share * (old + longest - period) / longest if old else 0.0
        if before >= 1.0:
            raise NoCheckError("the state is too old")
        place = position + velocity * old + math.sqrt(3.0) * c.max_thrust / c.mass * old**2
        w = cls(
            c, uncertainty, tuning, FreeFlight.of(c, *CELLS), period, longest, old, aim,
            full=c.max_thrust / c.mass - c.largest_drift(c.max_distance + place, fastest + velocity),
            slow=slow, low=low, high=high, across=across, turning=turning, place=place, seen=velocity,
            lag=old / slow / (1 - before), rounded=rounded,
        )  # fmt: skip
        if w.full <= 0.0 or w.late >= 0.5:
            raise NoCheckError("thrust does too much otherwise")
        for _ in range(ROUNDS):
            w = w.with_field()
            if not w.still + w.rising * c.max_distance < c.docking_speed:
                raise NoCheckError("the errors leave too much of the speed")
        return w.certified()

    @property
    def off(self) -> float:
        """|1 - kappa| at most."""
        return max(1.0 - self.low, self.high - 1.0)

    @property
    def thrust_error(self) -> float:
        """|1 - K| at most, K being what acts of what is asked for."""
        return self.off + self.across * self.high

    @property
    def late(self) -> float:
        """The share of w + e by which w is seen off, for what thrust did otherwise since the measurement."""
        return self.lag * self.thrust_error

    @property
    def stretch(self) -> float:
        """Beta, the share of w by which it is seen longer or shorter."""
        return self.lag * self.off

    @property
    def most(self) -> float:
        """The share of S that a hold takes away at most."""
        return self.tuning.share * (1.0 + self.stretch)

    @property
    def second(self) -> float:
        """What is taken off |w| across it, to second order, per share that a hold takes away."""
        return self.across**2 * self.tuning.share / (2 * (1.0 - self.tuning.share))

    def with_field(self) -> "RobustTerminalSet":
        """The same, with a field that is faster than this one's calm speed, and with the calm speed in it."""
        c, farthest = self.c, self.c.max_distance
        beside, edge = self.tuning.beside * c.collision_radius, farthest - EDGE
        none = torch.zeros((), dtype=torch.float64)
        out, back = (
            self.tuning.outwards * self.wanders(none + beside).item(),
            self.tuning.inwards * self.wanders(none + farthest).item(),
        )
        w = replace(
            self, out=out, beside=beside, ends=beside + max(out, 1e-6) / self.tuning.steep,
            back=back, begins=edge - max(back, 1e-6) / self.tuning.steep, edge=edge,
        )  # fmt: skip
        near, far = (
            w.errors(none, none + beside, none + w.ends),
            w.errors(none, none + w.begins, none + farthest),
        )
        rising = self.tuning.rising * 3 * c.mean_motion**2 * self.thrust_error * self.slow / self.low
        rising /= near.decay.item()
        still = self.tuning.calmer * max(near.calm.item(), far.calm.item() - rising * farthest)
        return replace(w, still=still, rising=rising)

    def calm(self, distance: Tensor) -> Tensor:
        """m/s, of |w| in the set at a call at most, at distances (...) in m."""
        return self.still + self.rising * distance

    def wanders(self, distance: Tensor) -> Tensor:
        """m/s, of |w| in the set at most, between calls, too."""
        return self.calm(distance) + self.stray(self.calm(distance), distance)

    def stray(self, speed: Tensor, farthest: Tensor) -> Tensor:
        """m/s, by which w is off its chord in a hold, for thrust turns with the body; |w| and |p| (...)."""
        n, field = self.c.mean_motion, max(self.out, self.back)
        natural = 3 * n**2 * (farthest + self.place) + 2 * n * (speed + field + self.seen)
        steep = max(self.out / self.c.collision_radius, self.tuning.steep)
        seen = self.seen + steep * self.place + self.old * natural
        asked = ((speed * (1.0 + self.late) + seen) / ((1.0 - self.late) * self.slow)).clamp(max=self.full)
        turned = self.high * (1 + self.across) * (asked + natural) + self.rounded
        return turned * self.turning * self.longest**2 / 8

    def field(self, p: Tensor) -> Tensor:
        """v_ref (3, ...) in m/s at positions (3, ...) in m."""
        r = norm(p).clamp(min=1.0)
        return self.speed(r) / r * p

    def speed(self, r: Tensor) -> Tensor:
        """m/s, of the field outwards at distances (...) in m; it falls with distance."""
        out = self.out * ((self.ends - r) / (self.ends - self.beside)).clamp(0.0, 1.0)
        return out - self.back * ((r - self.begins) / (self.edge - self.begins)).clamp(0.0, 1.0)

    def steepness(self, nearest: Tensor, farthest: Tensor) -> Tensor:
        """1/s, the largest slope of the field between two distances (...) in m: along the radius, or across it."""
        out = self.out * ((self.ends - nearest) / (self.ends - self.beside)).clamp(0.0, 1.0)
        near = torch.where(nearest < self.ends, (out / nearest).clamp(min=self.tuning.steep), 0.0)
        return torch.where(farthest > self.begins, near.clamp(min=self.tuning.steep), near)

    def errors(self, fastest: Tensor, nearest: Tensor, farthest: Tensor) -> Errors:
        """Of backup trajectories at |w| up to a speed in m/s, between two distances in m from the chief, (...)."""
        n, late, sees = self.c.mean_motion, self.late, 1.0 - self.late
        steep = self.steepness(nearest, farthest)
        drift = torch.maximum(self.speed(nearest).abs(), self.speed(farthest).abs())
        # what thrust that meets f, and the unknown, did otherwise since the measurement, counts beside the share `late`
        since = self.old * (
            self.thrust_error * (3 * n**2 * (farthest + self.place) + 2 * n * drift)
            + self.uncertainty.acceleration
        )
        seen = self.seen + steep * self.place + since
        # m/s^2 that are there at any speed: f that is not what thrust was meant to cancel, what is unknown, and the
        # field's own change along it, which is along the radius
        always = (
            self.thrust_error * (3 * n**2 * farthest + 2 * n * drift)
            + 3 * n**2 * (self.place + drift * self.longest)
            + 2 * n * (1.0 + self.thrust_error) * seen / sees
            + self.uncertainty.acceleration
            + (self.tuning.steep + self.rising) * drift
        ) * (1.0 + n * self.longest)
        # s, that a hold is per share that it takes away at most
        lasting = ((fastest + seen) / (sees * self.full)).clamp(min=self.slow) / self.low
        rate = 2 * n * (self.thrust_error + late) / sees + 3 * n**2 * self.longest + steep + self.rising
        growing = (
            lasting * rate
            + n * (self.longest + 2 * self.old * self.thrust_error) * (1.0 + self.across) / sees
        )
        saturated = (fastest + seen) / sees > self.full * self.slow
        growing = growing + torch.where(saturated, always / (self.full * self.low), 0.0)

        own = 1.0 - self.stretch
        share = (self.across / sees + self.lag * self.across * self.high + late**2 / sees + growing) / own
        decay = 1.0 / (1.0 + self.stretch) - self.stretch / own - share
        error = (seen * (1.0 + self.across) / sees + always * self.slow / self.low) / own
        slower = (1.0 + 2 * self.across + 3 * self.second) * late / sees + self.second + growing
        return Errors(
            calm=error / decay.clamp(min=1e-3), share=share, decay=decay, swift=(1.0 - slower) / (1.0 + self.stretch),
            seen=seen / sees, late=late / sees, steep=steep, drift=drift,
        )  # fmt: skip

    def certified(self) -> "RobustTerminalSet":
        """The same, with the nearest distance from which on the set is invariant."""
        c, count, moments = self.c, *GRID
        if not self.beside < self.ends < self.begins:
            raise NoCheckError("the zone is too small for the field")
        r = torch.linspace(c.collision_radius, c.max_distance, count, dtype=torch.float64)
        gap = (r[1] - r[0]).item()
        speed, most = self.speed(r), self.wanders(r)
        outwards = (2 * c.max_acceleration * (c.max_distance - r).clamp(min=0.0)).sqrt()
        inwards = (2 * c.max_acceleration * (r - c.collision_radius)).sqrt()
        limit = (c.docking_speed + c.speed_slope * r).clamp(max=c.max_speed)
        between = gap * (self.tuning.steep + self.rising)  # m/s, of speeds between two distances
        fine = (outwards >= most + speed + between) & (inwards >= most - speed + between)
        fine &= (
            (limit >= speed.abs() + most + between)
            & (self.clearances(r, moments, gap) >= 0.0)
            & self.stays(r)
        )
        bad = torch.nonzero(~fine[:-1]).flatten()
        first = int(bad.max()) + 1 if bad.numel() else 0
        if r[first] > self.beside or self.out <= most[first] or self.back <= most[-1]:
            raise NoCheckError("the calm speed is too large")
        return replace(self, nearest=r[first].item())

    def clearances(self, r: Tensor, moments: int, gap: float) -> Tensor:
        """m, by which free flight from the set at distances (k,) up to a gap apart stays clear at least.

        It is (Phi_rr + s / r Phi_rv) p + Phi_rv w. The first part is at least its least singular value times r. Between
        moments a flight is off its chord by what it bends.
        """
        c, times = (
            self.c,
            torch.linspace(0.0, self.c.passive_safety_horizon, moments + 1, dtype=torch.float64),
        )
        speed, most = self.speed(r), self.wanders(r)
        least = (
            least_stretch(speed / r, times, c.mean_motion) * r - self.free.velocity * times[:, None] * most
        )
        bend = self.free.bend_position * r + self.free.bend_velocity * (speed.abs() + most)
        sag = bend * (times[1] ** 2) / 8
        lost = gap * (
            self.free.position
            + self.free.velocity * times[-1] * (2 * self.tuning.steep + self.rising + self.out / self.beside)
        )
        return least.amin(0) - sag - lost - c.collision_radius

    def stays(self, r: Tensor) -> Tensor:
        """(k,) bool: at distances (k,) |w| that is calm stays so, and `error_tube.Fall` holds down to it."""
        calm = self.calm(r)
        # within a hold, and where it is seen
        moved = (self.wanders(r) + max(self.out, self.back)) * self.longest + self.place
        errors = self.errors(calm / (1.0 - self.most), (r - moved).clamp(min=1.0), r + moved)
        left = errors.seen * (1.0 + 2 * self.across + 3 * self.second) + errors.calm * errors.decay * (
            1.0 - self.stretch
        )
        left = left - errors.seen * (1.0 + self.across)
        seen = errors.seen + errors.late * errors.calm / (1.0 - self.most)
        return (
            (errors.decay > 0.0)
            & (errors.calm <= calm)
            & (left <= errors.swift * (1.0 + self.stretch) * errors.calm)
            & ((1.0 + 2 * self.tuning.share * self.across) * seen <= errors.calm)
        )


def mean_misalignment(hold: float, aim: float, turning: float, faster: float) -> float:
    """rad, by which the mean attitude over a hold is off that at its aim, both in s.

    The body turns at `turning` rad/s at most, which changes by `faster` rad/s^2 at most. The mean of the angle from the
    aim on is the integral of rate (hold - s) after it, less that of rate s before it, by the hold: a steady rate makes
    up on one side for the other.
    """
    if hold <= aim:
        return turning * (aim - hold / 2)
    after, before = (hold - aim) ** 2 / 2, aim**2 / 2
    change = min(faster * max(hold - aim, aim) / 3, 2 * turning)
    kept = abs(after - before) * turning + min(after, before) * change + faster * aim**3 / 6
    return min(kept, (after + before) * turning) / hold


def law(x: Tensor, w: RobustTerminalSet) -> Tensor:
    """G (3, B) in m/s^2 in Hill's frame, at states (16, B) as they are taken for."""
    off = x[V] - w.field(x[P])
    wanted = -off * (w.full / norm(off).clamp(min=1e-30)).clamp(max=1.0 / w.slow)
    return wanted - torch.stack(clohessy_wiltshire(x[P].unbind(), x[V].unbind(), w.c.mean_motion))


def thrust(x: Tensor, torque: Tensor, w: RobustTerminalSet) -> Tensor:
    """The law as thrust (3, B) in N, in the body, at states (16, B) as they are taken for; torque (3, B) is held."""
    aimed = step(x, torch.cat((torch.zeros_like(torque), torque)), w.aim, unsaturated(w.c))
    limit = w.c.max_thrust
    return (w.c.mass * (rotation_matrix(aimed[Q]) * law(x, w)[:, None]).sum(0)).clamp(-limit, limit)

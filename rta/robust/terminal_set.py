"""Motion with error bounds: the braking law, the errors of its execution, and its terminal robust invariant set.

The law is a function of the measurement, like the law of `rta.check.motion_law`. The field of velocities v_ref(p) leads
outwards beside the chief and inwards at the edge of the zone; it is zero between. With w = v - v_ref(p), thrust is to
give, from each call to the next,

    G = A - f,    A = -w min(a / |w|, 1 / slow),

where f is the natural acceleration. The mean acceleration over a hold is a share kappa of G along G, between `low` and
`high`, and across G at most the share `across` of that. So from call to call

    w+ = w - lambda (w + e) - c + d,    lambda = kappa hold min(a / |w + e|, 1 / slow) <= share,

where e is the error of the measured w, |c| <= across lambda |w + e|, and d contains all other accelerations. |w| falls
to a level set by the errors, and stays below it. A spacecraft whose velocity is not known exactly never rests: it
drifts. So the law does not end at rest, but in a *terminal robust invariant set*, which it never leaves for any
measurement,

    nearest <= |p| <= max_distance,    |v - v_ref(p)| <= calm(|p|),

since the field is faster than `calm` at both ends. Every limit of motion is satisfied in it: `RobustTerminalSet.of`
certifies that once, and raises an error if it fails. See docs/reference/proof_with_bounds.md, *Motion*.
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

EDGE = 1.0  # m inside the zone's edge, where the field reaches its full speed inwards
CELLS = (11, 1)  # cells of passive safety's horizon, searches in each; a prime, see `rta.check.flight`
ROUNDS = 40  # iterations for the calm speed and the field, which depend on each other
GRID = 4000, 100  # numbers of distances and times at which the set is tested


@dataclass(frozen=True)
class Tuning:
    """Holds the tuning of the law and its set. Any values with `share` below 1 are safe: `certified` decides.

    Attributes:
        share: the largest share of w that a hold takes away: more leads to larger errors, less takes longer.
        outwards, inwards: the field's speed beside the chief and at the edge, in calm speeds at these places.
        steep: 1/s, slope by which the field falls off with distance.
        beside: in collision radii, the distance up to which the field has its full speed outwards.
        calmer: the calm speed as a factor of the level set by the errors; a backup trajectory need not reach that
            level.
        rising: the calm speed's slope with distance, as a factor of the level's.
        arrived: factor of the level set by the errors to which a backup trajectory comes down at least.
    """

    share: float
    outwards: float
    inwards: float
    steep: float
    beside: float
    calmer: float
    rising: float
    arrived: float


# Both maximise the share of states from which a backup trajectory is verified: the first with the bounds U1, the second
# with U1 and a smallest thrust of 0.02 N or quanta of 0.05 N. The first one that has a set is used.
TUNINGS = (
    Tuning(0.25, outwards=1.2, inwards=1.3, steep=5e-4, beside=4 / 3, calmer=1.5, rising=1.8, arrived=1.1),
    Tuning(0.3, outwards=1.15, inwards=1.15, steep=2e-3, beside=2.0, calmer=1.03, rising=1.1, arrived=1.02),
)


@dataclass(frozen=True)
class Errors:
    """Holds the effect of errors on w on a backup trajectory, each (...); see `RobustTerminalSet.errors`.

    Attributes:
        calm: m/s, the final |w|.
        share: of |w| that becomes an error while |w| falls; decay: of this error that is removed meanwhile.
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
    """Holds the law, bounds of its execution errors, and its terminal robust invariant set.

    Attributes:
        tuning: how the set is tuned.
        free: bounds of free flight.
        period, longest: s, between calls, and the longest hold of a control; old: s, the age of a measurement.
        aim: s from a hold's beginning at which the body has the attitude that thrust is meant for.
        full, slow: a in m/s^2, and s.
        low, high: kappa; across: share of it.
        turning: rad/s, the body's largest rate.
        place, seen: m and m/s, errors of a measured state.
        lag: error of the measured w per w + e, and per share by which thrust was off since the measurement.
        rounded: m/s^2, the thrusters' rounding.
        out, beside, ends: m/s and m: the field's speed beside the chief, the distance up to which it has this speed,
            and the distance from which on it is zero.
        back, begins, edge: m/s and m, at the edge of the zone: its speed, the distances where it begins and is full.
        still, rising: m/s and 1/s, the calm speed at the chief, and its slope with distance.
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
        """Returns the set of the first tuning that has one; raises NoCheckError if the bounds leave none."""
        for tuning in TUNINGS[:-1]:
            with suppress(NoCheckError):
                return cls.tuned(c, period, uncertainty, tuning)
        return cls.tuned(c, period, uncertainty, TUNINGS[-1])

    @classmethod
    def tuned(cls, c: Limits, period: float, uncertainty: Uncertainty, tuning: Tuning) -> "RobustTerminalSet":
        """Returns the set of one tuning; raises NoCheckError if the bounds leave none.

        The thrusters' rounding of the law's thrust counts as an unknown acceleration.
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
        # rad, from the attitude predicted for a hold's aim to the hold's mean attitude
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
        # errors of thrust in the body: the gains of the axes, and the misalignment of each axis
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
        # the largest share by which w has fallen since its measurement
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
        """Returns the largest |1 - kappa|."""
        return max(1.0 - self.low, self.high - 1.0)

    @property
    def thrust_error(self) -> float:
        """Returns the largest |1 - K|, where K is the acting share of the commanded acceleration."""
        return self.off + self.across * self.high

    @property
    def late(self) -> float:
        """Returns the error of the measured w, as a share of w + e, from thrust that was off since the measurement."""
        return self.lag * self.thrust_error

    @property
    def stretch(self) -> float:
        """Returns beta, the share of w by which the measured w is longer or shorter."""
        return self.lag * self.off

    @property
    def most(self) -> float:
        """Returns the largest share of S that a hold takes away."""
        return self.tuning.share * (1.0 + self.stretch)

    @property
    def second(self) -> float:
        """Returns the second-order reduction of |w| by thrust across it, per share that a hold takes away."""
        return self.across**2 * self.tuning.share / (2 * (1.0 - self.tuning.share))

    def with_field(self) -> "RobustTerminalSet":
        """Returns the same set with a field faster than this one's calm speed, and the calm speed in that field."""
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
        """Returns the largest |w| in m/s in the set at a call, at distances (...) in m."""
        return self.still + self.rising * distance

    def wanders(self, distance: Tensor) -> Tensor:
        """Returns the largest |w| in m/s in the set, between calls, too."""
        return self.calm(distance) + self.stray(self.calm(distance), distance)

    def stray(self, speed: Tensor, farthest: Tensor) -> Tensor:
        """Returns in m/s how far w is off its chord in a hold, since thrust turns with the body; |w| and |p| (...)."""
        n, field = self.c.mean_motion, max(self.out, self.back)
        natural = 3 * n**2 * (farthest + self.place) + 2 * n * (speed + field + self.seen)
        steep = max(self.out / self.c.collision_radius, self.tuning.steep)
        seen = self.seen + steep * self.place + self.old * natural
        asked = ((speed * (1.0 + self.late) + seen) / ((1.0 - self.late) * self.slow)).clamp(max=self.full)
        turned = self.high * (1 + self.across) * (asked + natural) + self.rounded
        return turned * self.turning * self.longest**2 / 8

    def field(self, p: Tensor) -> Tensor:
        """Returns v_ref (3, ...) in m/s at positions (3, ...) in m."""
        r = norm(p).clamp(min=1.0)
        return self.speed(r) / r * p

    def speed(self, r: Tensor) -> Tensor:
        """Returns the field's speed outwards in m/s at distances (...) in m; it falls with distance."""
        out = self.out * ((self.ends - r) / (self.ends - self.beside)).clamp(0.0, 1.0)
        return out - self.back * ((r - self.begins) / (self.edge - self.begins)).clamp(0.0, 1.0)

    def steepness(self, nearest: Tensor, farthest: Tensor) -> Tensor:
        """Returns the field's largest slope in 1/s between two distances (...) in m: along the radius, or across it."""
        out = self.out * ((self.ends - nearest) / (self.ends - self.beside)).clamp(0.0, 1.0)
        near = torch.where(nearest < self.ends, (out / nearest).clamp(min=self.tuning.steep), 0.0)
        return torch.where(farthest > self.begins, near.clamp(min=self.tuning.steep), near)

    def errors(self, fastest: Tensor, nearest: Tensor, farthest: Tensor) -> Errors:
        """Returns errors of backup trajectories at |w| up to `fastest` m/s, between two distances in m, (...)."""
        n, late, sees = self.c.mean_motion, self.late, 1.0 - self.late
        steep = self.steepness(nearest, farthest)
        drift = torch.maximum(self.speed(nearest).abs(), self.speed(farthest).abs())
        # the errors since the measurement of thrust against f, and unknown accelerations, in addition to `late`
        since = self.old * (
            self.thrust_error * (3 * n**2 * (farthest + self.place) + 2 * n * drift)
            + self.uncertainty.acceleration
        )
        seen = self.seen + steep * self.place + since
        # m/s^2 at any speed: the part of f that thrust does not cancel, unknown accelerations, and the change of the
        # field along itself, which is along the radius
        always = (
            self.thrust_error * (3 * n**2 * farthest + 2 * n * drift)
            + 3 * n**2 * (self.place + drift * self.longest)
            + 2 * n * (1.0 + self.thrust_error) * seen / sees
            + self.uncertainty.acceleration
            + (self.tuning.steep + self.rising) * drift
        ) * (1.0 + n * self.longest)
        # s, the longest hold per share that it takes away
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
        """Returns the same set with the nearest distance from which on it is invariant."""
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
        """Returns a lower bound in m of free flight's clearance from the set at distances (k,), up to `gap` m apart.

        Free flight is (Phi_rr + s / r Phi_rv) p + Phi_rv w. The length of the first part is at least its least singular
        value times r. Between two of the times a flight is off its chord by its curvature.
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
        """Checks whether calm |w| stays calm at distances (k,), and `error_tube.Fall` holds down to it, (k,) bool."""
        calm = self.calm(r)
        # m, moved within a hold, and the error of position
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
    """Returns the angle in rad between the mean attitude over a hold and the attitude at its aim, both times in s.

    The body turns at most at `turning` rad/s, which changes at most by `faster` rad/s^2. The mean of the angle from the
    aim is the integral of rate (hold - s) after it, less the integral of rate s before it, divided by the hold. For a
    steady rate both parts compensate.
    """
    if hold <= aim:
        return turning * (aim - hold / 2)
    after, before = (hold - aim) ** 2 / 2, aim**2 / 2
    change = min(faster * max(hold - aim, aim) / 3, 2 * turning)
    kept = abs(after - before) * turning + min(after, before) * change + faster * aim**3 / 6
    return min(kept, (after + before) * turning) / hold


def law(x: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns G (3, B) in m/s^2 in Hill's frame, at measured states (16, B)."""
    off = x[V] - w.field(x[P])
    wanted = -off * (w.full / norm(off).clamp(min=1e-30)).clamp(max=1.0 / w.slow)
    return wanted - torch.stack(clohessy_wiltshire(x[P].unbind(), x[V].unbind(), w.c.mean_motion))


def thrust(x: Tensor, torque: Tensor, w: RobustTerminalSet) -> Tensor:
    """Returns the law as thrust (3, B) in N, in the body, at measured states (16, B), while torque (3, B) is held."""
    free = replace(w.c, saturate_rates=False)
    aimed = step(x, torch.cat((torch.zeros_like(torque), torque)), w.aim, free)
    limit = w.c.max_thrust
    return (w.c.mass * (rotation_matrix(aimed[Q]) * law(x, w)[:, None]).sum(0)).clamp(-limit, limit)

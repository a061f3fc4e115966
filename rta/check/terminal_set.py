"""The terminal set: backup trajectories end in it, and the laws never leave it. It is certified once per configuration.

Attitude: let a = d x s + sin(psi) d of `attitude_law.rest_deviation`, and w the body's rate relative to the Sun. A hold
takes (a, T w) to M (a, T w) plus an error, with z = kappa T and

    M = [1 - z / 2, -1/2; z, 0],        M' P M - P = -1,        V = (a, T w)' P (a, T w).

Where V <= R^2 the error is so small that V <= R^2 after the hold, too (`cone`). Motion: |v - v_ref(p)| <= CALM and
nearest <= |p| <= r_max. A hold leaves less than CALM (`TerminalSet.of`), and the field leads away from both ends.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from inspection.chief.hull import farthest
from inspection.model.attitude import dot, norm, rotation_matrix
from inspection.model.dynamics import energy_rate, most_gyroscopic, temperature_rate
from inspection.model.parameters import Limits
from inspection.model.state import OMEGA, E, P, Q, T, V
from rta.check.attitude_law import Pointing, rest_deviation
from rta.check.commit import NoCheckError
from rta.check.intersample_bounds import FreeFlight, least_stretch
from rta.check.motion_law import BESIDE, DRIFT, INSIDE, STEEP, Braking, field

CALM = 2e-3  # m/s
AROUND = 1.2  # factor of CALM between calls
WIDEST, PARTS = 0.1, 200  # largest R in rad, and how many equally spaced values up to it are tried
GRID = 4000, 100  # numbers of distances and times at which free flight is computed


@dataclass(frozen=True)
class TerminalSet:
    """Describes the set in which a backup trajectory ends.

    Attributes:
        quadratic: P, by its entries 11, 12 and 22; radius: R.
        hottest: deg C; emptiest: kJ; nearest, farthest: m from the chief.
    """

    c: Limits
    hold: float
    quadratic: tuple[float, float, float]
    radius: float
    hottest: float
    emptiest: float
    nearest: float
    farthest: float

    @property
    def leaves(self) -> float:
        """Returns the longest time in s that the field takes from contact with the chief to `nearest`."""
        return (self.nearest - self.c.least_distance) / (DRIFT - CALM)

    @classmethod
    @cache
    def of(cls, pointing: Pointing, braking: Braking) -> "TerminalSet":
        """Certifies the set; raises NoCheckError if that fails."""
        c, hold = pointing.c, pointing.hold
        if not (pointing.rate > 0.0 and 0.0 < pointing.kappa * hold < 1.0):
            raise NoCheckError("torque is too weak for the body's rates")
        if braking.straight * hold <= DRIFT + AROUND * CALM:
            raise NoCheckError("thrust is too weak")
        quadratic, contracts = lyapunov(pointing.kappa * hold)
        radius, far, rate = cone(pointing, quadratic, contracts)
        hottest, emptiest, _ = resources(far, c)
        if (left := leftover(braking, rate)) > CALM / 2:
            raise NoCheckError(f"a hold leaves {left:.2g} m/s")
        return cls(c, hold, quadratic, radius, hottest, emptiest, nearest(c), c.max_distance)

    def room(self, x: Tensor) -> Tensor:
        """Returns margins (5, ...) of cone, heat, charge, speed, place; all >= 0 where x (16, ...) is in the set."""
        axis, off, cosine = rest_deviation(x, self.c)
        turn = self.hold * (x[OMEGA] + self.c.mean_motion * rotation_matrix(x[Q])[2])
        d = -turn[0]  # of the panels' axis, -x
        one, mixed, two = self.quadratic
        v = one * (dot(axis, axis) + off**2) + 2 * mixed * (dot(axis, turn) + off * d) + two * dot(turn, turn)
        cone = torch.where(cosine > 0.0, self.radius**2 - v, -1.0)
        r = norm(x[P])
        return torch.stack(
            (
                cone,
                self.hottest - x[T],
                x[E] - self.emptiest,
                CALM - norm(x[V] - field(x[P], self.c)),
                torch.minimum(r - self.nearest, self.farthest - r),
            )
        )


def lyapunov(z: float) -> tuple[tuple[float, float, float], float]:
    """Returns P as in `TerminalSet`, and the largest factor of sqrt(V) in a hold."""
    m = torch.tensor([[1 - z / 2, -0.5], [z, 0.0]], dtype=torch.float64)
    kron = torch.kron(m.T, m.T) - torch.eye(4, dtype=torch.float64)
    p = torch.linalg.solve(kron, -torch.eye(2, dtype=torch.float64).flatten()).reshape(2, 2)
    return (p[0, 0].item(), p[0, 1].item(), p[1, 1].item()), math.sqrt(
        1 - 1 / torch.linalg.eigvalsh(p)[-1].item()
    )


def hold_error(w: Pointing, angle: float, rate: float) -> tuple[float, float, float]:
    """Returns bounds of the errors at a hold's end compared with M (a, T w), while |a| <= sin(angle) and |w| <= rate.

    They are errors of a, of T w, and in rad/s of w from effects that torque does not count on.

    In a hold a changes by -w, up to |w| g, because d x s changes by -w cos(delta) + s (d . w) and psi by -d . w, up to
    tan(delta / 2) |w|. At the hold's end w is kappa a, except for the body's roll, for gyroscopic accelerations, which
    change, and for the turn of n z.
    """
    c, t, n = w.c, w.hold, w.c.mean_motion
    spin, far = most_gyroscopic(c.inertia), angle + rate * t
    g = math.hypot(far + far**2 / 2, far**2 / 2 + math.tan(far / 2))
    otherwise = spin * 2 * (rate + n) * 2 * rate * t + n * rate * t + 1e-9
    of_w = t * (w.kappa**2 * t / 2 * angle**2 + otherwise)
    return t * rate * g + t * otherwise + of_w / 2, of_w, otherwise


def cone(w: Pointing, quadratic: tuple[float, float, float], contracts: float) -> tuple[float, float, float]:
    """Returns the largest R that the law does not leave, and the largest rad from rest and rad/s in it."""
    c, t, kappa = w.c, w.hold, w.kappa
    p = torch.tensor([[quadratic[0], quadratic[1]], [quadratic[1], quadratic[2]]], dtype=torch.float64)
    inverse, most = torch.linalg.inv(p), torch.linalg.eigvalsh(p)[-1].item()
    spin, n = most_gyroscopic(c.inertia), c.mean_motion
    for i in range(PARTS, 0, -1):
        radius = WIDEST * i / PARTS
        angle = math.asin(min(1.0, radius * math.sqrt(inverse[0, 0].item())))
        rate = 1.2 * max(radius * math.sqrt(inverse[1, 1].item()) / t, kappa * angle)
        far = angle + rate * t
        if far > 0.3:
            continue
        of_a, of_w, otherwise = hold_error(w, angle, rate)
        torque = max(c.inertia) * (2 * rate / t + spin * (rate + n) ** 2)
        kept = contracts * radius + math.sqrt(most) * math.hypot(of_w, of_a) <= radius
        kept &= (of_w / t + kappa * angle <= rate) and torque <= c.max_torque
        kept &= radius * math.sqrt(inverse[1, 1].item()) / t + otherwise <= rate
        kept &= math.pi - far >= c.field_of_view / 2 + c.exclusion_buffer
        kept &= kappa * math.sin(far) <= min(w.rate, w.roll) and math.cos(far) > 0.25
        if kept and rate + n <= c.max_rate and resources(far, c)[2]:
            return radius, far, rate
    raise NoCheckError("the attitude of rest")


def resources(far: float, c: Limits) -> tuple[float, float, bool]:
    """Returns the highest temperature in deg C and lowest energy in kJ that satisfy the limits `far` rad from rest.

    Also returns whether they then do so for good. The cooled axis is across d, so the Sun shines on it along
    sin(delta); the axis is delta and psi away from z.
    """
    aside = math.sqrt(2.0) * far
    hottest = c.max_temperature - c.temperature_sun_slope * far - c.temperature_earth_slope * aside
    sun, earth, facing = torch.tensor([math.sin(far), math.sin(aside), math.cos(far)], dtype=torch.float64)
    cools = temperature_rate(sun, earth, torch.full_like(sun, hottest), c) <= 0.0
    return hottest, c.min_energy + c.energy_sun_slope * far, bool(cools and energy_rate(facing, c) >= 0.0)


def leftover(w: Braking, rate: float) -> float:
    """Returns the largest |v - v_ref| in m/s that a hold in the set leaves; `rate` is the body's to the Sun in rad/s.

    It consists of the error of `thrust_along` in G, and of Simpson's rule, with an angular acceleration up to 2 w / T;
    of the change of f where turning thrust leads to another place; and of the change of the field on the path.
    """
    c, t, n = w.c, w.hold, w.c.mean_motion
    turned = (rate + n) * t
    mean_error = (turned**2 / 24 + 2 * turned / 24) ** 2 + (
        turned**4 + 12 * turned**3 + 12 * turned**2
    ) / 2880
    speed = DRIFT + AROUND * CALM
    acceleration = CALM / t + c.largest_drift(c.max_distance, speed)
    deviation = acceleration * turned * t / 8  # m/s, in the hold
    if deviation > (AROUND - 1.0) * CALM:
        raise NoCheckError("a hold strays too far")
    tide = 3 * n**2 * (acceleration * t**2 / 24 + deviation * t) + 2 * n * deviation
    steep = max(STEEP, DRIFT / (BESIDE * c.collision_radius))
    return acceleration * t * mean_error + tide * t + steep * speed * t


def nearest(c: Limits) -> float:
    """Returns the distance in m from the chief from which on velocities within CALM of v_ref satisfy all limits.

    Free flight is (Phi_rr + s / r Phi_rv) p + Phi_rv w with the field's speed s. The length of the first part is at
    least its least singular value times r.
    """
    count, moments = GRID
    beside, most, touching = BESIDE * c.collision_radius, AROUND * CALM, farthest(c)
    r = torch.linspace(c.collision_radius, c.max_distance, count, dtype=torch.float64)
    times = torch.linspace(0.0, c.passive_safety_horizon, moments + 1, dtype=torch.float64)
    along = torch.zeros(3, count, dtype=torch.float64)
    along[0] = r
    speed = field(along, c)[0]
    free = FreeFlight.of(c, 1, 0)
    clear = (least_stretch(speed / r, times, c.mean_motion) * r - free.velocity * times[:, None] * most).amin(
        0
    )
    gap = (r[1] - r[0]).item()
    bend = (free.bend_position * r + free.bend_velocity * (speed.abs() + most)) * times[1] ** 2 / 8
    # between two times the chord passes closer than both of its ends
    bend = bend + (times[1] * (3 * c.mean_motion * r + 2 * (speed.abs() + most))) ** 2 / (8 * r)
    lost = gap * (free.position + free.velocity * c.passive_safety_horizon * (2 * STEEP + DRIFT / beside))
    outwards = (2 * c.max_acceleration * (c.max_distance - r).clamp(min=0.0)).sqrt()
    inwards = (2 * c.max_acceleration * (r - c.collision_radius)).sqrt()
    limit = (c.docking_speed + c.speed_slope * r).clamp(max=c.max_speed)
    fine = (clear - bend - lost >= touching) & (limit >= speed.abs() + most)
    fine &= (outwards >= speed + most) & (inwards >= most - speed)
    height = c.least_distance * (r / touching - 1.0)  # smallest height above one of a hull's planes
    away = torch.where(speed > 0.0, speed * c.least_distance / touching, speed)
    fine &= (2 * c.max_acceleration * height.clamp(min=0.0)).sqrt() >= most - away
    bad = torch.nonzero(~fine[:-1]).flatten()
    first = int(bad.max()) + 1 if bad.numel() else 0
    if not (r[first] <= beside and beside + DRIFT / STEEP < c.max_distance - INSIDE - DRIFT / STEEP):
        raise NoCheckError("the zone is too small, or no rest beside the chief stays clear")
    return r[first].item()

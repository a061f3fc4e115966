"""The seven constraints that thrust enforces, each with all that the filter knows of it.

Each is a function of the task's constants and the filter's parameters to its entry. Its h is that of `rta.limits`, or
beside a hull one of its own; what is enforced in its place follows here. States have the component axis first; trailing
axes are independent spacecraft.
"""

import math
from functools import partial

import torch
from torch import Tensor

from inspection.chief.hull import planes_of
from inspection.model.attitude import dot, norm
from inspection.model.parameters import Limits
from inspection.model.state import P, V
from rta import limits
from rta.bounds.uncertainty import NO_UNCERTAINTY, Uncertainty
from rta.constraints.constraint import Constraint
from rta.constraints.passes import clearance_at, closest_passes
from rta.lie_derivatives import Function
from rta.limits import PARTS, radial_speed
from rta.parameters import RtaParameters

LEAST_BRAKING = (
    0.1  # share of a_max that is left for braking across; `rta.constraints.vehicle` refuses who would need it
)
# m/s, kept of the zone's barrier where thrusters may be dead: nothing checks how much a hold turns of what is left away
WEAK = 0.2


Entry = partial(Constraint, actuator="thrust", coupled=False)  # which no other actuator changes


def thrust_constraints(
    c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY
) -> tuple[Constraint, ...]:
    """All seven in the order of Table 3."""
    return (
        collision(c, r, uncertainty),
        dynamic_speed(c, r),
        keep_in_zone(c, r, uncertainty),
        passive_safety(c, r, uncertainty),
        *(velocity(i, c, r, uncertainty) for i in range(3)),
    )


def signed_sqrt(z: Tensor, floor: float) -> Tensor:
    """sign(z) sqrt(|z|), where |z| is below `floor` the chord through 0 (also for negative distances)."""
    return torch.where(z.abs() < floor, z / math.sqrt(floor), z.sign() * z.abs().clamp(min=floor).sqrt())


def root_above(z: Tensor, floor: float) -> Tensor:
    """sqrt(z) of z >= 0, below `floor` the tangent that starts there, which is nowhere below sqrt(z)."""
    return torch.where(z < floor, (z + floor) / (2 * math.sqrt(floor)), z.clamp(min=floor).sqrt())


def sqrt_floor(c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY) -> float:
    """The floor in m of the enforced `signed_sqrt`.

    The slope of sqrt(2 a z) is then at most sqrt(2 a / floor) = 1 / T, else it could overshoot while a control is held.
    """
    return max(r.distance_floor, 2 * uncertainty.max_acceleration(c, r) * uncertainty.hold(r) ** 2)


def thrust_acceleration(c: Limits) -> float:
    """The most that thrust along all three axes gives, in m/s^2."""
    return math.sqrt(3.0) * c.max_thrust / c.mass


def thrust_rotation_error(c: Limits, r: RtaParameters) -> float:
    """Returns the error in m/s^2 of the mean thrust of a period in a row, since thrust turns with the body.

    By alpha_max T^2 / 6 otherwise than the constant rates that `half_a_period_ahead` in `rta.barrier` takes
    into account, and by (omega T)^2 / 8 around the middle.
    """
    angular = math.sqrt(3.0) * c.max_torque / min(c.inertia)
    return thrust_acceleration(c) * (angular / 6 + c.max_rate**2 / 8) * r.period**2


def speed_curvature(c: Limits, r: RtaParameters) -> float:
    """a^2 T in m^2/s^3 for the largest acceleration a: in a period T, a changes v_i^2 by 2 a v_i T and a^2 T^2."""
    acceleration = thrust_acceleration(c) + (c.max_thrust / c.mass - c.max_acceleration)
    return acceleration**2 * r.period


def collision(c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY) -> Constraint:
    """Safe separation: from this speed braking still suffices.

    The barrier has the a_max of the worst case. Beside a hull h is the largest over planes n . p = b that touch it, of
    sqrt(2 a_max (n . p - b - r_d)) + n . v: one plane from which braking still suffices is enough. The barrier is that
    of the best plane now, and h in a period's end can only be more.
    """

    def beside_hull(x: Tensor) -> Tensor:
        planes = planes_of(c, x)
        height, speed = planes.above(x[P][:, None]), planes.along(x[V][:, None])
        return (limits.root(2 * c.max_acceleration * height) + speed).amax(0)

    def beside_planes(x: Tensor, which: Tensor | None = None) -> Tensor:
        """Of every plane, (planes, ...), or of `which` alone."""
        planes = planes_of(c, x) if which is None else planes_of(c, x).those(which)
        height, speed = planes.above(x[P][:, None]), planes.along(x[V][:, None])
        return math.sqrt(2 * least) * signed_sqrt(height, floor) + speed

    def beside_sphere(x: Tensor) -> Tensor:
        distance = norm(x[P]) - c.collision_radius
        return (math.sqrt(2 * least) * signed_sqrt(distance, floor) + radial_speed(x))[None]

    def barrier(x: Tensor) -> Function:
        if not c.planes:
            return beside_sphere
        best = beside_planes(x).argmax(0, keepdim=True)
        return lambda y: beside_planes(y, best)

    floor, least = sqrt_floor(c, r, uncertainty), uncertainty.max_acceleration(c, r)
    return Entry(
        "collision",
        beside_hull if c.planes else partial(limits.safe_separation, c=c),
        gains=(r.collision_gain,),
        margin=r.collision_margin,
        weight=math.inf,
        barrier=barrier,
        intersample_drop=thrust_rotation_error(c, r),
    )


def speed_limit(x: Tensor, c: Limits) -> Tensor:
    """nu_0 + nu_1 |p|, in m/s."""
    return c.docking_speed + c.speed_slope * norm(x[P])


def dynamic_speed(c: Limits, r: RtaParameters) -> Constraint:
    """The dynamic speed limit, which is h itself."""

    def drop(x: Tensor) -> Tensor:
        """|v| rises by a . v T / |v| and at most a^2 T^2 / (2 |v|), which counts near the limit, for |v| the limit."""
        limit = speed_limit(x, c)
        # at 5 and 10 s it would exceed what a spacecraft at rest can satisfy
        return (rotation + curvature / (2 * limit)).minimum(0.5 * r.gain(r.speed_gain) * limit)

    rotation, curvature = thrust_rotation_error(c, r), speed_curvature(c, r)
    return Entry(
        "dynamic_speed",
        partial(limits.dynamic_speed, c=c),
        gains=(r.speed_gain,),
        weight=r.slack_weight_motion,
        intersample_drop=drop,
    )


def keep_in_zone(c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY) -> Constraint:
    """The keep-in zone, held by a curve that thrust can follow."""

    def curve(x: Tensor) -> Tensor:
        """The zone as thrust can hold it, never above h, in m/s: with a_max - v_t^2 / |p|.

        d v_pr / dt holds the centrifugal v_t^2 / |p|, v_t the speed across p, which a_max leaves out: up to
        0.051 m/s^2 at the speed limit of 800 m, of a_max's 0.0705. Flying fast across where h is zero, 1 N does not
        keep h there; where this barrier is zero, 1 N inwards does, which every attitude can give.

        Outside it is -sqrt(2 a_max (|p| - r_max)) - v_pr: zero where the way back, slowed down by a_max, ends at r_max.
        The centrifugal acceleration helps to slow it down, so v_t must not enter: with a_max - v_t^2 / |p|, speed
        across would raise it. Instead of the root's chord, which would end above h, it has the tangent. So it falls at
        r_max, on the way out, by sqrt(a_max d / 2) with d for the floor. Here a_max is that of the worst case.
        """
        speed, distance = radial_speed(x), c.max_distance - norm(x[P])
        across = dot(x[V], x[V]) - speed**2
        braking = (least - across / norm(x[P])).clamp(min=LEAST_BRAKING * least)
        inside = (2 * braking).sqrt() * signed_sqrt(distance, floor)
        outside = -math.sqrt(2 * least) * root_above(-distance, floor)
        return torch.where(distance < 0.0, outside, inside) - speed

    # v_t^2 / |p| grows with thrust along v
    fastest = c.docking_speed + c.speed_slope * c.max_distance
    swing = fastest * thrust_acceleration(c) / c.max_distance * r.period
    floor, least = sqrt_floor(c, r, uncertainty), uncertainty.max_acceleration(c, r)
    return Entry(
        "keep_in_zone",
        partial(limits.keep_in_zone, c=c),
        gains=(r.keep_in_gain,),
        margin=r.keep_in_margin + (WEAK if uncertainty.health else 0.0),
        weight=r.slack_weight_critical,
        barrier=lambda x: lambda y: curve(y)[None],
        intersample_drop=thrust_rotation_error(c, r) + swing,
    )


def passive_safety(c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY) -> Constraint:
    """Passive safety; a row per time segment of the free flight.

    Beside a hull h is the height above the planes around it, see `passes_of_hull`. A control of a second turns a slow
    flight by much, from one corner of the hull to another. The row of the one, with n . dv t >= -alpha(h), lets the
    other lose as much times the ratio of their times, which segments that double bound.

    Raises:
        ValueError: the segments do not end with T_f.
    """
    if r.passive_safety_segments[-1] != c.passive_safety_horizon:
        raise ValueError(
            f"passive_safety_segments end at {r.passive_safety_segments[-1]} s: "
            f"must be the passive_safety_horizon, {c.passive_safety_horizon} s"
        )
    reported = tuple(c.passive_safety_horizon * i / PARTS for i in range(PARTS + 1))

    def beside_hull(x: Tensor) -> Tensor:
        return clearance_at(x, closest_passes(x, reported, c), c).amin(0)

    segments = r.passive_safety_segments
    if c.planes:
        segments = (0.0, *(segments[1] / k for k in (8, 4, 2)), *segments[1:])
    if uncertainty.needs_sampled_rows(r):  # whose end has a horizon of its own
        segments = (*segments[:-1], segments[-1] + uncertainty.hold(r))

    def barrier(x: Tensor, after: float) -> Function:
        passes = closest_passes(x, tuple(max(edge - after, 0.0) for edge in segments), c)
        return lambda y: clearance_at(y, passes, c)

    return Entry(
        "passive_safety",
        beside_hull if c.planes else partial(limits.passive_safety, c=c),
        gains=(r.passive_safety_gain,),
        margin=r.passive_safety_margin,
        weight=r.slack_weight_critical,
        barrier=barrier,
        looks_ahead=True,
        rows=len(segments) - 1,
        exact=not uncertainty.needs_sampled_rows(r),
        doubling=r.passive_safety_doubling,
    )


def velocity(axis: int, c: Limits, r: RtaParameters, uncertainty: Uncertainty = NO_UNCERTAINTY) -> Constraint:
    """The limit of the velocity along a Hill axis.

    Where a control is held, the margin is what a thruster can take off it in a hold, 2 v_max a T: a call in which the
    zone needs all thrust then costs margin, not the limit. Without, one in 400,000 random calls at 5 s broke it.
    """

    kept = (
        2 * c.max_speed * c.max_thrust / c.mass * uncertainty.hold(r)
        if uncertainty.needs_sampled_rows(r)
        else 0.0
    )
    return Entry(
        f"velocity_{'xyz'[axis]}",
        partial(limits.axial_velocity, c=c, axis=axis),
        gains=(r.velocity_gain,),
        margin=min(kept, c.max_speed**2 / 2),
        weight=r.slack_weight_motion,
        intersample_drop=speed_curvature(c, r) + 2 * c.max_speed * thrust_rotation_error(c, r),
    )

"""Thrusts that inspect a known case in a given time for little fuel, by gradients through the motion."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from inspection.chief.points import fibonacci_sphere, point_weights
from inspection.guidance import TILT, balanced, tilted
from inspection.model.attitude import cross, dot, norm, unit
from inspection.model.dynamics import sun_direction
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, P, V
from study.optimum.motion import Motion

STEPS = 500  # of Adam
RATE = 4e-5, 1e-6  # N, of Adam at first and at last
SOFT = 5.0, 0.3  # m, in which a point comes to be counted as inspected, at first and at last
SPARE = 0.5  # m above the horizon and its share below: what is asked for beyond the rules
SCORE_SPARE = 0.007
TURNED = 100.0  # s, until the camera is on the chief
TWILIGHT = 30.0  # m per cosine of the angle between the deputy and the Sun
NEAREST = 30.0  # m, from which on the camera, 18 deg off the chief at most, has all of it in view
CLEAR = 2.0  # m beyond the collision radius, of free flight
SLOWER = 0.03  # m/s below the speed limits
SAMPLES = 16  # times of free flight
MISSING, BROKEN = 100.0, 0.02  # prices in m/s, of the score, and of a limit's m or 100 * m/s in one knot


@dataclass
class Cases:
    """The cases of a search: states at the start, and what each knot may see.

    Attributes:
        start: (6, B); weights: (N, B); normals: (3, N); suns: (3, K, B), at the knots.
    """

    start: Tensor
    weights: Tensor
    normals: Tensor
    suns: Tensor

    @classmethod
    def of(cls, x: Tensor, priority: Tensor, knots: int, c: InspectionParameters) -> "Cases":
        normals = fibonacci_sphere(c.num_points)
        times = torch.arange(1, knots + 1, dtype=x.dtype) * c.action_period
        suns = sun_direction(x[THETA_S] - c.mean_motion * times[:, None])
        found = torch.cat((x[P], x[V])), point_weights(normals, priority), normals, suns
        return cls(*(each.float() for each in found))


def camera_axes(p: Tensor, sun: Tensor, c: InspectionParameters) -> tuple[Tensor, Tensor, Tensor]:
    """The body's axes in Hill's frame, (3, ...) each, as the guidance turns them while the battery is full.

    It is the guidance without its roll to the thrust.
    """
    outward = unit(p)
    angle = dot(outward, sun).clamp(-0.9999, 0.9999).arccos()
    x = tilted(outward, sun, (angle - balanced(c)).clamp(0.0, TILT))
    y = unit(sun - dot(sun, x) * x)
    return x, y, torch.stack(cross(x, y))


def missing(p: Tensor, cases: Cases, soft: float, c: InspectionParameters) -> Tensor:
    """(B,) of the wanted score, where a point counts more the better its best knot (K, 3, B) sees it.

    By the height above its horizon in m; not before the camera has been turned to the chief, and not from the dark,
    where the guidance's law turns it away.
    """
    lit = torch.einsum("in,ikb->nkb", cases.normals, cases.suns) > 0.0
    lit[:, : round(TURNED / c.action_period)] = False
    height = torch.einsum("in,kib->nkb", cases.normals, p) - c.chief_radius - SPARE
    height = torch.minimum(height, TWILIGHT * dot(unit(p.transpose(0, 1)), cases.suns))
    best = height.masked_fill(~lit, -1e3).amax(1)
    score = (cases.weights * torch.sigmoid(best / soft)).sum(0)
    return (c.success_score + SCORE_SPARE - score).clamp(min=0.0)


def broken(y: Tensor, c: InspectionParameters) -> Tensor:
    """(B,) by how much limits are broken at the knots (K, 6, B), in all: m, and 100 times m/s."""
    p, v = y[:, :3].transpose(0, 1), y[:, 3:].transpose(0, 1)
    distance = norm(p)
    near = (NEAREST - distance).clamp(min=0.0)
    far = (distance - c.max_distance + NEAREST).clamp(min=0.0)
    fast = (norm(v) + SLOWER - c.docking_speed - c.speed_slope * distance).clamp(min=0.0)
    axis = (v.abs().amax(0) + SLOWER - c.max_speed).clamp(min=0.0)
    times = torch.linspace(0.0, c.passive_safety_horizon, SAMPLES, dtype=y.dtype)
    coming = free_flight(p[:, None], v[:, None], times[:, None, None], c.mean_motion)
    pass_ = (c.collision_radius + CLEAR - norm(coming)).clamp(min=0.0).amax(0)
    return (near + far + 100.0 * (fast + axis) + pass_).sum(0) + drifting(y[-1], c)


def drifting(y: Tensor, c: InspectionParameters) -> Tensor:
    """(B,) m that free flight from (6, B) comes too near to the chief's track within an orbit, 10 times."""
    times = torch.linspace(0.0, 2 * math.pi / c.mean_motion, 4 * SAMPLES, dtype=y.dtype)
    x, _, z = free_flight(y[:3, None], y[3:, None], times[:, None], c.mean_motion)
    nearest = (x**2 + z**2 + 1e-6).sqrt().amin(0)
    return 10.0 * (c.collision_radius + CLEAR - nearest).clamp(min=0.0)


def spent(p: Tensor, thrust: Tensor, cases: Cases, c: InspectionParameters) -> Tensor:
    """(B,) m/s of delta v along the body's axes, at knots p (K, 3, B) and of thrusts (K, 3, B)."""
    axes = camera_axes(p.transpose(0, 1), cases.suns, c)
    force = thrust.transpose(0, 1)
    along = torch.stack([dot(axis, force) for axis in axes])
    return ((along**2 + 1e-10).sqrt() - 1e-5).sum((0, 1)) * (c.action_period / c.mass)


def cost(cases: Cases, thrust: Tensor, c: InspectionParameters, soft: float = 1.0) -> Tensor:
    """(B,) m/s of thrusts (K, 3, B) in N: what is spent, and the prices of what is missing or broken."""
    motion = Motion.of(len(thrust), c.action_period, c).to(torch.float32)
    return priced(motion, cases, thrust.float(), c, soft)


def priced(motion: Motion, cases: Cases, thrust: Tensor, c: InspectionParameters, soft: float) -> Tensor:
    """`cost` where the motion is known."""
    y = motion.states(cases.start, thrust)
    p = y[:, :3]
    return spent(p, thrust, cases, c) + MISSING * missing(p, cases, soft, c) + BROKEN * broken(y, c)


def searched(cases: Cases, thrust: Tensor, c: InspectionParameters, steps: int = STEPS) -> Tensor:
    """Thrusts (K, 3, B) in N after so many steps of Adam from the given ones; a case's do not depend on the others'."""
    motion = Motion.of(len(thrust), c.action_period, c).to(torch.float32)
    thrust = thrust.float().clone().requires_grad_()
    optimiser = torch.optim.Adam([thrust], lr=RATE[0], betas=(0.9, 0.99))
    for i in range(steps):
        share = i / steps
        optimiser.param_groups[0]["lr"] = between(RATE, share)
        optimiser.zero_grad()
        priced(motion, cases, thrust, c, between(SOFT, share)).sum().backward()
        optimiser.step()
        with torch.no_grad():
            # along any axis of the body still below the limit
            thrust.clamp_(-c.max_thrust / 2, c.max_thrust / 2)
    return thrust.detach().double()


def between(ends: tuple[float, float], share: float) -> float:
    """The number a share of the way from one end to the other, by ratios."""
    return ends[0] * (ends[1] / ends[0]) ** share

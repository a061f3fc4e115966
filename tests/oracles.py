"""What the tests of the filter are compared with: the paper by hand, differences of it, flights, programs solved.

`paper` and what it calls are written from the paper's equations with the paper's numbers, and most of it also takes
complex states, for derivatives by complex steps.
"""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import torch
from numpy import ndarray
from scipy.optimize import linprog, nnls
from scipy.sparse import block_diag
from scipy.stats import qmc
from torch import Tensor

from inspection.model.dynamics import Body, step
from inspection.model.parameters import InspectionParameters
from inspection.model.state import CONTROL_SIZE, SIZE
from rta.limits import PAPER
from study.verification.starts import states_of

# The paper's constraints

C = InspectionParameters()
MEAN_MOTION = 0.001027  # rad/s
# thrust less the tide at 800 m less Coriolis at 5 m/s, below the dynamic speed limit there (spec, decision 6)
A_MAX = 1 / 12 - 3 * MEAN_MOTION**2 * 800 - 2 * MEAN_MOTION * 5
PSM_TOLERANCE = 1e-4  # m; measured: at most 1e-5


def hamilton(a: ndarray, b: ndarray) -> ndarray:
    """Returns the Hamilton product of quaternions (4, B), scalar last."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3], axis=0)
    return np.concatenate((vector, (a[3] * b[3] - (a[:3] * b[:3]).sum(0))[None]))


def body_axis(q: ndarray, axis: int) -> ndarray:
    """Returns Hill-frame components (3, B) of a principal axis, H(H(q, n), q*)."""
    n = np.zeros_like(q)
    n[axis] = 1.0
    return hamilton(hamilton(q, n), np.concatenate((-q[:3], q[3:])))[:3]


def length(a: ndarray) -> ndarray:
    return np.sqrt((a * a).sum(0))


def positive(a: ndarray) -> ndarray:
    return np.where(a.real > 0, a, 0.0)


def root(z: ndarray) -> ndarray:
    """Returns sqrt(2 a_max z), continued oddly to negative distances."""
    return math.sqrt(2 * A_MAX) * np.sign(z) * np.sqrt(np.abs(z))


def cosines(x: ndarray, panel: float = -1.0) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Returns cosines of boresight and Sun, panel and Sun, the -n_y side and Sun, the -n_y side and Earth."""
    n_x, n_y = body_axis(x[6:10], 0), body_axis(x[6:10], 1)
    boresight = n_x[0] * np.cos(x[15]) + n_x[1] * np.sin(x[15])
    side = -n_y[0] * np.cos(x[15]) - n_y[1] * np.sin(x[15])
    return boresight, panel * boresight, side, n_y[0]


def orientation(x: ndarray, panel: float = -1.0) -> ndarray:
    """Returns attitude exclusion in rad, temperature in deg C and battery in kJ, (3, B)."""
    boresight, on_panel, side_sun, side_earth = cosines(x, panel)
    exclusion = np.arccos(boresight) - np.pi / 6 - np.pi / 18
    sun, earth = (positive(np.pi / 2 - np.arccos(cosine)) for cosine in (side_sun, side_earth))
    return np.stack(
        (exclusion, 10 - x[13] - 0.05 * sun - 0.01 * earth, x[14] - 1 - 0.05 * np.arccos(on_panel))
    )


def free_flight(p: ndarray, v: ndarray, t: ndarray, n: float) -> ndarray:
    """Returns Clohessy and Wiltshire's closed form, (3, ...)."""
    s, co = np.sin(n * t), np.cos(n * t)
    return np.stack(
        (
            (4 - 3 * co) * p[0] + s / n * v[0] + 2 / n * (1 - co) * v[1],
            6 * (s - n * t) * p[0] + p[1] - 2 / n * (1 - co) * v[0] + (4 * s - 3 * n * t) / n * v[1],
            p[2] * co + v[2] / n * s,
        )
    )


def speed_limit(x: ndarray) -> ndarray:
    return 0.2 + 7.5 * MEAN_MOTION * length(x[:3])


def passive_safety(x: ndarray, start: float = 0.0, end: float = 500.0) -> ndarray:
    """Returns inf |p(t)| - 15 m over [start, end] s, (B,): by dense samples, then denser ones about the best."""
    low, high = np.full(x.shape[1], start), np.full(x.shape[1], end)
    for count in (501, 41, 41, 41, 41, 41):
        t = np.linspace(low, high, count)
        distance = length(free_flight(x[:3], x[3:6], t, MEAN_MOTION))
        best = distance.argmin(0)
        low, high = (
            t[best + i, range(x.shape[1])]
            for i in (np.where(best > 0, -1, 0), np.where(best < count - 1, 1, 0))
        )
    return distance.min(0) - 15


def paper(x: ndarray) -> ndarray:
    """Returns all 13 constraints in the order of Table 3, (13, B)."""
    distance, speed = length(x[:3]), length(x[3:6])
    radial = (x[:3] * x[3:6]).sum(0) / distance
    return np.stack(
        (
            root(distance - 15) + radial,
            speed_limit(x) - speed,
            root(800 - distance) - radial,
            passive_safety(x),
            *(25 - x[3:6] ** 2),
            *orientation(x),
            *(np.radians(2) ** 2 - x[10:13] ** 2),
        )
    )


def states(count: int, seed: int = 0) -> ndarray:
    """Returns states (16, count) with every constraint on both sides of its limit."""
    rng = np.random.default_rng(seed)
    p, v = rng.standard_normal((2, 3, count))
    p *= rng.choice((5.0, 20.0, 100.0, 750.0), count) * rng.uniform(1, 1.2, count) / length(p)
    v *= rng.choice((0.0, 0.05, 0.5, 6.0), count) / length(v)
    q = rng.standard_normal((4, count))
    rest = rng.uniform(-0.05, 0.05, (3, count)), rng.uniform(9, 11, count), rng.uniform(0, 2, count)
    return np.vstack((p, v, q / length(q), *rest, rng.uniform(0, 2 * np.pi, count)))


def tensor(x: ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(x))


def at_the_edge(count: int, distance: float, within: float) -> ndarray:
    """Returns states (16, count) whose distance from the chief differs from the given one by at most `within`."""
    x = states(count, seed=8)
    x[:3] *= (distance + np.linspace(-within, within, count)) / length(x[:3])
    return x


# Rows by central differences along an independent f and g


def panel(c: InspectionParameters) -> float:
    return -1.0 if c.solar_panel_axis == "-x" else 1.0


def drift(x: ndarray, c: InspectionParameters) -> ndarray:
    """Returns the paper's f(x), (16, B)."""
    n, (q1, q2, q3, q4), (w1, w2, w3), (j1, j2, j3) = MEAN_MOTION, x[6:10], x[10:13], c.inertia
    _, on_panel, sun, earth = cosines(x, panel(c))
    view = 0.8 * positive(earth)
    solar, albedo = 0.13 * 0.03 * 1367 * positive(sun), 0.13 * 0.03 * 1367 * 0.27 * view
    infrared, rejected = 5.67051e-8 * 0.06 * 0.03 * np.stack((view * 255.0**4, (x[13] + 273.15) ** 4))
    rates = (
        *x[3:6],
        3 * n**2 * x[0] + 2 * n * x[4],
        -2 * n * x[3],
        -(n**2) * x[2],
        (q4 * w1 - q3 * w2 + q2 * w3) / 2,
        (q3 * w1 + q4 * w2 - q1 * w3) / 2,
        (-q2 * w1 + q1 * w2 + q4 * w3) / 2,
        (-q1 * w1 - q2 * w2 - q3 * w3) / 2,
        (j2 - j3) * w2 * w3 / j1,
        (j3 - j1) * w1 * w3 / j2,
        (j1 - j2) * w1 * w2 / j3,
        (solar + albedo + infrared - rejected) / (2 * 900),
        (983.3 * 0.77 * 0.03 * positive(on_panel) - 15) / 1000,
        np.full(x.shape[1], -n),
    )
    return np.stack(rates)


def push(x: ndarray, axis: int) -> ndarray:
    """g's column of the thrust along a body axis, (16, B)."""
    out = np.zeros_like(x)
    out[3:6] = body_axis(x[6:10], axis) / 12
    return out


def turn(x: ndarray, axis: int, c: InspectionParameters) -> ndarray:
    """g's column of the torque about a body axis, (16, B)."""
    out = np.zeros_like(x)
    out[10 + axis] = 1 / c.inertia[axis]
    return out


def slope(h: Callable[[ndarray], ndarray], x: ndarray, direction: ndarray, step: float) -> ndarray:
    """Returns central difference of h along a direction."""
    return (h(x + step * direction) - h(x - step * direction)) / (2 * step)


def flying(count: int = 100) -> ndarray:
    """Returns states (16, count) in flight, clear of the constraints' kinks and of free falls into the centre."""
    rng = np.random.default_rng(1)
    p, v, q = rng.standard_normal((3, 4, 10 * count))
    p, v = (a[:3] / length(a[:3]) for a in (p, v))
    p *= rng.choice((20.0, 60.0, 300.0, 750.0), 10 * count) * rng.uniform(1, 1.06, 10 * count)
    v *= rng.choice((0.1, 0.5, 5.0), 10 * count)
    rest = (
        rng.uniform(-0.035, 0.035, (3, 10 * count)),
        rng.uniform((3, 1, 0), (11, 7, 6.28), (10 * count, 3)).T,
    )
    x = np.vstack((p, v, q / length(q), *rest))
    angle = np.abs(cosines(x))
    clear = (angle > 0.02).all(0) & (angle < 0.97).all(0) & (passive_safety(x) > -13)
    return x[:, clear][:, :count]


IN_FLIGHT = flying()
# Measured on these states: 4e-8 everywhere but for passive safety, whose time of the closest pass is
# refined to some ms: 6e-3 m/s per N of at most 41, and 3e-4 m/s along f of at most 6.
TOLERANCE = 1e-7


def near(actual: Tensor, expected: ndarray, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(actual.numpy(), expected, rtol=0, atol=tolerance)


# Limits of any vehicle, and flights of its plant

AXES = {"x": 0, "y": 1, "z": 2}


def hypercube(count: int, seed: int, c: InspectionParameters) -> Tensor:
    """Returns states (16, count) all over the limits and around them."""
    sampler = qmc.LatinHypercube(17, rng=np.random.default_rng(seed))
    return states_of(torch.from_numpy(sampler.random(count).T.copy()), c)[0]


def heights(p: ndarray, c: InspectionParameters) -> ndarray:
    """Returns m beyond the sphere, or beyond each plane of the hull, with the deputy touching it: (planes, ...)."""
    if not c.planes:
        return (length(p) - c.collision_radius)[None]
    planes = np.array(c.planes)
    return planes[:, :3] @ p - planes[:, 3:] - c.deputy_radius


def free_clearance(p: ndarray, v: ndarray, c: InspectionParameters, spacing: float = 2.0) -> ndarray:
    """Returns m beyond the chief in free flight, by a grid of times: never below the infimum."""
    nearest = np.full(p.shape[1:], np.inf)
    for t in np.arange(0.0, c.passive_safety_horizon + 1e-9, spacing):
        nearest = np.minimum(nearest, heights(free_flight(p, v, t, c.mean_motion), c).max(0))
    return nearest


def motion(p: ndarray, v: ndarray, c: InspectionParameters, spacing: float | None = 2.0) -> ndarray:
    """Returns the paper's 7 limits of motion, velocity as v_max - |v_i|; no spacing: passive safety is infinite."""
    n, fastest = c.mean_motion, min(c.max_speed, c.docking_speed + c.speed_slope * c.max_distance)
    a_max = c.max_thrust / c.mass - 3 * n**2 * c.max_distance - 2 * n * fastest
    distance, speed = length(p), length(v)
    radial = (p * v).sum(0) / distance
    outwards = np.array(c.planes)[:, :3] @ v if c.planes else radial

    def root(z: ndarray) -> ndarray:
        return np.sign(z) * np.sqrt(2 * a_max * np.abs(z))

    free = np.full_like(speed, np.inf) if spacing is None else free_clearance(p, v, c, spacing)
    return np.stack(
        (
            (root(heights(p, c)) + outwards).max(0),
            c.docking_speed + c.speed_slope * distance - speed,
            root(c.max_distance - distance) - radial,
            free,
            *(c.max_speed - np.abs(v)),
        )
    )


def attitude(x: ndarray, c: InspectionParameters) -> ndarray:
    """Returns exclusion in rad, temperature in deg C, battery in kJ, and the remaining margin of the rates in rad/s."""
    sun = np.stack((np.cos(x[15]), np.sin(x[15]), np.zeros_like(x[15])))
    earth = np.zeros_like(sun)
    earth[0] = -1.0

    def angle(axis: str, direction: ndarray) -> ndarray:
        n = body_axis(x[6:10], AXES[axis[1]]) * (-1.0 if axis[0] == "-" else 1.0)
        return np.arccos(np.clip((n * direction).sum(0), -1.0, 1.0))

    heated, facing = (np.maximum(np.pi / 2 - angle(c.thermal_axis, r), 0.0) for r in (sun, earth))
    return np.stack(
        (
            angle("+x", sun) - c.field_of_view / 2 - c.exclusion_buffer,
            c.max_temperature - x[13] - c.temperature_sun_slope * heated - c.temperature_earth_slope * facing,
            x[14] - c.min_energy - c.energy_sun_slope * angle(c.solar_panel_axis, sun),
            c.max_rate - np.abs(x[10:13]).max(0),
        )
    )


@functools.cache
def stepping(seconds: float, c: InspectionParameters, turns: bool | None) -> Callable[..., list[Tensor]]:
    """Returns `step`, in C if kernels are here, with `turns` of bodies: mass, moments and push, (7, B).

    turns: in a frame that turns, or not.
    """

    def stepped(x: Tensor, u: Tensor, *bodies: Tensor) -> list[Tensor]:
        if turns is None:
            return [step(x, u, seconds, c)]
        mass, inertia, push = bodies[0].split((1, 3, 3))
        return [step(x, u, seconds, c, Body(mass[0], list(inertia), list(push), turns, saturates=False))]

    if not find_spec("kernels"):  # a wing
        return stepped
    from kernels.compiled import Compiled

    sizes = SIZE, CONTROL_SIZE, *([] if turns is None else [7])
    return Compiled(stepped, *(torch.ones(size, 1, dtype=torch.float64) for size in sizes))


def moved(x: Tensor, u: Tensor, seconds: float, c: InspectionParameters, body: Body | None = None) -> Tensor:
    """Returns the states (16, B) after controls (6, B) have acted for some s; body: one without saturated rates."""
    if body is None:
        return stepping(seconds, c, None)(x, u)[0]
    assert not body.saturates
    own = torch.stack((body.mass, *body.inertia, *body.push))
    return stepping(seconds, c, body.in_turning_frame)(x, u, own)[0]


# Quadratic programs

INF = np.inf


@dataclass(frozen=True)
class Programs:
    """Holds N programs of three controls: desired (N, 3), a (N, R, 3), b (N, R), slack weight (N, R), 0: must hold."""

    desired: ndarray
    a: ndarray
    b: ndarray
    weight: ndarray

    def tensors(self) -> list[Tensor]:
        """Returns the tensors with the batch last, as `rta.fast.active_set.solve` takes them."""
        parts = self.desired, self.a, self.b, self.weight
        return [torch.tensor(x).movedim(0, -1).contiguous() for x in parts]

    def of(self, chosen: ndarray) -> "Programs":
        """Returns some of the programs."""
        return Programs(*(part[chosen] for part in vars(self).values()))


def lhs(u: ndarray, a: ndarray, b: ndarray) -> ndarray:
    """Returns a u + b of one program or of N."""
    return (a @ u[..., None])[..., 0] + b


def projection(programs: Programs) -> ndarray:
    """Returns the nearest feasible points (N, 3), by trying every set of up to three active rows and bounds."""
    count = len(programs.desired)
    box = np.concatenate((np.eye(3), -np.eye(3)))[None].repeat(count, 0)
    a = np.concatenate((programs.a, box), 1)
    b = np.concatenate((programs.b, np.ones((count, 6))), 1)
    best, nearest = np.full(count, np.inf), np.full((count, 3), np.nan)
    for size in range(4):
        for active in itertools.combinations(range(a.shape[1]), size):
            normals, short = a[:, active], lhs(programs.desired, a[:, active], b[:, active])
            gram = normals @ normals.transpose(0, 2, 1)
            independent = np.abs(np.linalg.det(gram)) > 1e-12
            gram[~independent] = np.eye(size)
            shift = np.linalg.solve(gram, short[..., None])
            u = programs.desired - (normals.transpose(0, 2, 1) @ shift)[..., 0]
            distance = ((u - programs.desired) ** 2).sum(1)
            better = independent & (distance < best) & (lhs(u, a, b) >= -1e-10).all(1)
            best[better], nearest[better] = distance[better], u[better]
    return nearest


def by_nnls(a: ndarray, b: ndarray, desired: ndarray, weight: ndarray) -> ndarray:
    """Returns the control (n,) of one program with slack, by Lawson and Hanson's non-negative least squares.

    With z = (u, sqrt(weight) delta) the program is the point closest to (desired, 0) with G z >= h: the dual of its
    least-distance form (Lawson and Hanson 1974, ch. 23). Controls are in units of limits; an infinite weight (R,) is
    of a row that must hold.
    """
    soft = np.isfinite(weight)
    relief, eye = np.eye(len(b))[:, soft] / np.sqrt(weight[soft]), np.eye(len(desired))
    bounds = np.hstack((np.vstack((eye, -eye)), np.zeros((2 * len(desired), soft.sum()))))
    g, start = np.vstack((np.hstack((a, relief)), bounds)), np.append(desired, np.zeros(soft.sum()))
    h = np.append(-b, -np.ones(2 * len(desired))) - g @ start
    length = np.sqrt((g**2).sum(1))
    g, h = g[length > 0.0] / length[length > 0.0, None], h[length > 0.0] / length[length > 0.0]
    scale = max(1.0, np.abs(h).max())
    e, f = np.vstack((g.T, h / scale)), np.append(np.zeros(len(start)), 1.0)
    r = e @ nnls(e, f, maxiter=10_000)[0] - f
    return (start - scale * r[:-1] / r[-1])[: len(desired)]


PAPERS_WEIGHTS = np.array([limit.weight or INF for limit in PAPER.values()])


def feasible(a: ndarray, b: ndarray) -> ndarray:
    """Tells where (N,) a control in the box satisfies a u + b >= 0, (N, R, 3) and (N, R), by linear programming.

    One program for all: the sum of the largest t <= 1 with a u + b >= t.
    """
    count = len(b)
    rows = block_diag(np.concatenate((-a, np.ones((*b.shape, 1))), 2), format="csr")
    tallest = linprog(
        np.tile([0, 0, 0, -1], count), rows, b.ravel(), bounds=([(-1, 1)] * 3 + [(None, 1)]) * count
    )
    return tallest.x[3::4] >= 0.0


def given_slack(programs: Programs) -> ndarray:
    """Returns slack weights (N, R), infinite for rows that must hold: all rows, if all can hold at once."""
    can = feasible(programs.a, programs.b)[:, None]
    return np.where(can | (programs.weight == 0.0), INF, programs.weight)


def with_slack(programs: Programs, given: ndarray | None = None) -> ndarray:
    """Returns the reference's controls (N, 3), with `given_slack` unless that is known."""
    given = given_slack(programs) if given is None else given
    parts = zip(programs.a, programs.b, programs.desired, given, strict=True)
    return np.array([by_nnls(*program) for program in parts])


# The paper's barriers


def last_psi(x: ndarray) -> ndarray:
    """Returns Psi_0 of relative degree one and Psi_1 = dh/dt + k_1 h of degree two, by complex steps, (13, B)."""
    psi = paper(x)
    k = np.array([[limit.gains[0]] for limit in PAPER.values()])[7:10]
    along = orientation(x + 1e-30j * drift(x, C), panel(C)).imag / 1e-30
    psi[7:10] = along + k * orientation(x, panel(C))
    return psi

"""Proves a lower bound of the fuel with which a case can be inspected in a given time.

A mixed-integer linear program of which every flight that inspects the wanted weight by then gives a feasible point that
costs no more than the flight (experiments/learning_log.md has the lemmas by these names):

- *length*: the body's axes are orthogonal, so |F|_1 along them is at least the length of F, whatever the attitude, and
  that is at least its component in any direction.
- *impulses*: what an acceleration does to a position is linear, by a kernel N(t - s) that is smooth but for a kink at
  s = t. Shared between two nodes by hat functions it does the same but for the kernel's error of interpolation.
- *windows*: what a look between two times sees is above a horizon that is lowered by the path's error of
  interpolation at one of the two times. A point may be lit at any look of a window that touches that time.
- *the rest*: camera, attitude, all limits and what moves the deputy otherwise than the model are left out.
- *reach*: who spends at most U has |n . p| within bounds, which are the program's big numbers; who spends more spends
  more than U, and the bound is at most U.

The dual bound is what is certified, also where the search ends at its time limit.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import block_array, coo_array, diags_array
from torch import Tensor

from inspection.chief.points import fibonacci_sphere, point_weights
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from inspection.model.state import THETA_S, P, V

WINDOWS = 6  # of the flight, between the times at which a point may have been inspected
NODES = 2  # of the impulses, in a window
DIRECTIONS = 20  # whose components stand for the length of an impulse
FIRST, STEP = 0.05, 1.3  # m/s, of `climbed`: the first rung, and each next one's ratio to the one before
TOLERANCE = 0.01  # m of the horizon, and more than 1e-6, the solver's, of the largest big number


class Task(NamedTuple):
    """What is to be inspected, from where.

    Attributes:
        start: (6,) p and v in m and m/s in Hill's frame; sun: rad; normals: (3, N); weights: (N,).
        wanted: the weight; radius: of the chief in m; rate: the mean motion in rad/s; look: s between looks.
    """

    start: Tensor
    sun: float
    normals: Tensor
    weights: Tensor
    wanted: float
    radius: float
    rate: float
    look: float

    @classmethod
    def of(cls, x: Tensor, priority: Tensor, c: InspectionParameters) -> "Task":
        """Returns a case of the study, from a state (16,) and a priority vector (3,)."""
        normals = fibonacci_sphere(c.num_points)
        weights = point_weights(normals, priority[:, None])[:, 0]
        start, sun = torch.cat((x[P], x[V])), x[THETA_S].item()
        constants = c.success_score, c.chief_radius, c.mean_motion, c.action_period
        return cls(start, sun, normals, weights, *constants)

    def lit(self, times: Tensor) -> Tensor:
        """Returns whether a point is lit, (N, times) bool."""
        angle = self.sun - self.rate * times
        return self.normals.T @ torch.stack((angle.cos(), angle.sin(), 0 * angle)) > 0.0

    def undisturbed(self, times: Tensor) -> Tensor:
        """Returns the height n . p of free flight, (N, times) m."""
        return self.normals.T @ free_flight(self.start[:3, None], self.start[3:, None], times, self.rate)


def kernel(t: Tensor, n: float) -> Tensor:
    """Returns N(t) (..., 3, 3) in s, the position after t s (...) by a velocity of now; 0 where t < 0."""
    flights = [
        free_flight(torch.zeros(3, *t.shape, dtype=t.dtype), velocity.view(3, *[1] * t.dim()), t, n)
        for velocity in torch.eye(3, dtype=t.dtype)
    ]
    return torch.where((t > 0.0)[..., None, None], torch.stack(flights, -1).movedim(0, -2), 0.0)


def steepest(duration: float, n: float) -> float:
    """Bounds |N'(t)| for 0 <= t <= duration: |N'| <= 1 + 2 n t + 6 (n t)^2, by |cos| <= 1, |sin a| <= a."""
    return 1.0 + 2.0 * n * duration + 6.0 * (n * duration) ** 2


def bend(n: float) -> float:
    """Bounds |N''(t)| in 1/s for any t: of n [[-s, 2 c], [-2 c, -4 s]] the largest singular value is 4 n, at c = 0.

    The squared singular values are n^2 times those of [[4 - 3 s^2, -6 s c], [-6 s c, 4 + 12 s^2]], whose trace is
    8 + 9 s^2 and determinant 16: the larger grows with s^2, to 16.
    """
    return 4.0 * n


class Horizons(NamedTuple):
    """For every pair of a point and a time at which it may have been inspected: a . u + e . g >= lowest, with all that.

    Attributes:
        point: (pairs,); height: (pairs, nodes, 3) s, a; error: (pairs, nodes) s, e; lowest: (pairs,) m.
    """

    point: Tensor
    height: Tensor
    error: Tensor
    lowest: Tensor


def horizons(task: Task, duration: float, window: float, node: float) -> Horizons:
    """Returns the half-spaces that a flight of so many s meets where it sees a point, by the lemmas of the module."""
    n = task.rate
    ends = torch.arange(round(duration / window) + 1, dtype=torch.float64) * window
    nodes = torch.arange(round(duration / node) + 1, dtype=torch.float64) * node
    smooth = bend(n) * node**2 / 8.0  # of interpolating between nodes
    count = task.weights.numel()
    zeros = torch.zeros(count, len(nodes), dtype=torch.float64)
    nothing = torch.zeros(count, dtype=torch.bool), zeros[:, 0], zeros
    windows: list[tuple[Tensor, ...]] = [nothing]  # who is lit, how far paths and replies leave their chords
    for begin in ends[:-1]:
        looks = begin + torch.arange(round(window / task.look) + 1, dtype=torch.float64) * task.look
        share = ((looks - begin) / window)[:, None]
        path = task.undisturbed(looks)
        chord = path[:, :1] * (1 - share.T) + path[:, -1:] * share.T
        reply = kernel(looks[:, None] - nodes, n)  # (looks, nodes, 3, 3)
        strays = reply - (1 - share)[..., None, None] * reply[:1] - share[..., None, None] * reply[-1:]
        error = torch.einsum("ip,ljiq->pljq", task.normals, strays).norm(dim=-1).amax(1)  # (N, nodes)
        inside = (nodes > begin - node) & (nodes < begin + window + node)
        error = error + 2.0 * smooth + torch.where(inside, node / 4.0 * steepest(node, n), 0.0)
        windows.append((task.lit(looks).any(1), (path - chord).amax(1).clamp(min=0.0), error))
    windows.append(nothing)
    found = []
    for end, before, after in zip(ends, windows, windows[1:], strict=False):
        (point,) = torch.nonzero(before[0] | after[0], as_tuple=True)
        height = torch.einsum("ip,jiq->pjq", task.normals[:, point], kernel(end - nodes, n))
        error = torch.maximum(before[2], after[2])[point] + smooth
        free = task.undisturbed(end[None])[point, 0]
        lowest = task.radius - TOLERANCE - torch.maximum(before[1], after[1])[point] - free
        found.append((point, height, error, lowest))
    return Horizons(*(torch.cat(parts) for parts in zip(*found, strict=True)))


class Bound(NamedTuple):
    """A lower bound of the fuel, what the program's best solution costs (inf: none found), m/s; whether it ended."""

    fuel: float
    solution: float
    finished: bool


def lower_bound(task: Task, duration: float, most: float, seconds: float, windows: int = WINDOWS) -> Bound:
    """Bounds the least fuel in m/s of any flight that inspects the wanted weight within a duration in s.

    Args:
        most: U, m/s, beyond which nothing is claimed: where the program has no solution, U is the bound.
        seconds: after which the search ends.
        windows: into which the duration is divided, each of whole looks: what is bounded may take a little longer.
    """
    window = math.ceil(duration / windows / task.look - 1e-9) * task.look
    duration, node = windows * window, window / NODES
    sees = horizons(task, duration, window, node)
    reach = most * sees.height.norm(dim=-1).amax(1)
    possible = reach + most * sees.error.amax(1) >= sees.lowest
    sees = Horizons(*(part[possible] for part in sees))
    large = (sees.lowest + reach[possible]).clamp(min=0.0).numpy()
    pairs, nodes, count = sees.point.numel(), sees.error.shape[1], task.weights.numel()
    at_points = coo_array((np.ones(pairs), (sees.point.numpy(), np.arange(pairs))), shape=(count, pairs))
    directions, each_node = fibonacci_sphere(DIRECTIONS).T.numpy(), np.eye(nodes)
    # variables: u (nodes, 3), g (nodes,), z (pairs,), y (points,)
    rows = [
        [sees.height.flatten(1).numpy(), sees.error.numpy(), diags_array(-large), None],  # seen where z = 1
        [None, None, at_points, -np.eye(count)],  # y only where some z = 1
        [None, None, None, task.weights.numpy()[None]],  # the wanted weight
        [
            np.kron(-each_node, directions),
            np.kron(each_node, np.ones((DIRECTIONS, 1))),
            None,
            None,
        ],  # |u| <= g
        [None, -np.ones((1, nodes)), None, None],  # U
    ]
    wanted = [task.wanted - 1e-9]
    lowest = sees.lowest.numpy() - large, np.zeros(count), wanted, np.zeros(nodes * DIRECTIONS), [-most]
    sizes = np.array([3 * nodes, nodes, pairs, count])
    dense = [[None if part is None else coo_array(part) for part in row] for row in rows]
    result = milp(
        np.repeat([0.0, 1.0, 0.0, 0.0], sizes),
        constraints=LinearConstraint(block_array(dense, format="csr"), np.concatenate(lowest), np.inf),
        bounds=Bounds(np.repeat([-most, 0.0, 0.0, 0.0], sizes), np.repeat([most, most, 1.0, 1.0], sizes)),
        integrality=np.repeat([0, 0, 1, 0], sizes),
        options={"time_limit": seconds},
    )
    if result.status == 2:  # infeasible: nobody does it for U
        return Bound(most, np.inf, True)
    dual = getattr(result, "mip_dual_bound", None)
    found = np.inf if result.fun is None else float(result.fun)
    return Bound(min(most, max(0.0, dual or 0.0)), found, result.status == 0)


def climbed(task: Task, duration: float, known: float, seconds: float, most: float) -> float:
    """Proves a lower bound in m/s from rung to rung: that a flight needs more than U, for one U after the other.

    Small U make small big numbers, so that each proof is quick where a single program with a large U ends nowhere.

    Args:
        known: a bound that is known, m/s; most: where there is no use to go on, such as a flight that is known.
        seconds: for each rung.
    """
    bound, rung = known, max(FIRST, known * STEP)
    while bound < most:
        found = lower_bound(task, duration, min(rung, most), seconds)
        bound = max(bound, found.fuel)
        if not np.isinf(found.solution) or not found.finished:
            break
        rung *= STEP
    return bound

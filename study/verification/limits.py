"""States next to the limits of the filter's safe set, one or two limits at a time.

A state is drawn in four steps:

1. States come from a Latin hypercube all over the safe set (`study.verification.starts.states_of`); states outside the
   safe set are rejected.
2. Half of the states are moved next to one limit, half next to two, chosen by the weights AIMED. For each constraint
   either h or Psi (Psi_1 for relative degree two) is to be small: a gap is drawn log-uniformly from GAP, in units of
   `gap_units`.
3. One component, such as distance, speed or attitude, is moved towards an end beyond the limit, and bisected until the
   gap is left. The component is drawn from WAYS. With two limits, the first one is approached again if the move to the
   second led away from it.
4. A state counts if an episode may start there (`SafetyFilter.is_safe`), every enforced barrier is still non-negative,
   and the barriers that were to be small are at most the largest gap. So pairs of limits that are rarely met together
   have few states, and pairs that cannot be met together have none.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.stats import qmc
from torch import Tensor

from inspection.chief.hull import reach
from inspection.model.attitude import cross, dot, norm, rotated_by, unit
from inspection.model.dynamics import sun_and_earth_in_body
from inspection.model.parameters import AXES, Limits
from inspection.model.state import OMEGA, SIZE, THETA_S, E, P, Q, T, V
from rta.filter import SafetyFilter
from rta.lie_derivatives import Function
from rta.names import CONSTRAINTS
from study.verification.starts import NUMBERS, spawned, states_of

GAP = 1e-6, 1e-1  # smallest and largest
BISECTIONS = 2, 2, 20  # of a component's way; after each, states that must violate a limit are rejected
DRAWING = 3 * sum(BISECTIONS)  # about the number of evaluations of the barriers for a batch
CANDIDATES = 15  # in a hypercube, for each wanted state: usually enough
HYPERCUBES = 100  # most that are drawn before giving up
LIMITS = len(CONSTRAINTS)
PAIRS = tuple(itertools.combinations(range(LIMITS), 2))

# moves beyond each constraint, by the keys of `ends`; for constraints that are not here (your own) all moves are tried
WAYS = {
    "collision": ("nearer",),
    "dynamic_speed": ("faster",),
    "keep_in_zone": ("farther", "outwards"),
    "passive_safety": ("nearer", "inwards"),
    "velocity_x": ("velocity_x",),
    "velocity_y": ("velocity_y",),
    "velocity_z": ("velocity_z",),
    "attitude_exclusion": ("camera_lit", "sunlit", "rate_y", "rate_z"),
    "temperature": ("hotter", "surface_lit"),
    "battery": ("emptier", "panels_dark"),
    "angular_velocity_x": ("rate_x",),
    "angular_velocity_y": ("rate_y",),
    "angular_velocity_z": ("rate_z",),
}

# relative frequency of each limit; a pair has the product
AIMED = dict.fromkeys(CONSTRAINTS, 1.0) | {
    "collision": 3.0,
    "keep_in_zone": 2.0,
    "velocity_x": 4.0,
    "velocity_y": 4.0,
    "velocity_z": 4.0,
    "attitude_exclusion": 4.0,
    "temperature": 2.0,
    "battery": 2.0,
}


@dataclass(frozen=True)
class NearLimits:
    """Holds states next to limits, or on their way there; last axis the states.

    Attributes:
        state: (16, B).
        limits: (2, B) indices of the two constraints, twice the same for a single one.
        targets: (2, B) rows of `barriers`; gaps: (2, B) the least values to leave for them.
        column: (B,) numbers of the states in the order of drawing.
    """

    state: Tensor
    limits: Tensor
    targets: Tensor
    gaps: Tensor
    column: Tensor

    def __getitem__(self, columns: Tensor) -> "NearLimits":
        return NearLimits(*(part[..., columns] for part in vars(self).values()))


def together(parts: list[NearLimits]) -> NearLimits:
    """Joins the states of the parts."""
    fields = zip(*(vars(part).values() for part in parts), strict=True)
    return NearLimits(*(torch.cat(each, -1) for each in fields))


def barriers(x: Tensor, safety_filter: SafetyFilter) -> Tensor:
    """Returns the values that must not be negative at states (16, B): every h, then every Psi (2 * constraints, B)."""
    if not x.shape[1]:
        return x.new_zeros(2 * LIMITS, 0)
    _, _, psi, h = safety_filter.program.evaluated(x)
    return torch.cat((h, psi))


def gap_units(safety_filter: SafetyFilter) -> list[float]:
    """Returns for each of `barriers` the unit of its gap: that of h, and for a Psi_1 k1 times that of its h."""
    c = safety_filter.c
    own = {name: c.max_speed**2 for name in CONSTRAINTS if name.startswith("velocity")}
    own |= {name: c.max_rate**2 for name in CONSTRAINTS if name.startswith("angular")}
    own |= {"passive_safety": 10.0}  # m; else 1 m/s, rad, deg C, kJ
    h = [own.get(name, 1.0) for name in CONSTRAINTS]
    gains = [limit.gains[0] if len(limit.gains) == 2 else 1.0 for limit in safety_filter.limits.values()]
    return [*h, *(gain * scale for gain, scale in zip(gains, h, strict=True))]


def ends(x: Tensor, generator: torch.Generator, c: Limits) -> dict[str, Tensor]:
    """Returns the ends of the moves of states x (16, B), beyond a limit: states (16, B) by the name of the move."""
    fastest = 1.1 * (c.docking_speed + c.speed_slope * c.max_distance)
    outwards, sun = unit(x[P]), sun_and_earth_in_body(x)[0]
    nearest = reach(outwards, c)
    there = (c.docking_speed + c.speed_slope * nearest) / (c.docking_speed + c.speed_slope * norm(x[P]))
    number = torch.rand(7, x.shape[1], generator=generator, dtype=torch.float64).to(x)
    side = 1.1 * (2.0 * number[:6].round() - 1.0)

    def but(component: slice | int, value: Tensor | float, of: Tensor = x) -> Tensor:
        other = of.clone()
        other[component] = value
        return other

    def pointing(axis: str, direction: Tensor) -> Tensor:
        """Returns the attitude after the shortest turn of a body axis to a direction in the body frame."""
        index, sign = AXES[axis]
        body = torch.zeros_like(direction)
        body[index] = sign
        return rotated_by(
            x[Q], unit(torch.stack(cross(body, direction))) * dot(body, direction).clamp(-1, 1).arccos()
        )

    return {
        "nearer": but(V, there * x[V], but(P, nearest * outwards)),  # same share of the allowed speed
        "farther": but(P, c.max_distance * outwards),
        "inwards": but(V, -fastest * outwards),
        "outwards": but(V, fastest * outwards),
        "faster": but(V, fastest * unit(x[V])),
        **{f"velocity_{axis}": but(V.start + i, c.max_speed * side[i]) for i, axis in enumerate("xyz")},
        "camera_lit": but(Q, pointing("+x", sun)),
        "surface_lit": but(Q, pointing(c.thermal_axis, sun)),
        "panels_dark": but(Q, pointing(c.solar_panel_axis, -sun)),
        **{f"rate_{axis}": but(OMEGA.start + i, c.max_rate * side[3 + i]) for i, axis in enumerate("xyz")},
        "hotter": but(T, c.max_temperature + 1.0),
        "emptier": but(E, c.min_energy - 1.0),
        "sunlit": but(THETA_S, 2 * torch.pi * number[6]),
    }


def between(x: Tensor, end: Tensor, share: Tensor) -> Tensor:
    """Returns states (16, B) a share (B,) of the way from x to the end; attitudes turn about one axis."""
    y = x + share * (end - x)
    return torch.cat((y[: Q.start], unit(y[Q]), y[Q.stop :]))


def approach(
    near: NearLimits, which: int, generator: torch.Generator, barriers_at: Function, c: Limits
) -> NearLimits:
    """Moves states next to the first or second of their limits; states that do not get there are rejected."""
    x, target, gap = near.state, near.targets[which], near.gaps[which]
    every = ends(x, generator, c)
    names = list(every)
    moves = [WAYS.get(name, tuple(names)) for name in CONSTRAINTS]
    most = max(map(len, moves))
    ways = x.new_tensor([[names.index(way[i * len(way) // most]) for i in range(most)] for way in moves])
    choice = (torch.rand(x.shape[1], generator=generator, dtype=torch.float64).to(x) * most).long()
    move = ways[near.limits[which], choice].long()
    end = torch.stack(list(every.values())).gather(0, move.expand(1, SIZE, -1))[0]

    def above(y: Tensor) -> Tensor:
        return barriers_at(y).gather(0, target[None])[0] >= gap

    left = torch.nonzero(above(x) & ~above(end)).flatten()
    low, high = torch.zeros_like(gap), torch.ones_like(gap)
    for steps in BISECTIONS:
        near, x, end = near[left], x[:, left], end[:, left]
        target, gap, low, high = (part[left] for part in (target, gap, low, high))
        for _ in range(steps):
            middle = (low + high) / 2
            before = above(between(x, end, middle))
            low, high = torch.where(before, middle, low), torch.where(before, high, middle)
        values = [barriers_at(between(x, end, share)) for share in (low, high)]
        left = torch.nonzero(safe(values[0].maximum(values[1]))).flatten()
    return replace(near, state=between(x, end, low))[left]


@torch.no_grad()
def near_limits(
    count: int, seed: int, safety_filter: SafetyFilter, barriers_at: Function, device: torch.device | str
) -> NearLimits:
    """Draws states next to limits as the module's docstring says; `barriers_at` is `barriers` of the filter.

    Raises:
        RuntimeError: fewer were found in HYPERCUBES hypercubes.
    """
    of_hypercube, of_moves = spawned(seed, 2)
    sampler = qmc.LatinHypercube(NUMBERS, rng=np.random.default_rng(of_hypercube))
    generator = torch.Generator().manual_seed(of_moves)
    scale = torch.tensor(gap_units(safety_filter), dtype=torch.float64, device=device)
    c, found, have = safety_filter.c, [], 0
    for _ in range(HYPERCUBES):
        x, _ = states_of(torch.from_numpy(sampler.random(CANDIDATES * count).T.copy()), c)
        x = x.to(device)
        x = x[:, safe(barriers_at(x))]
        near = aimed(x, scale, generator)
        near = approach(near, 0, generator, barriers_at, c)
        pair = near.limits[0] != near.limits[1]
        both = approach(near[pair], 1, generator, barriers_at, c)
        away = barriers_at(both.state).gather(0, both.targets[:1])[0] > GAP[1] * scale[both.targets[0]]
        near = together([near[~pair], both[~away], approach(both[away], 0, generator, barriers_at, c)])
        values = barriers_at(near.state)
        counts = safe(values) & safety_filter.is_safe(near.state)
        counts &= (values.gather(0, near.targets) <= GAP[1] * scale[near.targets]).all(0)
        found.append(near[torch.nonzero(counts).flatten()])
        found[-1] = found[-1][found[-1].column.argsort()]
        have += found[-1].column.numel()
        if have >= count:
            return together(found)[torch.arange(count, device=device)]
    raise RuntimeError(f"only {have} of {count} states found next to the limits")


def safe(values: Tensor) -> Tensor:
    """Tells where all of `barriers` are non-negative, (B,) bool."""
    return (values >= 0.0).all(0)


def aimed(x: Tensor, scale: Tensor, generator: torch.Generator) -> NearLimits:
    """Draws for states x (16, B) the limits that they are to be moved next to."""
    number = torch.rand(6, x.shape[1], generator=generator, dtype=torch.float64).to(x)
    weight = torch.tensor(list(AIMED.values()), dtype=torch.float64)
    pairs = torch.tensor(PAIRS)
    single = number[0] < 0.5
    limits = torch.where(
        single, drawn(weight, number[1]), pairs.T.to(x.device)[:, drawn(weight[pairs].prod(1), number[1])]
    )
    targets = limits + LIMITS * (number[2:4] < 0.5).long()
    targets[1] = torch.where(single, targets[0], targets[1])
    low, high = np.log(GAP)
    gaps = scale[targets] * (low + (high - low) * number[4:6]).exp()
    return NearLimits(x, limits, targets, gaps, torch.arange(x.shape[1], device=x.device))


def drawn(weight: Tensor, number: Tensor) -> Tensor:
    """Draws indices (B,) by weights (k,) from numbers (B,) in [0, 1)."""
    share = weight.cumsum(0).to(number)
    return torch.searchsorted(share, number * share[-1], right=True).clamp(max=len(weight) - 1)

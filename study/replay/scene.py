"""What a replay shows: runs of `simulate`, read, checked and turned into what `replay.js` draws."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from inspection.chief.points import fibonacci_sphere
from inspection.chief.surface import Surface, hidden, hiding
from inspection.model import attitude
from inspection.model.dynamics import sun_direction
from inspection.model.parameters import InspectionParameters
from rta.constraints.names import CONSTRAINTS
from study import config as configuration
from study.errors import InputError
from study.files import load_arrays
from study.flight.figures import BLUE, GREY, ORANGE, Episode, rotate, speeds

MAX_ROWS = 5000  # of a run in the page
RIM = 24  # corners of the cone's rim
DIGITS, TIME_DIGITS = 4, 8  # significant ones of the page's numbers
Line = dict[str, Any]
Panel = dict[str, Any]

# shape of a row of every array of numbers that is needed
COLUMNS: dict[str, tuple[int, ...]] = {
    "time": (),
    "position": (3,),
    "velocity": (3,),
    "quaternion": (4,),
    "temperature": (),
    "energy": (),
    "sun_angle": (),
    "control_desired": (6,),
    "control_applied": (6,),
    "inspected_score": (),
    **{f"h_{name}": () for name in CONSTRAINTS},
}

# Shapes of what a chief has that is not the paper's: its attitude a row, points and normals a point, triangles a face
CHIEF: dict[str, tuple[int, ...]] = {
    "chief_attitude": (4,),
    "chief_points": (3,),
    "chief_normals": (3,),
    "chief_triangles": (3, 3),
}

ROUNDING = 1e-9  # of whatever unit: less of a difference is not drawn
RISE = 0.01  # of the chief's radius, by which a mesh's points are drawn above it
AXIS = 0.12  # of what is flown through, the length of the body's axes

# panels of the constraints: title, unit, factor from the file's unit, constraints, the control that acts on them
SQUARE_DEGREES = math.degrees(1.0) ** 2
CONSTRAINT_PANELS = (
    ("Safe separation", "m/s", 1.0, ("collision",), "thrust"),
    ("Dynamic speed", "m/s", 1.0, ("dynamic_speed",), "thrust"),
    ("Keep-in zone", "m/s", 1.0, ("keep_in_zone",), "thrust"),
    ("Passive safety", "m", 1.0, ("passive_safety",), "thrust"),
    ("Velocity", "m²/s²", 1.0, tuple(f"velocity_{axis}" for axis in "xyz"), "thrust"),
    ("Sun exclusion", "deg", math.degrees(1.0), ("attitude_exclusion",), "torque"),
    ("Temperature", "°C", 1.0, ("temperature",), "torque"),
    ("Battery", "kJ", 1.0, ("battery",), "torque"),
    ("Body rates", "deg²/s²", SQUARE_DEGREES, tuple(f"angular_velocity_{axis}" for axis in "xyz"), "torque"),
)


@dataclass(frozen=True)
class Replayed:
    """A file of `simulate`: its name as it is shown, its arrays over time and the task's parameters.

    At most `rows` of them are shown.
    """

    name: str
    episode: Episode
    c: InspectionParameters
    rows: int = MAX_ROWS

    @property
    def stride(self) -> int:
        """Rows of the file to a row of the page."""
        return -(-len(self.episode["time"]) // self.rows)


def read(path: str, rows: int = MAX_ROWS) -> Replayed:
    """Reads and checks a file of `simulate`, or an episode of a study's report in single precision."""
    names = (*COLUMNS, "inspected", "intervened", "parameters")
    older = ": not a file that simulate wrote, or one of an older version"
    episode = load_arrays(path, names, "run", older, maybe=tuple(CHIEF))
    c = configuration.from_toml(str(episode["parameters"]), f"{path}: parameters").inspection
    of_chief = {name: row for name, row in CHIEF.items() if "chief_points" in episode}
    points = len(episode["chief_points"]) if of_chief else c.num_points
    flags = {"inspected": (points,), "intervened": (2,)}
    length = episode["time"].size
    for name, row in (COLUMNS | flags | of_chief).items():
        if name not in episode:
            raise InputError(f"{path}: {name} is missing{older}")
        array, kind = episode[name], "bool" if name in flags else "numbers"
        many = {"chief_points": points, "chief_normals": points, "chief_triangles": len(array)}.get(
            name, length
        )
        if array.shape != (many, *row) or array.dtype.kind != ("b" if name in flags else "f"):
            raise InputError(f"{path}: {name} is {array.dtype} {array.shape}: must be {kind} {(many, *row)}")
        if not np.isfinite(array).all():
            raise InputError(f"{path}: {name} must hold finite numbers only")
    if length < 2 or not (np.diff(episode["time"]) > 0.0).all():
        raise InputError(f"{path}: time must rise over at least two rows")
    double = {name: episode[name].astype(np.float64) for name in (*COLUMNS, *of_chief)}
    return Replayed(Path(printable(path)).name, episode | double, c, rows)


def printable(path: str) -> str:
    """A path with a replacement character for each byte that is not UTF-8, which no page and no terminal takes."""
    return os.fsencode(path).decode("utf-8", errors="replace")


def thinned(run: Replayed) -> Episode:
    """At most `run.rows` rows: each the first of its block, but with the block's smallest h."""
    starts = np.arange(0, len(run.episode["time"]), run.stride)
    thin: Episode = {}
    for name in COLUMNS:
        values = run.episode[name]
        thin[name] = np.minimum.reduceat(values, starts) if name.startswith("h_") else values[starts]
    if "chief_attitude" in run.episode:
        thin["chief_attitude"] = run.episode["chief_attitude"][starts]
    return thin


def axes(quaternion: np.ndarray) -> np.ndarray:
    """A body's three axes in Hill's frame, (rows, 3 axes, 3), of attitudes (rows, 4)."""
    return np.stack([rotate(quaternion, axis) for axis in np.eye(3)], 1)


def chief(run: Replayed, episode: Episode) -> dict[str, Any]:
    """Points and normals (N, 3) of the chief, the corners of its faces, as indices, and its axes where it has any."""
    if "chief_points" not in run.episode:
        normals = fibonacci_sphere(run.c.num_points).numpy().T
        return {
            "points": run.c.chief_radius * normals,
            "normals": normals,
            "corners": None,
            "chief_axes": None,
            "shaded": None,
        }
    triangles = run.episode["chief_triangles"]
    return {
        # drawn a little above the faces, which would hide some of them
        "points": run.episode["chief_points"] + RISE * run.c.chief_radius * run.episode["chief_normals"],
        "normals": run.episode["chief_normals"],
        "corners": triangles.reshape(-1, 3) if len(triangles) else None,
        "chief_axes": axes(episode["chief_attitude"]),
        "shaded": shaded(run, episode) if len(triangles) else None,
    }


def shaded(run: Replayed, episode: Episode) -> list[list[int]]:
    """Of each row, the points that the mesh keeps in the dark."""
    points, normals, triangles = (
        torch.as_tensor(run.episode[f"chief_{name}"]) for name in ("points", "normals", "triangles")
    )
    sun = sun_direction(torch.as_tensor(episode["sun_angle"]))
    to_chief = attitude.conjugate(torch.as_tensor(episode["chief_attitude"]).T)
    sun = attitude.rotate(to_chief, sun)
    planes = hiding(Surface(points.T, normals.T, torch.ones(len(points)), triangles))
    dark = torch.stack([hidden(each, sun) for each in planes])
    return [row.nonzero().flatten().tolist() for row in dark.T]


def interventions(episode: Episode, program: int) -> list[list[float]]:
    """The intervals [start, end] in s of rows in which the filter's program, 0 for thrust, 1 for torque, corrected."""
    intervened = episode["intervened"][:-1, program]  # a row reports until the next
    edges = np.flatnonzero(np.diff(intervened, prepend=False, append=False))
    return rounded(episode["time"][edges].reshape(-1, 2), TIME_DIGITS)


def inspection_times(episode: Episode) -> list[float | None]:
    """When each point was inspected in s, None if it never was."""
    inspected = episode["inspected"]
    first = rounded(episode["time"][inspected.argmax(0)], TIME_DIGITS)
    return [t if ever else None for t, ever in zip(first, inspected.max(0).tolist(), strict=True)]


def cone_rim(c: InspectionParameters) -> np.ndarray:
    """Unit vectors (RIM, 3) in the body frame along the edge of the camera's field of view about +x."""
    half, turn = c.field_of_view / 2, np.linspace(0.0, 2 * np.pi, RIM, endpoint=False)
    across = math.sin(half) * np.stack((np.cos(turn), np.sin(turn)), 1)
    return np.column_stack((np.full(RIM, math.cos(half)), across))


def rounded(values: np.ndarray, digits: int = DIGITS) -> Any:
    """Nested lists of numbers with so many significant digits, which keeps the page small."""
    if values.ndim > 1:
        return [rounded(row, digits) for row in values]
    return [float(f"{value:.{digits}g}") for value in values.tolist()]


def line(
    values: np.ndarray, name: str = "", colour: str = BLUE, width: float = 1.4, held: bool = False
) -> Line:
    """A quantity, which is held until the next row or changes evenly until then."""
    return {"name": name, "colour": colour, "width": width, "held": held, "values": values}


def panel(
    title: str,
    unit: str,
    lines: list[Line],
    acts: str | None = None,
    safe: tuple[float | None, float | None] = (None, None),
) -> Panel:
    """A plot over time.

    Args:
        acts: the control that changes it, thrust or torque, whose interventions are marked in it.
        safe: lowest and highest safe value, None where there is no limit.
    """
    return {"title": title, "unit": unit, "lines": lines, "acts": acts, "safe": safe}


def panels(episode: Episode, c: InspectionParameters) -> dict[str, list[Panel]]:
    """Everything that is drawn over time, by section."""
    energy, temperature, weight = (
        [line(episode[name])] for name in ("energy", "temperature", "inspected_score")
    )
    return {
        "Control, body frame": control_panels(episode),
        "Battery, temperature and inspection": [
            panel("Energy", "kJ", energy, "torque", (c.min_energy, None)),
            panel("Temperature", "°C", temperature, "torque", (None, c.max_temperature)),
            panel("Inspected weight", "", weight),
        ],
        "Constraints, safe where h ≥ 0": [
            panel(title, unit, constraint_lines(episode, names, factor), acts, (0.0, None))
            for title, unit, factor, names, acts in CONSTRAINT_PANELS
        ],
    }


def control_panels(episode: Episode) -> list[Panel]:
    """Desired and applied thrust and torque, an axis each."""
    found = []
    for acts, first, factor, unit in (("thrust", 0, 1.0, "N"), ("torque", 3, 1e3, "mN m")):
        for i, axis in enumerate("xyz", start=first):
            # the applied control lies on top, and hides the desired one where they are equal
            lines = [
                line(factor * episode[f"control_{name}"][:, i], name, colour, width, held=True)
                for name, colour, width in (("desired", GREY, 2.5), ("applied", BLUE, 1.2))
            ]
            found.append(panel(f"{acts.capitalize()} {axis}", unit, lines, acts))
    return found


def constraint_lines(episode: Episode, names: Sequence[str], factor: float) -> list[Line]:
    """The values of one constraint, or of the three axes of one."""
    axes = [name[-1] for name in names] if len(names) > 1 else [""]
    return [
        line(factor * episode[f"h_{name}"], axis, colour)
        for name, axis, colour in zip(names, axes, (BLUE, ORANGE, "#000000"), strict=False)
    ]


def common_range(same: Sequence[Panel]) -> np.ndarray:
    """Ends of the vertical axis of the same panel in every run: all values, all limits, and some room."""
    values = [one["values"] for each in same for one in each["lines"]]
    limits = [limit for each in same for limit in each["safe"] if limit is not None]
    shown = np.concatenate((*values, limits))
    room = 0.08 * np.ptp(shown) if np.ptp(shown) > ROUNDING else 1.0
    return np.array([shown.min() - 2.0 * room, shown.max() + room])  # the strip of interventions is below


def run_data(run: Replayed, episode: Episode) -> dict[str, Any]:
    """What the page knows of a run, thinned to `episode`, beside its panels.

    Arrays are (rows, ...), times in s, places in m.
    """
    c = run.c
    return {
        "name": run.name,
        "time": rounded(episode["time"], TIME_DIGITS),
        "end": rounded(run.episode["time"][-1:], TIME_DIGITS)[0],
        "position": episode["position"],
        "axes": axes(episode["quaternion"]),
        "sun_angle": episode["sun_angle"],
        "speed": speeds(episode),
        **chief(run, episode),
        "chief_radius": c.chief_radius,
        "inspected": inspection_times(run.episode),
        "rim": cone_rim(c),
        "interventions": {
            control: interventions(run.episode, program)
            for program, control in enumerate(("thrust", "torque"))
        },
    }


def box(runs: Sequence[Replayed]) -> dict[str, Any]:
    """The scenes, which have one scale: [low, high] of each of Hill's axes and the lengths of what is drawn, in m.

    `aspect`, `centre`, the chief's place, and `reach`, the farthest from there, are in the units of plotly's camera;
    `dot` is a point's size in px on a large screen.
    """
    positions = np.concatenate([run.episode["position"] for run in runs])
    radius = max(run.c.chief_radius for run in runs)
    size = max(np.ptp(positions, axis=0).max(), 4.0 * radius)
    direction = max(2.5 * radius, 0.3 * size)  # to the Sun and the Earth
    inside = np.array([direction, direction, 1.5 * radius])
    low = np.minimum(positions.min(0), -inside) - AXIS * size
    high = np.maximum(positions.max(0), inside) + AXIS * size
    unit = np.prod(high - low) ** (1 / 3)
    return {
        "ranges": np.stack((low, high), 1),
        "lengths": {"axis": AXIS * size, "cone": 0.25 * size, "direction": direction},
        "aspect": (high - low) / unit,
        "centre": -(low + high) / 2 / unit,
        "reach": np.linalg.norm(positions, axis=1).max() / unit,
        "dot": min(4.0, max(1.5, 48.0 * radius / size)),
    }


def content(runs: Sequence[Replayed]) -> dict[str, Any]:
    """Everything that `replay.js` shows."""
    episodes = [thinned(run) for run in runs]
    of_runs = [panels(episode, run.c) for run, episode in zip(runs, episodes, strict=True)]
    sections = {
        title: [
            {"range": common_range(same), "runs": same}
            for same in zip(*(sections[title] for sections in of_runs), strict=True)
        ]
        for title in of_runs[0]
    }
    return {
        "runs": [run_data(run, episode) for run, episode in zip(runs, episodes, strict=True)],
        "sections": sections,
        **box(runs),
        "step": runs[0].c.action_period,
    }

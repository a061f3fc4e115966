"""What a replay shows: runs of `simulate`, read, checked and turned into what `replay.js` draws."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull

from inspection.chief.points import fibonacci_sphere
from inspection.chief.surface import Surface, hidden, hiding
from inspection.model import attitude
from inspection.model.dynamics import sun_direction
from inspection.model.orbit import coast
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, THETA_S, P, V
from rta.constraints.names import CONSTRAINTS
from settings import InputError, from_toml
from study.config import Config
from study.files import load_arrays
from study.flight.figures import Episode, effort, speeds
from study.pages import scene

MAX_ROWS = 5000  # of a run in the page
MAX_AHEAD = 400  # rows of a run from which the page knows where free flight leads
AHEAD = 25  # places of such a flight
LARGEST = 1e12  # of any number, whose square is finite in single precision, too
DIGITS, PLACE_DIGITS, TIME_DIGITS = 4, 6, 8  # significant ones of the page's numbers
FIRST, SECOND, THIRD, WANTED = "first", "second", "third", "wanted"  # colours of lines, see `replay.css`
FLIGHT = "Flight"  # the section whose numbers stand beside the scene, too
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

HULL = "clearance"  # the array in m that is there where the chief's hull is what to stay clear of

ROUNDING = 1e-9  # of whatever unit: less of a difference is not drawn
RISE = 0.01  # of the chief's radius, by which a mesh's points are drawn above it
WITHIN = 0.97  # of the way to the points, the corners of the body that is drawn where there are points alone

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
    episode = load_arrays(path, names, "run", older, maybe=(*CHIEF, HULL))
    c = from_toml(str(episode["parameters"]), f"{path}: parameters", Config()).inspection
    of_chief = {name: row for name, row in CHIEF.items() if "chief_points" in episode}
    of_chief |= {HULL: ()} if HULL in episode else {}
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
        if not np.isfinite(array).all() or (array.dtype.kind == "f" and (np.abs(array) > LARGEST).any()):
            raise InputError(f"{path}: {name} must hold finite numbers only, up to {LARGEST:g}")
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
    if HULL in run.episode:
        thin[HULL] = np.minimum.reduceat(run.episode[HULL], starts)
    if "chief_attitude" in run.episode:
        thin["chief_attitude"] = run.episode["chief_attitude"][starts]
    thin["delta_v"] = effort(run.episode, run.c)[0][starts]
    return thin


def chief(run: Replayed, episode: Episode) -> dict[str, Any]:
    """Points and normals (N, 3) of the chief, corners of its faces and of its hull's, (3 F, 3), and its attitudes.

    What it does not have, or what is not to be drawn, is None.
    """
    if "chief_points" not in run.episode:
        normals = fibonacci_sphere(run.c.num_points).numpy().T
        return {
            "points": run.c.chief_radius * normals,
            "normals": normals,
            **dict.fromkeys(("triangles", "hull", "chief", "shaded")),
        }
    points, normals = run.episode["chief_points"], run.episode["chief_normals"]
    triangles = run.episode["chief_triangles"].reshape(-1, 3)
    corners = triangles if len(triangles) else points
    return {
        # drawn a little above the faces, which would hide some of them
        "points": points + RISE * run.c.chief_radius * normals,
        "normals": normals,
        "triangles": triangles if len(triangles) else WITHIN * hull(points),
        "hull": hull(corners) if HULL in run.episode else None,
        "chief": rounded(episode["chief_attitude"], PLACE_DIGITS),
        "shaded": shaded(run, episode) if len(triangles) else None,
    }


def hull(corners: np.ndarray) -> np.ndarray:
    """Corners (3 F, 3) of the faces of the convex hull of corners (k, 3), or none where all are in a plane."""
    if len(corners) < 4 or np.linalg.matrix_rank(corners - corners[0], tol=ROUNDING) < 3:
        return np.zeros((0, 3))
    return corners[ConvexHull(corners).simplices].reshape(-1, 3)


def ahead(episode: Episode, c: InspectionParameters) -> np.ndarray:
    """Where free flight leads within the horizon of passive safety: from rows evenly apart, (rows, AHEAD, 3) in m."""
    rows = np.arange(0, len(episode["time"]), -(-len(episode["time"]) // MAX_AHEAD))
    x = torch.zeros(SIZE, len(rows), dtype=torch.float64)
    x[P], x[V] = (torch.as_tensor(episode[name][rows]).T for name in ("position", "velocity"))
    x[THETA_S] = torch.as_tensor(episode["sun_angle"][rows])
    times = torch.linspace(0.0, c.passive_safety_horizon, AHEAD, dtype=torch.float64)
    return coast(x[:, None], times[:, None], c).permute(2, 1, 0).numpy()


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


def rounded(values: np.ndarray, digits: int = DIGITS) -> Any:
    """Nested lists of numbers with so many significant digits, which keeps the page small."""
    if values.ndim > 1:
        return [rounded(row, digits) for row in values]
    return [float(f"{value:.{digits}g}") for value in values.tolist()]


def line(
    values: np.ndarray, name: str = "", colour: str = FIRST, width: float = 1.4, held: bool = False
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
    energy, temperature, weight, spent = (
        [line(episode[name])] for name in ("energy", "temperature", "inspected_score", "delta_v")
    )
    distance, clear = (
        [line(np.linalg.norm(episode["position"], axis=1))],
        (c.collision_radius, c.max_distance),
    )
    of_clearance = (
        [panel("Clearance", "m", [line(episode[HULL])], "thrust", (0.0, None))] if HULL in episode else []
    )
    return {
        FLIGHT: [
            panel("Distance", "m", distance, "thrust", (None, c.max_distance) if of_clearance else clear),
            *of_clearance,
            panel("Speed", "m/s", [line(speeds(episode))], "thrust"),
            panel("Inspected weight", "", weight),
            panel("Delta v", "m/s", spent, "thrust"),
        ],
        "Control, body frame": control_panels(episode),
        "Battery and temperature": [
            panel("Energy", "kJ", energy, "torque", (c.min_energy, None)),
            panel("Temperature", "°C", temperature, "torque", (None, c.max_temperature)),
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
                for name, colour, width in (("desired", WANTED, 2.5), ("applied", FIRST, 1.2))
            ]
            found.append(panel(f"{acts.capitalize()} {axis}", unit, lines, acts))
    return found


def constraint_lines(episode: Episode, names: Sequence[str], factor: float) -> list[Line]:
    """The values of one constraint, or of the three axes of one."""
    axes = [name[-1] for name in names] if len(names) > 1 else [""]
    return [
        line(factor * episode[f"h_{name}"], axis, colour)
        for name, axis, colour in zip(names, axes, (FIRST, SECOND, THIRD), strict=False)
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
        "position": rounded(episode["position"], PLACE_DIGITS),
        "quaternion": rounded(episode["quaternion"], PLACE_DIGITS),
        "sun_angle": episode["sun_angle"],
        "desired": episode["control_desired"][:, :3],
        "control": episode["control_applied"][:, :3],
        "ahead": ahead(episode, c),
        **scene.task(c),
        **chief(run, episode),
        "inspected": inspection_times(run.episode),
        "interventions": {
            control: interventions(run.episode, program)
            for program, control in enumerate(("thrust", "torque"))
        },
    }


def content(runs: Sequence[Replayed]) -> dict[str, Any]:
    """Everything that `replay.js` shows."""
    episodes = [thinned(run) for run in runs]
    if any(HULL in episode for episode in episodes):  # all have the same panels
        for run, episode in zip(runs, episodes, strict=True):
            of_sphere = np.linalg.norm(episode["position"], axis=1) - run.c.collision_radius
            episode.setdefault(HULL, of_sphere)
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
        "beside": FLIGHT,
        "step": runs[0].c.action_period,
    }

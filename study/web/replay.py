"""The replay of one or two runs of `simulate`: a self-contained page with scenes and plots on a common clock.

Its text is in `replay.html.j2`, its code in `replay.js`; `scene.js` draws, as in `play`.
"""

import math
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
from inspection.model.orbit import free_flight
from inspection.model.parameters import InspectionParameters
from rta.names import CONSTRAINTS
from settings import InputError
from study.config import Config, recorded
from study.errors import as_input_error
from study.files import load_arrays, write_text
from study.flight.figures import Episode, effort, speeds
from study.web.template import drawn, embedded, render

MAX_ROWS = 5000  # of a run in the page
MAX_AHEAD = 400  # rows of a run for which the page has the free flight
AHEAD = 25  # points of a free flight
LARGEST = 1e12  # of any number; its square is finite in single precision
DIGITS, PLACE_DIGITS, TIME_DIGITS = 4, 6, 8  # significant digits of the page's numbers
HULL = "clearance"  # the array in m that exists if the chief's hull is the keep-out zone
RISE = 0.01  # height of drawn points above the mesh, in chief radii
WITHIN = 0.97  # without a mesh, corners of the drawn body, as a share of the way to the points

# shape of a row of every required array over time
ROWS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("time", "temperature", "energy", "sun_angle", "inspected_score"), ()),
    **dict.fromkeys(("position", "velocity"), (3,)),
    "quaternion": (4,),
    **dict.fromkeys(("control_desired", "control_applied"), (6,)),
    **{f"h_{name}": () for name in CONSTRAINTS},
}
# arrays of a chief that is not the paper's
CHIEF = ("chief_attitude", "chief_points", "chief_normals", "chief_triangles")

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
    """Holds a file of `simulate`: its displayed name, its arrays over time and the task's parameters.

    The page shows at most `rows` of its rows.
    """

    name: str
    episode: Episode
    c: InspectionParameters
    rows: int = MAX_ROWS

    @property
    def stride(self) -> int:
        """Returns the number of the file's rows per row of the page."""
        return -(-len(self.episode["time"]) // self.rows)


def write(paths: Sequence[str], out: Path, rows: int = MAX_ROWS, report: str | None = None) -> int:
    """Writes the page of one run or of several side by side; returns its size in bytes.

    Args:
        rows: most rows that are shown of each run; report: the address of a study's report, to link to.

    Raises:
        InputError: a file is not one of `simulate` or lacks something, or the page cannot be written.
    """
    text = document([read(path, rows) for path in paths], report)
    with as_input_error(f"--out {out}: cannot write it", OSError, UnicodeError):
        write_text(out, text)
    return len(text.encode())


def document(runs: Sequence[Replayed], report: str | None = None) -> str:
    """Returns the whole page."""
    return render(
        "web/replay.html.j2",
        runs=runs,
        c=runs[0].c,
        has_hull=any(HULL in run.episode for run in runs),
        report=report,
        data=embedded(content(runs), rounded),
    )


def read(path: str, rows: int = MAX_ROWS) -> Replayed:
    """Reads and checks a file of `simulate`, or an episode of a study's report in single precision.

    Raises:
        InputError: the file is neither.
    """
    older = ": not a file that simulate wrote, or one of an older version"
    names = (*ROWS, "inspected", "intervened", "parameters")
    episode = load_arrays(path, names, "run", older, maybe=(*CHIEF, HULL))
    c = recorded(str(episode["parameters"]), f"{path}: parameters", Config()).inspection
    length, points = episode["time"].size, c.num_points
    shapes: dict[str, tuple[int, ...]] = {name: (length, *row) for name, row in ROWS.items()}
    if "chief_points" in episode:
        points, faces = len(episode["chief_points"]), len(episode.get("chief_triangles", ()))
        shapes |= {"chief_points": (points, 3), "chief_normals": (points, 3)}
        shapes |= {"chief_attitude": (length, 4), "chief_triangles": (faces, 3, 3)}
    if HULL in episode:
        shapes[HULL] = (length,)
    for name, shape in (shapes | {"inspected": (length, points), "intervened": (length, 2)}).items():
        array = episode.get(name, np.array(None))
        if array.shape != shape or array.dtype.kind != ("f" if name in shapes else "b"):
            raise InputError(f"{path}: {name} is {array.dtype} {array.shape}, wanted is {shape}{older}")
        if not (np.abs(array) <= LARGEST).all():  # also raised for NaN
            raise InputError(f"{path}: {name} must hold finite numbers only, up to {LARGEST:g}")
    if length < 2 or not (np.diff(episode["time"]) > 0.0).all():
        raise InputError(f"{path}: time must rise over at least two rows")
    double = {name: episode[name].astype(np.float64) for name in shapes}
    return Replayed(Path(path).name, episode | double, c, rows)


def content(runs: Sequence[Replayed]) -> dict[str, Any]:
    """Returns everything that `replay.js` shows."""
    episodes = [thinned(run) for run in runs]
    if any(HULL in episode for episode in episodes):  # all runs must have the same panels
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
        "step": runs[0].c.action_period,
    }


def thinned(run: Replayed) -> Episode:
    """Returns at most `run.rows` rows: each is the first row of its block, but has the block's smallest h."""
    starts = np.arange(0, len(run.episode["time"]), run.stride)
    thin: Episode = {}
    for name in (*ROWS, "chief_attitude", HULL):
        if name in run.episode:
            values = run.episode[name]
            least = name == HULL or name.startswith("h_")
            thin[name] = np.minimum.reduceat(values, starts) if least else values[starts]
    return thin | {"delta_v": effort(run.episode, run.c)[0][starts]}


def run_data(run: Replayed, episode: Episode) -> dict[str, Any]:
    """Returns the page's data of a run, thinned to `episode`, besides its panels.

    Arrays are (rows, ...), times in s, positions in m. A point that is never inspected has no time of inspection.
    """
    whole, times = run.episode, rounded(run.episode["time"], TIME_DIGITS)
    first, ever = whole["inspected"].argmax(0), whole["inspected"].max(0).tolist()
    # a row covers the time until the next
    edges = np.diff(whole["intervened"][:-1].T, prepend=False, append=False)
    corrected = [[times[row] for row in np.flatnonzero(program)] for program in edges]
    return {
        "name": run.name,
        "time": rounded(episode["time"], TIME_DIGITS),
        "end": times[-1],
        **{name: rounded(episode[name], PLACE_DIGITS) for name in ("position", "quaternion")},
        "sun_angle": episode["sun_angle"],
        "desired": episode["control_desired"][:, :3],
        "control": episode["control_applied"][:, :3],
        "ahead": ahead(episode, run.c),
        **drawn(run.c),
        **chief(run, episode),
        "inspected": [times[row] if seen else None for row, seen in zip(first, ever, strict=True)],
        "interventions": {
            control: list(zip(ends[::2], ends[1::2], strict=True))
            for control, ends in zip(("thrust", "torque"), corrected, strict=True)
        },
    }


def chief(run: Replayed, episode: Episode) -> dict[str, Any]:
    """Returns the chief's points and normals (N, 3), corners of its faces and of its hull (3 F, 3), and its attitudes.

    Entries that the chief does not have, or that are not drawn, are None.
    """
    if "chief_points" not in run.episode:
        normals = fibonacci_sphere(run.c.num_points).numpy().T
        others = dict.fromkeys(("triangles", "hull", "chief", "shaded"))
        return {"points": run.c.chief_radius * normals, "normals": normals, **others}
    points, normals = run.episode["chief_points"], run.episode["chief_normals"]
    triangles = run.episode["chief_triangles"].reshape(-1, 3)
    corners = triangles if len(triangles) else points
    return {
        # a little above the faces, which would hide some of the points
        "points": points + RISE * run.c.chief_radius * normals,
        "normals": normals,
        "triangles": triangles if len(triangles) else WITHIN * hull(points),
        "hull": hull(corners) if HULL in run.episode else None,
        "chief": rounded(episode["chief_attitude"], PLACE_DIGITS),
        "shaded": shaded(run, episode) if len(triangles) else None,
    }


def hull(corners: np.ndarray) -> np.ndarray:
    """Returns corners (3 F, 3) of the faces of the convex hull of corners (k, 3), or none if all are in a plane."""
    if len(corners) < 4 or np.linalg.matrix_rank(corners - corners[0], tol=1e-9) < 3:
        return np.zeros((0, 3))
    return corners[ConvexHull(corners).simplices].reshape(-1, 3)


def ahead(episode: Episode, c: InspectionParameters) -> np.ndarray:
    """Returns the free flight from some rows within the horizon of passive safety, (rows, AHEAD, 3) in m."""
    rows = np.arange(0, len(episode["time"]), -(-len(episode["time"]) // MAX_AHEAD))
    p, v = (torch.as_tensor(episode[name][rows], dtype=torch.float64).T for name in ("position", "velocity"))
    times = torch.linspace(0.0, c.passive_safety_horizon, AHEAD, dtype=torch.float64)
    return free_flight(p[:, None], v[:, None], times[:, None], c.mean_motion).permute(2, 1, 0).numpy()


def shaded(run: Replayed, episode: Episode) -> list[list[int]]:
    """Returns for each row the points that are in the mesh's shadow."""
    points, normals, triangles = (
        torch.as_tensor(run.episode[f"chief_{name}"]) for name in ("points", "normals", "triangles")
    )
    sun = sun_direction(torch.as_tensor(episode["sun_angle"]))
    sun = attitude.rotate(attitude.conjugate(torch.as_tensor(episode["chief_attitude"]).T), sun)
    planes = hiding(Surface(points.T, normals.T, torch.ones(len(points)), triangles))
    dark = torch.stack([hidden(each, sun) for each in planes])
    return [row.nonzero().flatten().tolist() for row in dark.T]


def rounded(values: np.ndarray, digits: int = DIGITS) -> Any:
    """Returns nested lists of numbers with `digits` significant digits, which keeps the page small."""
    if values.ndim > 1:
        return [rounded(row, digits) for row in values]
    return [float(f"{value:.{digits}g}") for value in values.tolist()]


# plots


def panel(
    title: str,
    unit: str,
    acts: str | None,
    values: np.ndarray | dict[str, np.ndarray],
    safe: tuple[float | None, float | None] = (None, None),
    held: bool = False,
) -> dict[str, Any]:
    """Returns a plot over time.

    Args:
        acts: the control that changes the quantity, thrust or torque; its interventions are marked in the plot.
        values: of the line (rows,), or of several lines by name.
        safe: lowest and highest safe value, None for no limit.
        held: a row's value holds until the next row.
    """
    named = values if isinstance(values, dict) else {"": values}
    lines = [{"name": name, "values": each} for name, each in named.items()]
    return {"title": title, "unit": unit, "acts": acts, "lines": lines, "safe": safe, "held": held}


def panels(episode: Episode, c: InspectionParameters) -> dict[str, list[dict[str, Any]]]:
    """Returns all plots over time, by section; the numbers of the first section are also shown beside the scene."""
    has_hull = HULL in episode
    distance = np.linalg.norm(episode["position"], axis=1)
    nearest = None if has_hull else c.collision_radius
    control = []
    for acts, first, factor, unit in (("thrust", 0, 1.0, "N"), ("torque", 3, 1e3, "mN m")):
        for i, axis in enumerate("xyz", start=first):
            # the applied control is drawn last, and hides the desired one where both are equal
            lines = {kind: factor * episode[f"control_{kind}"][:, i] for kind in ("desired", "applied")}
            control.append(panel(f"{acts.capitalize()} {axis}", unit, acts, lines, held=True))
    constraints = []
    for title, unit, factor, names, acts in CONSTRAINT_PANELS:
        lines = {name[-1] if len(names) > 1 else "": factor * episode[f"h_{name}"] for name in names}
        constraints.append(panel(title, unit, acts, lines, safe=(0.0, None)))
    return {
        "Flight": [
            panel("Distance", "m", "thrust", distance, safe=(nearest, c.max_distance)),
            *([panel("Clearance", "m", "thrust", episode[HULL], safe=(0.0, None))] if has_hull else []),
            panel("Speed", "m/s", "thrust", speeds(episode)),
            panel("Inspected weight", "", None, episode["inspected_score"]),
            panel("Delta v", "m/s", "thrust", episode["delta_v"]),
        ],
        "Control, body frame": control,
        "Battery and temperature": [
            panel("Energy", "kJ", "torque", episode["energy"], safe=(c.min_energy, None)),
            panel("Temperature", "°C", "torque", episode["temperature"], safe=(None, c.max_temperature)),
        ],
        "Constraints, safe where h ≥ 0": constraints,
    }


def common_range(same: Sequence[dict[str, Any]]) -> np.ndarray:
    """Returns the ends of the vertical axis of one panel in all runs: all values, all limits, and some room."""
    values = [one["values"] for each in same for one in each["lines"]]
    limits = [limit for each in same for limit in each["safe"] if limit is not None]
    shown = np.concatenate((*values, limits))
    room = 0.08 * np.ptp(shown) if np.ptp(shown) > 1e-9 else 1.0
    return np.array([shown.min() - 2.0 * room, shown.max() + room])  # the strip of interventions is below

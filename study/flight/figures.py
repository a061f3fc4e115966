"""Figures of simulated episodes, from the arrays that `simulate` returns."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator
from mpl_toolkits.mplot3d import Axes3D

from inspection.chief.points import fibonacci_sphere
from inspection.model.parameters import InspectionParameters
from study.files import writing

# colours that also differ in lightness (Okabe and Ito's palette)
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#E69F00", "#009E73", "#666666"
SKY, RED, PURPLE = "#56B4E9", "#D55E00", "#CC79A7"
SAFE, UNSAFE = "#DDF1E4", "#F2C4B8"
# small text that stays readable where lines cross it
OUTLINED: dict[str, Any] = {
    "fontsize": 8,
    "ha": "center",
    "path_effects": [withStroke(linewidth=3, foreground="white")],
    "zorder": 10,
}
Episode = dict[str, np.ndarray]


def rotate(q: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Rotates a body vector a (3,) into Hill's frame by quaternions (k, 4), scalar last: (k, 3)."""
    t = 2.0 * np.cross(q[:, :3], a)
    return a + q[:, 3:] * t + np.cross(q[:, :3], t)


def speeds(episode: Episode) -> np.ndarray:
    """Returns |v| (k,) in m/s."""
    return np.linalg.norm(episode["velocity"], axis=1)


def pointing(episode: Episode) -> np.ndarray:
    """Returns the paper's dot product of boresight and direction to the chief (k,), 1 where the camera points at it."""
    boresight = rotate(episode["quaternion"], np.array([1.0, 0.0, 0.0]))
    direction = -episode["position"] / np.linalg.norm(episode["position"], axis=1, keepdims=True)
    return (boresight * direction).sum(1)


def effort(episode: Episode, c: InspectionParameters) -> tuple[np.ndarray, np.ndarray]:
    """Returns delta v in m/s and torque in N m spent until each row (k,), counted as the metrics of an episode do."""
    # a row's control acts until the next row
    held = np.diff(episode["time"], prepend=episode["time"][0])[:, None]
    spent = np.cumsum(np.abs(np.roll(episode["control_applied"], 1, axis=0)) * held, axis=0)
    return spent[:, :3].sum(1) / c.mass, spent[:, 3:].sum(1) / c.action_period


def nearness(episode: Episode, c: InspectionParameters) -> tuple[np.ndarray, float, str]:
    """Returns the distance (rows,) in m to the chief's centre or hull, the least one allowed, and an axis label."""
    if "clearance" in episode:
        return episode["clearance"], 0.0, "above the hull (m)"
    return np.linalg.norm(episode["position"], axis=1), c.collision_radius, "distance (m)"


def points_of_chief(episode: Episode, c: InspectionParameters) -> np.ndarray:
    """Returns the chief's points (N, 3) in m, in Hill's frame as at the episode's end."""
    if "chief_points" not in episode:
        return c.chief_radius * fibonacci_sphere(c.num_points).numpy().T
    x, y, z = (rotate(episode["chief_attitude"][-1:], axis)[0] for axis in np.eye(3))
    return episode["chief_points"] @ np.stack((x, y, z))


def trajectory(ax: Axes3D, episode: Episode, c: InspectionParameters, top_speed: float) -> None:
    """Draws the 3-D path coloured by speed up to `top_speed` in m/s, with chief, camera and the Sun at both ends."""
    p = episode["position"]
    chief = points_of_chief(episode, c).T
    ax.scatter(*chief, s=3, color=GREY, depthshade=False)
    path = ax.scatter(
        *p.T, c=speeds(episode), s=6, cmap="viridis_r", vmin=0.0, vmax=top_speed, depthshade=False
    )
    every = max(1, len(p) // 16)
    boresight = rotate(episode["quaternion"], np.array([1.0, 0.0, 0.0]))[::every]
    span = np.ptp(p, axis=0).max()
    ax.quiver(*p[::every].T, *(0.12 * span * boresight.T), color=BLUE, lw=0.9)
    for index, label in ((0, "Sun, start"), (-1, "Sun, end")):
        theta = episode["sun_angle"][index]
        sun = np.array([math.cos(theta), math.sin(theta), 0.0]) * (chief.max() + 0.35 * span)
        ax.plot(*zip(np.zeros(3), sun, strict=True), color=ORANGE, lw=1.2, ls="-" if index == 0 else "--")
        ax.text(*sun[:2], 0.04 * span, label, color="#8A5A00", **OUTLINED)
    ax.scatter(*p[0], color="black", marker="o", s=28)
    ax.text(*(p[0] + [0.0, 0.0, 0.06 * span]), "start", **OUTLINED)
    ax.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    extents = np.ptp((ax.get_xlim(), ax.get_ylim(), ax.get_zlim()), axis=1)
    ax.set_box_aspect(tuple(extents), zoom=0.88)  # room for the labels below
    # the same distance between ticks on every axis, so that the ticks of a short axis do not overlap
    ticks = MaxNLocator(6).tick_values(0.0, extents.max())
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_major_locator(MultipleLocator(ticks[1]))
    ax.xaxis.labelpad = 9
    ax.figure.colorbar(path, ax=ax, shrink=0.65, pad=0.15, label="speed (m/s)")


def band(ax: Axes, low: float = -math.inf, high: float = math.inf) -> None:
    """Shades the range between two limits green and the rest red; each finite limit is in view and dotted."""
    scale = ax.yaxis.get_transform()
    bottom, top = scale.transform(np.array(ax.get_ylim()))
    limits = [limit for limit in (low, high) if math.isfinite(limit)]
    room = 0.05 * (top - bottom)
    inside = scale.transform(np.array(limits))
    bottom, top = scale.inverted().transform(
        np.array([min(bottom, inside.min() - room), max(top, inside.max() + room)])
    )
    ax.axhspan(bottom, top, color=UNSAFE, lw=0, zorder=-1)
    ax.axhspan(max(low, bottom), min(high, top), color=SAFE, lw=0, zorder=0)
    for limit in limits:
        ax.axhline(limit, color="black", ls=":", lw=1)
    ax.set_ylim(bottom, top)


def limits_panels(axes: Sequence[Axes], episode: Episode, c: InspectionParameters) -> None:
    """Draws speed, angle between boresight and Sun, temperature and battery charge with their limits."""
    t, speed = episode["time"], speeds(episode)
    limit = c.docking_speed + c.speed_slope * np.linalg.norm(
        episode["position"], axis=1
    )  # grows with distance
    theta = episode["sun_angle"]
    sun = np.stack((np.cos(theta), np.sin(theta), np.zeros_like(theta)), 1)
    cosine = (rotate(episode["quaternion"], np.array([1.0, 0.0, 0.0])) * sun).sum(1).clip(-1.0, 1.0)
    off_sun, charge = np.degrees(np.arccos(cosine)), episode["energy"]
    for ax, values in zip(axes, (speed, off_sun, episode["temperature"], charge), strict=True):
        ax.plot(t, values, color=BLUE)

    moving, pointing, warm, charged = axes
    moving.plot(t, limit, color="black", ls=":", lw=1)
    moving.set(ylabel="speed (m/s)", ylim=(0, 1.15 * max(limit.max(), speed.max())))
    moving.fill_between(t, 0, limit, color=SAFE, lw=0, zorder=0)
    moving.fill_between(t, limit, moving.get_ylim()[1], color=UNSAFE, lw=0, zorder=0)
    pointing.set(ylabel="Sun off boresight (deg)", ylim=(0, 182))
    band(pointing, low=math.degrees(c.field_of_view / 2 + c.exclusion_buffer))
    warm.set(ylabel="temperature (°C)")
    band(warm, high=c.max_temperature)
    charged.set(ylabel="energy (kJ)", ylim=(0, 1.05 * max(charge.max(), c.min_energy)))
    band(charged, low=c.min_energy)


def components(ax: Axes, t: np.ndarray, values: np.ndarray, limit: float, label: str) -> None:
    """Draws three components (k, 3) that share a limit of either sign."""
    for name, line, colour in zip("xyz", values.T, (BLUE, ORANGE, "black"), strict=True):
        ax.plot(t, line, color=colour, lw=0.9, label=name)
    extent = max(limit, abs(values).max())
    ax.set(ylabel=label, ylim=(-1.35 * extent, 1.1 * extent))  # room for the legend
    band(ax, -limit, limit)
    ax.legend(loc="lower right", ncols=3, fontsize=8, frameon=False, handlelength=1.3)


def constraint_figure(episode: Episode, c: InspectionParameters, path: Path) -> None:
    """Writes the paper's figure of the filter as a PNG: limited quantities, dotted limits, and controls over time."""
    t = episode["time"]
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(3, 3, sharex=True)
    titles = (
        "Collision, keep in zone and PSM",
        "Dynamic speed",
        "Axial velocity",
        "Sun avoidance",
        "Temperature limit",
        "Energy limit",
        "Angular velocity",
        "Control: thrust",
        "Control: torque",
    )
    for ax, letter, title in zip(axes.flat, "abcdefghi", titles, strict=True):
        ax.set_title(f"({letter}) {title}", loc="left", fontsize=10)
        ax.set_xlim(t[0], t[-1])
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")

    ax = axes[0, 0]
    distance, least, label = nearness(episode, c)
    closest = episode["h_passive_safety"] + least
    ax.plot(t, closest, color=ORANGE, lw=0.9, label="nearest if coasting")
    if least > 0.0:  # measured from the centre, like the keep-in zone
        now, scale, low, farthest, place = "distance", "log", 2.5, c.max_distance, "lower left"
    else:
        now, scale, low, farthest, place = "now", "symlog", -1.0, math.inf, "best"
    ax.plot(t, distance, color=BLUE, label=now)
    ax.set(ylabel=label, yscale=scale, ylim=(low, 1300))
    ax.yaxis.set_major_formatter("{x:g}")
    band(ax, least, farthest)
    ax.legend(loc=place, fontsize=8, frameon=False, handlelength=1.3)

    limits_panels([axes[0, 1], *axes[1]], episode, c)
    components(axes[0, 2], t, episode["velocity"], c.max_speed, "velocity (m/s)")
    rates = np.degrees(episode["angular_velocity"])
    components(axes[2, 0], t, rates, math.degrees(c.max_rate), "body rate (deg/s)")
    applied = episode["control_applied"]
    components(axes[2, 1], t, applied[:, :3], c.max_thrust, "thrust (N)")
    components(axes[2, 2], t, 1e3 * applied[:, 3:], 1e3 * c.max_torque, "torque (mN m)")
    figure.align_ylabels()
    with writing(path) as file:
        figure.savefig(file, dpi=120, format="png")


def episode_figure(episode: Episode, c: InspectionParameters, path: Path) -> None:
    """Writes trajectory, inspection, pointing, effort and the limits of one episode as a PNG."""
    t = episode["time"]
    figure = Figure(figsize=(13, 7.6))
    grid = figure.add_gridspec(3, 4, left=0.05, right=0.94, bottom=0.07, top=0.98, wspace=0.34, hspace=0.22)
    trajectory(figure.add_subplot(grid[:2, :2], projection="3d"), episode, c, speeds(episode).max())

    def panel(row: int, column: int, label: str = "") -> Axes:
        ax = figure.add_subplot(grid[row, column])
        ax.set(xlabel="time (s)" if row == 2 else "", ylabel=label, xlim=(t[0], t[-1]))
        return ax

    ax = panel(0, 2, "inspected weight")
    ax.plot(t, episode["inspected_score"], color=BLUE)
    ax.set_ylim(0, 1.02)
    ax.axhline(c.success_score, color=GREEN, ls="--", lw=1)

    ax = panel(0, 3, "boresight · chief direction")
    ax.plot(t, pointing(episode), color=BLUE)
    ax.set_ylim(-1.05, 1.05)

    distance, least, label = nearness(episode, c)
    ax = panel(1, 2, label)
    ax.plot(t, distance, color=BLUE)
    ax.set_ylim(0, None)
    band(ax, low=least)

    limits_panels([panel(1, 3), panel(2, 0), panel(2, 1), panel(2, 2)], episode, c)

    ax = panel(2, 3, "Δv (m/s)")
    ax.plot(t, effort(episode, c)[0], color=BLUE)
    ax.set_ylim(0, None)
    torque = ax.twinx()
    torque.plot(t, 1e3 * np.abs(episode["control_applied"][:, 3:]).sum(1), color=ORANGE, lw=0.8)
    torque.set_ylabel("Σ|torque| (mN m)", color="#8A5A00")
    torque.set_ylim(0, None)

    with writing(path) as file:
        figure.savefig(file, dpi=110, format="png")

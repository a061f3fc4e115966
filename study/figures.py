"""Figures of simulated episodes, from the arrays that `simulate` returns."""

import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from inspection.chief import fibonacci_sphere
from inspection.parameters import InspectionParameters

matplotlib.use("Agg")

# Colours that differ in lightness too (Okabe and Ito's palette)
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#E69F00", "#009E73", "#666666"
SAFE, UNSAFE = "#DDF1E4", "#F6DCD6"
Episode = dict[str, np.ndarray]


def rotate(q: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Body vector a (3,) in Hill's frame for quaternions (k, 4), scalar last: (k, 3)."""
    t = 2.0 * np.cross(q[:, :3], a)
    return a + q[:, 3:] * t + np.cross(q[:, :3], t)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between rows (k, 3) of unit vectors in degrees."""
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1.0, 1.0)))


def trajectory(ax: Axes, episode: Episode, c: InspectionParameters) -> None:
    """3-D path coloured by speed, with chief, camera directions and the Sun at both ends."""
    p, speed = episode["position"], np.linalg.norm(episode["velocity"], axis=1)
    chief = c.chief_radius * fibonacci_sphere(c.num_points).numpy()
    ax.scatter(*chief, s=3, color=GREY, depthshade=False)
    path = ax.scatter(*p.T, c=speed, s=6, cmap="viridis_r", depthshade=False)
    every = max(1, len(p) // 16)
    boresight = rotate(episode["quaternion"], np.array([1.0, 0.0, 0.0]))[::every]
    span = np.ptp(p, axis=0).max()
    ax.quiver(*p[::every].T, *(0.12 * span * boresight.T), color=BLUE, lw=0.9)
    for index, label in ((0, "Sun, start"), (-1, "Sun, end")):
        theta = episode["sun_angle"][index]
        sun = np.array([math.cos(theta), math.sin(theta), 0.0]) * (chief.max() + 0.35 * span)
        ax.plot(*zip(np.zeros(3), sun, strict=True), color=ORANGE, lw=1.2, ls="-" if index == 0 else "--")
        ax.text(*(1.08 * sun), label, color="#8A5A00", fontsize=8, ha="center")
    ax.scatter(*p[0], color="black", marker="o", s=28)
    ax.text(*(p[0] + [0.0, 0.0, 0.06 * span]), "start", fontsize=8, ha="center")
    ax.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    ax.set_aspect("equal")
    ax.locator_params(nbins=6)
    ax.locator_params(axis="z", nbins=3)
    ax.figure.colorbar(path, ax=ax, shrink=0.65, pad=0.12, label="speed (m/s)")


def band(ax: Axes, limit: float, safe: str) -> None:
    """Shades the safe side ("above" or "below") of a limit green and the other red."""
    low, high = ax.get_ylim()
    low, high = min(low, limit - 0.05 * (high - low)), max(high, limit + 0.05 * (high - low))
    above, below = (SAFE, UNSAFE) if safe == "above" else (UNSAFE, SAFE)
    ax.axhspan(limit, high, color=above, lw=0, zorder=0)
    ax.axhspan(low, limit, color=below, lw=0, zorder=0)
    ax.axhline(limit, color="black", ls=":", lw=1)
    ax.set_ylim(low, high)


def episode_figure(episode: Episode, c: InspectionParameters, path: Path) -> None:
    """Trajectory, inspection, pointing, effort and the limits of one episode as a PNG."""
    t, p, v = episode["time"], episode["position"], episode["velocity"]
    distance, speed = np.linalg.norm(p, axis=1), np.linalg.norm(v, axis=1)
    boresight = rotate(episode["quaternion"], np.array([1.0, 0.0, 0.0]))
    theta = episode["sun_angle"]
    sun = np.stack((np.cos(theta), np.sin(theta), np.zeros_like(theta)), 1)
    step = np.diff(t, prepend=t[0])
    applied = np.abs(episode["control_applied"])
    # a row's control acts until the next row
    delta_v = np.cumsum(np.roll(applied[:, :3].sum(1), 1) / c.mass * step)

    figure = Figure(figsize=(13, 7.6))
    grid = figure.add_gridspec(3, 4, left=0.05, right=0.955, bottom=0.07, top=0.98, wspace=0.34, hspace=0.22)
    trajectory(figure.add_subplot(grid[:2, :2], projection="3d"), episode, c)

    def panel(row: int, column: int, label: str) -> Axes:
        ax = figure.add_subplot(grid[row, column])
        ax.set(xlabel="time (s)" if row == 2 else "", ylabel=label, xlim=(t[0], t[-1]))
        return ax

    ax = panel(0, 2, "inspected weight")
    ax.plot(t, episode["inspected_score"], color=BLUE)
    ax.set_ylim(0, 1.02)
    ax.axhline(c.success_score, color=GREEN, ls="--", lw=1)

    ax = panel(0, 3, "boresight · chief direction")
    ax.plot(t, -(boresight * p).sum(1) / distance, color=BLUE)
    ax.set_ylim(-1.05, 1.05)

    ax = panel(1, 2, "distance (m)")
    ax.plot(t, distance, color=BLUE)
    ax.set_ylim(0, None)
    band(ax, c.collision_radius, "above")

    ax = panel(1, 3, "speed (m/s)")
    limit = c.docking_speed + c.speed_slope * distance
    ax.plot(t, speed, color=BLUE)
    ax.plot(t, limit, color="black", ls=":", lw=1)
    ax.set_ylim(0, 1.15 * max(limit.max(), speed.max()))
    ax.fill_between(t, 0, limit, color=SAFE, lw=0, zorder=0)
    ax.fill_between(t, limit, ax.get_ylim()[1], color=UNSAFE, lw=0, zorder=0)

    ax = panel(2, 0, "Sun off boresight (deg)")
    ax.plot(t, angle_deg(boresight, sun), color=BLUE)
    ax.set_ylim(0, 182)
    band(ax, math.degrees(c.field_of_view / 2 + c.exclusion_buffer), "above")

    ax = panel(2, 1, "temperature (°C)")
    ax.plot(t, episode["temperature"], color=BLUE)
    band(ax, c.max_temperature, "below")

    ax = panel(2, 2, "energy (kJ)")
    ax.plot(t, episode["energy"], color=BLUE)
    ax.set_ylim(0, None)
    band(ax, c.min_energy, "above")

    ax = panel(2, 3, "Δv (m/s)")
    ax.plot(t, delta_v, color=BLUE)
    ax.set_ylim(0, None)
    torque = ax.twinx()
    torque.plot(t, 1e3 * applied[:, 3:].sum(1), color=ORANGE, lw=0.8)
    torque.set_ylabel("Σ|torque| (mN m)", color="#8A5A00")
    torque.set_ylim(0, None)

    figure.savefig(path, dpi=110)

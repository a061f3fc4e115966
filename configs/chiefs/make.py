"""Makes the meshes of this folder, closed parts that do not touch: python configs/chiefs/make.py"""

import struct
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
Mesh = np.ndarray  # (F, 3, 3) m, corners counterclockwise from outside


def prism(outline: np.ndarray, low: float, high: float, top: float = 1.0) -> Mesh:
    """Of a convex outline (n, 2), counterclockwise, between two heights; at the upper one scaled by `top`."""
    n = len(outline)
    floor = np.column_stack((outline, np.full(n, low)))
    roof = np.column_stack((top * outline, np.full(n, high)))
    faces = []
    for i in range(n):
        j = (i + 1) % n
        faces += [(floor[i], floor[j], roof[j]), (floor[i], roof[j], roof[i])]
    for i in range(1, n - 1):
        faces += [(roof[0], roof[i], roof[i + 1]), (floor[0], floor[i + 1], floor[i])]
    return np.array(faces)


def box(centre: tuple[float, float, float], size: tuple[float, float, float]) -> Mesh:
    """Of a centre and edge lengths in m."""
    x, y, z = np.array(size) / 2
    return prism(np.array([(x, y), (-x, y), (-x, -y), (x, -y)]), -z, z) + np.array(centre)


def polygon(corners: int, radius: float) -> np.ndarray:
    """A regular one, (n, 2)."""
    angle = 2 * np.pi * np.arange(corners) / corners
    return radius * np.column_stack((np.cos(angle), np.sin(angle)))


def about_z(mesh: Mesh, degrees: float) -> Mesh:
    """The mesh turned."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return mesh @ np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))


def box_and_panels() -> Mesh:
    """A bus of 6 m by 5 m by 5 m between two panels."""
    panels = [box((0.0, side * 6.2, 0.0), (0.2, 6.0, 3.6)) for side in (-1, 1)]
    return np.concatenate((box((0.0, 0.0, 0.0), (6.0, 5.0, 5.0)), *panels))


def satellite() -> Mesh:
    """A six-sided bus with a dish, a mast and three wings."""
    wings = [about_z(box((6.7, 0.0, 0.5), (4.6, 2.4, 0.2)), angle) for angle in (30.0, 150.0, 270.0)]
    dish = prism(polygon(8, 0.8), 4.4, 6.2, top=4.0)
    mast = box((0.0, 0.0, -6.4), (0.4, 0.4, 4.0))
    return np.concatenate((prism(polygon(6, 3.2), -3.8, 3.8), dish, mast, *wings))


def write_stl(mesh: Mesh, path: Path) -> None:
    """A binary STL file."""
    normals = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    with path.open("wb") as file:
        file.write(bytes(80) + struct.pack("<I", len(mesh)))
        for normal, corners in zip(normals / np.linalg.norm(normals, axis=1)[:, None], mesh, strict=True):
            file.write(struct.pack("<12fH", *normal, *corners.ravel(), 0))


if __name__ == "__main__":
    np.savez_compressed(HERE / "box.npz", triangles=box_and_panels())
    write_stl(satellite(), HERE / "satellite.stl")

"""The few solids that a scene is made of, as pyvista meshes in metres."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pyvista as pv

from ltsim.arrays import Floats, Ints


def polygon(corners: Floats) -> pv.PolyData:
    """A flat convex face through corners (k, 3)."""
    return pv.PolyData(corners, faces=[len(corners), *range(len(corners))])


def lines(ends: Floats) -> pv.PolyData:
    """Separate segments; `ends` (2 m, 3) holds beginnings and ends in turn."""
    count = len(ends) // 2
    cells = np.column_stack([np.full(count, 2), np.arange(2 * count).reshape(-1, 2)])
    return pv.PolyData(np.ascontiguousarray(ends), lines=cells.ravel())


def circle(centre: Floats, radius: float, height: float, steps: int = 72) -> Floats:
    """Points (steps + 1, 3) of a closed level circle around `centre` (2,)."""
    angle = np.linspace(0.0, 2.0 * np.pi, steps + 1)
    return np.column_stack(
        [centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle), np.full(steps + 1, height)]
    )


def cone(apex: Floats, rim: Floats) -> pv.PolyData:
    """The mantle between an apex (3,) and an open rim (k, 3)."""
    count = len(rim)
    first = np.arange(1, count + 1)
    faces = np.column_stack([np.full(count, 3), np.zeros(count, dtype=int), first, np.roll(first, -1)])
    return pv.PolyData(np.vstack([apex, rim]), faces=faces.ravel())


def rod(begin: Floats, end: Floats, radius: float) -> pv.PolyData:
    """A round bar between two points (3,)."""
    along = end - begin
    return pv.Cylinder(
        center=0.5 * (begin + end), direction=along, radius=radius, height=float(np.linalg.norm(along)), resolution=12
    )


FEW_BALLS = 150
"""Above so many a ball is small on the screen, and eight sides look round."""
MANY_BALLS = 600
"""Above so many six sides do."""


def balls(centres: Floats, axes: Floats) -> pv.PolyData:
    """Ellipsoids around centres (k, 3) in one mesh; the columns of `axes` (k, 3, 3) are the semi-axes."""
    count = len(centres)
    unit = _unit_sphere(*((18, 12) if count <= FEW_BALLS else (8, 6) if count <= MANY_BALLS else (6, 4)))
    points = np.einsum("kij,nj->kni", axes, unit.points) + centres[:, None, :]
    first = len(unit.points) * np.arange(len(centres), dtype=np.int64)[:, None, None]
    corners: Ints = (np.asarray(unit.regular_faces, dtype=np.int64)[None] + first).reshape(-1, 3)
    return pv.PolyData.from_regular_faces(points.reshape(-1, 3).astype(np.float32), corners)  # type: ignore[arg-type]


def merged(parts: Sequence[pv.PolyData]) -> pv.PolyData:
    """Many meshes as one, which draws and ships faster."""
    return parts[0].append_polydata(*parts[1:]) if len(parts) > 1 else parts[0]


def metre_grid(outline: Floats, height: float) -> pv.PolyData | None:
    """Lines at whole metres over the rectangle around an outline (k, 2); None where there are none or too many."""
    (x0, y0), (x1, y1) = outline.min(axis=0), outline.max(axis=0)
    xs, ys = np.arange(np.ceil(x0), x1 + 1e-9), np.arange(np.ceil(y0), y1 + 1e-9)
    if not 0 < len(xs) + len(ys) <= 200:
        return None
    ends = [[[x, y0, height], [x, y1, height]] for x in xs] + [[[x0, y, height], [x1, y, height]] for y in ys]
    return lines(np.array(ends).reshape(-1, 3))


def triangles(corners: Floats) -> pv.PolyData:
    """A surface of triangles (k, 3, 3)."""
    places = np.arange(3 * len(corners)).reshape(-1, 3)
    return pv.PolyData(corners.reshape(-1, 3), faces=np.column_stack([np.full(len(corners), 3), places]).ravel())


@cache
def _unit_sphere(around: int, up: int) -> pv.PolyData:
    return pv.Sphere(radius=1.0, theta_resolution=around, phi_resolution=up)

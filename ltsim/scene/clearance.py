"""Clearance of the stands of instruments from the bodies of the hall."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.scene.meshes import RAY_BUNDLE_RADIUS, Obstacles

CLEARANCE_TOLERANCE = 1e-9
"""Amount [m] by which a body may be closer to the axis of a stand than the clearance, to allow for rounding errors."""
N_STANDS_PER_BATCH = 64
"""Number of stands whose distances from the triangles around them are computed together."""


@dataclass(frozen=True)
class StandClearance:
    """Clearance around stands: an upright cylinder below each instrument, from the floor to the centre of its head.

    Bodies below the height of the instrument must stay outside the cylinder. Bodies above it, such as a gallery or a
    crane, do not matter.
    """

    obstacles: Obstacles
    """Bodies of the hall."""
    radius: float
    """Radius [m] of the cylinder: largest horizontal distance of a foot of the stand from its axis."""

    @cached_property
    def _triangle_tree(self) -> shapely.STRtree:
        """Search tree of the triangles by their bounding rectangles, seen from above.

        A triangle is represented by a diagonal of its rectangle, which takes half of the memory of the rectangle.
        """
        low, high = self.obstacles.triangles[:, :, :2].min(axis=1), self.obstacles.triangles[:, :, :2].max(axis=1)
        return shapely.STRtree(shapely.linestrings(np.stack([low, high], axis=1)))

    def has_room(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N instrument positions (N, 3) [m] without a body in the cylinder below it."""
        if not self.radius or not len(self.obstacles.triangles):
            return np.ones(len(position), dtype=bool)
        starts = range(0, len(position), N_STANDS_PER_BATCH)
        room_flags = [self._has_room_by_batch(position[start : start + N_STANDS_PER_BATCH]) for start in starts]
        return np.concatenate([*room_flags, np.zeros(0, dtype=bool)])

    def _has_room_by_batch(self, position: Floats) -> Bools:
        """Flags (N,): True for each of N instrument positions (N, 3) [m] without a body in the cylinder below it.

        Edges of triangles are tested only if no corner is in the cylinder: of a CAD file with many triangles, a corner
        is nearly always in the cylinder if any part is.
        """
        stand, triangle = self._triangles_near_stands(position)
        corners, stands = self.obstacles.triangles[triangle], position[stand, None]
        is_between = (corners[:, :, 2] > self._floor_height) & (corners[:, :, 2] < stands[:, :, 2])
        squares = np.sum((corners[:, :, :2] - stands[:, :, :2]) ** 2, axis=2)
        radius = max(self.radius - CLEARANCE_TOLERANCE, 0.0)
        has_room = np.ones(len(position), dtype=bool)
        has_room[stand[(is_between & (squares < radius**2)).any(axis=1)]] = False
        is_open = has_room[stand]
        distances = _horizontal_distances(position[stand[is_open]], corners[is_open], self._floor_height)
        has_room[stand[is_open][distances < radius]] = False
        return has_room

    def nearest_body(self, position: Floats) -> tuple[float, str]:
        """Distance [m] (horizontal) and name of the body in the cylinder nearest to an instrument position (3,) [m].

        The distance is infinite without such a body, and the name is empty for a body without a name.
        """
        _, triangle = self._triangles_near_stands(position[None])
        places = np.repeat(position[None], len(triangle), axis=0)
        distances = _horizontal_distances(places, self.obstacles.triangles[triangle], self._floor_height)
        if not distances.min(initial=np.inf) <= self.radius:
            return np.inf, ""
        nearest, names = int(np.argmin(distances)), self.obstacles.body_names_and_triangle_counts
        ends = np.cumsum([n_triangles for _, n_triangles in names])
        body = names[int(np.searchsorted(ends, triangle[nearest], "right"))][0] if names else ""
        return float(distances[nearest]), body

    @property
    def _floor_height(self) -> float:
        """Height [m] above which triangles count: just above the floor, which may be a body itself."""
        return self.obstacles.floor_height + RAY_BUNDLE_RADIUS

    def _triangles_near_stands(self, position: Floats) -> tuple[Ints, Ints]:
        """Indices (k,) of stands and indices (k,) of triangles: k pairs whose triangle may be in the cylinder.

        The stands are those at N instrument positions `position` (N, 3) [m].
        """
        x, y, top = position.T
        boxes = shapely.box(x - self.radius, y - self.radius, x + self.radius, y + self.radius)
        stand, triangle = self._triangle_tree.query(boxes)
        lowest, highest = self._triangle_height_limits
        is_between = (highest[triangle] > self._floor_height) & (lowest[triangle] < top[stand])
        return stand[is_between], triangle[is_between]

    @cached_property
    def _triangle_height_limits(self) -> tuple[Floats, Floats]:
        """Lowest and highest height (m,) [m] of each of m triangles."""
        heights = self.obstacles.triangles[:, :, 2]
        return heights.min(axis=1), heights.max(axis=1)


def _horizontal_distances(position: Floats, triangles: Floats, floor: float) -> Floats:
    """Horizontal distances (k,) [m] from k upright lines to parts of k triangles (k, 3, 3) [m].

    A line extends from the height `floor` [m] to a position (k, 3) [m]; only the part of the triangle between these
    heights counts.
    """
    heights, top = triangles[:, :, 2], position[:, 2]
    is_cut = (heights.min(axis=1) < floor) | (heights.max(axis=1) > top)
    starts = triangles[:, :, :2] - position[:, None, :2]
    edges = np.roll(starts, -1, axis=1) - starts
    squares = np.maximum(np.sum(edges**2, axis=2), np.finfo(np.float64).tiny)
    fractions = np.clip(-np.sum(starts * edges, axis=2) / squares, 0.0, 1.0)
    distances = np.linalg.norm(starts + fractions[..., None] * edges, axis=2).min(axis=1)
    sides = starts[:, :, 0] * edges[:, :, 1] - starts[:, :, 1] * edges[:, :, 0]
    distances[(sides > 0.0).all(axis=1) | (sides < 0.0).all(axis=1)] = 0.0  # below or above the triangle
    outlines = _outlines_between_heights(triangles[is_cut], floor, top[is_cut])
    distances[is_cut] = shapely.distance(outlines, shapely.points(position[is_cut, :2]))
    return np.asarray(distances)


def _outlines_between_heights(triangles: Floats, floor: float, top: Floats) -> np.ndarray:
    """Outlines (k,), seen from above, of those parts of k triangles (k, 3, 3) [m] that lie between two heights.

    The heights are `floor` [m] for all and `top` (k,) [m] for each triangle. An outline is the convex hull of the
    corners between the heights and of the points at which edges cross the heights.
    """
    starts, edges = triangles, np.roll(triangles, -1, axis=1) - triangles
    limits = np.stack([np.full(len(triangles), floor), top], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        fractions = (limits[:, None, :] - starts[:, :, None, 2]) / edges[:, :, None, 2]
    is_crossed = (fractions >= 0.0) & (fractions <= 1.0)
    crossings = starts[:, :, None, :2] + np.where(is_crossed, fractions, 0.0)[..., None] * edges[:, :, None, :2]
    is_inside = (starts[:, :, 2] >= floor) & (starts[:, :, 2] <= top[:, None])
    points = np.concatenate([starts[:, :, :2], crossings.reshape(len(triangles), 6, 2)], axis=1)
    is_part = np.concatenate([is_inside, is_crossed.reshape(len(triangles), 6)], axis=1)
    first = points[np.arange(len(points)), np.argmax(is_part, axis=1)]
    points = np.where(is_part[..., None], points, first[:, None])
    return np.asarray(shapely.convex_hull(shapely.multipoints(shapely.points(points))))

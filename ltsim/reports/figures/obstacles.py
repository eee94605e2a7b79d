"""Obstacles of a hall seen from above, for floor plans."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.path import Path

from ltsim.core.arrays import Floats

MAX_TRIANGLES_PER_PATH = 5_000
"""Largest number of triangles that are drawn as one path; each path takes half a kilobyte."""
MAX_VECTOR_TRIANGLES = 2_000
"""Largest number of triangles of obstacles that are drawn as vectors of 200 bytes each; more triangles are rasterised.
"""


def draw_obstacles(ax: Axes, triangles: Floats) -> None:
    """Draw n triangles (n, 3, 3) of obstacles from above, many of them as one path."""
    if not len(triangles):
        return
    corners = triangles[:, :, :2]
    first_edge, second_edge = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    is_clockwise = first_edge[:, 0] * second_edge[:, 1] < first_edge[:, 1] * second_edge[:, 0]
    corners = np.where(is_clockwise[:, None, None], corners[:, ::-1], corners)  # overlaps do not cancel
    closed_triangles, codes = corners[:, [0, 1, 2, 0]], [Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    triangle_batches = (
        closed_triangles[i : i + MAX_TRIANGLES_PER_PATH]
        for i in range(0, len(closed_triangles), MAX_TRIANGLES_PER_PATH)
    )
    ax.add_collection(
        PathCollection(
            [Path(part.reshape(-1, 2), np.tile(codes, len(part))) for part in triangle_batches],
            facecolors="#B9A98C",
            edgecolors="#B9A98C",
            linewidths=0.3,
            rasterized=len(triangles) > MAX_VECTOR_TRIANGLES,
        ),
        autolim=False,
    )
    ax.plot([], [], color="#B9A98C", linewidth=6.0, label="obstacle")

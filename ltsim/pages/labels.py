"""Names beside their places that do not overprint: each goes to the nearest free spot around its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.arrays import Floats

AROUND = np.radians([0, 180, 90, 270, 45, 135, 225, 315, 22, 158, 202, 338])
RINGS = (7.0, 13.0, 21.0, 31.0, 43.0)
"""Distances [pt] of a label from its place that are tried."""
LEADER = 13.0
"""From this distance [pt] on a thin line leads back to the place."""
MARKER = 4.0
"""Half a marker's size [pt]."""
WIDE, HIGH = 0.62, 1.25
"""Size of a letter over the font's."""


@dataclass(frozen=True)
class Label:
    """A name, its place (2,) in data units, its size [pt]; `bold` ones are printed strongly, `away` is tried first."""

    text: str
    place: Floats
    size: float = 6.2
    bold: bool = False
    colour: str = "#4A5056"
    away: float = 0.0


def place_labels(figure: Figure, ax: Axes, labels: Sequence[Label], markers: Floats) -> None:
    """Write labels, the first ones first; none covers another or a marker (n, 2) while any free spot is near.

    The numbers of the axes stay free too. The axes' limits must stand.
    """
    figure.draw_without_rendering()
    point = figure.dpi / 72.0
    spots = ax.transData.transform(markers) / point if len(markers) else np.zeros((0, 2))
    taken = [(x - MARKER, y - MARKER, x + MARKER, y + MARKER) for x, y in spots]
    left, below = (float(side) / point for side in ax.get_window_extent().p0)
    taken += [(-1e4, -1e4, left, 1e4), (-1e4, -1e4, 1e4, below)]  # the numbers of the axes stand there
    for label in labels:
        centre = ax.transData.transform(label.place) / point
        size = np.array([WIDE * len(label.text) * (1.1 if label.bold else 1.0), HIGH]) * label.size
        offset, box = _free(centre, size, label.away, taken)
        taken.append(box)
        far = float(np.linalg.norm(offset - 0.5 * size * np.sign(offset))) > LEADER
        note = ax.annotate(
            label.text,
            tuple(label.place),
            xytext=tuple(offset),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=label.size,
            fontweight="bold" if label.bold else "normal",
            color=label.colour,
            zorder=8,
            arrowprops={"arrowstyle": "-", "color": "#9AA0A6", "lw": 0.4, "shrinkA": 0, "shrinkB": 2} if far else None,
            bbox={"boxstyle": "square,pad=0.05", "facecolor": "#FFFFFFB0", "edgecolor": "none"},
        )
        note.set_in_layout(False)


Box = tuple[float, float, float, float]


def _free(centre: Floats, size: Floats, away: float, taken: Sequence[Box]) -> tuple[Floats, Box]:
    """Offset [pt] of a label's middle and its box: the first free one, else the one that covers least."""
    best: tuple[float, Floats, Box] | None = None
    boxes = np.array(taken).reshape(-1, 4)
    for ring in RINGS:
        for turn in (away, *(away + AROUND)):
            direction = np.array([np.cos(turn), np.sin(turn)])
            offset = direction * (ring + 0.5 * size * np.abs(direction))
            low, high = centre + offset - 0.5 * size, centre + offset + 0.5 * size
            wide = np.minimum(high[0], boxes[:, 2]) - np.maximum(low[0], boxes[:, 0])
            tall = np.minimum(high[1], boxes[:, 3]) - np.maximum(low[1], boxes[:, 1])
            covered = float(np.sum(np.maximum(wide, 0) * np.maximum(tall, 0)))
            if best is None or covered < best[0]:
                best = covered, offset, (low[0], low[1], high[0], high[1])
            if covered == 0.0:
                return offset, best[2]
    assert best is not None
    return best[1], best[2]

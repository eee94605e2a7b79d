"""Names beside their places: each is written where it is free, else left out; the tables hold all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.arrays import Floats

TURNS = np.radians([0, 180, 90, 270])
GAP = 6.0
"""[pt] From a place to its name."""
WIDE, HIGH = 0.62, 1.25
"""Size of a letter over the font's."""


@dataclass(frozen=True)
class Label:
    """A name, its place (2,) in data units, its size [pt]; `bold` ones are printed strongly, `away` is tried first."""

    text: str
    place: Floats
    size: float = 7.0
    bold: bool = False
    colour: str = "#4A5056"
    away: float = 0.0


def place_labels(figure: Figure, ax: Axes, labels: Sequence[Label], markers: Floats) -> None:
    """Write labels beside markers (n, 2), the first ones first; the axes' limits must stand."""
    figure.draw_without_rendering()
    point = figure.dpi / 72.0
    spots = ax.transData.transform(markers).reshape(-1, 2) / point
    left, below = ax.get_window_extent().p0 / point
    right, top = 72.0 * figure.get_size_inches()
    numbers = [[-1e4, -1e4, left, 1e4], [-1e4, -1e4, 1e4, below]]  # those of the axes stand there
    numbers += [[right, -1e4, 1e4, 1e4], [-1e4, top, 1e4, 1e4]]  # and here the figure ends
    taken = np.concatenate([np.concatenate([spots - 3.0, spots + 3.0], axis=1), numbers])
    for label in labels:
        half = 0.5 * label.size * np.array([WIDE * len(label.text), HIGH])
        for turn in label.away + TURNS:
            way = np.array([np.cos(turn), np.sin(turn)])
            offset = way * (GAP + half * np.abs(way))
            middle = ax.transData.transform(label.place) / point + offset
            box = np.concatenate([middle - half, middle + half])
            if not ((box[:2] < taken[:, 2:]) & (box[2:] > taken[:, :2])).all(axis=1).any():
                taken = np.concatenate([taken, box[None]])
                ax.annotate(
                    label.text, tuple(label.place), xytext=tuple(offset), textcoords="offset points", ha="center",
                    va="center", fontsize=label.size, fontweight="bold" if label.bold else "normal",
                    color=label.colour, zorder=8, in_layout=False,
                )  # fmt: skip
                break

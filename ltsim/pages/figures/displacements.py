"""Displacements of points between two epochs, seen from above and from the side, with their 95 % ellipses."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Bools, Floats
from ltsim.pages.labels import Label, place_labels
from ltsim.pages.style import AFTER, GREY, RED, new_figure, styled

VIEWS = (("seen from above", 0, 1), ("seen from the side", 0, 2))


def enlargement(places: Floats, shifts: Floats, semi_axes: Floats) -> float:
    """How many times larger than life shifts are drawn: the longest takes an eighth of the picture."""
    extent = float(np.ptp(places, axis=0).max()) or 1.0
    longest = float(max(np.linalg.norm(shifts, axis=1).max(), semi_axes.max(), 1e-9))
    return 1e3 * 0.125 * extent / longest


@styled
def displacements(places: Floats, shifts: Floats, semi_axes: Floats, moved: Bools, names: list[str]) -> Figure:
    """Arrows of the shifts, enlarged alike, and a circle of the largest semi-axis around each tip.

    Parameters
    ----------
    places : (T, 3) float, [mm]
    shifts, semi_axes : (T, 3) float, [um]
    moved : (T,) bool
    names : list of str
    """
    figure = new_figure(3.0)
    enlarged = enlargement(places, shifts, semi_axes) * 1e-3
    for ax, (title, i, j) in zip(figure.subplots(1, 2), VIEWS, strict=True):
        for place, shift, axes, far in zip(places, shifts, semi_axes, moved, strict=True):
            colour = RED if far else AFTER
            start, end = place[[i, j]], place[[i, j]] + enlarged * shift[[i, j]]
            turn = np.linspace(0, 2 * np.pi, 60)
            ring = end[:, None] + enlarged * axes[0] * np.stack([np.cos(turn), np.sin(turn)])
            ax.plot(*ring, color=GREY, linewidth=0.7)
            ax.plot([start[0], end[0]], [start[1], end[1]], color=colour, linewidth=1.8 if far else 1.0)
            ax.plot(*start, marker="s" if far else "o", markersize=3.5, color=colour, linestyle="none")
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(title)
        ax.set_xlabel(f"{'xyz'[i]} [mm]")
        ax.set_ylabel(f"{'xyz'[j]} [mm]")
    gone = np.flatnonzero(moved)
    for ax, (_, i, j) in zip(figure.axes, VIEWS, strict=True):
        place_labels(figure, ax, [Label(names[k], places[k, [i, j]], colour=RED) for k in gone], places[:, [i, j]])
    return figure

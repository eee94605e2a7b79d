"""Correlation matrix of estimated parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.report.style import DIVERGING, ON_DEEP, ON_PALE, bare, new_figure, on_phone, shorten, styled

MOST_NUMBERS = 24
"""Parameters whose coefficients and lower names can be read."""


@styled
def correlation(names: Sequence[str], matrix: Floats) -> Figure:
    """Correlation coefficients (p, p) as a coloured matrix; those above 0.3 in size are written.

    Parameters
    ----------
    names : sequence of str
    matrix : (p, p) float
    """
    count = len(names)
    small = on_phone()
    height = 4.6 if small else min(7.2, 1.9 + 0.27 * count)
    figure = new_figure(height, width=min(7.4, 2.9 + 0.30 * count))
    ax = figure.subplots()
    off_diagonal = np.where(np.eye(count, dtype=bool), np.nan, matrix)
    ax.set_facecolor("#DDE1E4")
    picture = ax.imshow(off_diagonal, cmap=DIVERGING, vmin=-1, vmax=1)
    short = [shorten(name, 26) for name in names]
    below = short if count <= MOST_NUMBERS else []  # in the order of those at the side
    letters = 6.0 if small else 7.5
    ax.set_xticks(range(len(below)), below, rotation=60, ha="right", rotation_mode="anchor", fontsize=letters)
    ax.set_yticks(range(count), short, fontsize=letters)
    bare(ax)
    if count <= (8 if small else MOST_NUMBERS):
        for i, j in zip(*np.nonzero(np.abs(matrix) > 0.3), strict=True):
            if i != j:
                colour = ON_DEEP if abs(matrix[i, j]) > 0.6 else ON_PALE
                ax.text(j, i, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
    bar = figure.colorbar(picture, ax=ax, shrink=0.7, pad=0.02, location="bottom" if small else "right")
    bar.set_label("correlation" if small else "correlation (numbers: %)")
    bar.outline.set_visible(False)
    return figure

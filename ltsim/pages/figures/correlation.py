"""Correlation matrix of estimated parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.style import DIVERGING, ON_DEEP, ON_PALE, bare, new_figure, on_phone, shorten, styled

MOST = 24
"""Parameters whose names and coefficients can be read."""


@styled
def correlation(names: Sequence[str], matrix: Floats) -> Figure:
    """Correlation coefficients (p, p) as a coloured matrix; those above 0.3 in size are written.

    Of more than 24 parameters it shows those 24 that correlate most with another, and says so.

    Parameters
    ----------
    names : sequence of str
    matrix : (p, p) float
    """
    apart = np.abs(np.where(np.eye(len(names), dtype=bool), 0.0, matrix)).max(axis=1, initial=0.0)
    shown = np.sort(np.argsort(-apart, kind="stable")[:MOST])
    count, matrix = len(shown), matrix[np.ix_(shown, shown)]
    small = on_phone()
    figure = new_figure(4.6 if small else 1.9 + 0.22 * count, width=min(7.4, 2.9 + 0.30 * count), layout="compressed")
    ax = figure.subplots()
    if count < len(names):
        ax.set_title(f"the {count} of {len(names)} parameters that correlate most", fontsize=7.5, fontweight="normal")
    off_diagonal = np.where(np.eye(count, dtype=bool), np.nan, matrix)
    ax.set_facecolor("#DDE1E4")
    picture = ax.imshow(off_diagonal, cmap=DIVERGING, vmin=-1, vmax=1)
    short = [shorten(names[i], 26) for i in shown]
    letters = 6.0 if small else 7.5
    ax.set_xticks(range(count), short, rotation=60, ha="right", rotation_mode="anchor", fontsize=letters)
    ax.set_yticks(range(count), short, fontsize=letters)
    bare(ax)
    if not small or count <= 8:
        for i, j in zip(*np.nonzero(np.abs(matrix) > 0.3), strict=True):
            if i != j:
                colour = ON_DEEP if abs(matrix[i, j]) > 0.6 else ON_PALE
                ax.text(j, i, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=6.5, color=colour)
    bar = figure.colorbar(picture, ax=ax, shrink=0.7, pad=0.02, location="bottom" if small else "right")
    bar.set_label("correlation" if small else "correlation (numbers: %)")
    bar.outline.set_visible(False)
    return figure

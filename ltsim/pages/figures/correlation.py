"""Correlation matrix of estimated parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.style import DIVERGING, ON_DEEP, ON_PALE, bare, new_figure, shorten, styled

MOST = 24
"""Parameters whose names can be read."""


@styled
def correlation(names: Sequence[str], matrix: Floats) -> Figure:
    """Correlation coefficients (p, p) as a coloured matrix; those above 0.3 in size are written in percent.

    Of more than 24 parameters it shows those 24 that correlate most with another, and says so.
    """
    apart = np.abs(np.where(np.eye(len(names), dtype=bool), 0.0, matrix)).max(axis=1, initial=0.0)
    shown = np.sort(np.argsort(-apart, kind="stable")[:MOST])
    count, matrix = len(shown), matrix[np.ix_(shown, shown)]
    figure = new_figure(2.2 + 0.15 * count)
    ax = figure.subplots()
    if count < len(names):
        ax.set_title(f"the {count} of {len(names)} parameters that correlate most", fontsize=7.5, fontweight="normal")
    ax.set_facecolor("#DDE1E4")
    table = np.where(np.eye(count, dtype=bool), np.nan, matrix)
    colours = ax.pcolormesh(table, cmap=DIVERGING, vmin=-1, vmax=1)
    ax.invert_yaxis()
    short = [shorten(names[i], 26) for i in shown]
    ax.set_xticks(np.arange(count) + 0.5, short, rotation=60, ha="right", rotation_mode="anchor", fontsize=6.5)
    ax.set_yticks(np.arange(count) + 0.5, short, fontsize=6.5)
    bare(ax)
    for i, j in zip(*np.nonzero(np.abs(np.nan_to_num(table)) > 0.3), strict=True):
        colour = ON_DEEP if abs(matrix[i, j]) > 0.6 else ON_PALE
        ax.text(j + 0.5, i + 0.5, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=5.5, color=colour)
    bar = figure.colorbar(colours, ax=ax, shrink=0.7, pad=0.02)
    bar.set_label("correlation (numbers: %)")
    bar.outline.set_visible(False)
    return figure

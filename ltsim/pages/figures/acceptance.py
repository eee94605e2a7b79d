"""Errors of acceptance tests over their limits."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ltsim.acceptance.files import AcceptanceFile
from ltsim.pages.style import BLUE, INK, RED, category_rows, new_figure, styled

SPREAD = 0.32
"""Of a group's tests about its row."""


@styled
def shares_of_limits(content: AcceptanceFile) -> Figure:
    """Error over limit of every test, a row a group; bars are expanded uncertainties, failed errors are crosses."""
    groups = [g.name for g in content.groups]
    figure = new_figure(0.9 + 0.42 * max(len(groups), 3))
    ax = figure.subplots()
    rows = category_rows(ax, groups)
    ax.axvspan(-1, 1, color=BLUE, alpha=0.08, lw=0)
    for edge in (-1, 1):
        ax.axvline(edge, color=INK, lw=0.8)
    for row, name in zip(rows, groups, strict=True):
        mine = [t for t in content.tests if t.group == name]
        share = np.array([t.error_um / t.limit_um for t in mine])
        width = np.array([(t.expanded_um or 0.0) / t.limit_um for t in mine])
        place = row + np.linspace(-SPREAD, SPREAD, len(mine)) * (len(mine) > 1)
        good = np.abs(share) <= 1
        ax.hlines(place, share - width, share + width, color=BLUE, lw=0.6, alpha=0.6)
        ax.plot(share[good], place[good], "o", ms=2.6, color=BLUE, mec="none")
        ax.plot(share[~good], place[~good], "x", ms=5, color=RED, mew=1.4)
    largest = max(1.0, *(abs(t.error_um) / t.limit_um for t in content.tests))
    ax.set_xlim(-1.15 * largest, 1.15 * largest)
    ax.set_xlabel("error / limit")
    return figure

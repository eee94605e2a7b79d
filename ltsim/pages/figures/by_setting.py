"""One statistic over the settings of a campaign, method by method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.style import CYCLE, INK, MARKERS, category_rows, legend_of, new_figure, styled

MOST_SETTINGS = 40


@dataclass(frozen=True)
class Mean:
    """Mean of one statistic in one setting by one method, its 95 % interval and the middle 90 % of the trials."""

    setting: str
    method: str
    mean: float
    low: float
    high: float
    five: float
    ninety_five: float


@styled
def by_setting(rows: Sequence[Mean], *, label: str, published: float | None = None) -> Figure:
    """A row a setting: marks are means with 95 % intervals, thin lines the middle 90 % of the trials.

    Parameters
    ----------
    rows : sequence of Mean
    label : str
        The statistic with its unit.
    published : float, optional
        A published figure to compare with.
    """
    settings = list(dict.fromkeys(row.setting for row in rows))[:MOST_SETTINGS]
    methods = list(dict.fromkeys(row.method for row in rows))
    figure = new_figure(0.75 + len(settings) * (0.14 + 0.14 * len(methods)))
    ax = figure.subplots()
    places = dict(zip(settings, category_rows(ax, settings), strict=True))
    for m, method in enumerate(methods):
        mine = [row for row in rows if row.method == method and row.setting in places]
        y = np.array([places[row.setting] for row in mine]) + 0.62 * ((m + 0.5) / len(methods) - 0.5)
        colour = CYCLE[m % len(CYCLE)]
        ninety, mean = ("90 % of trials", "95 % interval of the mean") if m == 0 else ("", "")
        ax.hlines(y, [r.five for r in mine], [r.ninety_five for r in mine], color=colour, lw=0.9, label=ninety)
        ax.hlines(y, [r.low for r in mine], [r.high for r in mine], color=colour, lw=3.6, label=mean)
        ax.plot([r.mean for r in mine], y, MARKERS[m % len(MARKERS)], ms=4.5, color=colour, label=method)
    if published is not None:
        ax.axvline(published, color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label="the paper")
    ax.set_xlabel(label)
    legend_of(figure, [ax], ncols=2)
    return figure

"""Whether estimates differ from the truth by what their stated standard deviation says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.campaigns.statistics import NORMAL_95, Scores
from ltsim.pages.style import BLUE, INK, PALE, RED, category_rows, legend_of, new_figure, styled

ALLOWED = (0.935, 0.965)
"""Band for the share of 95 % intervals that hold the truth."""


def interval(row: Scores) -> tuple[float, float]:
    """The 95 % interval of a share that was counted (Wilson 1927, equation 4)."""
    n, z2 = row.trials, NORMAL_95**2
    centre = (row.coverage_95 + z2 / (2 * n)) / (1 + z2 / n)
    half = NORMAL_95 / (1 + z2 / n) * np.sqrt(row.coverage_95 * (1 - row.coverage_95) / n + z2 / (4 * n * n))
    return float(centre - half), float(centre + half)


def uncovered(rows: Sequence[Scores], allowed: tuple[float, float] = ALLOWED) -> list[bool]:
    """Whether even the interval of the share that holds the truth lies outside the allowed band: what is drawn red."""
    return [high < allowed[0] or low > allowed[1] for low, high in map(interval, rows)]


@styled
def coverage(rows: Sequence[Scores], *, allowed: tuple[float, float] = ALLOWED) -> Figure:
    """Share of trials whose 95 % interval holds the truth, with its own 95 % interval, against the allowed band."""
    figure = new_figure(0.9 + 0.2 * max(len(rows), 3))
    ax = figure.subplots()
    places = category_rows(ax, [row.parameter for row in rows])
    share, bounds = np.array([row.coverage_95 for row in rows]), np.array([interval(row) for row in rows])
    ax.axvspan(*allowed, color=PALE, zorder=0, label=f"allowed {100 * allowed[0]:.1f} to {100 * allowed[1]:.1f} %")
    ax.axvline(0.95, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label="nominal 95 %")
    red = np.array(uncovered(rows, allowed), dtype=bool)
    for chosen, colour, word in ((~red, BLUE, "share, its 95 % interval"), (red, RED, "outside the band")):
        if chosen.any():
            ax.hlines(places[chosen], *bounds[chosen].T, color=colour, linewidth=1.8)
            ax.plot(share[chosen], places[chosen], "o", ms=4.5, color=colour, label=word)
    ax.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    ax.set_xlabel("95 % intervals that hold the truth")
    ax.set_xlim(min(bounds.min(), allowed[0]) - 0.01, min(max(bounds.max(), allowed[1]) + 0.01, 1.0))
    legend_of(figure, [ax], ncols=2)
    return figure

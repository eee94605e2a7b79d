"""Whether estimates differ from the truth by what their stated uncertainty says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from ltsim.arrays import Floats
from ltsim.pages import style
from ltsim.pages.style import BLUE, INK, PALE, RED, SKY, category_rows, new_figure, quiet_axis, shorten, styled

MOST_PANELS = 24


@dataclass(frozen=True)
class ZScores:
    """(estimate - truth) / stated sigma of one parameter, one value a trial."""

    name: str
    values: Floats

    def covered(self, level: float = 0.95) -> tuple[float, float, float]:
        """Share of trials whose interval of `level` holds the truth, with its 95 % interval (Wilson 1927)."""
        inside = int(np.sum(np.abs(self.values) <= stats.norm.isf(0.5 * (1.0 - level))))
        interval = stats.binomtest(inside, len(self.values)).proportion_ci(0.95, method="wilson")
        return inside / len(self.values), float(interval.low), float(interval.high)


@styled
def z_scores(rows: Sequence[ZScores]) -> Figure:
    """Small histograms of z with the standard normal drawn over them; mean and standard deviation in each."""
    rows = rows[:MOST_PANELS]
    columns = style.columns(4)
    lines = -(-len(rows) // columns)
    figure = new_figure(0.3 + 1.25 * lines)
    axes = figure.subplots(lines, columns, sharex=True, squeeze=False)
    grid = np.linspace(-4, 4, 161)
    for ax, row in zip(axes.flat, rows, strict=False):
        values = row.values[np.isfinite(row.values)]
        ax.hist(np.clip(values, -4, 4), bins=np.linspace(-4, 4, 33), density=True, color=SKY)
        ax.plot(grid, stats.norm.pdf(grid), color=INK, linewidth=1.0)
        ax.set_title(shorten(row.name, 28), fontsize=7.5, fontweight="normal")
        ax.set_yticks([])
        ax.spines["left"].set_visible(False)
        quiet_axis(ax, grid="none")
        ax.set_ylim(0, 0.56)
        ax.set_xticks([-3, 0, 3])
        ax.text(
            0.99,
            0.97,
            f"mean {values.mean():+.2f}\nsd {values.std(ddof=1):.2f}",
            transform=ax.transAxes,
            fontsize=7,
            ha="right",
            va="top",
        )
    for ax in axes.flat[len(rows) :]:
        ax.set_axis_off()
    figure.supxlabel("(estimate − truth) / stated sigma", fontsize=8.5)
    return figure


ALLOWED = (0.935, 0.965)
"""Band for the share of 95 % intervals that hold the truth."""


def uncovered(rows: Sequence[ZScores], *, level: float = 0.95, allowed: tuple[float, float] = ALLOWED) -> list[bool]:
    """Whether even the interval of the share that holds the truth lies outside the allowed band: what is drawn red."""
    intervals = [row.covered(level)[1:] for row in rows]
    return [high < allowed[0] or low > allowed[1] for low, high in intervals]


@styled
def coverage(rows: Sequence[ZScores], *, level: float = 0.95, allowed: tuple[float, float] = ALLOWED) -> Figure:
    """Share of trials whose interval holds the truth, with its own uncertainty, against the allowed band."""
    figure = new_figure(0.7 + 0.2 * max(len(rows), 3))
    ax = figure.subplots()
    places = category_rows(ax, [row.name for row in rows])
    share = np.array([row.covered(level) for row in rows])
    outside = uncovered(rows, level=level, allowed=allowed)
    colours = np.where(outside, RED, BLUE)
    ax.axvspan(*allowed, color=PALE, zorder=0, label=f"allowed {100 * allowed[0]:.1f} to {100 * allowed[1]:.1f} %")
    ax.axvline(level, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label=f"nominal {100 * level:.0f} %")
    ax.hlines(places, share[:, 1], share[:, 2], colors=colours.tolist(), linewidth=1.8)
    ax.scatter(share[:, 0], places, s=24, c=colours.tolist(), zorder=3)
    ax.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    ax.set_xlabel(f"{100 * level:.0f} % intervals that hold the truth")
    low, high = min(share[:, 1].min(), allowed[0]), max(share[:, 2].max(), allowed[1])
    ax.set_xlim(low - 0.01, min(high + 0.01, 1.0))
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure

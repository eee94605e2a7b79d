"""One statistic over what a campaign varies: a line over one factor, a colour a method or level, a panel the rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ltsim.pages.style import CYCLE, INK, MARKERS, legend_of, new_figure, quiet_axis, shorten, styled

MOST_PANELS, MOST_LINES = 12, 8
NINETY = "90 % of trials"


@dataclass(frozen=True)
class Swept:
    """Mean of one statistic at one place: its `x`, line and panel in words, its 95 % interval, the middle 90 %.

    `x` is a number, or a word where the levels are no numbers.
    """

    x: float | str
    line: str
    panel: str
    mean: float
    low: float
    high: float
    five: float
    ninety_five: float


@styled
def by_factor(
    rows: Sequence[Swept], *, label: str, axis: str, published: float | None = None, joined: bool = True
) -> Figure:
    """Small multiples with common axes: means with 95 % intervals; the shade is the middle 90 % of trials.

    Parameters
    ----------
    rows : sequence of Swept
    label : str
        The statistic with its unit.
    axis : str
        The factor along the lines, with its unit.
    published : float, optional
        A published figure to compare with.
    joined : bool
        Whether points of a line are joined. Points spread over ranges are not, and each panel has its own factor: the
        panel's name.
    """
    panels = list(dict.fromkeys(row.panel for row in rows))[:MOST_PANELS]
    across = min(len(panels), 2)
    down = -(-len(panels) // across)
    figure = new_figure(0.9 + (1.9 if across > 1 else 2.6) * down)
    axes = figure.subplots(down, across, sharex=joined, sharey=True, squeeze=False)
    words = list(dict.fromkeys(row.x for row in rows if isinstance(row.x, str)))
    names = list(dict.fromkeys(row.line for row in rows))[:MOST_LINES]
    for ax, panel in zip(axes.flat, panels, strict=False):
        for k, name in enumerate(names):
            own = [row for row in rows if (row.panel, row.line) == (panel, name)]
            _line(ax, own, k, len(names), words, joined=joined)
        if published is not None:
            ax.axhline(published, color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label="the paper")
        if joined:
            ax.set_title(shorten(panel, 44 if across < 2 else 34), fontsize=8.5)
        else:
            ax.set_xlabel(panel)
        _axis(ax, [row.x for row in rows if row.panel == panel], words, joined=joined)
        quiet_axis(ax)
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    figure.supxlabel(axis, fontsize=8.5)
    figure.supylabel(label, fontsize=8.5)
    legend_of(figure, axes.flat[: len(panels)], ncols=2)
    return figure


def _line(ax: Axes, rows: Sequence[Swept], k: int, count: int, words: Sequence[str], *, joined: bool) -> None:
    """The points of one line with their intervals."""
    if not rows:
        return
    place = np.array([words.index(row.x) if isinstance(row.x, str) else row.x for row in rows], dtype=np.float64)
    order = np.argsort(place, kind="stable")
    x, mean = place[order], np.array([rows[i].mean for i in order])
    low, high = (np.array([getattr(rows[i], side) for i in order]) for side in ("low", "high"))
    if words:
        x = x + 0.3 * ((k + 0.5) / count - 0.5)
    colour = CYCLE[k % len(CYCLE)]
    if joined and not words:
        five, ninety_five = (np.array([getattr(rows[i], side) for i in order]) for side in ("five", "ninety_five"))
        ax.fill_between(x, five, ninety_five, color=colour, alpha=0.12, linewidth=0, label=NINETY if k == 0 else None)
    told = (f"{rows[0].line}: mean, 95 % interval" if k == 0 else rows[0].line).removeprefix(": ")
    ax.errorbar(
        x, mean, [mean - low, high - mean], color=colour, marker=MARKERS[k % len(MARKERS)], markersize=4.5,
        linestyle=("-" if joined else "none"), elinewidth=2.4, label=told,
    )  # fmt: skip


def _axis(ax: Axes, places: Sequence[float | str], words: Sequence[str], *, joined: bool) -> None:
    """Ticks where the levels are; a logarithmic axis where they span a decade."""
    if words:
        ax.set_xticks(range(len(words)), [shorten(word, 18) for word in words])
        ax.set_xlim(-0.5, len(words) - 0.5)
        return
    levels = sorted({float(x) for x in places if not isinstance(x, str)})
    logarithmic = levels[0] > 0 and levels[-1] >= 8 * levels[0]
    if logarithmic:
        ax.set_xscale("log")
        ax.minorticks_off()
    if joined and len(levels) <= 8:
        ticks = levels
    elif logarithmic:
        decades = range(math.floor(math.log10(levels[0])), math.ceil(math.log10(levels[-1])) + 1)
        ticks = [t for k in decades for t in (10.0**k, 2 * 10.0**k, 5 * 10.0**k) if levels[0] <= t <= levels[-1]]
    else:
        whole = all(level.is_integer() for level in levels)
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=whole))
        return
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])

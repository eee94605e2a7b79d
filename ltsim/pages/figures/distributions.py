"""Distributions over the trials of a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ltsim.arrays import Floats
from ltsim.pages.style import AFTER, INK, SKY, legend_of, new_figure, number, quiet_axis, shorten, styled, unit_text


@dataclass(frozen=True)
class Distribution:
    """One quantity over trials: values (n,), its unit, and a published figure to compare with."""

    name: str
    values: Floats
    unit: str = ""
    published: float | None = None

    @property
    def mean_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean."""
        half = 1.96 * float(np.std(self.values, ddof=1)) / np.sqrt(len(self.values)) if len(self.values) > 1 else np.nan
        mean = float(np.mean(self.values))
        return mean - half, mean + half

    @property
    def middle(self) -> tuple[float, float]:
        """Bounds of the middle 90 % of the trials."""
        five, ninety_five = np.percentile(self.values, [5, 95])
        return float(five), float(ninety_five)

    @property
    def published_percentile(self) -> float | None:
        """Share of the trials below the published figure [%]."""
        if self.published is None:
            return None
        return 100.0 * float(np.mean(self.values < self.published))


@styled
def distributions(rows: Sequence[Distribution], *, source: str = "the paper") -> Figure:
    """Small histograms, two a line: mean with 95 % interval, middle 90 % of trials, the published figure."""
    across = min(2, max(len(rows), 1))
    lines = -(-len(rows) // across)
    figure = new_figure(0.4 + 1.7 * lines)
    axes = figure.subplots(lines, across, squeeze=False)
    for ax, row in zip(axes.flat, rows, strict=False):
        _panel(ax, row, source)
    for ax in axes.flat[len(rows) :]:
        ax.set_axis_off()
    legend_of(figure, axes.flat)
    return figure


def _panel(ax: Axes, row: Distribution, source: str) -> None:
    """One histogram."""
    values = row.values[np.isfinite(row.values)]
    low, high = np.percentile(values, [0.25, 99.75])
    if row.published is not None:
        low, high = min(low, row.published), max(high, row.published)
    margin = 0.04 * (high - low) or 1.0
    height, edges = np.histogram(values, bins=min(60, max(12, int(np.sqrt(len(values))))), range=(low, high))
    ax.stairs(height, edges, fill=True, color=SKY)
    ax.set_xlim(low - margin, high + margin)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    quiet_axis(ax, grid="none")
    top = 1.05 * float(height.max())
    ax.set_ylim(0, 1.28 * top)
    ax.hlines(1.07 * top, *row.middle, color=INK, linewidth=1.0, label="90 % of trials")
    ax.hlines(1.07 * top, *row.mean_interval, color=AFTER, linewidth=5.0, label="mean, 95 % interval")
    ax.plot([float(values.mean())], [1.07 * top], "o", ms=4.5, color=AFTER)
    ax.set_title(shorten(row.name, 40), fontsize=8)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(f"[{unit_text(row.unit)}]" if row.unit else "")
    if row.published is not None:
        ax.axvline(row.published, color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label=source)
        left = row.published > 0.5 * (low + high)
        ax.annotate(
            f"{number(row.published)} · percentile {row.published_percentile:.0f}", (row.published, 1.27 * top),
            xytext=(-3 if left else 3, -1), textcoords="offset points", fontsize=7.5, ha="right" if left else "left",
            va="top", in_layout=False,
        )  # fmt: skip

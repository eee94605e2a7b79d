"""The paper's distance and coordinate criteria before and after calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from ltsim.pages.style import AFTER, BEFORE, INK, category_rows, legend_of, new_figure, styled


@dataclass(frozen=True)
class Criterion:
    """One criterion [um]: mean and largest deviation before and after."""

    name: str
    mean_before: float
    mean_after: float
    max_before: float
    max_after: float
    improvement_percent: float | None = None


@styled
def criteria(rows: Sequence[Criterion]) -> Figure:
    """Two lines a criterion, mean and largest; an arrow runs from before to after."""
    lines = []
    for row in rows:
        change = "" if row.improvement_percent is None else f" ({row.improvement_percent:+.1f} % better)"
        lines.append((f"{row.name}, mean{change}", row.mean_before, row.mean_after))
        lines.append((f"{row.name}, largest", row.max_before, row.max_after))
    figure = new_figure(0.9 + 0.3 * len(lines))
    ax = figure.subplots()
    places = category_rows(ax, [name for name, _, _ in lines])
    for place, (_, before, after) in zip(places, lines, strict=True):
        ax.annotate("", (after, place), (before, place), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.0})
    ax.plot([x[1] for x in lines], places, "o", ms=5, mfc="white", mec=BEFORE, label="before")
    ax.plot([x[2] for x in lines], places, "o", ms=5, color=AFTER, label="after")
    ax.set_xlim(left=0)
    ax.set_xlabel("deviation between stations [µm]")
    legend_of(figure, [ax])
    return figure

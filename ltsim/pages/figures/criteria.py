"""The paper's distance and coordinate criteria before and after calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from ltsim.pages.style import AFTER, BEFORE, INK, category_rows, new_figure, number, on_phone, styled

BESIDE: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8}


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
        lines.append((f"{row.name}, mean", row.mean_before, row.mean_after, _verdict(row.improvement_percent)))
        lines.append((f"{row.name}, largest", row.max_before, row.max_after, ""))
    figure = new_figure(0.75 + 0.3 * len(lines))
    ax = figure.subplots()
    places = category_rows(ax, [line[0] for line in lines])
    for place, (_, before, after, text) in zip(places, lines, strict=True):
        ax.annotate(
            "", xy=(after, place), xytext=(before, place), arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.0}
        )
        away = 6 if before >= after else -6
        for value, colour, beside in ((before, "#5C6166", away), (after, AFTER, -away)):
            side = "left" if beside > 0 else "right"
            ax.annotate(number(value), (value, place), xytext=(beside, 0), color=colour, ha=side, **BESIDE)
        if text:
            ax.annotate(
                text, (1.0, place), xycoords=("axes fraction", "data"), va="center", ha="left", fontsize=8, color=AFTER
            )
    ax.scatter([x[1] for x in lines], places, s=30, facecolors="white", edgecolors=BEFORE, zorder=3, label="before")
    ax.scatter([x[2] for x in lines], places, s=30, color=AFTER, zorder=3, label="after")
    most = max(max(line[1], line[2]) for line in lines)
    ax.set_xlim((-0.3 if on_phone() else -0.1) * most, (1.3 if on_phone() else 1.12) * most)
    ax.set_xlabel("deviation between stations [µm]")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def _verdict(improvement: float | None) -> str:
    """Words for an improvement in percent."""
    if improvement is None:
        return ""
    return f"  {abs(improvement):.1f} % {'better' if improvement >= 0 else 'worse'}"

"""Pictures of an examination: power against strength, p-values of clean recordings, confusion of names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.pages.style import MARKERS, new_figure, styled, svg
from ltsim.recording.files import write_text

from .reliability import reliability_figure
from .score import Row

CURVES = {
    "found": ("single", "found"),
    "named (first or stated)": ("single", "named"),
    "named first": ("single", "named_first"),
    "unknown called unknown, observable right": ("unknown", "and_observable_right"),
    "pairs: both named or stated": ("pair", "both_named_or_stated"),
}
"""Label: kind of recording and what is counted of it."""
KINDS = tuple({f"{kind}_" for kind, _ in CURVES.values()})


def draw(rows: Sequence[Row], summary: dict[str, Any], out: Path) -> None:
    """Write power.svg, reliability.svg, and confusion.svg where effects of the catalogue were hidden."""
    clean = [r["search_p_value"] for r in rows if r["kind"] == "clean" and r["exit"] == 0]
    named = [r for r in rows if r["kind"] in ("single", "mistake") and r["exit"] == 0]
    write_text(out / "power.svg", svg(power_figure(summary, clean)))
    write_text(out / "reliability.svg", svg(reliability_figure(rows)))
    if named:
        write_text(out / "confusion.svg", svg(confusion_figure(named)))


@styled
def power_figure(summary: dict[str, Any], clean: Sequence[float]) -> Figure:
    """Shares against strength, where any was asked; p-values of clean recordings against their own distribution."""
    asked = any(key.startswith(KINDS) for key in summary)
    figure = new_figure(4.0, width=10.0 if asked else 5.0)
    panels = figure.subplots(1, 1 + asked, squeeze=False)[0]
    if asked:
        _power(panels[0], summary)
    _clean(panels[-1], clean)
    return figure


def _power(axes: Axes, summary: dict[str, Any]) -> None:
    for (label, (kind, quantity)), marker in zip(CURVES.items(), MARKERS, strict=False):
        blocks = {int(k.split("_")[1]): b[quantity] for k, b in summary.items() if k.startswith(f"{kind}_")}
        points = [(s, 100 * b["share"], 100 * b["low"], 100 * b["high"]) for s, b in sorted(blocks.items()) if b["of"]]
        if points:
            x, y, low, high = np.array(points).T
            axes.errorbar(x, y, [y - low, high - y], marker=marker, capsize=3, label=label)
    axes.set(xscale="log", xlabel="strength (noncentrality left by the ordinary adjustment)", ylabel="share [%]")
    ticks = sorted({int(k.split("_")[1]) for k in summary if k.startswith(KINDS)})
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.minorticks_off()
    if ticks:
        axes.legend(loc="lower right", frameon=False)


def _clean(axes: Axes, p_values: Sequence[float]) -> None:
    ordered = np.sort(p_values)
    axes.step(ordered, np.arange(1, len(ordered) + 1) / max(len(ordered), 1), where="post", label="clean recordings")
    axes.plot([0, 1], [0, 1], color="0.6", label="as stated")
    axes.set(xlabel="p-value of the search", ylabel="share of clean recordings below", xlim=(0, 1), ylim=(0, 1))
    axes.legend(loc="upper left", frameon=False)


@styled
def confusion_figure(rows: Sequence[Row]) -> Figure:
    """Hidden effects against first findings."""
    truths = sorted({r["truth"] for r in rows})
    names = sorted({*truths, *(r["first"] or "nothing" for r in rows)})
    counts = Counter((r["truth"], r["first"] or "nothing") for r in rows)
    share = np.array([[counts[t, n] for n in names] for t in truths], dtype=np.float64)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1.0)
    figure = new_figure(9.5, width=11.0)
    axes = figure.subplots()
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, truth in enumerate(truths):
        for j, name in enumerate(names):
            if counts[truth, name]:
                colour = "white" if share[i, j] > 0.6 else "black"
                axes.text(j, i, str(counts[truth, name]), ha="center", va="center", fontsize=7, color=colour)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(range(len(truths)), truths, fontsize=7)
    axes.set(xlabel="first finding", ylabel="hidden")
    axes.grid(visible=False)
    return figure

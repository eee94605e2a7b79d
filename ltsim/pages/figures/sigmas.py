"""How well parameters become known by a layout, against the maker's guarantee and against another layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.style import AFTER, BEFORE, GREY, at_right, category_rows, new_figure, number, styled, unit_text


@dataclass(frozen=True)
class SigmaRow:
    """Standard deviations of one parameter in its unit: by the layout, by the reference, and before measuring."""

    name: str
    unit: str
    sigma: float
    prior_sigma: float
    reference: float | None = None


@styled
def sigmas(rows: Sequence[SigmaRow]) -> Figure:
    """Sigma as a share of the prior's, on a logarithmic axis: left is better; the sigma stands at the right."""
    figure = new_figure(0.55 + 0.21 * max(len(rows), 3))
    ax = figure.subplots()
    places = category_rows(ax, [row.name for row in rows])
    share = np.array([row.sigma / row.prior_sigma for row in rows])
    other = np.array([np.nan if r.reference is None else r.reference / r.prior_sigma for r in rows])
    ax.hlines(places, share, other, color=BEFORE, linewidth=1.0, zorder=1)
    if np.isfinite(other).any():
        ax.scatter(other, places, s=28, facecolors="white", edgecolors=BEFORE, zorder=2, label="reference layout")
    ax.scatter(share, places, s=28, color=AFTER, zorder=3, label="this layout")
    ax.axvline(1.0, color=GREY, linewidth=1.0, linestyle=(0, (4, 2)), label="nothing learnt")
    ax.set_xscale("log")
    low = float(np.nanmin(np.concatenate([share, other])))
    ax.set_xlim(0.8 * low, 1.4)
    ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if t >= 0.8 * low]
    ax.set_xticks(ticks, [f"{100 * t:g} %" for t in ticks])
    ax.minorticks_off()
    at_right(ax, places, [f"{number(r.sigma, 2)} {unit_text(r.unit)}" for r in rows])
    ax.set_xlabel("sigma after measuring / sigma of the prior")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure

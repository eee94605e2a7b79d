"""Estimated parameters with their uncertainty against what the maker guarantees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.style import AFTER, GREY, INK, PALE, at_right, category_rows, new_figure, styled, with_unit


@dataclass(frozen=True)
class ParameterRow:
    """One estimate in the unit a person reads; `prior_sigma` is None where nothing was known."""

    name: str
    value: float
    sigma: float
    unit: str
    prior_sigma: float | None = None
    truth: float | None = None

    @property
    def determined(self) -> bool:
        """Whether the measurement tells more than half of what is known of it."""
        return self.prior_sigma is None or self.sigma < 0.7 * self.prior_sigma


@styled
def parameters(rows: Sequence[ParameterRow]) -> Figure:
    """Each estimate in units of its prior sigma with its 95 % interval; the numbers stand at the right.

    Where a parameter has no prior, its own sigma scales it, so its bar is two wide and its place is its
    significance. Hollow marks are parameters that the recording hardly determines.
    """
    figure = new_figure(0.55 + 0.21 * max(len(rows), 3))
    ax = figure.subplots()
    places = category_rows(ax, [row.name for row in rows])
    scales = np.array([row.prior_sigma or row.sigma or 1.0 for row in rows])
    values = np.array([row.value for row in rows]) / scales
    half = 1.96 * np.array([row.sigma for row in rows]) / scales
    ax.axvspan(-1.0, 1.0, color=PALE, zorder=0, label="prior, ± 1 sigma")
    ax.axvline(0.0, color=GREY, linewidth=0.7, zorder=1)
    ax.hlines(places, values - half, values + half, color=AFTER, linewidth=1.8, zorder=2, label="95 % interval")
    clear = np.array([row.determined for row in rows], dtype=bool)
    ax.scatter(values[clear], places[clear], s=26, color=AFTER, zorder=3, label="estimate")
    if (~clear).any():
        ax.scatter(
            values[~clear],
            places[~clear],
            s=26,
            facecolors="white",
            edgecolors=AFTER,
            zorder=3,
            label="hardly determined",
        )
    _truth(ax, rows, places, scales)
    at_right(ax, places, [with_unit(r.value, r.sigma, r.unit) for r in rows])
    ax.set_xlabel("estimate / sigma of the prior")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper right", ncols=5)
    return figure


def _truth(ax: Axes, rows: Sequence[ParameterRow], places: Floats, scales: Floats) -> None:
    """Mark the truth of a simulation where it is known."""
    known = [i for i, row in enumerate(rows) if row.truth is not None]
    if known:
        x = [(rows[i].truth or 0.0) / scales[i] for i in known]
        ax.scatter(x, places[known], s=40, marker="|", color=INK, linewidths=1.6, zorder=4, label="truth")

"""Estimated parameters with their uncertainty against what the maker guarantees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.style import AFTER, GREY, INK, PALE, at_right, category_rows, legend_of, new_figure, styled, with_unit


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

    Where a parameter has no prior, its own sigma scales it. Hollow marks are hardly determined by the recording.
    """
    figure = new_figure(0.75 + 0.2 * max(len(rows), 3))
    ax = figure.subplots()
    places = category_rows(ax, [row.name for row in rows], size=7.0)
    scales = np.array([row.prior_sigma or row.sigma or 1.0 for row in rows])
    values, sigma = (np.array([getattr(row, name) for row in rows]) / scales for name in ("value", "sigma"))
    ax.axvspan(-1.0, 1.0, color=PALE, zorder=0, label="prior, ± 1 sigma")
    ax.axvline(0.0, color=GREY, linewidth=0.7, zorder=1)
    ax.hlines(places, values - 1.96 * sigma, values + 1.96 * sigma, color=AFTER, linewidth=1.8, label="95 % interval")
    clear = np.array([row.determined for row in rows], dtype=bool)
    for chosen, fill, word in ((clear, AFTER, "estimate"), (~clear, "white", "hardly determined")):
        if chosen.any():
            ax.plot(values[chosen], places[chosen], "o", ms=4.5, mfc=fill, mec=AFTER, label=word)
    known = [i for i, row in enumerate(rows) if row.truth is not None]
    if known:
        truth = np.array([rows[i].truth for i in known], dtype=np.float64) / scales[known]
        ax.plot(truth, places[known], "|", ms=9, mew=1.8, color=INK, zorder=4, label="hidden truth")
    at_right(ax, places, [with_unit(r.value, r.sigma, r.unit) for r in rows])
    ax.set_xlabel("estimate / sigma of the prior")
    legend_of(figure, [ax])
    return figure

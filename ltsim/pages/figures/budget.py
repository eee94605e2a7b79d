"""Where the uncertainty of results comes from: one bar a result, one colour a source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.style import CYCLE, GREY, category_rows, new_figure, styled

MOST_SOURCES = 7
"""Sources with a colour of their own; the smallest are drawn together."""


@styled
def budget(names: Sequence[str], shares: Mapping[str, Sequence[float]]) -> Figure:
    """Shares of the variance of each result by source; the sources that matter most over all results come first.

    Parameters
    ----------
    names : sequence of str
        The results.
    shares : mapping of str to sequence of float
        For each source its share of every result, 0 to 1.
    """
    ranked = sorted(shares, key=lambda name: -float(np.sum(shares[name])))
    told, rest = ranked[:MOST_SOURCES], ranked[MOST_SOURCES:]
    rows = {name: np.asarray(shares[name], dtype=np.float64) for name in told}
    if rest:
        rows["all others"] = np.sum([shares[name] for name in rest], axis=0)
    figure = new_figure(0.75 + 0.21 * max(len(names), 3))
    ax = figure.subplots()
    places = category_rows(ax, list(names))
    left = np.zeros(len(names))
    for i, (name, share) in enumerate(rows.items()):
        colour = GREY if name == "all others" else CYCLE[i % len(CYCLE)]
        ax.barh(places, 100 * share, left=100 * left, height=0.62, color=colour, label=name)
        left += share
    ax.set_xlim(0, 100)
    ax.set_xlabel("share of the variance [%]")
    ax.grid(visible=False, axis="y")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    return figure

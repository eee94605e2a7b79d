"""Where a finding is, and what it does beside what was hidden."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.labels import Label, place_labels
from ltsim.pages.style import AFTER, GREY, INK, RED, legend_of, new_figure, quiet_axis, styled

MOST_MARKED = 12
"""Targets that can be told apart in one picture."""


@styled
def hidden_and_found(at: Floats, hidden: Floats, found: Floats, *, axis: str, label: str) -> Figure:
    """Changes of readings (n,) by what was hidden, as rings, and by what was found, over a covariate (n,)."""
    figure = new_figure(2.7)
    ax = figure.subplots()
    order = np.argsort(at, kind="stable")
    ax.axhline(0.0, color=GREY, linewidth=0.7)
    ax.plot(at[order], hidden[order], "-o", ms=5, mfc="none", color=INK, lw=0.8, label="hidden")
    ax.plot(at[order], found[order], "-o", ms=2.4, color=RED, lw=1.2, label="found")
    ax.set_xlabel(axis)
    ax.set_ylabel(label)
    quiet_axis(ax, grid="both")
    legend_of(figure, [ax])
    return figure


@styled
def whereabouts(
    stations: Sequence[str],
    position: Floats,
    targets: Sequence[str],
    points: Floats,
    *,
    marked: Sequence[str],
    pairs: Sequence[tuple[str, str]] = (),
) -> Figure:
    """Stations (S, 3) and targets (T, 3) [m] from above; some names are marked, pairs of them joined by an arrow."""
    figure = new_figure(3.6)
    ax = figure.subplots()
    places = np.concatenate([position, points])[:, :2]
    names = [*stations, *targets]
    hot = np.isin(names, list(marked))
    kinds = np.arange(len(names)) < len(stations)
    for chosen, marker, colour, word in (
        (kinds & ~hot, "^", INK, "station"), (~kinds & ~hot, "o", AFTER, "target"),
        (kinds & hot, "^", RED, "station of the finding"), (~kinds & hot, "o", RED, "target of the finding"),
    ):  # fmt: skip
        if chosen.any():
            ax.plot(*places[chosen].T, marker, ms=6 if marker == "^" else 4.5, color=colour, label=word)
    for pair in pairs:
        start, end = (places[len(stations) + list(targets).index(name)] for name in pair)
        ax.annotate(
            "", end, start, arrowprops={"arrowstyle": "<|-|>", "color": RED, "lw": 1.6, "shrinkA": 5, "shrinkB": 5}
        )
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    quiet_axis(ax, grid="both")
    legend_of(figure, [ax], ncols=2)
    order = np.argsort(~hot, kind="stable")
    place_labels(
        figure, ax,
        [Label(names[i], places[i], 8.0 if hot[i] else 6.5, bold=bool(hot[i]), colour=RED if hot[i] else INK)
         for i in order], places,
    )  # fmt: skip
    return figure

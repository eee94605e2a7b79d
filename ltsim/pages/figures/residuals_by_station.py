"""Residuals of every observable, station by station, before and after."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.residuals import Residuals
from ltsim.pages.style import AFTER, BEFORE, INK, OBSERVABLE_UNIT, new_figure, quiet_axis, shorten, styled, unit_text
from ltsim.recording.recording import OBSERVABLES

MOST_STATIONS = 30


@styled
def residuals_by_station(after: Residuals, before: Residuals | None = None) -> Figure:
    """One panel an observable; each station shows its residuals as dots and their root mean square as a bar.

    Parameters
    ----------
    after : Residuals
    before : Residuals, optional
        Residuals of the same recording without the instrument's parameters or the findings.
    """
    shown = [name for name in OBSERVABLES if after.of(name).any()]
    stations = after.stations[:MOST_STATIONS]
    figure = new_figure(2.1 * max(len(shown), 1))
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for ax, observable in zip(axes, shown, strict=True):
        if before is not None:
            _column(ax, before, observable, stations, shift=-0.17, colour=BEFORE, hollow=True)
        _column(ax, after, observable, stations, shift=0.17 if before else 0.0, colour=AFTER, hollow=False)
        ax.set_title(observable)
        ax.set_ylabel(f"residual [{unit_text(OBSERVABLE_UNIT[observable])}]")
        ax.axhline(0.0, color=INK, linewidth=0.6, zorder=1)
        quiet_axis(ax)
    if len(after) > 600:
        for ax in axes:
            ax.set_rasterization_zorder(2.5)  # dots become one small image an axes; lines stay lines
    crowded = len(stations) > 12
    axes[-1].set_xticks(range(len(stations)), [shorten(s, 14) for s in stations], rotation=60 if crowded else 0)
    axes[-1].set_xlim(-0.6, len(stations) - 0.4)
    if before is not None:
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=4)
    return figure


def _column(
    ax: Axes, residuals: Residuals, observable: str, stations: list[str], *, shift: float, colour: str, hollow: bool
) -> None:
    """Dots and root-mean-square bars of all stations in one panel."""
    word = "before" if hollow else "after"
    for place, station in enumerate(stations):
        values = residuals.residual[residuals.of(observable) & (residuals.station == station)]
        if not len(values):
            continue
        x = place + shift + _spread(len(values))
        ax.scatter(
            x,
            values,
            s=9,
            facecolors="none" if hollow else colour,
            edgecolors=colour,
            linewidths=0.6,
            alpha=0.75,
            zorder=2,
            label=word if place == 0 else None,
        )
        size = float(np.sqrt(np.mean(values**2)))
        ax.vlines(
            place + shift,
            -size,
            size,
            color=INK if not hollow else "#5C6166",
            linewidth=2.6,
            zorder=3,
            label=f"± rms {word}" if place == 0 else "",
            linestyles="solid" if not hollow else (0, (1.2, 0.6)),
        )


def _spread(count: int) -> Floats:
    """Places (count,) across a column so that dots do not hide each other: a fixed low-discrepancy sequence."""
    steps = (np.arange(count) * 0.6180339887) % 1.0
    return np.asarray((steps - 0.5) * 0.26, dtype=np.float64)

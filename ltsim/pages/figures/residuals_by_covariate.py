"""Residuals against what they might depend on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ltsim.arrays import Floats
from ltsim.pages.residuals import COVARIATE_UNIT, Residuals
from ltsim.pages.style import (
    AFTER,
    BEFORE,
    INK,
    OBSERVABLE_UNIT,
    RED,
    new_figure,
    on_phone,
    quiet_axis,
    shorten,
    styled,
    unit_text,
)
from ltsim.recording.recording import OBSERVABLES

USUAL = ("azimuth", "elevation", "distance", "time")


@styled
def residuals_by_covariate(
    after: Residuals, before: Residuals | None = None, *, covariates: Sequence[str] = USUAL
) -> Figure:
    """A grid: one row an observable, one column a covariate; the line is the running mean with its 95 % band.

    Parameters
    ----------
    after : Residuals
    before : Residuals, optional
    covariates : sequence of str
        Names in `after.covariates`; those that are missing are left out.
    """
    names = [name for name in covariates if name in after.covariates]
    shown = [name for name in OBSERVABLES if after.of(name).any()]
    figure = new_figure(1.75 * max(len(shown), 1) + 0.3)
    grid = figure.subplots(len(shown), len(names), sharex="col", sharey="row", squeeze=False)
    for line, observable in zip(grid, shown, strict=True):
        for ax, name in zip(line, names, strict=True):
            if before is not None and name in before.covariates:
                scatter(ax, before, observable, name, colour=BEFORE, hollow=True)
            scatter(ax, after, observable, name, colour=AFTER, hollow=False)
            rows = after.of(observable)
            running_mean(ax, after.covariates[name][rows], after.residual[rows], colour=RED)
        line[0].set_ylabel(f"{observable} [{unit_text(OBSERVABLE_UNIT[observable])}]")
    for ax, name in zip(grid[-1], names, strict=True):
        ax.set_xlabel(axis_text(name))
        if on_phone():
            ax.xaxis.set_major_locator(MaxNLocator(2))
    if before is not None:
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def axis_text(covariate: str) -> str:
    """Label of a covariate's axis."""
    unit = COVARIATE_UNIT.get(covariate, "")
    return f"{shorten(covariate)} [{unit}]" if unit else shorten(covariate)


def scatter(ax: Axes, residuals: Residuals, observable: str, covariate: str, *, colour: str, hollow: bool) -> None:
    """Dots of one observable against one covariate."""
    rows = residuals.of(observable)
    ax.scatter(
        residuals.covariates[covariate][rows],
        residuals.residual[rows],
        s=7,
        facecolors="none" if hollow else colour,
        edgecolors=colour,
        linewidths=0.5,
        alpha=0.6,
        label="before" if hollow else "after",
        zorder=1 if hollow else 2,
    )
    under_dots(ax)


def under_dots(ax: Axes) -> None:
    """The line at zero and the grid of an axes whose dots become one small image; lines stay lines."""
    ax.axhline(0.0, color=INK, linewidth=0.6, zorder=2.6)
    ax.set_rasterization_zorder(2.5)
    quiet_axis(ax, grid="both")


def running_mean(ax: Axes, x: Floats, y: Floats, *, colour: str) -> None:
    """Mean of the dots in about ten equally filled bins, with twice its standard error."""
    good = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[good], kind="stable")
    count = len(order) // 12
    if count < 3:
        return
    bins = np.array_split(order, min(count, 12))
    xs, ys = x[good], y[good]
    centre = np.array([xs[b].mean() for b in bins])
    mean = np.array([ys[b].mean() for b in bins])
    error = np.array([ys[b].std(ddof=1) / np.sqrt(len(b)) for b in bins])
    ax.fill_between(centre, mean - 2 * error, mean + 2 * error, color=colour, alpha=0.25, linewidth=0, zorder=3)
    ax.plot(centre, mean, color=colour, linewidth=1.2, zorder=4, label="running mean ± 2 s.e.")

"""The signature of a finding: the residuals it concerns, before and after it is modelled."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ltsim.pages.figures.residuals_by_covariate import axis_text, running_mean, under_dots
from ltsim.pages.residuals import Residuals
from ltsim.pages.style import AFTER, OBSERVABLE_UNIT, RED, new_figure, on_phone, styled, unit_text
from ltsim.recording.recording import OBSERVABLES


@styled
def signature(
    before: Residuals,
    after: Residuals,
    *,
    covariate: str,
    observables: Sequence[str] = (),
    stations: Sequence[str] = (),
    targets: Sequence[str] = (),
) -> Figure:
    """Left without the finding, right with it; the line is the running mean with its 95 % band.

    Parameters
    ----------
    before, after : Residuals
    covariate : str
        The x axis, a name in the covariates.
    observables, stations, targets : sequence of str
        What the finding is confined to; empty for all. Dots elsewhere are drawn pale.
    """
    shown = [name for name in OBSERVABLES if (not observables or name in observables) and before.of(name).any()]
    figure = new_figure(0.6 + 1.9 * max(len(shown), 1))
    grid = figure.subplots(len(shown), 2, sharex=True, sharey="row", squeeze=False)
    for line, observable in zip(grid, shown, strict=True):
        for ax, residuals, title in zip(line, (before, after), ("without the finding", "with it"), strict=True):
            rows = residuals.of(observable) & np.isfinite(residuals.covariates[covariate])
            here = residuals.at(stations, targets)
            x, y = residuals.covariates[covariate], residuals.residual
            elsewhere = rows & ~here
            pale: dict[str, Any] = {"s": 6, "color": "#C3C8CC", "zorder": 1}
            strong: dict[str, Any] = {"s": 12, "color": AFTER, "zorder": 2, "alpha": 0.85}
            for some, look, word in (
                (elsewhere, pale, "elsewhere"),
                (rows & here, strong, "where the finding acts"),
            ):
                ax.scatter(x[some], y[some], linewidths=0, label=word if some.any() else None, **look)
            running_mean(ax, x[rows & here], y[rows & here], colour=RED)
            under_dots(ax)
            size = float(np.sqrt(np.mean(residuals.w[rows & here] ** 2))) if (rows & here).any() else np.nan
            words = title.removesuffix(" the finding") if on_phone() else title
            ax.set_title(f"{observable} {words}", fontsize=8.5)
            ax.annotate(
                f"normalised rms {size:.2f}", (0.99, 0.98), xycoords="axes fraction", ha="right", va="top", fontsize=7.5
            )
        line[0].set_ylabel(f"residual [{unit_text(OBSERVABLE_UNIT[observable])}]")
    for ax in grid[-1]:
        ax.set_xlabel(axis_text(covariate))
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure

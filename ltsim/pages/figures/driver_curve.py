"""What a carrier does over the covariate that drives it, with its band; over the residuals where it is a reading."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ltsim.arrays import Floats
from ltsim.pages.figures.residuals_by_covariate import scatter
from ltsim.pages.residuals import Residuals
from ltsim.pages.style import AFTER, INK, OBSERVABLE_UNIT, RED, new_figure, quiet_axis, styled, unit_text
from ltsim.units import FACTOR

BAND = 1.96
ANGLES = ("azimuth", "elevation", "incidence", "nest-direction")


@styled
def driver_curve(
    at: Floats,
    value: Floats,
    sigma: Floats,
    *,
    covariate: str,
    carrier: str,
    unit: str,
    residuals: Residuals | None = None,
) -> Figure:
    """The fitted curve with its 95 % band.

    Parameters
    ----------
    at : (k,) float
        Values of the covariate, SI or in the unit of the recording's own column.
    value, sigma : (k,) float
        Of the carrier, in `unit`.
    covariate, carrier, unit : str
    residuals : Residuals, optional
        Without the finding: dots behind the curve of a reading, whose sign is then that of a residual.
    """
    figure = new_figure(2.6)
    ax = figure.subplots()
    factor, label = _axis(covariate)
    x, sign = factor * at, 1.0
    if residuals is not None and covariate in residuals.covariates and carrier in OBSERVABLE_UNIT:
        scatter(ax, residuals, carrier, covariate, colour=AFTER, hollow=True)
        sign = -FACTOR[unit] / FACTOR[OBSERVABLE_UNIT[carrier]]
        unit = OBSERVABLE_UNIT[carrier]
    order = np.argsort(x, kind="stable")
    low, high = (sign * (value + s * BAND * sigma) for s in (-1.0, 1.0))
    ax.fill_between(x[order], low[order], high[order], color=RED, alpha=0.2, linewidth=0)
    ax.plot(x[order], (sign * value)[order], color=RED, linewidth=1.4)
    ax.axhline(0.0, color=INK, linewidth=0.6)
    ax.set_xlabel(label)
    ax.set_ylabel(f"{carrier} [{unit_text(unit)}]")
    quiet_axis(ax, grid="both")
    return figure


def _axis(covariate: str) -> tuple[float, str]:
    """Factor from the stored unit to the axis's, and the axis's label."""
    if covariate.endswith(ANGLES):
        return float(np.degrees(1.0)), f"{covariate} [deg]"
    if covariate in ("time", "station-time", "lapse"):
        return 1.0 / 60.0, f"{covariate} [min]"
    if covariate in ("distance", "height", "x", "y", "z"):
        return 1.0, f"{covariate} [m]"
    return 1.0, covariate

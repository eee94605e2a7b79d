"""Figures of residuals by station and over covariates, and of the findings of a diagnosis."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import SI_PER_UNIT
from ltsim.diagnosis.schema import FindingScope, ResponseCurve
from ltsim.recordings.recording import OBSERVABLES
from ltsim.reports import style
from ltsim.reports.residuals import COVARIATE_UNITS, DEFAULT_COVARIATES, OBSERVABLE_UNITS, Residuals

MAX_STATION_PANELS = 30
"""Largest number of stations in the figure of residuals by station; only the first stations are drawn."""
MAX_VECTOR_DOTS = 40
"""Largest number of dots that a series of a figure draws as vectors; more dots are rasterised."""
INTERVAL_95_HALF_WIDTH_SIGMAS = 1.96
"""Half-width of a 95 % interval of a normal distribution, in standard deviations."""


@style.with_figure_style
def residuals_by_covariate_figure(residuals: Residuals) -> Figure:
    """Figure of the normalised residuals of all observables over each available covariate, with running means."""
    names = [name for name in DEFAULT_COVARIATES if name in residuals.covariates]
    figure = style.new_figure(2.0 * max(-(-len(names) // 2), 1) + 0.4)
    axes = figure.subplots(-(-len(names) // 2), 2, sharey=True, squeeze=False)
    for ax, name in zip(axes.flat, names, strict=False):
        for observable, colour in zip(OBSERVABLES, style.COLOUR_CYCLE, strict=False):
            rows = residuals.observable_mask(observable) & np.isfinite(residuals.normalised_residual)
            x, w = residuals.covariates[name][rows], residuals.normalised_residual[rows]
            ax.plot(x, w, ".", ms=2.0, color=colour, alpha=0.35, rasterized=len(w) > MAX_VECTOR_DOTS, zorder=1.5)
            _draw_running_mean(ax, x, w, colour=colour, label=observable)
        ax.axhline(0.0, color=style.INK_COLOUR, linewidth=0.6)
        style.set_grid(ax, grid_axis="both")
        ax.xaxis.set_major_locator(MaxNLocator(5))
        ax.set_xlabel(covariate_axis_label(name))
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    for ax in axes[:, 0]:
        ax.set_ylabel("residual / its sigma")
    style.add_legend(figure, axes.flat)
    return figure


@style.with_figure_style
def residuals_by_station_figure(residuals: Residuals, reference: Residuals | None = None) -> Figure:
    """Figure of residuals by station as dots, with their root mean square as a bar; one panel per observable.

    `reference` are the residuals before a correction, drawn next to the residuals in another colour.
    """
    observables = [name for name in OBSERVABLES if residuals.observable_mask(name).any()]
    stations = residuals.stations[:MAX_STATION_PANELS]
    figure = style.new_figure(1.7 * max(len(observables), 1) + 0.4)
    axes = figure.subplots(len(observables), 1, sharex=True, squeeze=False)[:, 0]
    series = [(residuals, 0.18 if reference else 0.0, style.COLOUR_AFTER, "after")]
    series += [(reference, -0.18, style.COLOUR_BEFORE, "before")] if reference is not None else []
    for ax, observable in zip(axes, observables, strict=True):
        for series_residuals, offset, colour, word in series:
            for station_index, station in enumerate(stations):
                is_shown = series_residuals.observable_mask(observable) & (series_residuals.station_names == station)
                values = series_residuals.displayed_residual[is_shown]
                x = station_index + offset + 0.26 * ((np.arange(len(values)) * 0.618034) % 1.0 - 0.5)
                label, is_rasterized = (word if station_index == 0 else None), len(values) > MAX_VECTOR_DOTS
                ax.plot(
                    x, values, ".", ms=2.5, color=colour, alpha=0.7, label=label, rasterized=is_rasterized, zorder=1.5
                )
                rms = float(np.sqrt(np.mean(values**2))) if len(values) else np.nan
                bar_label = f"± rms {word}" if station_index == 0 else None
                ax.vlines(station_index + offset, -rms, rms, color=colour, linewidth=3.0, alpha=0.8, label=bar_label)
        ax.set_ylabel(_observable_label(observable))
        ax.axhline(0.0, color=style.INK_COLOUR, linewidth=0.6)
        style.set_grid(ax)
    axes[-1].set_xticks(
        range(len(stations)), [style.shortened_name(s, 14) for s in stations], rotation=60 * (len(stations) > 8)
    )
    axes[-1].set_xlim(-0.6, len(stations) - 0.4)
    style.add_legend(figure, axes[:1], n_columns=4)
    return figure


@style.with_figure_style
def finding_comparison_figure(
    without_finding: Residuals, with_finding: Residuals, covariate: str, scope: FindingScope
) -> Figure:
    """Figure of residuals over a covariate, from models without (left) and with (right) a finding of a diagnosis.

    Each row of panels shows one observable. `scope` contains the stations, targets and observables of the finding.
    Residuals at other stations and targets are pale dots.
    """
    observables = [
        n
        for n in OBSERVABLES
        if (not scope.observables or n in scope.observables) and without_finding.observable_mask(n).any()
    ]
    figure = style.new_figure(0.5 + 1.8 * max(len(observables), 1))
    grid = figure.subplots(len(observables), 2, sharex=True, sharey="row", squeeze=False)
    normalised_residuals = (
        without_finding.normalised_residual,
        with_finding.normalised_by_noise_of(without_finding).normalised_residual,
    )
    for panel_row, observable in zip(grid, observables, strict=True):
        for ax, residuals, normalised, model_text in zip(
            panel_row, (without_finding, with_finding), normalised_residuals, ("without", "with it"), strict=True
        ):
            rows = residuals.observable_mask(observable) & np.isfinite(residuals.covariates[covariate])
            is_at_finding = rows & residuals.station_and_target_mask(scope.stations, scope.targets)
            if (rows & ~is_at_finding).any():
                _draw_residuals(
                    ax, residuals, rows & ~is_at_finding, covariate, color=style.GREY, label="elsewhere", ms=2.0
                )
            _draw_residuals(
                ax,
                residuals,
                is_at_finding,
                covariate,
                color=style.COLOUR_AFTER,
                label="readings of the finding",
                ms=4.0,
            )
            _draw_running_mean(
                ax,
                residuals.covariates[covariate][is_at_finding],
                residuals.displayed_residual[is_at_finding],
                label="running mean",
            )
            w = normalised[is_at_finding]
            rms = float(np.sqrt(np.mean(w[np.isfinite(w)] ** 2))) if np.isfinite(w).any() else 0.0
            ax.set_title(f"{model_text}: rms {rms:.2f} of the noise", fontsize=8, fontweight="normal")
        panel_row[0].set_ylabel(_observable_label(observable))
    for ax in grid[-1]:
        ax.set_xlabel(covariate_axis_label(covariate))
    style.add_legend(figure, grid[0, :1])
    return figure


@style.with_figure_style
def response_curve_figure(curve: ResponseCurve, response: str, residuals: Residuals | None = None) -> Figure:
    """Figure of the estimated curve of an observable or an instrument constant over its covariate, with the 95 % band.

    For an observable, the residuals of the model without the finding are drawn as dots behind the curve, and the curve
    has the sign of a residual (observed minus adjusted). `response` is the name of the observable or constant.
    """
    at, value, sigma = (np.array(values) for values in (curve.at, curve.value, curve.sigma))
    covariate, unit = curve.covariate, curve.unit
    if residuals is not None and covariate == "time":
        covariate = residuals.measurement_order_covariate
    figure, ax = style.new_panel(2.6)
    factor, label = _axis_factor_and_label(covariate)
    sign = 1.0
    if residuals is not None and covariate in residuals.covariates and response in OBSERVABLE_UNITS:
        rows, dots_label = residuals.observable_mask(response), "residuals without the finding"
        _draw_residuals(ax, residuals, rows, covariate, color=style.COLOUR_BEFORE, label=dots_label, ms=2.5)
        sign = -SI_PER_UNIT[unit] / SI_PER_UNIT[OBSERVABLE_UNITS[response]]
        unit = OBSERVABLE_UNITS[response]
    order = np.argsort(at, kind="stable")
    x, y, half_width = factor * at[order], sign * value[order], abs(sign) * INTERVAL_95_HALF_WIDTH_SIGMAS * sigma[order]
    ax.fill_between(x, y - half_width, y + half_width, color=style.RED, alpha=0.2, linewidth=0, label="95 % band")
    ax.plot(x, y, color=style.RED, label="estimate")
    ax.axhline(0.0, color=style.INK_COLOUR, linewidth=0.6)
    ax.set_xlabel(label)
    ax.set_ylabel(f"{response} [{style.unit_text(unit)}]")
    style.set_grid(ax, grid_axis="both")
    style.add_legend(figure, [ax])
    return figure


def covariate_axis_label(covariate: str) -> str:
    """Label of the axis of a covariate, with its unit."""
    unit = COVARIATE_UNITS.get(covariate, "")
    return f"{style.shortened_name(covariate)} [{unit}]" if unit else style.shortened_name(covariate)


def _axis_factor_and_label(covariate: str) -> tuple[float, str]:
    """Factor from the SI unit of a covariate to the unit of the axis, and label of the axis."""
    if covariate.endswith(("azimuth", "elevation", "incidence", "nest-direction")):
        return float(np.degrees(1.0)), f"{covariate} [°]"
    if covariate in ("time", "station-time", "lapse"):
        return 1.0 / 60.0, f"{covariate} [min]"
    return 1.0, f"{covariate} [m]" if covariate in ("distance", "height", "x", "y", "z") else covariate


def _observable_label(observable: str) -> str:
    """Axis label of an observable with its unit."""
    return f"{observable} [{style.unit_text(OBSERVABLE_UNITS[observable])}]"


def _draw_residuals(ax: Axes, residuals: Residuals, is_drawn: Bools, covariate: str, **style_options: Any) -> None:
    """Draw residuals over a covariate with a line at zero; `style_options` is passed to matplotlib."""
    is_rasterized = int(is_drawn.sum()) > MAX_VECTOR_DOTS
    x, y = residuals.covariates[covariate][is_drawn], residuals.displayed_residual[is_drawn]
    ax.plot(x, y, ".", alpha=0.7, rasterized=is_rasterized, zorder=1.5, **style_options)
    ax.axhline(0.0, color=style.INK_COLOUR, linewidth=0.6)
    style.set_grid(ax, grid_axis="both")


def _draw_running_mean(ax: Axes, x: Floats, values: Floats, *, colour: str = style.RED, label: str = "mean") -> None:
    """Draw means over `x` in about ten bins with equally many values, with a band of twice the standard error."""
    is_valid = np.isfinite(x) & np.isfinite(values)
    order = np.flatnonzero(is_valid)[np.argsort(x[is_valid], kind="stable")]
    bins = np.array_split(order, min(len(order) // 12, 12)) if len(order) >= 36 else []
    if not bins:
        return
    centre, mean = (np.array([column[b].mean() for b in bins]) for column in (x, values))
    error = np.array([values[b].std(ddof=1) / np.sqrt(len(b)) for b in bins])
    ax.fill_between(centre, mean - 2 * error, mean + 2 * error, color=colour, alpha=0.25, linewidth=0)
    ax.plot(centre, mean, color=colour, linewidth=1.4, label=label)


@style.with_figure_style
def injected_and_estimated_figure(
    covariate: Floats, injected_changes: Floats, estimated_changes: Floats, axis: str, label: str
) -> Figure:
    """Figure of injected changes (n,) of n readings as rings, estimated changes (n,) as dots, over a covariate.

    `axis` is the axis label of the `covariate` (n,), `label` the axis label of the changes.
    """
    figure, ax = style.new_panel(2.7)
    order = np.argsort(covariate, kind="stable")
    ax.axhline(0.0, color=style.GREY, linewidth=0.7)
    ax.plot(
        covariate[order],
        injected_changes[order],
        "-o",
        ms=5,
        mfc="none",
        color=style.INK_COLOUR,
        lw=0.8,
        label="injected",
    )
    ax.plot(covariate[order], estimated_changes[order], "-o", ms=2.4, color=style.RED, lw=1.2, label="estimated")
    ax.set_xlabel(axis)
    ax.set_ylabel(label)
    style.set_grid(ax, grid_axis="both")
    style.add_legend(figure, [ax])
    return figure

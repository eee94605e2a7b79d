"""Figures of parameters, correlations, calibration histories, disagreements of stations, uncertainty budgets, plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from ltsim.calibration.schema import ParameterEntry
from ltsim.core.arrays import Floats
from ltsim.core.notation import number_text, with_sigma
from ltsim.core.results import Table
from ltsim.reports import style
from ltsim.reports.formatting import (
    QUALITY_MEASURE_BY_GOAL,
    is_determined_by_readings,
    labels_without_common_prefix,
    typographic_text,
)

if TYPE_CHECKING:
    from ltsim.calibration.history import ParameterHistory
    from ltsim.planning.plan_entries import PlannedParameterEntry
    from ltsim.planning.result import Plan


def parameter_labels(parameters: Sequence[ParameterEntry]) -> list[str]:
    """Names of parameters, each with its instrument if there are several instruments."""
    return [f"{row.name} ({row.instrument})" if row.instrument else row.name for row in parameters]


@style.with_figure_style
def parameter_estimates_figure(
    parameters: Sequence[ParameterEntry], true_values: Sequence[float | None] = ()
) -> Figure:
    """Figure of parameter estimates in units of their prior sigma with 95 % intervals; values at the right.

    The estimate of a parameter without a prior is divided by its sigma. Hollow markers show parameters that the
    recording hardly determines. `true_values` are the values of a simulation, None for a parameter without such a
    value.
    """
    figure, ax = style.new_panel(0.75 + 0.2 * max(len(parameters), 3))
    places = style.set_category_rows(ax, parameter_labels(parameters), font_size=7.0)
    scales = np.array([row.prior_sigma or row.sigma or 1.0 for row in parameters])
    values, sigma = (
        np.array([getattr(row, name) or 0.0 for row in parameters]) / scales for name in ("value", "sigma")
    )
    ax.axvspan(-1.0, 1.0, color=style.BAND_COLOUR, linewidth=0, zorder=0, label="prior, ± 1 sigma")
    ax.axvline(0.0, color=style.GREY, linewidth=0.7, zorder=1)
    ax.hlines(
        places,
        values - 1.96 * sigma,
        values + 1.96 * sigma,
        color=style.COLOUR_AFTER,
        linewidth=1.8,
        label="95 % interval",
    )
    is_well_determined = np.array(
        [is_determined_by_readings(row.sigma, row.prior_sigma) for row in parameters], dtype=bool
    )
    for chosen, face_colour, legend_label in (
        (is_well_determined, style.COLOUR_AFTER, "estimate"),
        (~is_well_determined, "white", "hardly determined"),
    ):
        if chosen.any():
            ax.plot(
                values[chosen], places[chosen], "o", ms=4.5, mfc=face_colour, mec=style.COLOUR_AFTER, label=legend_label
            )
    indices_with_truth = [i for i, value in enumerate(true_values) if value is not None]
    if indices_with_truth:
        truth = np.array([true_values[i] for i in indices_with_truth], dtype=np.float64) / scales[indices_with_truth]
        ax.plot(
            truth, places[indices_with_truth], "|", ms=9, mew=1.8, color=style.INK_COLOUR, zorder=4, label="true value"
        )
    style.write_at_right_of_rows(ax, places, [with_sigma(r.value, r.sigma, r.unit) for r in parameters])
    ax.set_xlabel("estimate / sigma of the prior")
    style.add_legend(figure, [ax])
    return figure


@style.with_figure_style
def predicted_sigmas_figure(
    parameters: Sequence[PlannedParameterEntry], reference_sigmas: Mapping[str, float]
) -> Figure:
    """Figure of the predicted sigma of each parameter divided by its prior sigma, on a logarithmic axis.

    The sigmas are written at the right. `reference_sigmas` are the predicted sigmas of another layout, by parameter.
    """
    figure, ax = style.new_panel(0.55 + 0.21 * max(len(parameters), 3))
    places = style.set_category_rows(ax, [row.name for row in parameters])
    ratios = np.array([row.sigma / row.prior_sigma for row in parameters])
    reference_ratios = np.array([reference_sigmas.get(row.name, np.nan) / row.prior_sigma for row in parameters])
    ax.hlines(places, ratios, reference_ratios, color=style.COLOUR_BEFORE, linewidth=1.0, zorder=1)
    if np.isfinite(reference_ratios).any():
        ax.scatter(
            reference_ratios,
            places,
            s=28,
            facecolors="white",
            edgecolors=style.COLOUR_BEFORE,
            zorder=2,
            label="reference layout",
        )
    ax.scatter(ratios, places, s=28, color=style.COLOUR_AFTER, zorder=3, label="this layout")
    ax.axvline(1.0, color=style.GREY, linewidth=1.0, linestyle=(0, (4, 2)), label="no information")
    ax.set_xscale("log")
    low = float(np.nanmin(np.concatenate([ratios, reference_ratios])))
    ax.set_xlim(0.8 * low, 1.4)
    ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if t >= 0.8 * low]
    ax.set_xticks(ticks, [f"{100 * t:g} %" for t in ticks])
    ax.minorticks_off()
    style.write_at_right_of_rows(
        ax, places, [f"{number_text(r.sigma, 2)} {style.unit_text(r.unit)}" for r in parameters]
    )
    ax.set_xlabel("sigma after measuring / sigma of the prior")
    style.add_legend(figure, [ax])
    return figure


MAX_CORRELATED_PARAMETERS = 24
"""Largest number of parameters in a figure of correlations."""


@style.with_figure_style
def correlation_figure(parameters: Sequence[ParameterEntry], covariance: Floats) -> Figure:
    """Figure of the correlations of p parameters with a covariance matrix (p, p), as colours.

    Correlations above 0.3 are also given as numbers [%]. If there are more than 24 parameters, the 24 with the largest
    correlations are shown, with a note.
    """
    names, sigma = parameter_labels(parameters), np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    matrix = covariance / np.outer(scale, scale)
    largest_correlations = np.abs(np.where(np.eye(len(names), dtype=bool), 0.0, matrix)).max(axis=1, initial=0.0)
    shown_indices = np.sort(np.argsort(-largest_correlations, kind="stable")[:MAX_CORRELATED_PARAMETERS])
    count, matrix = len(shown_indices), matrix[np.ix_(shown_indices, shown_indices)]
    figure, ax = style.new_panel(2.2 + 0.15 * count)
    if count < len(names):
        ax.set_title(
            f"the {count} of {len(names)} parameters with the largest correlations", fontsize=7.5, fontweight="normal"
        )
    ax.set_facecolor("#DDE1E4")
    table = np.where(np.eye(count, dtype=bool), np.nan, matrix)
    colours = ax.pcolormesh(table, cmap=style.DIVERGING_COLOUR_MAP, vmin=-1, vmax=1)
    ax.invert_yaxis()
    labels = [style.shortened_name(names[i], 26) for i in shown_indices]
    ax.set_xticks(np.arange(count) + 0.5, labels, rotation=60, ha="right", rotation_mode="anchor", fontsize=6.5)
    ax.set_yticks(np.arange(count) + 0.5, labels, fontsize=6.5)
    ax.tick_params(length=0)
    ax.grid(visible=False)
    ax.spines[:].set_visible(False)
    for i, j in zip(*np.nonzero(np.abs(np.nan_to_num(table)) > 0.3), strict=True):
        colour = style.TEXT_COLOUR_ON_DARK if abs(matrix[i, j]) > 0.6 else style.TEXT_COLOUR_ON_LIGHT
        ax.text(j + 0.5, i + 0.5, f"{100 * matrix[i, j]:.0f}", ha="center", va="center", fontsize=5.5, color=colour)
    colour_bar = figure.colorbar(colours, ax=ax, shrink=0.7, pad=0.02)
    colour_bar.set_label("correlation (numbers: %)")
    colour_bar.outline.set_visible(False)
    return figure


@style.with_figure_style
def parameter_history_figure(names: Sequence[str], parameter_histories: Sequence[ParameterHistory]) -> Figure:
    """Figure of the estimates of each parameter in all calibrations with 95 % intervals, one panel per parameter.

    The band is the mean over the calibrations, plus and minus the standard deviation of the true values between them.
    """
    columns = 2 if len(parameter_histories) > 1 else 1
    n_panel_rows = max(1, -(-len(parameter_histories) // columns))
    figure = style.new_figure(0.7 + 1.35 * n_panel_rows)
    panels = figure.subplots(n_panel_rows, columns, sharex=True, squeeze=False)
    labels = [style.shortened_name(name, 24) for name in labels_without_common_prefix(names)]
    positions = np.arange(len(labels))
    for ax, course in zip(panels.ravel(), parameter_histories, strict=False):
        band = (course.mean - course.between_calibration_sigma, course.mean + course.between_calibration_sigma)
        ax.axhspan(*band, color=style.BAND_COLOUR, linewidth=0, zorder=0, label="mean ± spread between calibrations")
        ax.axhline(0.0, color=style.GREY, linewidth=0.7, zorder=1)
        half_widths = 1.96 * np.array(course.sigmas)
        ax.errorbar(
            positions,
            course.values,
            half_widths,
            fmt="o",
            ms=3.5,
            color=style.COLOUR_AFTER,
            lw=1.2,
            label="estimate, 95 % interval",
        )
        ax.set_title(f"{course.name} [{style.unit_text(course.unit)}]", fontsize=8, loc="right")
        ax.set_xticks(positions, labels, rotation=60, ha="right", fontsize=7)
        ax.set_xlim(-0.5, len(positions) - 0.5)
        style.set_grid(ax)
    for ax in panels.ravel()[len(parameter_histories) :]:
        ax.set_axis_off()
        panels[-2, -1].tick_params(labelbottom=True)
    if parameter_histories:
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure


@style.with_figure_style
def criteria_before_after_figure(criteria: Table) -> Figure:
    """Figure of the disagreement of the stations (mean and largest) before and after a calibration.

    `criteria` is a table `CRITERIA_TABLE` with the disagreements in distances and in coordinates. Arrows point from
    before to after.
    """
    lines = []
    for row in criteria.json_rows():
        change = "" if row["improvement_percent"] is None else f" ({row['improvement_percent']:+.1f} % better)"
        lines.append((f"{row['criterion']}, mean{change}", row["mean_um"], row["mean_after_um"]))
        lines.append((f"{row['criterion']}, largest", row["max_um"], row["max_after_um"]))
    figure, ax = style.new_panel(0.9 + 0.3 * len(lines))
    places = style.set_category_rows(ax, [name for name, _, _ in lines])
    for place, (_, before, after) in zip(places, lines, strict=True):
        ax.annotate(
            "", (after, place), (before, place), arrowprops={"arrowstyle": "-|>", "color": style.INK_COLOUR, "lw": 1.0}
        )
    ax.plot([x[1] for x in lines], places, "o", ms=5, mfc="white", mec=style.COLOUR_BEFORE, label="before")
    ax.plot([x[2] for x in lines], places, "o", ms=5, color=style.COLOUR_AFTER, label="after")
    ax.set_xlim(left=0)
    ax.set_xlabel("deviation between stations [µm]")
    style.add_legend(figure, [ax])
    return figure


MAX_BUDGET_SOURCES = 7
"""Largest number of sources of uncertainty with separate colours; the smaller sources are summed."""


@style.with_figure_style
def variance_budget_figure(names: Sequence[str], variance_fractions: Mapping[str, Sequence[float]]) -> Figure:
    """Figure of the fractions of the variance of each result by source of uncertainty, the largest sources first.

    Parameters
    ----------
    names : sequence of str
        Names of the results.
    variance_fractions : mapping of str to sequence of float
        Fraction of the variance by source in every result, 0 to 1.
    """
    ranked = sorted(variance_fractions, key=lambda name: -float(np.sum(variance_fractions[name])))
    largest, smaller_sources = ranked[:MAX_BUDGET_SOURCES], ranked[MAX_BUDGET_SOURCES:]
    fractions_by_name = {name: np.asarray(variance_fractions[name], dtype=np.float64) for name in largest}
    if smaller_sources:
        fractions_by_name["all others"] = np.sum([variance_fractions[name] for name in smaller_sources], axis=0)
    figure, ax = style.new_panel(0.55 + 0.21 * max(len(names), 3) + style.legend_height(list(fractions_by_name), 2))
    places = style.set_category_rows(ax, list(names))
    bar_starts = np.zeros(len(names))
    for i, (name, fractions) in enumerate(fractions_by_name.items()):
        colour = style.GREY if name == "all others" else style.COLOUR_CYCLE[i % len(style.COLOUR_CYCLE)]
        ax.barh(places, 100 * fractions, left=100 * bar_starts, height=0.62, color=colour, label=name)
        bar_starts += fractions
    ax.set_xlim(0, 100)
    ax.set_xlabel("part of the variance [%]")
    ax.grid(visible=False, axis="y")
    style.add_legend(figure, [ax], n_columns=2)
    return figure


ValueWithInterval = tuple[float, float, float]
"""Value, followed by the lower and the upper limit of its interval."""


@style.with_figure_style
def values_with_intervals_figure(
    values_by_name: Mapping[str, ValueWithInterval],
    label: str,
    *,
    reference_values: Mapping[str, Sequence[float]] | None = None,
) -> Figure:
    """Figure of values with intervals, one row for each name; dashed lines at reference values.

    `values_by_name` has the value and its limits by name, and `label` is the axis label. `reference_values` has the
    label of each group of lines as key, and as value the reference values of the rows.
    """
    lines = ["\n".join(wrap(name, 34)) for name in values_by_name]
    figure, ax = style.new_panel(0.9 + 0.15 * sum(1.4 + name.count("\n") for name in lines))
    places = style.set_category_rows(ax, lines)
    ax.set_yticks(places, lines)
    value, low, high = np.array(list(values_by_name.values())).T
    ax.hlines(places, low, high, color=style.COLOUR_AFTER, linewidth=1.8)
    ax.plot(value, places, "o", ms=4.5, color=style.COLOUR_AFTER)
    for colour, (legend_label, positions) in zip(
        (style.INK_COLOUR, style.RED, style.GREY), (reference_values or {}).items(), strict=False
    ):
        for position in positions:
            ax.axvline(position, color=colour, linewidth=1.0, linestyle=(0, (4, 2)), label=legend_label)
    figure.supxlabel(typographic_text(label), fontsize=8.5)
    style.add_legend(figure, [ax])
    return figure


@style.with_figure_style
def lines_with_intervals_figure(
    positions: Sequence[float], lines: Mapping[str, Sequence[ValueWithInterval]], x_title: str, y_title: str
) -> Figure:
    """Figure of lines through values with intervals at n `positions` on the x axis."""
    figure, ax = style.new_panel(2.7)
    for name, rows, colour, marker in zip(lines, lines.values(), style.COLOUR_CYCLE, style.MARKERS, strict=False):
        value, low, high = np.array(rows).T
        half_widths = np.maximum([value - low, high - value], 0.0)
        ax.errorbar(positions, value, half_widths, color=colour, marker=marker, ms=4.0, lw=1.2, label=name)
    ax.set_xlabel(typographic_text(x_title))
    ax.set_ylabel(typographic_text(y_title))
    style.set_grid(ax, grid_axis="both")
    style.add_legend(figure, [ax])
    return figure


MAX_LABELLED_LAYOUTS = 14
"""Largest number of layouts with a label in a figure; the first layouts are labelled."""
LAYOUT_COLOURS = {"tried": style.GREY, "best": style.BLUE, "chosen": style.RED, "reference": style.GREEN}
"""Colour of a layout in the figure of quality over duration, by its role (`chosen` is the plan)."""
LAYOUT_MARKERS = {"tried": ".", "best": "o", "chosen": "*", "reference": "D"}
"""Marker of a layout in the figure of quality over duration, by its role (`chosen` is the plan)."""
LAYOUT_MARKER_SIZES = {"tried": 34, "best": 30, "chosen": 150, "reference": 46}
"""Area of the marker of a layout [pt^2] in the figure of quality over duration, by its role."""
LAYOUT_LABELS = {"tried": "tried", "best": "best in its time", "chosen": "the plan", "reference": "reference"}
"""Label of a layout in the legend of the figure of quality over duration, by its role."""


@style.with_figure_style
def trade_off_figure(plan: Plan, quality_name: str) -> Figure:
    """Figure of the quality of each layout over its duration, by the measure `quality_name`.

    A line joins the layouts whose quality no faster layout exceeds.
    """
    label, factor = QUALITY_MEASURE_BY_GOAL.get(quality_name, (quality_name, 1.0))
    points_by_role: dict[str, list[tuple[float, float, str]]] = {"tried": [], "best": [], "reference": [], "chosen": []}
    for option in plan.tradeoff_points:
        layout_text = f"{option.station_count}s {option.faces}f {option.repeats}r"
        points_by_role["best" if option.is_efficient else "tried"].append(
            (option.hours, option.qualities.get(quality_name) or np.nan, layout_text)
        )
    for role, layout in (("reference", plan.reference_layout), ("chosen", plan)):
        if layout is not None and layout.qualities.get(quality_name) is not None:
            points_by_role[role].append((layout.hours, layout.qualities[quality_name] or np.nan, ""))
    figure, ax = style.new_panel(3.2)
    all_qualities = np.array([factor * quality for points in points_by_role.values() for _, quality, _ in points])
    for role, points in points_by_role.items():
        if points:
            hours, quality = zip(*((h, factor * q) for h, q, _ in sorted(points)), strict=True)
            marker_style: dict[str, Any] = {
                "marker": LAYOUT_MARKERS[role],
                "s": LAYOUT_MARKER_SIZES[role],
                "color": LAYOUT_COLOURS[role],
                "label": LAYOUT_LABELS[role],
            }
            ax.scatter(hours, quality, zorder=4 if role != "tried" else 2, linewidths=0, **marker_style)
            if role == "best":
                ax.plot(hours, quality, color=style.BLUE, linewidth=1.0, zorder=3)
    for hour, size, layout_text in points_by_role["best"][:MAX_LABELLED_LAYOUTS]:
        ax.annotate(layout_text, (hour, factor * size), xytext=(6, 5), textcoords="offset points", fontsize=7.5)
    if (all_qualities > 0).all() and all_qualities.max() > 20 * all_qualities.min():
        ax.set_yscale("log")
    ax.margins(x=0.1, y=0.12)
    ax.set_xlabel("time for the measurement [h]; s: stations, f: faces, r: rounds")
    ax.set_ylabel(f"{typographic_text(label)}\n(lower is better)")
    style.set_grid(ax, grid_axis="both")
    style.add_legend(figure, [ax], n_columns=2)
    return figure

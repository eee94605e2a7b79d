"""Figures of campaigns: distributions over trials, means over factors, coverage of intervals."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ltsim.campaigns.design import Factor
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.statistics import NORMAL_QUANTILE_95
from ltsim.campaigns.summary import ZScoreSummary
from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, unknown_name_error
from ltsim.core.notation import number_text
from ltsim.core.units import UNIT_BY_KEY_ENDING
from ltsim.reports import style
from ltsim.reports.formatting import typographic_text

MAX_FIGURE_PANELS = 12
"""Largest number of panels of a figure; further panels are drawn in further figures or omitted."""
MAX_PANEL_LINES = 8
"""Largest number of lines of a panel; further lines are omitted."""
Y_LABEL_LINE_LENGTH_PER_PANEL_ROW = 26
"""Width [characters] at which the label of the y axis is broken, for each row of panels in the figure."""
CENTRAL_90_PERCENT_LABEL = "90 % of trials"
"""Label, in figures, of the band between the 5 % and 95 % quantiles of the trials."""
NOISE_FLOOR_LABEL = "noise floor"
"""Label, in figures, of the error of readings corrected with the true parameters, so that only noise remains."""
PUBLISHED_CRITERIA_BY_SCENARIO = MappingProxyType(
    {
        "paper-workshop": {
            "coordinate_before_max_um": 149.0, "coordinate_before_mean_um": 46.0, "distance_before_max_um": 60.0,
            "distance_before_mean_um": 29.0, "coordinate_after_max_um": 118.0, "coordinate_after_mean_um": 39.0,
            "distance_after_max_um": 39.0, "distance_after_mean_um": 17.0, "coordinate_improvement_percent": 14.47,
            "distance_improvement_percent": 40.1,
        },
        "paper-laboratory": {
            "coordinate_before_max_um": 54.0, "coordinate_before_mean_um": 21.0, "distance_before_max_um": 84.0,
            "distance_before_mean_um": 24.0, "coordinate_after_max_um": 41.0, "coordinate_after_mean_um": 17.0,
            "distance_after_max_um": 53.0, "distance_after_mean_um": 18.0, "coordinate_improvement_percent": 17.98,
            "distance_improvement_percent": 25.53,
        },
    }
)  # fmt: skip
"""Published disagreements of the stations, by scenario and result column: tables 3 and 4 of Sensors 2021, 21, 7479."""


@dataclass(frozen=True)
class SweepPoint:
    """Point of a figure over factor levels: mean of a result column in one cell (combination of factor levels)."""

    level: float | str
    """Factor level on the x axis, a number or a text."""
    line_label: str
    """Label of the line to which the point belongs."""
    panel_label: str
    """Title of the panel to which the point belongs."""
    mean: float
    interval_low: float
    interval_high: float
    quantile_05: float
    quantile_95: float


def factor_title(factor: Factor) -> str:
    """Title of a factor without its unit: `angle noise`."""
    name = next((factor.name.removesuffix(e) for e in UNIT_BY_KEY_ENDING if factor.name.endswith(e)), factor.name)
    return name.replace("_", " ")


def factor_axis_title(factor: Factor) -> str:
    """Title of the axis of a factor: `angle noise [arcsec]`."""
    unit = typographic_text(factor.unit)
    return factor_title(factor) + (f" [{unit}]" if unit else "")


def factor_level_text(factor: Factor, level: Any) -> str:
    """Text of a factor with its level: `angle noise 0.2 arcsec`."""
    if factor.name == "title":
        return str(level)
    value = factor.level_text(level).removesuffix(f" {factor.unit}") if factor.unit else factor.level_text(level)
    return f"{factor_title(factor)} {value} {typographic_text(factor.unit)}".rstrip()


def sweep_points(
    results: CampaignResults, statistic: str, along: str | Sequence[str], *, panel: str = "", **levels: Any
) -> list[SweepPoint]:
    """Points of a figure: means of a result column, one per method and combination of factor levels (cell).

    Parameters
    ----------
    results : CampaignResults
    statistic : str
        Name of a result column of the campaign. Columns of calibrated errors have a further line, the noise floor: the
        error that remains with the true parameters.
    along : str or sequence of str
        Factor whose levels are the positions on the x axis; with several factors the positions are texts.
    panel : str
        Factor with one panel per level.
    **levels
        Restriction to cells with these levels, such as ``faces=1``, or to one ``method``.
    """
    factors = {factor.name: factor for factor in results.factors}
    names = [along] if isinstance(along, str) else [*along]
    for name in filter(None, (*names, panel, *levels)):
        if name not in factors and name != "method":
            raise unknown_name_error("factor of this campaign", name, ("method", *factors))
    places = [level | {"method": method} for level in results.levels for method in results.manifest.methods]
    for name, required in levels.items():
        if required not in (existing := list(dict.fromkeys(position[name] for position in places))):
            raise unknown_name_error(f"level of {name}", str(required), [str(level) for level in existing])
    floor_statistic = statistic.replace("error_calibrated", "error_true_parameters")
    floors = results.statistic_summaries(floor_statistic) if floor_statistic != statistic else []
    lowest = [min((s for s in floors if s.cell == cell), key=lambda s: s.mean) for cell in {s.cell: 0 for s in floors}]
    points = []
    for s in [*results.statistic_summaries(statistic), *lowest]:
        here = results.levels[s.cell] | {"method": s.method}
        if any(here[name] != required for name, required in levels.items()):
            continue
        texts = {name: factor_level_text(factor, here[name]) for name, factor in factors.items()} | {"method": s.method}
        level = here[names[0]] if len(names) == 1 else None
        position = ", ".join(texts[name] for name in names) if level is None else level
        line = s.method if s.column == statistic else NOISE_FLOOR_LABEL
        points.append(
            SweepPoint(position, line, texts.get(panel, ""), s.mean, s.low, s.high, s.quantiles[1], s.quantiles[5])
        )
    return points


def sweep_figure(results: CampaignResults, statistic: str, along: str, *, panel: str = "", **levels: Any) -> Figure:
    """Figure of the means of a result column along a factor, one line per method; used by `CampaignResults.plot`."""
    if not along:
        names = " or ".join(f.name for f in results.factors)
        raise ModelError(f"along is empty; give a factor of the campaign: {names}" if names else "no factor varies")
    axis = factor_axis_title(next((f for f in results.factors if f.name == along), Factor(name=along, keys=())))
    unit = results.units.get(statistic, "")
    words = statistic.removesuffix("_percent").removesuffix("_um").replace("_", " ")
    label = f"{words} [{typographic_text(unit)}]" if unit else words
    rows = sweep_points(results, statistic, along, panel=panel, **levels)
    if len({(row.level, row.line_label, row.panel_label) for row in rows}) < len(rows):
        others = [f.name for f in results.factors if f.name not in (along, panel, *levels)]
        raise ModelError(f"several cells share a position on the axis; give panel, or a level of {' or '.join(others)}")
    return sweep_panels_figure(rows, statistic_title=label, x_title=axis)


@style.with_figure_style
def sweep_panels_figure(
    plotted_points: Sequence[SweepPoint],
    *,
    statistic_title: str,
    x_title: str,
    published_value: float | None = None,
    joins_points: bool = True,
) -> Figure:
    """Figure of panels with common axes: means with 95 % intervals, and the central 90 % of the trials as shaded bands.

    Parameters
    ----------
    plotted_points : sequence of SweepPoint
    statistic_title : str
        Title of the y axis: the result column with its unit.
    x_title : str
        Title of the x axis: the factor along the lines, with its unit.
    published_value : float, optional
        Published value to compare with.
    joins_points : bool
        True to join the points of a line. If False, each panel has a separate factor, named by the panel.
    """
    panels = list(dict.fromkeys(row.panel_label for row in plotted_points))[:MAX_FIGURE_PANELS]
    n_rows, n_columns = -(-len(panels) // 2), min(len(panels), 2)
    figure = style.new_figure(0.9 + (1.9 if n_columns > 1 else 2.6) * n_rows)
    axes = figure.subplots(n_rows, n_columns, sharex=joins_points, sharey=True, squeeze=False)
    words = list(dict.fromkeys(row.level for row in plotted_points if isinstance(row.level, str)))
    names = list(dict.fromkeys(row.line_label for row in plotted_points))[:MAX_PANEL_LINES]
    for ax, panel in zip(axes.flat, panels, strict=False):
        for k, name in enumerate(names):
            points = [row for row in plotted_points if (row.panel_label, row.line_label) == (panel, name)]
            _draw_line(ax, points, _axis_positions(points, words, (k + 0.5) / len(names)), k, is_joined=joins_points)
        if published_value is not None:
            ax.axhline(published_value, color=style.INK_COLOUR, linewidth=1.2, linestyle=(0, (4, 2)), label="published")
        if joins_points:
            ax.set_title(style.shortened_name(panel, 44 if n_columns < 2 else 34), fontsize=8.5)
        else:
            ax.set_xlabel(panel)
        levels = [row.level for row in plotted_points if row.panel_label == panel]
        _set_axis_ticks(ax, levels, words, is_joined=joins_points)
        style.set_grid(ax)
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for ax in axes.flat[max(len(panels) - n_columns, 0) : len(panels)]:
        ax.tick_params(labelbottom=True)
    figure.supxlabel(x_title, fontsize=8.5)
    label_lines = textwrap.fill(statistic_title, Y_LABEL_LINE_LENGTH_PER_PANEL_ROW * n_rows)
    if n_rows > 1:
        figure.supylabel(label_lines, fontsize=8.5)
    else:  # beside its panel: that of a figure is centred on panel and legend together
        axes[0, 0].set_ylabel(label_lines, fontsize=8.5)
    style.add_legend(figure, axes.flat[: len(panels)], n_columns=2)
    legend_labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    figure.set_figheight(figure.get_figheight() + style.legend_height(legend_labels, 2))
    return figure


def _axis_positions(line_points: Sequence[SweepPoint], level_texts: Sequence[str], offset_fraction: float) -> Floats:
    """Positions (n,) on the x axis: levels of a factor; texts at 0, 1, ... shifted by -0.15 to 0.15 by the fraction."""
    place = [level_texts.index(row.level) if isinstance(row.level, str) else row.level for row in line_points]
    return np.array(place, dtype=np.float64) + (0.3 * (offset_fraction - 0.5) if level_texts else 0.0)


def _draw_line(ax: Axes, points: Sequence[SweepPoint], positions: Floats, line_number: int, *, is_joined: bool) -> None:
    """Draw means with intervals and band at `positions` on the x axis, joined by a line if `is_joined`."""
    if not points:
        return
    order = np.argsort(positions, kind="stable")
    x, mean = positions[order], np.array([points[i].mean for i in order])
    low, high = (np.array([getattr(points[i], side) for i in order]) for side in ("interval_low", "interval_high"))
    colour = style.COLOUR_CYCLE[line_number % len(style.COLOUR_CYCLE)]
    p05, p95 = (np.array([getattr(points[i], side) for i in order]) for side in ("quantile_05", "quantile_95"))
    has_trials = bool(np.any(p05 < p95))
    if is_joined and not isinstance(points[0].level, str) and has_trials:
        band_label = CENTRAL_90_PERCENT_LABEL if line_number == 0 else None
        ax.fill_between(x, p05, p95, color=colour, alpha=0.12, linewidth=0, label=band_label)
    interval_text = "mean, 95 % interval" if has_trials else "95 % interval"  # a share has no trials
    name = points[0].line_label
    label = f"{name}: {interval_text}".removeprefix(": ") if line_number == 0 else name
    ax.errorbar(
        x, mean, [mean - low, high - mean], color=colour, marker=style.MARKERS[line_number % len(style.MARKERS)],
        markersize=4.5, linestyle=("-" if is_joined else "none"), elinewidth=2.4, label=label,
    )  # fmt: skip


def _set_axis_ticks(ax: Axes, values: Sequence[float | str], tick_labels: Sequence[str], *, is_joined: bool) -> None:
    """Set ticks at the levels; the axis is logarithmic if the levels are positive and span a factor of at least 8."""
    if tick_labels:
        ax.set_xticks(range(len(tick_labels)), [style.shortened_name(word, 18) for word in tick_labels])
        ax.set_xlim(-0.5, len(tick_labels) - 0.5)
        return
    levels = sorted({float(x) for x in values if not isinstance(x, str)})
    is_logarithmic = levels[0] > 0 and levels[-1] >= 8 * levels[0]
    if is_logarithmic:
        ax.set_xscale("log")
        ax.minorticks_off()
    if is_joined and len(levels) <= 8:
        ticks = levels
    elif is_logarithmic:
        decades = range(math.floor(math.log10(levels[0])), math.ceil(math.log10(levels[-1])) + 1)
        ticks = [t for k in decades for t in (10.0**k, 2 * 10.0**k, 5 * 10.0**k) if levels[0] <= t <= levels[-1]]
    else:
        all_integers = all(level.is_integer() for level in levels)
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=all_integers))
        return
    ax.set_xticks(ticks, [f"{tick:.4g}" for tick in ticks])


MAX_DRAWN_CELLS = 40
"""Largest number of combinations of factor levels (cells) in a figure with one row per cell; the first are drawn."""


@style.with_figure_style
def cell_rows_figure(points: Sequence[SweepPoint], *, x_label: str, published_value: float | None = None) -> Figure:
    """Figure with one row per combination of factor levels (cell): means with 95 % intervals, central 90 % of trials.

    Parameters
    ----------
    points : sequence of SweepPoint
        `level` is the description of the cell, `line_label` the method.
    x_label : str
        Title of the x axis: the result column with its unit.
    published_value : float, optional
        Published value to compare with.
    """
    settings = list(dict.fromkeys(str(row.level) for row in points))[:MAX_DRAWN_CELLS]
    methods = list(dict.fromkeys(row.line_label for row in points))
    figure, ax = style.new_panel(0.75 + len(settings) * (0.14 + 0.14 * len(methods)))
    places = dict(zip(settings, style.set_category_rows(ax, settings), strict=True))
    for m, method in enumerate(methods):
        mine = [row for row in points if row.line_label == method and str(row.level) in places]
        y = np.array([places[str(row.level)] for row in mine]) + 0.62 * ((m + 0.5) / len(methods) - 0.5)
        colour = style.COLOUR_CYCLE[m % len(style.COLOUR_CYCLE)]
        ninety, mean = ("90 % of trials", "95 % interval of the mean") if m == 0 else ("", "")
        ax.hlines(y, [r.quantile_05 for r in mine], [r.quantile_95 for r in mine], color=colour, lw=0.9, label=ninety)
        ax.hlines(y, [r.interval_low for r in mine], [r.interval_high for r in mine], color=colour, lw=3.6, label=mean)
        ax.plot([r.mean for r in mine], y, style.MARKERS[m % len(style.MARKERS)], ms=4.5, color=colour, label=method)
    if published_value is not None:
        ax.axvline(published_value, color=style.INK_COLOUR, linewidth=1.2, linestyle=(0, (4, 2)), label="published")
    ax.set_xlabel(x_label)
    style.add_legend(figure, [ax], n_columns=2)
    return figure


@dataclass(frozen=True)
class TrialDistribution:
    """Distribution of the values of a quantity over n trials."""

    name: str
    values: Floats
    unit: str = ""
    published_value: float | None = None
    """Published value to compare with; None without it."""


@style.with_figure_style
def distributions_figure(distributions: Sequence[TrialDistribution]) -> Figure:
    """Figure with histograms of quantities over trials: mean and 95 % interval, central 90 %, published value."""
    n_columns = min(2, max(len(distributions), 1))
    n_rows = -(-len(distributions) // n_columns)
    figure = style.new_figure(0.4 + 1.7 * n_rows)
    axes = figure.subplots(n_rows, n_columns, squeeze=False)
    for ax, row in zip(axes.flat, distributions, strict=False):
        _draw_distribution(ax, row)
    for ax in axes.flat[len(distributions) :]:
        ax.set_axis_off()
    style.add_legend(figure, axes.flat)
    return figure


def _draw_distribution(ax: Axes, sample: TrialDistribution) -> None:
    """Draw the histogram of a quantity, with mean, intervals and published value above."""
    published = sample.published_value
    finite = sample.values[np.isfinite(sample.values)]
    low, high = np.percentile(finite, [0.25, 99.75])
    if published is not None:
        low, high = min(low, published), max(high, published)
    margin = 0.04 * (high - low) or 1.0
    counts, edges = np.histogram(finite, bins=min(60, max(12, int(np.sqrt(len(finite))))), range=(low, high))
    ax.stairs(counts, edges, fill=True, color=style.SKY)
    ax.set_xlim(low - margin, high + margin)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    style.set_grid(ax, grid_axis="none")
    top = 1.05 * float(counts.max())
    ax.set_ylim(0, 1.28 * top)
    mean, half = float(finite.mean()), NORMAL_QUANTILE_95 * float(finite.std(ddof=1)) / np.sqrt(len(finite))
    ax.hlines(
        1.07 * top, *np.percentile(finite, [5, 95]), color=style.INK_COLOUR, linewidth=1.0, label="90 % of trials"
    )
    ax.hlines(
        1.07 * top, mean - half, mean + half, color=style.COLOUR_AFTER, linewidth=5.0, label="mean, 95 % interval"
    )
    ax.plot([mean], [1.07 * top], "o", ms=4.5, color=style.COLOUR_AFTER)
    ax.set_title(style.shortened_name(sample.name, 40), fontsize=8)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(f"[{style.unit_text(sample.unit)}]" if sample.unit else "")
    if published is not None:
        ax.axvline(published, color=style.INK_COLOUR, linewidth=1.2, linestyle=(0, (4, 2)), label="published")
        right, below = published > 0.5 * (low + high), 100 * float(np.mean(finite < published))
        ax.annotate(
            typographic_text(f"{number_text(published)}, percentile {below:.0f}"), (published, 1.27 * top),
            xytext=(-3 if right else 3, -1), textcoords="offset points", fontsize=7.5, ha="right" if right else "left",
            va="top", in_layout=False,
        )  # fmt: skip


ALLOWED_COVERAGE = (0.935, 0.965)
"""Lowest and highest allowed coverage of 95 % intervals, by convention; significantly different ones are drawn red."""


def coverage_interval(row: ZScoreSummary) -> tuple[float, float]:
    """Lower and upper limit of the 95 % interval of an observed coverage (Wilson 1927)."""
    from scipy.stats import binomtest  # slow to load

    interval = binomtest(round(row.coverage_95 * row.trials), row.trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def is_coverage_outside_band(summaries: Sequence[ZScoreSummary]) -> list[bool]:
    """Flags (one per parameter): True if the 95 % interval of the observed coverage lies outside `ALLOWED_COVERAGE`."""
    return [high < ALLOWED_COVERAGE[0] or low > ALLOWED_COVERAGE[1] for low, high in map(coverage_interval, summaries)]


@style.with_figure_style
def coverage_figure(summaries: Sequence[ZScoreSummary]) -> Figure:
    """Figure of the observed coverage of the 95 % intervals of each parameter, with the uncertainty of this coverage.

    The uncertainty is drawn as a 95 % interval, next to the band of allowed coverage.
    """
    figure, ax = style.new_panel(0.9 + 0.2 * max(len(summaries), 3))
    places = style.set_category_rows(ax, [row.parameter for row in summaries])
    coverage = np.array([row.coverage_95 for row in summaries])
    bounds = np.array([coverage_interval(row) for row in summaries])
    band = f"allowed {100 * ALLOWED_COVERAGE[0]:.1f} to {100 * ALLOWED_COVERAGE[1]:.1f} %"
    ax.axvspan(*ALLOWED_COVERAGE, color=style.BAND_COLOUR, linewidth=0, zorder=0, label=band)
    ax.axvline(0.95, color=style.INK_COLOUR, linewidth=1.0, linestyle=(0, (4, 2)), label="nominal 95 %")
    red = np.array(is_coverage_outside_band(summaries), dtype=bool)
    for chosen, colour, word in ((~red, style.BLUE, "coverage, 95 % interval"), (red, style.RED, "outside the band")):
        if chosen.any():
            ax.hlines(places[chosen], *bounds[chosen].T, color=colour, linewidth=1.8)
            ax.plot(coverage[chosen], places[chosen], "o", ms=4.5, color=colour, label=word)
    ax.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    ax.set_xlabel("coverage of the 95 % intervals")
    ax.set_xlim(min(bounds.min(), ALLOWED_COVERAGE[0]) - 0.01, min(max(bounds.max(), ALLOWED_COVERAGE[1]) + 0.01, 1.0))
    style.add_legend(figure, [ax], n_columns=2)
    return figure

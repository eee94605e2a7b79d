"""Figures of results over the factors of a campaign; selection of the factors for the x axis, lines and panels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ltsim.campaigns.design import Factor
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.summary import StatisticSummary
from ltsim.reports.figures.campaign import (
    MAX_FIGURE_PANELS,
    MAX_PANEL_LINES,
    SweepPoint,
    cell_rows_figure,
    factor_axis_title,
    factor_level_text,
    sweep_panels_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def varying_factors(results: CampaignResults) -> list[Factor]:
    """Factors with several levels that do not correspond one to one to the levels of an earlier factor."""
    independent: list[Factor] = []
    for factor in results.factors:
        values = levels_of_cells(results, factor)
        if len(set(values)) > 1 and not any(
            _is_bijection(values, levels_of_cells(results, other)) for other in independent
        ):
            independent.append(factor)
    return independent


def cell_descriptions(results: CampaignResults) -> dict[int, str]:
    """Short description of each cell (combination of factor levels), by the number of the cell."""
    factors = varying_factors(results)
    texts = [", ".join(factor_level_text(f, level[f.name]) for f in factors) for level in results.levels]
    default_text = "as in the scenario" if len(texts) == 1 else ""
    return {
        entry.cell: text or default_text or entry.label
        for entry, text in zip(results.manifest.cells, texts, strict=True)
    }


def levels_of_cells(results: CampaignResults, factor: Factor) -> list[Any]:
    """Level of a factor in each cell (combination of factor levels) of a campaign."""
    return [level[factor.name] for level in results.levels]


def _is_bijection(first_column: Sequence[Any], second_column: Sequence[Any]) -> bool:
    """True if the values of two columns correspond one to one."""
    n_pairs = len(set(zip(first_column, second_column, strict=True)))
    return n_pairs == len(set(first_column)) == len(set(second_column))


def statistic_figures(
    results: CampaignResults, summaries: Sequence[StatisticSummary], label: str, published_value: float | None
) -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Captions of the figures of a result column, each with the function that draws the figure.

    A figure has lines over a factor if the cells (combinations of factor levels) form a grid. It has dots over each
    factor if the cells are points of a space-filling design, and otherwise one row per cell. `summaries` are the
    statistics of the column, `label` is its axis label, and `published_value` a value to compare with.
    """
    factors = varying_factors(results)
    trials_sentence = f"{results.manifest.trials} trials for each combination of factor levels."
    panels_figure = partial(sweep_panels_figure, statistic_title=label, published_value=published_value)
    n_cells = len({tuple(level[f.name] for f in factors) for level in results.levels})
    is_grid = n_cells == len(results.levels) == math.prod(len(set(levels_of_cells(results, f))) for f in factors)
    if factors and results.manifest.settings.get("design"):
        points = [(f, _axis_position(f, results.levels[s.cell]), s) for f in factors for s in summaries]
        rows = [_sweep_point(s, place, s.method, factor_axis_title(factor)) for factor, place, s in points]
        figure = partial(panels_figure, rows, x_title="", joins_points=False)
        markers_sentence = "Each marker is the mean of one combination of factor levels; each panel shows one factor."
        yield f"{markers_sentence} {trials_sentence}", figure
    elif factors and is_grid and n_cells > 2:
        axis, rows = _axis_title_and_line_points(results, factors, summaries)
        names = list(dict.fromkeys(row.panel_label for row in rows))
        for first in range(0, len(names), MAX_FIGURE_PANELS):
            shown = names[first : first + MAX_FIGURE_PANELS]
            panels_sentence = (
                f" Panels {first + 1} to {first + len(shown)} of {len(names)}."
                if len(names) > MAX_FIGURE_PANELS
                else ""
            )
            yield (
                trials_sentence + panels_sentence,
                partial(panels_figure, [row for row in rows if row.panel_label in shown], x_title=axis),
            )
    else:
        cell_texts = cell_descriptions(results)
        yield (
            trials_sentence,
            partial(
                cell_rows_figure,
                [_sweep_point(s, cell_texts[s.cell], s.method, "") for s in summaries],
                x_label=label,
                published_value=published_value,
            ),
        )


def _axis_title_and_line_points(
    results: CampaignResults, factors: Sequence[Factor], summaries: Sequence[StatisticSummary]
) -> tuple[str, list[SweepPoint]]:
    """Title of the x axis, and the points of all lines over the factor on this axis."""
    x_factor, line_factor, panel_factors = axis_line_and_panel_factors(results, factors)
    line_points = []
    for s in summaries:
        level = results.levels[s.cell]
        line = factor_level_text(line_factor, level[line_factor.name]) if line_factor else s.method
        line_points.append(
            _sweep_point(
                s,
                _axis_position(x_factor, level),
                line,
                ", ".join(factor_level_text(f, level[f.name]) for f in panel_factors),
            )
        )
    return factor_axis_title(x_factor), line_points


def axis_line_and_panel_factors(
    results: CampaignResults, factors: Sequence[Factor]
) -> tuple[Factor, Factor | None, list[Factor]]:
    """Factor on the x axis, factor that distinguishes the lines (None for the method), and factors of the panels."""
    n_levels = {f.name: len(set(levels_of_cells(results, f))) for f in factors}
    x_factor = max(factors, key=lambda f: (f.kind in ("number", "integer"), n_levels[f.name]))
    other_factors = [f for f in factors if f is not x_factor]
    if len(results.manifest.methods) > 1 or not other_factors:
        return x_factor, None, other_factors
    line_factor = max(other_factors, key=lambda f: n_levels[f.name] if n_levels[f.name] <= MAX_PANEL_LINES else 0)
    return x_factor, line_factor, [f for f in other_factors if f is not line_factor]


def _axis_position(factor: Factor, levels: Mapping[str, Any]) -> float | str:
    """Position of a level on the axis of its factor: a number, or the text of a level without a number."""
    value = levels[factor.name]
    return float(value) if factor.kind in ("number", "integer") and value is not None else factor.level_text(value)


def _sweep_point(summary: StatisticSummary, x: float | str, line: str, panel: str) -> SweepPoint:
    """Point of a figure from the summary of a result column: level `x`, line and panel."""
    return SweepPoint(
        x, line, panel, summary.mean, summary.low, summary.high, summary.quantiles[1], summary.quantiles[5]
    )

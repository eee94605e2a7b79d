"""Factors of a campaign in its figures: the varying ones, their roles (axis, lines, panels), the figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ltsim.campaigns.design import Factor
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.statistics import StatisticSummary
from ltsim.reports.figures.campaign import (
    MAX_FIGURE_PANELS,
    MAX_PANEL_LINES,
    SweepPoint,
    factor_axis_title,
    factor_level_text,
    factor_panels_figure,
    setting_rows_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def varying_factors(results: CampaignResults) -> list[Factor]:
    """Factors that vary, without those that change together with an earlier one."""
    independent: list[Factor] = []
    for factor in results.factors:
        values = levels_of_cells(results, factor)
        if len(set(values)) > 1 and not any(
            _is_bijection(values, levels_of_cells(results, other)) for other in independent
        ):
            independent.append(factor)
    return independent


def cell_descriptions(results: CampaignResults) -> dict[int, str]:
    """Short description of each cell, by its number."""
    factors = varying_factors(results)
    texts = [", ".join(factor_level_text(f, level[f.name]) for f in factors) for level in results.levels]
    plain = "as the scenario" if len(texts) == 1 else ""
    return {
        entry.cell: words or plain or entry.label for entry, words in zip(results.manifest.cells, texts, strict=True)
    }


def levels_of_cells(results: CampaignResults, factor: Factor) -> list[Any]:
    """Level of a factor in each cell."""
    return [level[factor.name] for level in results.levels]


def _is_bijection(first: Sequence[Any], second: Sequence[Any]) -> bool:
    """True if the values of two columns correspond one to one."""
    pairs = len(set(zip(first, second, strict=True)))
    return pairs == len(set(first)) == len(set(second))


def statistic_figures(
    results: CampaignResults, spreads: Sequence[StatisticSummary], label: str, published_value: float | None
) -> Iterator[tuple[str, Callable[[], Figure]]]:
    """Captions and figures of a statistic.

    Lines over a factor if the cells form a grid, dots over each factor of a design, else one row per cell.
    """
    factors, several = varying_factors(results), f"{results.manifest.trials} trials per setting."
    how: dict[str, Any] = {"label": label, "published_value": published_value}
    cells = len({tuple(level[f.name] for f in factors) for level in results.levels})
    of_grid = cells == len(results.levels) == math.prod(len(set(levels_of_cells(results, f))) for f in factors)
    if factors and results.manifest.settings.get("design"):
        places = [(f, _axis_position(f, results.levels[s.cell]), s) for f in factors for s in spreads]
        rows = [_sweep_point(s, place, s.method, factor_axis_title(factor)) for factor, place, s in places]
        figure = partial(factor_panels_figure, rows, axis="", joins_points=False, **how)
        yield f"Each mark is one setting, against each factor. {several}", figure
    elif factors and of_grid and cells > 2:
        axis, rows = _factor_lines(results, factors, spreads)
        names = list(dict.fromkeys(row.panel for row in rows))
        for first in range(0, len(names), MAX_FIGURE_PANELS):
            shown = names[first : first + MAX_FIGURE_PANELS]
            part = (
                f" Panels {first + 1} to {first + len(shown)} of {len(names)}."
                if len(names) > MAX_FIGURE_PANELS
                else ""
            )
            yield (
                several + part,
                partial(factor_panels_figure, [row for row in rows if row.panel in shown], axis=axis, **how),
            )
    else:
        named = cell_descriptions(results)
        yield (
            several,
            partial(setting_rows_figure, [_sweep_point(s, named[s.cell], s.method, "") for s in spreads], **how),
        )


def _factor_lines(
    results: CampaignResults, factors: Sequence[Factor], spreads: Sequence[StatisticSummary]
) -> tuple[str, list[SweepPoint]]:
    """Title of the axis, and points of lines over one factor."""
    along, across, panels = factor_arrangement(results, factors)
    rows = []
    for s in spreads:
        level = results.levels[s.cell]
        line = factor_level_text(across, level[across.name]) if across else s.method
        rows.append(
            _sweep_point(
                s, _axis_position(along, level), line, ", ".join(factor_level_text(f, level[f.name]) for f in panels)
            )
        )
    return factor_axis_title(along), rows


def factor_arrangement(
    results: CampaignResults, factors: Sequence[Factor]
) -> tuple[Factor, Factor | None, list[Factor]]:
    """Factor along the lines, factor of the lines (None: the method), factors of the panels."""
    levels = {f.name: len(set(levels_of_cells(results, f))) for f in factors}
    along = max(factors, key=lambda f: (f.kind in ("number", "integer"), levels[f.name]))
    other_factors = [f for f in factors if f is not along]
    if len(results.manifest.methods) > 1 or not other_factors:
        return along, None, other_factors
    across = max(other_factors, key=lambda f: levels[f.name] if levels[f.name] <= MAX_PANEL_LINES else 0)
    return along, across, [f for f in other_factors if f is not across]


def _axis_position(factor: Factor, level: Mapping[str, Any]) -> float | str:
    value = level[factor.name]
    return float(value) if factor.kind in ("number", "integer") and value is not None else factor.level_text(value)


def _sweep_point(summary: StatisticSummary, x: float | str, line: str, panel: str) -> SweepPoint:
    return SweepPoint(
        x, line, panel, summary.mean, summary.low, summary.high, summary.quantiles[1], summary.quantiles[5]
    )

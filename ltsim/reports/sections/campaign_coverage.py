"""Coverage of the intervals of a campaign's calibrations: key figures, figures and the table of z-scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from ltsim.campaigns.columns import columns_from_rows
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.summary import ZScoreSummary
from ltsim.core.results import Table
from ltsim.reports.document_model import Block, KeyFigure, PictureBlock, table_blocks
from ltsim.reports.figures.campaign import ALLOWED_COVERAGE, coverage_figure, is_coverage_outside_band
from ltsim.reports.figures.campaign_factors import cell_descriptions

MAX_SHOWN_Z_SCORES = 5_000
"""Largest number of rows of the table of z-scores in a report; the table `z_scores` in Python contains all."""
MAX_COVERAGE_FIGURES = 3
"""Largest number of figures of the coverage of intervals, one per method."""
NOISE_ERROR_PRIOR_FACTOR_KEYS = ("noise_factor", "error_factor", "prior_factor")
"""Keys of the tracker's table in a scenario with factors on its noise, true errors or declared prior. With a factor
other than 1 the recording declares wrong noise or a wrong prior."""


def coverage_content(results: CampaignResults) -> tuple[list[KeyFigure], list[Block]]:
    """Key figures of the coverage of intervals, and figures and table of z-scores, from one query of the rows.

    The figures show the coverage by calibration method in the first cell (combination of factor levels).
    """
    trackers = {
        entry.cell: scenario.instrument
        for entry, scenario in zip(results.manifest.cells, results.manifest.scenarios, strict=False)
    }
    coverages_by_kind: dict[str, list[tuple[float, int]]] = {}
    first_scores: list[ZScoreSummary] = []
    first_cell_scores_by_method: dict[str, list[ZScoreSummary]] = {}
    for summary in results.iterate_z_score_summaries():
        factors = {name: getattr(trackers.get(summary.cell), name, 1.0) for name in NOISE_ERROR_PRIOR_FACTOR_KEYS}
        text = ", ".join(f"{name.replace('_', ' ')} {value:g}" for name, value in factors.items() if value != 1.0)
        coverages_by_kind.setdefault(text, []).append((summary.coverage_95, summary.trials))
        scores = first_cell_scores_by_method.setdefault(summary.method, [])
        if not scores or summary.cell == scores[0].cell:
            scores.append(summary)
        if len(first_scores) < MAX_SHOWN_Z_SCORES:
            first_scores.append(summary)
    figures = _coverage_figures(results, first_cell_scores_by_method)
    return _coverage_key_figures(coverages_by_kind), figures + _z_score_table(results, first_scores)


def _coverage_key_figures(coverages_by_kind: Mapping[str, Sequence[tuple[float, int]]]) -> list[KeyFigure]:
    """Coverage of the 95 % intervals, one key figure for each combination of values of `NOISE_ERROR_PRIOR_FACTOR_KEYS`.

    `coverages_by_kind` are coverages and numbers of trials by the text of a combination. The coverage is expected to be
    95 % only where all of these factors are 1.
    """
    facts = []
    for text, coverages in sorted(coverages_by_kind.items(), key=lambda group: group[0]):
        shares, n_intervals = [share for share, _ in coverages], sum(trials for _, trials in coverages)
        mean_share = sum(share * trials for share, trials in coverages) / n_intervals
        range_text = f"; single parameters and cells: {100 * min(shares):.1f} to {100 * max(shares):.1f} %"
        name = "coverage of 95 % intervals" + (f" with {text} (not declared)" if text else "")
        name += f"; {n_intervals} intervals" + (range_text if len(coverages) > 1 else "")
        facts.append(KeyFigure(name, f"{100 * mean_share:.1f} %"))
    return facts


def _coverage_figures(results: CampaignResults, scores_by_method: Mapping[str, Sequence[ZScoreSummary]]) -> list[Block]:
    """Figures of the coverage of intervals in the first cell, one per calibration method."""
    blocks: list[Block] = []
    for method, scores in scores_by_method.items():
        rows = [s for s in scores if s.trials > 1]
        if rows and len(blocks) < MAX_COVERAGE_FIGURES:
            cell_text = f", {cell_descriptions(results)[scores[0].cell]}" if len(results.levels) > 1 else ""
            blocks.append(
                PictureBlock(f"Coverage: {method}{cell_text}", partial(coverage_figure, rows), coverage_sentence(rows))
            )
    return blocks


def _z_score_table(results: CampaignResults, scores: Sequence[ZScoreSummary]) -> list[Block]:
    """Table of z-scores of the parameters; empty without z-scores."""
    if not scores:
        return []
    text = "z: (estimate - true value) / declared sigma; correct sigmas give mean 0 and standard deviation 1. "
    text += "Coverage 95: fraction of the 95 % intervals that contain the true value; 0.95 is expected."
    table = Table.from_columns("z_scores", columns_from_rows(results.with_factor_levels(scores)))
    return [*table_blocks("z-scores of the parameters", table, note=text)]


def coverage_sentence(z_scores: Sequence[ZScoreSummary]) -> str:
    """Sentence on the parameters whose observed coverage, with its interval, lies outside the allowed band."""
    low, high = (f"{100 * bound:.1f}" for bound in ALLOWED_COVERAGE)
    outside = [row.parameter for row, out in zip(z_scores, is_coverage_outside_band(z_scores), strict=True) if out]
    band = f"the allowed band of {low} to {high} %"
    if not outside:
        return f"No parameter is red: each interval overlaps {band}."
    return f"Red: the interval lies outside {band} for {', '.join(outside)}."

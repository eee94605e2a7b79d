"""Section of a campaign: factors, improvements with intervals, errors, z-scores, coverage."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.schema import (
    ERRORS_TABLE,
    FACTORS_TABLE,
    MEANS_BY_LEVEL_TABLE,
    RATIO_STATISTICS,
    ManifestFile,
    find_column,
    ratio_columns,
)
from ltsim.campaigns.statistics import SolverComparison, StatisticSummary, ZScoreSummary
from ltsim.core.notation import number_text
from ltsim.core.results import Table as TableOf
from ltsim.reports.document import (
    Block,
    CodeBlock,
    KeyFigure,
    PictureBlock,
    Section,
    TableBlock,
    assessment_of,
    table_block,
)
from ltsim.reports.figures.campaign import (
    ALLOWED_COVERAGE,
    PUBLISHED_CRITERIA,
    TrialDistribution,
    coverage_figure,
    distributions_figure,
    factor_axis_title,
    is_outside_allowed_coverage,
)
from ltsim.reports.figures.campaign_factors import (
    cell_descriptions,
    levels_of_cells,
    statistic_figures,
    varying_factors,
)
from ltsim.reports.sections.method_comparison import MethodComparison
from ltsim.reports.words import as_sentence, count_text, tracker_presets_text
from ltsim.simulation.keys import key_description

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_DRAWN_TRIALS = 200_000
"""Largest number of trials in a figure; tables and intervals use all trials."""
MAX_COVERAGE_FIGURES = 3
"""Largest number of figures of coverage."""
MAX_LISTED_LEVELS = 8
"""Number of levels of a factor above which only the first and the last are listed."""
MAX_OPEN_BLOCKS = 4
"""Largest number of blocks that are open on the page."""
MAX_CELL_ROWS = 48
"""Number of cells above which means are tabulated by level and not by cell."""
IMPROVEMENT_COLUMN = "distance_improvement_percent"
"""Statistic that the answer reports."""

STATISTIC_LABELS = MappingProxyType(
    {
        "distance_improvement_percent": "distance criterion, improvement [%]",
        "coordinate_improvement_percent": "coordinate criterion, improvement [%]",
        "share_removed": "fraction of the correctable error removed",
        "target_error_um": "error of the targets [µm]",
    }
)
"""Axis label of a statistic, by its column."""


def campaign_section(folder: Path) -> Section:
    """Section of the folder of a campaign.

    Raises
    ------
    SetupError
        When the folder holds no finished shard, or a damaged one.
    """
    results = CampaignResults(folder)
    manifest = results.manifest
    spreads = {name: results.distribution(name) for name in results.columns if ":" not in name}
    scores, comparisons = results.z_score_summaries(), results.solver_comparisons()
    published = PUBLISHED_CRITERIA.get(str(manifest.settings.get("scenario", "")), {})
    drawn_ = _distribution_figures(results, published)
    shown = [*_improvement_figures(results, spreads, published), *_varying_factors_table(results)] or drawn_[:1]
    shown += _means_by_level_table(results, spreads)
    comparison = MethodComparison.from_results(results, spreads)
    shown[1:1] = _error_tables(results, spreads)
    shown[:0] = comparison.blocks() if comparison else []
    blocks: list[Block] = [*shown, *(b for b in drawn_ if b not in shown)]
    blocks += [*_coverage_blocks(results, scores), *_statistic_tables(results, spreads, comparisons)]
    blocks.append(CodeBlock("Settings of the campaign", json.dumps(manifest.settings, indent=1)))
    scenarios = [scenario.model_dump(mode="json") for scenario in manifest.scenarios]
    blocks.append(CodeBlock("Scenarios of its cells", json.dumps(scenarios, indent=1)))
    versions = [*manifest.versions.items(), *([("commit", manifest.commit[:12])] if manifest.commit else [])]
    return Section(
        title=f"Campaign: {manifest.title}" if manifest.title else "Campaign of simulated calibrations",
        kind="Campaign",
        summary=" ".join(
            [_answer_sentence(results, spreads, comparisons), *([comparison.sentence()] if comparison else [])]
        ),
        assessment=assessment_of(not sum(comparison.failed for comparison in comparisons)),
        key_figures=_key_figures(manifest, comparisons, scores),
        blocks=blocks,
        seed=str(manifest.seed),
        versions=versions,
        axes="the axes of the scenario",
        instrument=tracker_presets_text(manifest.scenarios),
        n_open_blocks=min(len(shown), MAX_OPEN_BLOCKS),
    )


def _mean_text(summary: StatisticSummary, level: str = "95 %: ") -> str:
    return f"{number_text(summary.mean)} ({level}{number_text(summary.low)} to {number_text(summary.high)})"


def _answer_sentence(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], comparisons: Sequence[SolverComparison]
) -> str:
    """Answer: factors, improvement by calibration, best and worst cells."""
    manifest, factors = results.manifest, varying_factors(results)
    fewest, most = (
        min(comparison.trials for comparison in comparisons),
        max(comparison.trials for comparison in comparisons),
    )
    size = f"Over {fewest} trials" if fewest == most else f"Over {fewest} to {most} trials"
    if len(manifest.cells) > 1:
        size += f" in each of {len(manifest.cells)} settings"
        size += f" of {_list_text([factor_axis_title(f).partition(' [')[0] for f in factors])}" if factors else ""
    means_in_words = []
    for method in manifest.methods:
        means = [s for s in spreads.get(IMPROVEMENT_COLUMN, []) if s.method == method]
        if len(means) == 1:
            means_in_words.append(f"{method} by {_mean_text(means[0])} %")
        elif means:
            low, high = min(s.mean for s in means), max(s.mean for s in means)
            means_in_words.append(f"{method} by {number_text(low)} to {number_text(high)} %")
    text = f"{size}, calibration improves the distance criterion on average: {'; '.join(means_in_words)}."
    return (text if means_in_words else f"{size} with {', '.join(manifest.methods)}.") + _extreme_cells_sentence(
        results, spreads
    )


def _extreme_cells_sentence(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> str:
    means = spreads.get("target_error_um", [])
    if len(results.manifest.cells) < 2 or not means:
        return ""
    names, several = cell_descriptions(results), len(results.manifest.methods) > 1
    least, most = min(means, key=lambda s: s.mean), max(means, key=lambda s: s.mean)
    first, last = (
        f"{number_text(s.mean)} um ({f'{s.method}, ' if several else ''}{names[s.cell]})" for s in (least, most)
    )
    return f" The error of the targets is smallest with {first} and largest with {last}."


def _list_text(items: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(items[:-1]), *items[-1:]]))


def _key_figures(
    manifest: ManifestFile, comparisons: Sequence[SolverComparison], scores: Sequence[ZScoreSummary]
) -> list[KeyFigure]:
    failed = sum(comparison.failed for comparison in comparisons)
    checked = [
        comparison.largest_difference_sigma
        for comparison in comparisons
        if comparison.largest_difference_sigma is not None
    ]
    facts = [
        KeyFigure("trials", str(sum(comparison.trials for comparison in comparisons))),
        KeyFigure("settings", str(len(manifest.cells))),
        KeyFigure("methods", ", ".join(manifest.methods)),
        KeyFigure("failed", str(failed), assessment_of(not failed)),
    ]
    if checked:
        facts.append(
            KeyFigure(
                "batch solver against full solver", f"{max(checked):.1e} sigma", assessment_of(max(checked) < 1e-3)
            )
        )
    if scores:
        shares, n_intervals = [s.coverage_95 for s in scores], sum(s.trials for s in scores)
        pooled = sum(s.coverage_95 * s.trials for s in scores) / n_intervals
        spread = f"; by parameter and setting {100 * min(shares):.1f} to {100 * max(shares):.1f} %"
        value = f"{100 * pooled:.1f} % of {n_intervals} intervals" + (spread if len(scores) > 1 else "")
        facts.append(KeyFigure("coverage of 95 % intervals", value))
    return facts


def _varying_factors_table(results: CampaignResults) -> list[Block]:
    rows = []
    for factor in results.factors:
        values = list(dict.fromkeys(factor.level_text(level[factor.name]) for level in results.levels))
        shown = values if len(values) <= MAX_LISTED_LEVELS else [values[0], "...", values[-1]]
        meaning = key_description(factor.keys[0]).replace("`", "")
        rows.append([factor_axis_title(factor), ", ".join(shown), ", ".join(factor.keys), meaning])
    return [*table_block("What was varied", FACTORS_TABLE.with_rows(rows))]


def _means_by_level_table(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> list[TableBlock]:
    """Table of means over the cells of each level, if there are many cells; factors with few levels first."""
    if len(results.levels) <= MAX_CELL_ROWS:
        return []
    groups: dict[tuple[str, ...], list[float]] = {}
    for factor in sorted(varying_factors(results), key=lambda f: len(set(levels_of_cells(results, f)))):
        for name in filter(spreads.get, STATISTIC_LABELS):
            for s in spreads[name]:
                key = factor_axis_title(factor), factor.level_text(results.levels[s.cell][factor.name]), s.method, name
                groups.setdefault(key, []).append(s.mean)
    rows = [[*key, sum(m) / len(m), min(m), max(m)] for key, m in groups.items()]
    return table_block("Means over the settings of a level", MEANS_BY_LEVEL_TABLE.with_rows(rows))


def _improvement_figures(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], published_values: Mapping[str, float]
) -> list[Block]:
    """Figures of means with intervals over the settings, compared with the published values."""
    blocks: list[Block] = []
    if len(results.levels) == 1:  # shown by the distributions
        return blocks
    for column, label in STATISTIC_LABELS.items():
        rows, paper = spreads.get(column, []), published_values.get(column)
        for text, figure in statistic_figures(results, rows, label, paper) if rows else ():
            outside = [s for s in rows if paper is not None and not s.quantiles[1] <= paper <= s.quantiles[5]]
            where = f"outside in {len(outside)} of {len(rows)} settings" if outside else "inside in every setting"
            comparison = (
                f" The published value {number_text(paper)} is dashed; compared with the 90 % of the trials it "
                f"is {where}."
            )
            caption = text if paper is None else text + comparison
            blocks.append(PictureBlock(label.split(" [")[0].capitalize(), figure, caption))
    return blocks


def campaign_figure(results: CampaignResults) -> Figure:
    """Figure of the first main statistic over the factors; of distributions if nothing varies."""
    if len(results.levels) > 1:
        for column, label in STATISTIC_LABELS.items():
            if column in results.columns:
                return next(statistic_figures(results, results.distribution(column), label, None))[1]()
    return distributions_figure(_trial_distributions(results, {}))


def _trial_distributions(results: CampaignResults, published_values: Mapping[str, float]) -> list[TrialDistribution]:
    """Distributions of the criteria, or of other errors, over the trials of the first setting and method."""
    cell = results.manifest.cells[0].cell
    sized = [c for c in results.columns if c.endswith(("_um", "_percent"))]
    columns_used = [c for c in sized if c.startswith(("distance", "coordinate"))] or sized
    columns_used.sort(
        key=lambda c: (not c.endswith("percent"), "mean" not in c, "before" not in c, c.startswith("coord"))
    )
    values = {
        c: results.column_values(c, cell, results.manifest.methods[0], max_trials=MAX_DRAWN_TRIALS)
        for c in columns_used
    }
    return [
        TrialDistribution(_column_label(c), v, "um" if c.endswith("_um") else "%", published_values.get(c))
        for c, v in values.items()
        if len(v) > 1
    ]


def _distribution_figures(results: CampaignResults, published_values: Mapping[str, float]) -> list[Block]:
    """Histograms of the criteria of the first method, if there is one setting."""
    rows = [] if len(results.levels) > 1 else _trial_distributions(results, published_values)
    caption = "Dashed: published values, with the share of trials below them." if published_values else ""
    title = f"Distributions over trials: {results.manifest.methods[0]}"
    return [PictureBlock(title, partial(distributions_figure, rows), caption)] if rows else []


def _coverage_blocks(results: CampaignResults, scores: Sequence[ZScoreSummary]) -> list[Block]:
    """z-scores and coverage: figure for the first cell of each method, table for all cells."""
    blocks: list[Block] = []
    for method in dict.fromkeys(s.method for s in scores):
        mine = [s for s in scores if s.method == method]
        rows = [s for s in mine if s.cell == mine[0].cell and s.trials > 1]
        if rows and len(blocks) < MAX_COVERAGE_FIGURES:
            place = f", {cell_descriptions(results)[mine[0].cell]}" if len(results.levels) > 1 else ""
            blocks.append(
                PictureBlock(f"Coverage: {method}{place}", partial(coverage_figure, rows), coverage_sentence(rows))
            )
    text = "z: (estimate - truth) / declared sigma; correct sigmas give mean 0 and standard deviation 1."
    return [*blocks, *table_block("z-scores of the parameters", results.table("z_scores"), note=text)] if scores else []


def coverage_sentence(rows: Sequence[ZScoreSummary]) -> str:
    """Sentence on the parameters whose coverage is outside the allowed band."""
    low, high = (f"{100 * bound:.1f}" for bound in ALLOWED_COVERAGE)
    red = [row.parameter for row, out in zip(rows, is_outside_allowed_coverage(rows), strict=True) if out]
    band = f"the allowed band of {low} to {high} %"
    if not red:
        return f"No parameter is red: each interval overlaps {band}."
    return f"Red: the interval lies outside {band} for {', '.join(red)}."


def _column_label(column: str) -> str:
    """`distance_before_mean_um` as `distance, mean before`."""
    if column.startswith("new_point_"):
        return f"new point: {_column_label(column.removeprefix('new_point_'))}"
    parts = column.removesuffix("_um").removesuffix("_percent").replace("max", "largest").split("_")
    return f"{parts[0]}, {' '.join(reversed(parts[1:]))}" if len(parts) > 1 else column


def _error_tables(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> list[Block]:
    """Tables of errors before and after calibration, with the noise floor that no parameter removes."""
    names = cell_descriptions(results)
    blocks: list[Block] = []
    for share in RATIO_STATISTICS:
        entries = [spreads.get(name, []) for name in (*ratio_columns(share), share)]
        rows = [
            [names[of[0].cell], of[0].method, *(_mean_text(s, "") for s in of)]
            for of in zip(*entries, strict=all(entries))
        ]
        named = "new point" if share.startswith("new_point") else "point"
        note = f"Raw: {_column_meaning(ratio_columns(share)[0])}. Share removed: {_column_meaning(share)}. "
        note += "Noise floor: error with the true parameters. In brackets: 95 % interval."
        blocks += table_block(f"Error of a {named}", ERRORS_TABLE.with_rows(rows), note=note)
    return blocks


def _column_meaning(column: str) -> str:
    declared = find_column(column)
    return as_sentence("" if declared is None else declared.meaning.replace("`", "")).removesuffix(".")


def _statistic_tables(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], comparisons: Sequence[SolverComparison]
) -> list[Block]:
    """Tables of all statistics, their definitions, and the convergence of the trials."""
    cells = results.table("summary")
    extra_fields = {
        "cell",
        "deviation",
        "least",
        "largest",
        *(f"quantile_{q}_percent" for q in ("2.5", "25", "75", "97.5")),
    }
    shown = _settings_table(
        results, cells.with_columns(" ".join(name for name in cells.header if name not in extra_fields))
    )
    means = [f"{_column_label(c)} [{results.units.get(c, '')}]: {_column_meaning(c)}" for c in spreads]
    note = "Verified: trials repeated with the full solver; difference of the estimates."
    failed = frozenset(i for i, comparison in enumerate(comparisons) if comparison.failed)
    ended = results.table("ends")
    ended = _settings_table(results, ended.with_columns(" ".join(name for name in ended.header if name != "cell")))
    return [
        *table_block(f"Statistics ({count_text(len(shown.rows), 'row')})", shown),
        CodeBlock("Definitions of the statistics", "\n".join(means)),
        *table_block("Convergence of the trials", ended, note=note, marked_rows=failed),
    ]


def _settings_table(results: CampaignResults, table: TableOf) -> TableOf:
    """Table of cells with the settings displayed as given: 0.5 and not 0.5000."""
    given = {f.name for f in results.factors}
    columns = (replace(c, shown=".6g") if c.name in given and c.kind == "number" else c for c in table.columns)
    return replace(table, columns=tuple(columns))

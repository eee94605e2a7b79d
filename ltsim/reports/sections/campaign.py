"""Section of a campaign: varied factors, improvement by calibration, errors, z-scores, coverage of intervals."""

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
    ERRORS_BEFORE_AND_AFTER_TABLE,
    FACTORS_TABLE,
    MEANS_BY_FACTOR_LEVEL_TABLE,
    RATIO_STATISTICS,
    SUMMARY_FILE_NAME,
    error_columns_of_ratio,
    find_result_column,
)
from ltsim.campaigns.summary import SolverComparison, StatisticSummary
from ltsim.campaigns.summary_output import SummariesByColumn, first_summary_rows
from ltsim.core.notation import number_text
from ltsim.core.results import Table as TableOf
from ltsim.reports.document_model import (
    Block,
    CodeBlock,
    KeyFigure,
    PictureBlock,
    Section,
    TableBlock,
    assessment_of,
    table_blocks,
)
from ltsim.reports.figures.campaign import (
    PUBLISHED_CRITERIA_BY_SCENARIO,
    TrialDistribution,
    distributions_figure,
    factor_axis_title,
    factor_title,
)
from ltsim.reports.figures.campaign_factors import (
    cell_descriptions,
    levels_of_cells,
    statistic_figures,
    varying_factors,
)
from ltsim.reports.formatting import capitalised_sentence, count_text, tracker_preset_names_text
from ltsim.reports.sections.campaign_coverage import coverage_content
from ltsim.reports.sections.method_comparison import MethodComparison
from ltsim.simulation.scenario_keys import key_description

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_DRAWN_TRIALS = 200_000
"""Largest number of trials in a figure; tables and intervals use all trials."""
MAX_LISTED_LEVELS = 8
"""Largest number of levels of a factor that are all listed; of more levels only the first and the last are listed."""
MAX_SHOWN_SCENARIOS = 100
"""Largest number of combinations of factor levels (cells) whose scenarios a report contains; the manifest contains
all."""
MAX_SHOWN_STATISTIC_ROWS = 5_000
"""Largest number of rows of the table of statistics in a report; `summary.csv` contains all. A row takes 1.5 kB."""
MAX_OPEN_BLOCKS = 4
"""Largest number of blocks of the section that the page shows open, and not only by their titles."""
MAX_CELL_ROWS = 48
"""Largest number of combinations of factor levels (cells) with a table row for each cell. For more cells, the table has
a row for each level of a factor."""
SUMMARY_IMPROVEMENT_COLUMN = "distance_improvement_percent"
"""Result column whose mean the summary of a campaign reports: reduction by calibration [%] of the mean disagreement of
the stations in distances between targets."""

STATISTIC_TITLE_BY_COLUMN = MappingProxyType(
    {
        "distance_improvement_percent": ("disagreement in distances, reduction", " [%]"),
        "coordinate_improvement_percent": ("disagreement in coordinates, reduction", " [%]"),
        "share_removed": ("fraction of the correctable error removed", ""),
        "target_error_um": ("error of the targets", " [µm]"),
    }
)
"""Title of a result column, and its unit on an axis, by the name of the column."""


def campaign_section(folder: Path) -> Section:
    """Section of the folder of a campaign.

    Raises
    ------
    InputError
        If the folder contains no finished shard (file of rows), or a damaged one.
    """
    return section_of_results(CampaignResults(folder))


def section_of_results(results: CampaignResults) -> Section:
    """Section of the results of a campaign."""
    manifest, comparisons = results.manifest, results.solver_comparisons()
    summaries = SummariesByColumn(results)
    published_values = PUBLISHED_CRITERIA_BY_SCENARIO.get(str(manifest.settings.get("scenario", "")), {})
    distribution_blocks = _distribution_figures(results, published_values)
    open_blocks = [
        *_main_result_figures(results, summaries, published_values),
        *_varying_factors_tables(results),
    ] or distribution_blocks[:1]
    open_blocks += _means_by_level_tables(results, summaries)
    comparison = MethodComparison.from_results(results, summaries)
    open_blocks[1:1] = _errors_before_and_after_tables(results, summaries)
    open_blocks[:0] = comparison.blocks() if comparison else []
    blocks: list[Block] = [*open_blocks, *(b for b in distribution_blocks if b not in open_blocks)]
    coverage_figures, coverage_blocks = coverage_content(results)
    blocks += [*coverage_blocks, *_statistic_tables(results, comparisons)]
    blocks.append(CodeBlock("Campaign file as JSON", json.dumps(manifest.settings, indent=1)))
    scenarios = [scenario.model_dump(mode="json") for scenario in manifest.scenarios[:MAX_SHOWN_SCENARIOS]]
    which = f"first {MAX_SHOWN_SCENARIOS} " if len(manifest.scenarios) > MAX_SHOWN_SCENARIOS else ""
    blocks.append(CodeBlock(f"Scenarios of the {which}cells", json.dumps(scenarios, indent=1)))
    versions = [*manifest.versions.items(), *([("commit", manifest.commit[:12])] if manifest.commit else [])]
    return Section(
        title=f"Campaign: {manifest.title}" if manifest.title else "Campaign of simulated calibrations",
        kind="Campaign",
        summary=" ".join(
            [
                _summary_sentence(results, summaries, comparisons),
                *([comparison.sentence()] if comparison else []),
            ]
        ),
        assessment=assessment_of(not sum(comparison.failed_trials for comparison in comparisons)),
        key_figures=_key_figures(results, comparisons) + coverage_figures,
        blocks=blocks,
        seed_text=str(manifest.seed),
        package_versions=versions,
        axes_text="those of the scenario",
        instrument_text=tracker_preset_names_text(manifest.scenarios),
        n_open_blocks=min(len(open_blocks), MAX_OPEN_BLOCKS),
    )


def _mean_interval_text(summary: StatisticSummary, level: str = "95 %: ") -> str:
    """Mean of a result over the trials with its 95 % interval, as text; `level` is a text before the interval."""
    return f"{number_text(summary.mean)} ({level}{number_text(summary.low)} to {number_text(summary.high)})"


def _summary_sentence(
    results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]], comparisons: Sequence[SolverComparison]
) -> str:
    """Summary of a campaign: trials, varied factors, improvement by calibration, extreme errors."""
    manifest, factors = results.manifest, varying_factors(results)
    fewest, most = (
        min(comparison.trials for comparison in comparisons),
        max(comparison.trials for comparison in comparisons),
    )
    trials_text = f"Over {fewest} trials" if fewest == most else f"Over {fewest} to {most} trials"
    if len(manifest.cells) > 1:
        trials_text += f" for each of {len(manifest.cells)} combinations of factor levels"
        trials_text += f" ({_enumeration_text([factor_title(f) for f in factors])})" if factors else ""
    mean_texts = []
    for method in manifest.methods:
        method_text = f"with {method} " if len(manifest.methods) > 1 else ""
        means = [s for s in summaries.get(SUMMARY_IMPROVEMENT_COLUMN, []) if s.method == method]
        if len(means) == 1:
            mean_texts.append(f"{method_text}by {_mean_interval_text(means[0])} %")
        elif means:
            ends = dict.fromkeys(number_text(limit(s.mean for s in means)) for limit in (min, max))
            mean_texts.append(f"{method_text}by {' to '.join(ends)} %")
    text = f"{trials_text}, calibration reduces the disagreement of the stations in distances, on average "
    text += f"{'; '.join(mean_texts)}."
    return (text if mean_texts else f"{trials_text} with {', '.join(manifest.methods)}.") + _extreme_cells_sentence(
        results, summaries
    )


def _extreme_cells_sentence(results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]]) -> str:
    """Sentence on the combinations of factor levels (cells) with the smallest and the largest error of the targets.

    `summaries` holds the statistics of each result column by its name.
    """
    means = summaries.get("target_error_um", [])
    if len(results.manifest.cells) < 2 or not means:
        return ""
    cell_texts, has_several_methods = cell_descriptions(results), len(results.manifest.methods) > 1
    least, most = min(means, key=lambda s: s.mean), max(means, key=lambda s: s.mean)
    lowest_text, highest_text = (
        f"{number_text(s.mean)} um ({f'{s.method}, ' if has_several_methods else ''}{cell_texts[s.cell]})"
        for s in (least, most)
    )
    return f" The error of the targets is smallest with {lowest_text} and largest with {highest_text}."


def _enumeration_text(texts: Sequence[str]) -> str:
    """Texts joined by commas and a final `and`."""
    return " and ".join(filter(None, [", ".join(texts[:-1]), *texts[-1:]]))


def _key_figures(results: CampaignResults, comparisons: Sequence[SolverComparison]) -> list[KeyFigure]:
    """Key figures of a campaign: calibrations (trials times methods), cells, methods, failures, solvers."""
    manifest = results.manifest
    failed = sum(comparison.failed_trials for comparison in comparisons)
    differences = [
        comparison.largest_difference_sigma
        for comparison in comparisons
        if comparison.largest_difference_sigma is not None
    ]
    facts = [
        KeyFigure("calibrations", str(sum(comparison.trials for comparison in comparisons))),
        KeyFigure("combinations of factor levels", str(len(manifest.cells))),
        KeyFigure("methods", ", ".join(manifest.methods)),
        KeyFigure("failed", str(failed), assessment_of(not failed)),
    ]
    if differences:
        facts.append(
            KeyFigure(
                "largest difference of batch solver and lt.calibrate",
                f"{max(differences):.1e} sigma",
                assessment_of(max(differences) < 1e-3),
            )
        )
    return facts


def _varying_factors_tables(results: CampaignResults) -> list[Block]:
    """List with the table of the varied factors and their levels; empty if no factor varies."""
    table_rows = []
    for factor in results.factors:
        values = list(dict.fromkeys(factor.level_text(level[factor.name]) for level in results.levels))
        shown = values if len(values) <= MAX_LISTED_LEVELS else [values[0], "...", values[-1]]
        meaning = key_description(factor.keys[0]).replace("`", "")
        table_rows.append([factor_axis_title(factor), ", ".join(shown), ", ".join(factor.keys), meaning])
    return [*table_blocks("What was varied", FACTORS_TABLE.with_rows(table_rows))]


def _means_by_level_tables(
    results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]]
) -> list[TableBlock]:
    """Tables of means over all combinations with the same level of a factor, if there are more than `MAX_CELL_ROWS`.

    The combinations of factor levels are the cells of the campaign.
    """
    if len(results.levels) <= MAX_CELL_ROWS:
        return []
    means_by_level: dict[tuple[str, ...], list[float]] = {}
    for factor in sorted(varying_factors(results), key=lambda f: len(set(levels_of_cells(results, f)))):
        for name in STATISTIC_TITLE_BY_COLUMN:
            for s in summaries.get(name, []):
                key = factor_axis_title(factor), factor.level_text(results.levels[s.cell][factor.name]), s.method, name
                means_by_level.setdefault(key, []).append(s.mean)
    table_rows = [[*key, sum(m) / len(m), min(m), max(m)] for key, m in means_by_level.items()]
    return table_blocks(
        "Means over all combinations with the same level of a factor", MEANS_BY_FACTOR_LEVEL_TABLE.with_rows(table_rows)
    )


def _main_result_figures(
    results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]], published_values: Mapping[str, float]
) -> list[Block]:
    """Figures of the mean of each main result over the factors, with intervals and published values."""
    blocks: list[Block] = []
    if len(results.levels) == 1:  # shown by the distributions
        return blocks
    for column, (title, unit) in STATISTIC_TITLE_BY_COLUMN.items():
        rows, published_value = summaries.get(column, []), published_values.get(column)
        for text, figure in statistic_figures(results, rows, title + unit, published_value) if rows else ():
            outside = [
                s
                for s in rows
                if published_value is not None and not s.quantiles[1] <= published_value <= s.quantiles[5]
            ]
            side, which = (
                ("outside", f"{len(outside)} of {len(rows)} combinations of factor levels")
                if outside
                else ("inside", "every combination of factor levels")
            )
            comparison = (
                f" The published value {number_text(published_value)} is dashed; it lies {side} the central 90 % of "
                f"the trials in {which}."
            )
            caption = text if published_value is None else text + comparison
            blocks.append(PictureBlock(title.capitalize(), figure, caption))
    return blocks


def campaign_figure(results: CampaignResults) -> Figure:
    """Figure of the first main result over the factors; distributions over the trials if no factor varies."""
    if len(results.levels) > 1:
        for column, (title, unit) in STATISTIC_TITLE_BY_COLUMN.items():
            if column in results.columns:
                return next(statistic_figures(results, results.statistic_summaries(column), title + unit, None))[1]()
    return distributions_figure(_trial_distributions(results, {}))


def _trial_distributions(results: CampaignResults, published_values: Mapping[str, float]) -> list[TrialDistribution]:
    """Distributions over the trials of the first cell (combination of factor levels) and the first method.

    The quantities are the disagreements of the stations, or, if a campaign does not have these, other errors.
    `published_values` are values by column to compare with.
    """
    cell = results.manifest.cells[0].cell
    error_columns = [c for c in results.columns if c.endswith(("_um", "_percent"))]
    columns_used = [c for c in error_columns if c.startswith(("distance", "coordinate"))] or error_columns
    columns_used.sort(
        key=lambda c: (not c.endswith("percent"), "mean" not in c, "before" not in c, c.startswith("coord"))
    )
    values_by_column = {
        c: results.column_values(c, cell, results.manifest.methods[0], max_trials=MAX_DRAWN_TRIALS)
        for c in columns_used
    }
    return [
        TrialDistribution(_column_label(c), v, "um" if c.endswith("_um") else "%", published_values.get(c))
        for c, v in values_by_column.items()
        if len(v) > 1
    ]


def _distribution_figures(results: CampaignResults, published_values: Mapping[str, float]) -> list[Block]:
    """Histograms of the disagreement of the stations for the first method; empty for several combinations of levels.

    `published_values` are values by column to compare with.
    """
    distributions = [] if len(results.levels) > 1 else _trial_distributions(results, published_values)
    caption = "Dashed: published values, with the share of trials below them." if published_values else ""
    title = f"Distributions over trials: {results.manifest.methods[0]}"
    return [PictureBlock(title, partial(distributions_figure, distributions), caption)] if distributions else []


def _column_label(column: str) -> str:
    """Label of a column, such as `distance, mean before` for `distance_before_mean_um`."""
    if column.startswith("new_point_"):
        return f"new point: {_column_label(column.removeprefix('new_point_'))}"
    name_words = column.removesuffix("_um").removesuffix("_percent").replace("max", "largest").split("_")
    return f"{name_words[0]}, {' '.join(reversed(name_words[1:]))}" if len(name_words) > 1 else column


def _errors_before_and_after_tables(
    results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]]
) -> list[Block]:
    """Tables of errors before and after calibration, and of the error that remains with the true parameters."""
    names = cell_descriptions(results)
    blocks: list[Block] = []
    for share in RATIO_STATISTICS:
        columns = (*error_columns_of_ratio(share), share)
        texts = [[_mean_interval_text(s, "") for s in summaries.get(name, [])] for name in columns]
        places = [(names[s.cell], s.method) for s in summaries.get(share, [])]
        rows = [[*place, *cells] for place, *cells in zip(places, *texts, strict=all(texts))]
        point_kind = "new point" if share.startswith("new_point") else "point"
        note = f"Raw: {_column_meaning(error_columns_of_ratio(share)[0])}. Share removed: {_column_meaning(share)}. "
        note += "Noise floor: error after correction with the true parameters. In brackets: 95 % interval."
        blocks += table_blocks(f"Error of a {point_kind}", ERRORS_BEFORE_AND_AFTER_TABLE.with_rows(rows), note=note)
    return blocks


def _column_meaning(column: str) -> str:
    """Definition of a column as a sentence without full stop; empty for an undeclared column."""
    declared = find_result_column(column)
    return capitalised_sentence("" if declared is None else declared.meaning.replace("`", "")).removesuffix(".")


def _statistic_tables(results: CampaignResults, comparisons: Sequence[SolverComparison]) -> list[Block]:
    """Tables of all results with their definitions, and table of the convergence of the trials."""
    cells, n_rows = first_summary_rows(results, MAX_SHOWN_STATISTIC_ROWS)
    extra_fields = {
        "cell",
        "standard_deviation",
        "minimum",
        "maximum",
        *(f"quantile_{q}_percent" for q in ("2.5", "25", "75", "97.5")),
    }
    shown_table = _table_with_levels_as_in_file(
        results, cells.select_columns(" ".join(name for name in cells.header if name not in extra_fields))
    )
    definitions = [
        f"{_column_label(c)} [{results.units.get(c, '')}]: {_column_meaning(c)}" for c in SummariesByColumn(results)
    ]
    note = (
        "Verified trials were calibrated again one by one with lt.calibrate (full solver); the difference is between "
        "the estimates of both solvers."
    )
    failed = frozenset(i for i, comparison in enumerate(comparisons) if comparison.failed_trials)
    convergence_table = results.table("solver_comparisons")
    convergence_table = _table_with_levels_as_in_file(
        results, convergence_table.select_columns(" ".join(name for name in convergence_table.header if name != "cell"))
    )
    count = f"first {MAX_SHOWN_STATISTIC_ROWS} of {n_rows} rows" if n_rows > MAX_SHOWN_STATISTIC_ROWS else ""
    all_rows_text = f"{SUMMARY_FILE_NAME} contains all rows." if count else ""
    return [
        *table_blocks(f"Statistics ({count or count_text(n_rows, 'row')})", shown_table, note=all_rows_text),
        CodeBlock("Definitions of the statistics", "\n".join(definitions)),
        *table_blocks("Convergence of the trials", convergence_table, note=note, marked_rows=failed),
    ]


def _table_with_levels_as_in_file(results: CampaignResults, table: TableOf) -> TableOf:
    """Table whose factor levels are written as in the campaign file: 0.5 and not 0.5000."""
    factor_names = {f.name for f in results.factors}
    columns = (
        replace(c, display_format=".6g") if c.name in factor_names and c.kind == "number" else c for c in table.columns
    )
    return replace(table, columns=tuple(columns))

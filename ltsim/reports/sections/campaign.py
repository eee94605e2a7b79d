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
from ltsim.reports.document import Block, CodeBlock, Fact, Picture, Section, TableBlock, mood, table_block
from ltsim.reports.figures.campaign import (
    ALLOWED,
    PAPER,
    TrialDistribution,
    coverage,
    distributions,
    title,
    uncovered,
)
from ltsim.reports.figures.campaign_factors import cell_words, drawn, level_column, varied
from ltsim.reports.words import count, of_presets, sentence
from ltsim.simulation.keys import key_description

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_DRAWN = 200_000
"""Largest number of trials in a figure; tables and intervals use all trials."""
MAX_CELLS = 3
MAX_VALUES = 8
MAX_SHOWN = 4
MAX_ROWS = 48
IMPROVEMENT = "distance_improvement_percent"

LABELS = MappingProxyType(
    {
        "distance_improvement_percent": "distance criterion, improvement [%]",
        "coordinate_improvement_percent": "coordinate criterion, improvement [%]",
        "share_removed": "fraction of the correctable error removed",
        "target_error_um": "error of the targets [µm]",
    }
)


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
    scores, ends = results.z_score_summaries(), results.solver_comparisons()
    published = PAPER.get(str(manifest.settings.get("scenario", "")), {})
    drawn_ = _distributions(results, published)
    shown = [*_improvements(results, spreads, published), *_varied(results)] or drawn_[:1]
    shown += _by_factor(results, spreads)
    shown[1:1] = _errors(results, spreads)
    blocks: list[Block] = [*shown, *(b for b in drawn_ if b not in shown)]
    blocks += [*_coverage(results, scores), *_statistics(results, spreads, ends)]
    blocks.append(CodeBlock("Settings of the campaign", json.dumps(manifest.settings, indent=1)))
    scenarios = [scenario.model_dump(mode="json") for scenario in manifest.scenarios]
    blocks.append(CodeBlock("Scenarios of its cells", json.dumps(scenarios, indent=1)))
    versions = [*manifest.versions.items(), *([("commit", manifest.commit[:12])] if manifest.commit else [])]
    return Section(
        title=f"Campaign: {manifest.title}" if manifest.title else "Campaign of simulated calibrations",
        kind="Campaign",
        answer=_answer(results, spreads, ends),
        mood=mood(not sum(end.failed for end in ends)),
        facts=_facts(manifest, ends, scores),
        blocks=blocks,
        seed=str(manifest.seed),
        versions=versions,
        axes="those of the scenario",
        instrument=of_presets(manifest.scenarios),
        shown=min(len(shown), MAX_SHOWN),
    )


def _mean(s: StatisticSummary, level: str = "95 %: ") -> str:
    return f"{number_text(s.mean)} ({level}{number_text(s.low)} to {number_text(s.high)})"


def _answer(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], ends: Sequence[SolverComparison]
) -> str:
    """Answer: factors, improvement by calibration, best and worst cells."""
    manifest, factors = results.manifest, varied(results)
    fewest, most = min(e.trials for e in ends), max(e.trials for e in ends)
    size = f"Over {fewest} trials" if fewest == most else f"Over {fewest} to {most} trials"
    if len(manifest.cells) > 1:
        size += f" in each of {len(manifest.cells)} settings"
        size += f" of {_listed([title(f).partition(' [')[0] for f in factors])}" if factors else ""
    means_in_words = []
    for method in manifest.methods:
        means = [s for s in spreads.get(IMPROVEMENT, []) if s.method == method]
        if len(means) == 1:
            means_in_words.append(f"{method} by {_mean(means[0])} %")
        elif means:
            low, high = min(s.mean for s in means), max(s.mean for s in means)
            means_in_words.append(f"{method} by {number_text(low)} to {number_text(high)} %")
    text = f"{size}, calibration improves the distance criterion on average: {'; '.join(means_in_words)}."
    return (text if means_in_words else f"{size} with {', '.join(manifest.methods)}.") + _extremes(results, spreads)


def _extremes(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> str:
    means = spreads.get("target_error_um", [])
    if len(results.manifest.cells) < 2 or not means:
        return ""
    names, several = cell_words(results), len(results.manifest.methods) > 1
    least, most = min(means, key=lambda s: s.mean), max(means, key=lambda s: s.mean)
    first, last = (
        f"{number_text(s.mean)} um ({f'{s.method}, ' if several else ''}{names[s.cell]})" for s in (least, most)
    )
    return f" The error of the targets is smallest with {first} and largest with {last}."


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _facts(manifest: ManifestFile, ends: Sequence[SolverComparison], scores: Sequence[ZScoreSummary]) -> list[Fact]:
    failed = sum(end.failed for end in ends)
    checked = [end.largest_difference_sigma for end in ends if end.largest_difference_sigma is not None]
    facts = [
        Fact("trials", str(sum(end.trials for end in ends))),
        Fact("settings", str(len(manifest.cells))),
        Fact("methods", ", ".join(manifest.methods)),
        Fact("failed", str(failed), mood(not failed)),
    ]
    if checked:
        facts.append(Fact("batch solver against full solver", f"{max(checked):.1e} sigma", mood(max(checked) < 1e-3)))
    if scores:
        shares = [s.coverage_95 for s in scores]
        facts.append(Fact("coverage of 95 %", f"{100 * min(shares):.1f} to {100 * max(shares):.1f} %"))
    return facts


def _varied(results: CampaignResults) -> list[Block]:
    rows = []
    for factor in results.factors:
        values = list(dict.fromkeys(factor.level_text(level[factor.name]) for level in results.levels))
        shown = values if len(values) <= MAX_VALUES else [values[0], "...", values[-1]]
        meaning = key_description(factor.keys[0]).replace("`", "")
        rows.append([title(factor), ", ".join(shown), ", ".join(factor.keys), meaning])
    return [*table_block("What was varied", FACTORS_TABLE.filled(rows))]


def _by_factor(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> list[TableBlock]:
    """Table of means over the cells of each level, if there are many cells; factors with few levels first."""
    if len(results.levels) <= MAX_ROWS:
        return []
    groups: dict[tuple[str, ...], list[float]] = {}
    for factor in sorted(varied(results), key=lambda f: len(set(level_column(results, f)))):
        for name in filter(spreads.get, LABELS):
            for s in spreads[name]:
                key = title(factor), factor.level_text(results.levels[s.cell][factor.name]), s.method, name
                groups.setdefault(key, []).append(s.mean)
    rows = [[*key, sum(m) / len(m), min(m), max(m)] for key, m in groups.items()]
    return table_block("Means over the settings of a level", MEANS_BY_LEVEL_TABLE.filled(rows))


def _improvements(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], published: Mapping[str, float]
) -> list[Block]:
    """Figures of means with intervals over the settings, compared with the published values."""
    blocks: list[Block] = []
    if len(results.levels) == 1:  # shown by the distributions
        return blocks
    for column, label in LABELS.items():
        rows, paper = spreads.get(column, []), published.get(column)
        for text, figure in drawn(results, rows, label, paper) if rows else ():
            outside = [s for s in rows if paper is not None and not s.quantiles[1] <= paper <= s.quantiles[5]]
            where = f"outside in {len(outside)} of {len(rows)} settings" if outside else "inside in every setting"
            comparison = (
                f" The published value {number_text(paper)} is dashed; compared with the 90 % of the trials it "
                f"is {where}."
            )
            caption = text if paper is None else text + comparison
            blocks.append(Picture(label.split(" [")[0].capitalize(), figure, caption))
    return blocks


def campaign_figure(results: CampaignResults) -> Figure:
    """Figure of the first main statistic over the factors; of distributions if nothing varies."""
    if len(results.levels) > 1:
        for column, label in LABELS.items():
            if column in results.columns:
                return next(drawn(results, results.distribution(column), label, None))[1]()
    return distributions(_rows_of(results, {}))


def _rows_of(results: CampaignResults, published: Mapping[str, float]) -> list[TrialDistribution]:
    """Distributions of the criteria, or of other errors, over the trials of the first setting and method."""
    cell = results.manifest.cells[0].cell
    sized = [c for c in results.columns if c.endswith(("_um", "_percent"))]
    wanted = [c for c in sized if c.startswith(("distance", "coordinate"))] or sized
    wanted.sort(key=lambda c: (not c.endswith("percent"), "mean" not in c, "before" not in c, c.startswith("coord")))
    values = {c: results.column_values(c, cell, results.manifest.methods[0], max_trials=MAX_DRAWN) for c in wanted}
    return [
        TrialDistribution(_column_words(c), v, "um" if c.endswith("_um") else "%", published.get(c))
        for c, v in values.items()
        if len(v) > 1
    ]


def _distributions(results: CampaignResults, published: Mapping[str, float]) -> list[Block]:
    """Histograms of the criteria of the first method, if there is one setting."""
    rows = [] if len(results.levels) > 1 else _rows_of(results, published)
    caption = "Dashed: published values, with the share of trials below them." if published else ""
    title = f"Distributions over trials: {results.manifest.methods[0]}"
    return [Picture(title, partial(distributions, rows), caption)] if rows else []


def _coverage(results: CampaignResults, scores: Sequence[ZScoreSummary]) -> list[Block]:
    """z-scores and coverage: figure for the first cell of each method, table for all cells."""
    blocks: list[Block] = []
    for method in dict.fromkeys(s.method for s in scores):
        mine = [s for s in scores if s.method == method]
        rows = [s for s in mine if s.cell == mine[0].cell and s.trials > 1]
        if rows and len(blocks) < MAX_CELLS:
            place = f", {cell_words(results)[mine[0].cell]}" if len(results.levels) > 1 else ""
            blocks.append(Picture(f"Coverage: {method}{place}", partial(coverage, rows), coverage_words(rows)))
    text = "z: (estimate - truth) / declared sigma; correct sigmas give mean 0 and standard deviation 1."
    return [*blocks, *table_block("z-scores of the parameters", results.table("z_scores"), note=text)] if scores else []


def coverage_words(rows: Sequence[ZScoreSummary]) -> str:
    """Sentence on the parameters whose coverage is outside the allowed band."""
    low, high = (f"{100 * bound:.1f}" for bound in ALLOWED)
    red = [row.parameter for row, out in zip(rows, uncovered(rows), strict=True) if out]
    band = f"the allowed band of {low} to {high} %"
    if not red:
        return f"No parameter is red: each interval overlaps {band}."
    return f"Red: the interval lies outside {band} for {', '.join(red)}."


def _column_words(column: str) -> str:
    """`distance_before_mean_um` as `distance, mean before`."""
    if column.startswith("new_point_"):
        return f"new point: {_column_words(column.removeprefix('new_point_'))}"
    parts = column.removesuffix("_um").removesuffix("_percent").replace("max", "largest").split("_")
    return f"{parts[0]}, {' '.join(reversed(parts[1:]))}" if len(parts) > 1 else column


def _errors(results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]]) -> list[Block]:
    """Tables of errors before and after calibration, with the noise floor that no parameter removes."""
    names = cell_words(results)
    blocks: list[Block] = []
    for share in RATIO_STATISTICS:
        entries = [spreads.get(name, []) for name in (*ratio_columns(share), share)]
        rows = [
            [names[of[0].cell], of[0].method, *(_mean(s, "") for s in of)] for of in zip(*entries, strict=all(entries))
        ]
        named = "new point" if share.startswith("new_point") else "point"
        note = f"{_meaning(share)}. Noise floor: error with the true parameters. In brackets: 95 % interval."
        blocks += table_block(f"Error of a {named}", ERRORS_TABLE.filled(rows), note=note)
    return blocks


def _meaning(column: str) -> str:
    declared = find_column(column)
    return sentence("" if declared is None else declared.meaning.replace("`", "")).removesuffix(".")


def _statistics(
    results: CampaignResults, spreads: Mapping[str, list[StatisticSummary]], ends: Sequence[SolverComparison]
) -> list[Block]:
    """Tables of all statistics, their definitions, and the convergence of the trials."""
    cells = results.table("summary")
    more = {"cell", "deviation", "least", "largest", *(f"quantile_{q}_percent" for q in ("2.5", "25", "75", "97.5"))}
    shown = _settings(results, cells.with_columns(" ".join(name for name in cells.header if name not in more)))
    means = [f"{_column_words(c)} [{results.units.get(c, '')}]: {_meaning(c)}" for c in spreads]
    note = "Verified: trials repeated with the full solver; difference of the estimates."
    failed = frozenset(i for i, e in enumerate(ends) if e.failed)
    ended = results.table("ends")
    ended = _settings(results, ended.with_columns(" ".join(name for name in ended.header if name != "cell")))
    return [
        *table_block(f"Statistics ({count(len(shown.rows), 'row')})", shown),
        CodeBlock("Definitions of the statistics", "\n".join(means)),
        *table_block("Convergence of the trials", ended, note=note, marked=failed),
    ]


def _settings(results: CampaignResults, table: TableOf) -> TableOf:
    """Table of cells with the settings displayed as given: 0.5 and not 0.5000."""
    given = {f.name for f in results.factors}
    columns = (replace(c, shown=".6g") if c.name in given and c.kind == "number" else c for c in table.columns)
    return replace(table, columns=tuple(columns))

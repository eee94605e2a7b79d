"""What a report says of a campaign: the improvement with its interval, distributions, z-scores, coverage."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ltsim.arrays import Floats
from ltsim.campaigns.schema import ManifestFile
from ltsim.campaigns.statistics import Checked, Results, Scores, Spread
from ltsim.pages import figures, style
from ltsim.pages.document import Block, Fact, Listing, Section, Table, mood, picture
from ltsim.pages.sections.sweep import cell_words, drawn, title, varied
from ltsim.pages.words import count
from ltsim.simulation.keys import meaning_of

MOST_DRAWN = 200_000
"""Trials whose values are drawn; tables and intervals use all of them."""
MOST_CELLS, MOST_NAMED, MOST_VALUES = 3, 3, 8
IMPROVEMENT = "distance_improvement_percent"

LABELS = MappingProxyType(
    {
        "distance_improvement_percent": "distance criterion, improvement [%]",
        "coordinate_improvement_percent": "coordinate criterion, improvement [%]",
        "share_removed": "share of the correctable error removed",
        "target_error_um": "error of the targets [µm]",
    }
)
PAPER = MappingProxyType(
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
"""Tables 3 and 4 of Sensors 2021, 21, 7479."""


def campaign_section(folder: Path) -> Section:
    """The section of a campaign's folder.

    Raises
    ------
    SetupError
        When the folder holds no finished shard, or a damaged one.
    """
    results = Results(folder)
    manifest = results.manifest
    spreads = {name: results.spread(name) for name in results.columns if ":" not in name}
    scores, ends = results.z_scores(), results.checked()
    blocks: list[Block] = [*_varied(results), *_improvements(results, spreads)]
    blocks += _distributions(results, spreads)
    blocks += _scores(results, scores)
    blocks += [_ends(results, ends), _statistics(results, spreads), *_score_table(results, scores)]
    blocks.append(Listing("Settings of the campaign", json.dumps(manifest.settings, indent=1)))
    blocks.append(Listing("Scenarios of its cells", json.dumps(manifest.scenarios, indent=1)))
    failed = sum(end.failed for end in ends)
    versions = list(manifest.versions.items())
    if manifest.commit:
        versions.append(("commit", manifest.commit[:12]))
    return Section(
        title=manifest.title or folder.name,
        kind="Campaign",
        answer=_answer(results, spreads, ends),
        mood=mood(not failed),
        facts=_facts(manifest, ends, scores),
        blocks=blocks,
        seed=str(manifest.seed),
        versions=versions,
    )


def _answer(results: Results, spreads: Mapping[str, list[Spread]], ends: Sequence[Checked]) -> str:
    """What was varied, what calibration is worth, and where it is best and worst."""
    manifest, factors = results.manifest, varied(results)
    fewest, most = min(e.trials for e in ends), max(e.trials for e in ends)
    size = f"Over {fewest} trials" if fewest == most else f"Over {fewest} to {most} trials"
    if len(manifest.cells) > 1:
        size += f" in each of {len(manifest.cells)} settings"
        size += f" of {_listed([title(f).partition(' [')[0] for f in factors])}" if factors else ""
    improved = spreads.get(IMPROVEMENT, [])
    if not improved:
        return f"{size} with {', '.join(manifest.methods)}.{_extremes(results, spreads)}"
    said = []
    for method in manifest.methods:
        means = [s for s in improved if s.method == method]
        if len(means) == 1:
            half = 0.5 * (means[0].high - means[0].low)
            said.append(f"{method} by {style.with_sigma(means[0].mean, half)} %")
        elif means:
            low, high = min(s.mean for s in means), max(s.mean for s in means)
            said.append(f"{method} by {style.number(low)} to {style.number(high)} %")
    told = f"{size}, calibration improves the distance criterion on average: {'; '.join(said)}."
    return told + _extremes(results, spreads)


def _extremes(results: Results, spreads: Mapping[str, list[Spread]]) -> str:
    """Where the targets err least and most."""
    means = spreads.get("target_error_um", [])
    if len(results.manifest.cells) < 2 or not means:
        return ""
    names, several = cell_words(results), len(results.manifest.methods) > 1
    least, most = min(means, key=lambda s: s.mean), max(means, key=lambda s: s.mean)

    def at(s: Spread) -> str:
        half = 0.5 * (s.high - s.low)
        method = f"{s.method}, " if several else ""
        return f"{style.with_sigma(s.mean, half)} µm ({method}{names[s.cell]})"

    return f" Targets err least with {at(least)}, most with {at(most)}."


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _facts(manifest: ManifestFile, ends: Sequence[Checked], scores: Sequence[Scores]) -> list[Fact]:
    """Figures at a glance."""
    failed = sum(end.failed for end in ends)
    checked = [end.largest_difference_sigma for end in ends if end.largest_difference_sigma is not None]
    facts = [
        Fact("trials", str(sum(end.trials for end in ends))),
        Fact("settings", str(len(manifest.cells))),
        Fact("methods", str(len(manifest.methods))),
        Fact("failed", str(failed), mood(not failed)),
    ]
    if checked:
        facts.append(Fact("fast against full solver", f"{max(checked):.1e} σ", mood(max(checked) < 1e-3)))
    if scores:
        shares = [s.coverage_95 for s in scores]
        facts.append(Fact("coverage of 95 %", f"{100 * min(shares):.1f} to {100 * max(shares):.1f} %"))
    return facts


def _published(results: Results) -> Mapping[str, float]:
    """The paper's figures for its own scenario."""
    scenario = str(results.manifest.settings.get("scenario", ""))
    return PAPER.get(scenario, {})


def _varied(results: Results) -> list[Block]:
    """What differs between the settings: its values, and what the keys mean that take them."""
    rows = []
    for factor in results.factors:
        values = list(dict.fromkeys(factor.words(level[factor.name]) for level in results.levels))
        shown = values if len(values) <= MOST_VALUES else [values[0], "...", values[-1]]
        told = meaning_of(factor.keys[0]).replace("`", "")
        rows.append([title(factor), ", ".join(shown), ", ".join(factor.keys), told])
    return [Table("What was varied", ["", "values", "key", "meaning"], rows, text_columns=4)] if rows else []


def _improvements(results: Results, spreads: Mapping[str, list[Spread]]) -> list[Block]:
    """Means with intervals over the settings, and where the paper's figure lies."""
    blocks: list[Block] = []
    for column, label in LABELS.items():
        published = _published(results).get(column)
        for text, figure in drawn(results, spreads.get(column, []), label, published) if spreads.get(column) else ():
            told = "" if published is None else f" {_beside_paper(results, spreads[column], published)}"
            blocks.append(picture(label.split(" [")[0].capitalize(), figure, text + told))
    return blocks


def _beside_paper(results: Results, spreads: Sequence[Spread], published: float) -> str:
    """A sentence: where the paper's figure lies outside the middle 90 % of the trials."""
    names, paper = cell_words(results), f"The paper's {style.number(published)} (dashed) lies"
    sides = {(s.cell, s.method): _side(published, s.quantiles[1], s.quantiles[5]) for s in spreads}
    outside = {place: side for place, side in sides.items() if side}
    if not outside:
        return f"{paper} within the middle 90 % of the trials everywhere."
    several = len(results.manifest.methods) > 1
    where = "; ".join(
        f"{f'{method}, ' if several else ''}{names[cell]} ({side})" for (cell, method), side in outside.items()
    )
    if len(outside) > MOST_NAMED or len(outside) == len(sides):
        many = "all" if len(outside) == len(sides) else f"{len(outside)} of {len(sides)}"
        where = f"{many} settings{' and methods' if several else ''} ({' or '.join(sorted(set(outside.values())))})"
    return f"{paper} outside the middle 90 % of the trials in {where}."


def _side(published: float, low: float, high: float) -> str:
    """On which side of an interval a figure lies; empty inside."""
    return "below" if published < low else "above" if published > high else ""


def _distributions(results: Results, spreads: Mapping[str, list[Spread]]) -> list[Block]:
    """Histograms of the criteria, cell by cell, for the file's first method."""
    published, names = _published(results), cell_words(results)
    method = results.manifest.methods[0]
    wanted = [c for c in spreads if c.endswith(("_um", "_percent")) and c.startswith(("distance", "coordinate"))]
    wanted.sort(key=lambda c: (not c.endswith("percent"), "mean" not in c, "before" not in c, c.startswith("coord")))
    blocks: list[Block] = []
    for cell in list(names)[: MOST_CELLS if len(names) <= MOST_CELLS else 1]:
        rows = []
        for column in wanted:
            values = _values(results, column, cell, method)
            if len(values) > 1:
                unit = "um" if column.endswith("_um") else "%"
                rows.append(figures.Distribution(_column_words(column), values, unit, published.get(column)))
        if rows:
            text = "Dark line: the middle 90 % of the trials; blue: the mean." + _paper_among(rows)
            title = f"Distributions over trials: {method}" + (f", {names[cell]}" if len(names) > 1 else "")
            blocks.append(picture(title, figures.distributions(rows), text))
    return blocks


def _paper_among(rows: Sequence[figures.Distribution]) -> str:
    """Sentences on the paper's figures, which lie outside the middle 90 % of the trials or not."""
    if all(row.published is None for row in rows):
        return ""
    outside = [
        f"{row.name} (paper {style.number(row.published)}, trials {style.number(row.middle[0])} to "
        f"{style.number(row.middle[1])})"
        for row in rows
        if row.published is not None and _side(row.published, *row.middle)
    ]
    found = f"outside the middle 90 %: {'; '.join(outside)}." if outside else "all within the middle 90 %."
    return f" Dashed: the paper's figures and the share of trials below them; {found}"


def _scores(results: Results, scores: Sequence[Scores]) -> list[Block]:
    """z-scores and coverage in the first cell, for each method that has them."""
    blocks: list[Block] = []
    for method in dict.fromkeys(s.method for s in scores):
        mine = [s for s in scores if s.method == method]
        cell = mine[0].cell
        rows = [
            figures.ZScores(s.parameter, _values(results, f"z:{s.parameter}", cell, method))
            for s in mine
            if s.cell == cell and s.trials > 1
        ]
        if rows:
            title = f"{method}, {cell_words(results)[cell]}"
            text = "Where estimates and stated uncertainties are right, the bars follow the standard normal curve."
            blocks.append(picture(f"z-scores: {title}", figures.z_scores(rows), text))
            blocks.append(picture(f"Coverage: {title}", figures.coverage(rows), coverage_words(rows)))
    return blocks


def coverage_words(rows: Sequence[figures.ZScores]) -> str:
    """Which shares are red, and why."""
    low, high = (f"{100 * bound:.1f}" for bound in figures.ALLOWED)
    red = [row.name for row, out in zip(rows, figures.uncovered(rows), strict=True) if out]
    band = f"the allowed band of {low} to {high} %"
    if not red:
        return f"Marks: the share with its own 95 % interval. None is red: each interval reaches into {band}."
    return f"Marks: the share with its own 95 % interval. Red, since that lies outside {band}: {', '.join(red)}."


def _settings(results: Results) -> tuple[list[str], dict[int, list[str]]]:
    """The columns of settings of a table: their headers, and their cells for each cell of the campaign."""
    factors = results.factors
    rows = {
        entry.cell: [f.words(level[f.name]) for f in factors]
        for entry, level in zip(results.manifest.cells, results.levels, strict=True)
    }
    return [title(f) for f in factors], rows


def _values(results: Results, column: str, cell: int, method: str) -> Floats:
    """Finite values (n,) of a column in a cell for a method."""
    name = column.replace('"', '""')
    rows = results.query(
        f"SELECT \"{name}\" FROM rows WHERE cell = {int(cell)} AND method = '{method.replace(chr(39), 2 * chr(39))}' "
        f'AND isfinite("{name}") AND trial < {MOST_DRAWN} ORDER BY trial'
    )
    return np.array(rows, dtype=np.float64).reshape(-1)


def _column_words(column: str) -> str:
    """`distance_before_mean_um` as `distance, mean before`."""
    parts = column.removesuffix("_um").removesuffix("_percent").replace("max", "largest").split("_")
    return f"{parts[0]}, {' '.join(reversed(parts[1:]))}" if len(parts) > 1 else column


def _ends(results: Results, ends: Sequence[Checked]) -> Table:
    """How the trials ended."""
    heads, own = _settings(results)
    rows = [
        [
            *own[e.cell], e.method, str(e.trials), str(e.failed), str(e.by_full_solver),
            str(e.checked),
            "–" if e.largest_difference_sigma is None else f"{e.largest_difference_sigma:.1e}",
        ]
        for e in ends
    ]  # fmt: skip
    header = [*heads, "method", "trials", "failed", "by full solver", "verified", "largest difference [σ]"]
    note = "Verified: trials that the full solver repeated; the difference is that of the estimates."
    failed = frozenset(i for i, e in enumerate(ends) if e.failed)
    return Table("How the trials ended", header, rows, text_columns=len(heads) + 1, note=note, marked=failed)


def _statistics(results: Results, spreads: Mapping[str, list[Spread]]) -> Table:
    """All statistics."""
    heads, own = _settings(results)
    rows = [
        [
            *own[s.cell], s.method, _column_words(column), results.units.get(column, ""), style.number(s.mean),
            f"{style.number(s.low)} to {style.number(s.high)}", *(style.number(s.quantiles[k]) for k in (1, 3, 5)),
        ]
        for column, entries in spreads.items()
        if column != "full_difference_sigma"
        for s in entries
    ]  # fmt: skip
    header = [*heads, "method", "statistic", "unit", "mean", "95 % interval", "5 %", "median", "95 %"]
    return Table(f"Statistics ({count(len(rows), 'row')})", header, rows, text_columns=len(heads) + 3)


def _score_table(results: Results, scores: Sequence[Scores]) -> list[Block]:
    """z-scores in figures."""
    if not scores:
        return []
    heads, own = _settings(results)
    rows = [
        [
            *own[s.cell], s.method, s.parameter, str(s.trials), style.fixed(s.mean, 3),
            style.fixed(s.deviation, 3), f"{100 * s.coverage_95:.1f} %",
        ]
        for s in scores
    ]  # fmt: skip
    header = [*heads, "method", "parameter", "trials", "mean z", "sd of z", "coverage of 95 %"]
    return [Table("z-scores of the parameters", header, rows, text_columns=len(heads) + 2)]

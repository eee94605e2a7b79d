"""What a report says of a campaign: the improvement with its interval, distributions, z-scores, coverage."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ltsim.arrays import Floats
from ltsim.campaign.schema import ManifestFile
from ltsim.campaign.statistics import Checked, Results, Scores, Spread
from ltsim.report import figures, style
from ltsim.report.document import Block, Fact, Listing, Section, Table, mood, picture
from ltsim.report.words import count

MOST_DRAWN = 200_000
"""Trials whose values are drawn; tables and intervals use all of them."""
MOST_CELLS = 3
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
    blocks: list[Block] = _improvements(results, spreads)
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
        answer=_answer(manifest, spreads),
        mood=mood(not failed),
        facts=_facts(manifest, ends, scores),
        blocks=blocks,
        seed=str(manifest.seed),
        versions=versions,
    )


def _answer(manifest: ManifestFile, spreads: Mapping[str, list[Spread]]) -> str:
    """The first sentence."""
    trials, cells = manifest.trials, len(manifest.cells)
    size = f"Over {trials} trials" + (f" in each of {cells} settings" if cells > 1 else "")
    improved = spreads.get(IMPROVEMENT, [])
    if not improved:
        return f"{size} with {', '.join(manifest.methods)}."
    said = []
    for method in manifest.methods:
        means = [s for s in improved if s.method == method]
        if len(means) == 1:
            half = 0.5 * (means[0].high - means[0].low)
            said.append(f"{method} by {style.with_sigma(means[0].mean, half)} %")
        elif means:
            low, high = min(s.mean for s in means), max(s.mean for s in means)
            said.append(f"{method} by {style.number(low)} to {style.number(high)} %")
    return f"{size}, calibration improves the distance criterion on average: {'; '.join(said)}."


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


def _cell_names(results: Results) -> dict[int, str]:
    """What each cell is, without the settings that all cells share."""
    parts = {c.cell: c.label.split(", ") for c in results.manifest.cells}
    shared = set.intersection(*map(set, parts.values())) if len(parts) > 1 else set()
    own = {cell: ", ".join(p for p in words if p not in shared) for cell, words in parts.items()}
    return {cell: label or "as the scenario" for cell, label in own.items()}


def _published(results: Results) -> Mapping[str, float]:
    """The paper's figures for its own scenario."""
    scenario = str(results.manifest.settings.get("scenario", ""))
    return PAPER.get(scenario, {})


def _improvements(results: Results, spreads: Mapping[str, list[Spread]]) -> list[Block]:
    """Means with intervals over the settings."""
    names = _cell_names(results)
    blocks: list[Block] = []
    for column, label in LABELS.items():
        if spreads.get(column):
            rows = [
                figures.Mean(
                    names.get(s.cell, str(s.cell)), s.method, s.mean, s.low, s.high, s.quantiles[1], s.quantiles[5]
                )
                for s in spreads[column]
            ]
            figure = figures.by_setting(rows, label=label, published=_published(results).get(column))
            text = "Thick: mean with its 95 % confidence interval; thin: the middle 90 % of the trials."
            blocks.append(picture(label.split(" [")[0].capitalize(), figure, text))
    return blocks


def _distributions(results: Results, spreads: Mapping[str, list[Spread]]) -> list[Block]:
    """Histograms of the criteria, cell by cell, for the file's first method."""
    published, names = _published(results), _cell_names(results)
    method = results.manifest.methods[0]
    wanted = [c for c in spreads if c.endswith(("_um", "_percent")) and c.startswith(("distance", "coordinate"))]
    wanted.sort(key=lambda c: (not c.endswith("percent"), "mean" not in c, "before" not in c, c.startswith("coord")))
    blocks: list[Block] = []
    for cell in list(names)[:MOST_CELLS]:
        rows = []
        for column in wanted:
            values = _values(results, column, cell, method)
            if len(values) > 1:
                unit = "um" if column.endswith("_um") else "%"
                rows.append(figures.Distribution(_column_words(column), values, unit, published.get(column)))
        if rows:
            text = "Dark line: the middle 90 % of the trials; blue: the mean." + (
                " Dashed: the paper's figure and the share of trials below it." if published else ""
            )
            title = f"Distributions over trials: {method}" + (f", {names[cell]}" if len(names) > 1 else "")
            blocks.append(picture(title, figures.distributions(rows), text))
    return blocks


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
            title = f"{method}, {_cell_names(results).get(cell, '')}"
            text = "Where estimates and stated uncertainties are right, the bars follow the standard normal curve."
            blocks.append(picture(f"z-scores: {title}", figures.z_scores(rows), text))
            text = "Red where the share of intervals that hold the truth is outside the allowed band."
            blocks.append(picture(f"Coverage: {title}", figures.coverage(rows), text))
    return blocks


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
    names = _cell_names(results)
    rows = [
        [
            names.get(e.cell, str(e.cell)), e.method, str(e.trials), str(e.failed), str(e.by_full_solver),
            str(e.checked),
            "–" if e.largest_difference_sigma is None else f"{e.largest_difference_sigma:.1e}",
        ]
        for e in ends
    ]  # fmt: skip
    header = ["setting", "method", "trials", "failed", "by full solver", "verified", "largest difference [σ]"]
    note = "Verified: trials that the full solver repeated; the difference is that of the estimates."
    failed = frozenset(i for i, e in enumerate(ends) if e.failed)
    return Table("How the trials ended", header, rows, text_columns=2, note=note, marked=failed)


def _statistics(results: Results, spreads: Mapping[str, list[Spread]]) -> Table:
    """All statistics."""
    names = _cell_names(results)
    rows = [
        [
            names.get(s.cell, str(s.cell)), s.method, column, style.number(s.mean),
            f"{style.number(s.low)} to {style.number(s.high)}", *(style.number(s.quantiles[k]) for k in (1, 3, 5)),
        ]
        for column, entries in spreads.items()
        if column != "full_difference_sigma"
        for s in entries
    ]  # fmt: skip
    header = ["setting", "method", "statistic", "mean", "95 % interval", "5 %", "median", "95 %"]
    return Table(f"Statistics ({count(len(rows), 'row')})", header, rows, text_columns=3)


def _score_table(results: Results, scores: Sequence[Scores]) -> list[Block]:
    """z-scores in figures."""
    if not scores:
        return []
    names = _cell_names(results)
    rows = [
        [
            names.get(s.cell, str(s.cell)), s.method, s.parameter, str(s.trials), style.fixed(s.mean, 3),
            style.fixed(s.deviation, 3), f"{100 * s.coverage_95:.1f} %",
        ]
        for s in scores
    ]  # fmt: skip
    header = ["setting", "method", "parameter", "trials", "mean z", "sd of z", "coverage of 95 %"]
    return [Table("z-scores of the parameters", header, rows, text_columns=3)]

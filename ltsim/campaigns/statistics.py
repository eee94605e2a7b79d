"""What the rows of a campaign say: queries that stream over the shards, a column at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ltsim.arrays import Floats
from ltsim.campaigns.columns import TYPES
from ltsim.campaigns.design import Factor, factors_of_settings
from ltsim.campaigns.engine import FAILED
from ltsim.campaigns.rows import CHECKED
from ltsim.campaigns.schema import LEVELS, ManifestFile, summary_table
from ltsim.campaigns.store import Store
from ltsim.errors import ModelError, SetupError, unknown_name
from ltsim.recording.result_table import ResultTable
from ltsim.results import Columns, Result, by_row
from ltsim.units import unit_of_key

NORMAL_95 = 1.959963984540054
MEMORY = "1GB"
MOST_EXACT = 50_000_000
"""Rows whose quantiles are exact: these take all values of a column at once."""
IMPROVEMENTS = ("distance", "coordinate")


@dataclass(frozen=True)
class Spread:
    """A column over the trials of one cell and method.

    `low` and `high` bound the mean with 95 % confidence; `quantiles` belong to `LEVELS`.
    """

    cell: int
    method: str
    column: str
    trials: int
    mean: float
    deviation: float
    low: float
    high: float
    least: float
    largest: float
    quantiles: tuple[float, ...]


@dataclass(frozen=True)
class Scores:
    """The z-scores of one parameter: N(0, 1) where the truth is drawn from the prior and the covariance is right."""

    cell: int
    method: str
    parameter: str
    trials: int
    mean: float
    deviation: float
    coverage_95: float


@dataclass(frozen=True)
class Checked:
    """How the trials of a cell and method ended, and how far the batch is from the full solver."""

    cell: int
    method: str
    trials: int
    failed: int
    by_full_solver: int
    checked: int
    largest_difference_sigma: float | None


class Results(Result):
    """The rows of a campaign's folder, as tables to query.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    SetupError
        When there is no campaign, none of its shards is finished yet, or one is damaged.

    Attributes
    ----------
    manifest : ManifestFile
    factors : tuple of Factor
        What differs between cells: the columns of settings.
    levels : list of dict
        Their values in each cell, by name.
    columns : tuple of str
        The columns that hold results.
    units : dict
        Units of columns that have one, by name.

    Notes
    -----
    Table `rows` holds one row a trial and method with the settings of its cell, and two columns added:
    ``distance_improvement_percent`` and ``coordinate_improvement_percent``. Table `cells` says what each cell is.
    """

    def __init__(self, folder: Path) -> None:
        store = Store(folder)
        self.manifest = store.manifest()
        self.factors, self.levels = _factors(self.manifest)
        shards = store.shards()
        if not shards:
            raise SetupError(f"{folder}: no shard of this campaign is finished yet")
        # One thread: sums keep their order, and tables their last digit.
        self._base = duckdb.connect(config={"memory_limit": MEMORY, "threads": 1})
        source = f"read_parquet([{', '.join(map(_literal, shards))}], union_by_name = true)"
        try:
            store.verify(self.manifest.fingerprint)
            self._base.register("cells", self._cells())
            names = [row[0] for row in self._base.execute(f"DESCRIBE SELECT * FROM {source}").fetchall()]
            if not {factor.name for factor in self.factors} <= set(names):  # rows of an earlier version
                source += " JOIN (SELECT * EXCLUDE label FROM cells) USING (cell)"
            self._base.execute(f"CREATE VIEW rows AS SELECT *{_improvements(names)} FROM {source}")
            self.columns: tuple[str, ...] = tuple(
                row[0] for row in self._base.execute("DESCRIBE rows").fetchall() if row[1] == "FLOAT"
            )
            self.units = {f.name: f.unit for f in self.factors if f.unit} | _units(pq.read_schema(shards[0]))
        except (duckdb.Error, pa.ArrowException, OSError, ValueError) as problem:
            raise _damaged(folder, problem) from None
        self._folder = folder

    def _cells(self) -> pa.Table:
        """What each cell is, as columns: number, line of words, settings."""
        listed = self.manifest.cells
        plain = {"cell": pa.array([c.cell for c in listed], pa.int32()), "label": pa.array([c.label for c in listed])}
        own = {
            f.name: pa.array([level[f.name] for level in self.levels], TYPES.get(f.kind, pa.string()))
            for f in self.factors
        }
        return pa.table(plain | own)

    def _lines(self) -> list[str]:
        manifest = self.manifest
        title = f"{manifest.title}: " if manifest.title else ""
        cells, methods = manifest.cells, manifest.methods
        return [
            f"Campaign: {title}{manifest.trials} trials of {len(cells)} cells by {', '.join(methods)}",
            f"{self.query('SELECT count(*) FROM rows')[0][0]} rows in {self._folder}",
        ]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        summary = self.summary
        return {
            "summary": lambda: _tidy(summary())[1],
            "cells": self._cells().to_pydict,
            "ends": lambda: self._with_settings(summary()["ends"]),
            "z_scores": lambda: self._with_settings(summary()["z_scores"]),
            "rows": self._rows,
        }

    def _rows(self) -> Columns:
        rows = self._base.execute("SELECT * FROM rows ORDER BY cell, method, trial")
        names = [column[0] for column in rows.description]
        return dict(zip(names, zip(*rows.fetchall(), strict=True), strict=True))

    def _with_settings(self, entries: list[dict[str, Any]]) -> Columns:
        """Entries of cells as columns, the settings behind the cell's number."""
        return by_row([{"cell": entry["cell"]} | self.levels[entry["cell"]] | entry for entry in entries])

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        """Rows of any query over `rows` and `cells`.

        Raises
        ------
        ModelError
            When the query is no SQL of these tables.
        SetupError
            When a shard is damaged.
        """
        try:
            return self._base.execute(sql).fetchall()
        except (duckdb.IOException, duckdb.InvalidInputException) as problem:
            raise _damaged(self._folder, problem) from None
        except duckdb.Error as problem:
            raise ModelError(f"the query fails: {' '.join(str(problem).split())}") from None

    def _known(self, column: str) -> str:
        if column not in self.columns:
            raise unknown_name("column of these rows", column, self.columns)
        return f'"{column}"'

    def _quantiles(self, value: str) -> str:
        """SQL of the quantiles; those of very many rows would not fit into memory and come from a t-digest."""
        size = self.manifest.trials * len(self.manifest.cells) * len(self.manifest.methods)
        kind = "quantile_cont" if size <= MOST_EXACT else "approx_quantile"
        return f"{kind}({value}, [{', '.join(str(level) for level in LEVELS)}])"

    def spread(self, column: str) -> list[Spread]:
        """Mean, spread and quantiles of a column in every cell and for every method."""
        name = self._known(column)
        found = self.query(
            f"SELECT cell, method, count({name}), avg({name}), stddev_samp({name}), min({name}), max({name}), "
            f"{self._quantiles(name)} FROM rows WHERE {name} IS NOT NULL GROUP BY cell, method "
            "ORDER BY cell, method"
        )
        return [_spread(column, row) for row in found]

    def values(self, column: str, cell: int, method: str, *, most: int) -> Floats:
        """Finite values (n,) of a column in a cell for a method, of the first `most` trials."""
        name, word = self._known(column), method.replace("'", "''")
        rows = self.query(
            f"SELECT {name} FROM rows WHERE cell = {int(cell)} AND method = '{word}' AND isfinite({name}) "
            f"AND trial < {int(most)} ORDER BY trial"
        )
        return np.array(rows, dtype=np.float64).reshape(-1)

    def z_scores(self) -> list[Scores]:
        """Mean, spread and coverage of the z-scores of every parameter."""
        found = []
        for column in (c for c in self.columns if c.startswith("z:")):
            name = self._known(column)
            rows = self.query(
                f"SELECT cell, method, count({name}), avg({name}), stddev_samp({name}), "
                f"avg((abs({name}) <= {NORMAL_95})::INT) FROM rows WHERE isfinite({name}) "
                "GROUP BY cell, method ORDER BY cell, method"
            )
            found += [
                Scores(cell, method, column.removeprefix("z:"), count, mean, _number(deviation), coverage)
                for cell, method, count, mean, deviation, coverage in rows
            ]
        return sorted(found, key=lambda s: (s.cell, s.method))

    def checked(self) -> list[Checked]:
        """Ends of the trials, and the largest difference from the full solver on the sample that was verified."""
        rows = self.query(
            f"SELECT cell, method, count(*), count(*) FILTER (status = '{FAILED}'), "
            f"count(*) FILTER (status = 'full solver'), count({CHECKED}), max({CHECKED}) "
            "FROM rows GROUP BY cell, method ORDER BY cell, method"
        )
        return [Checked(*row) for row in rows]

    def paired(self, column: str, first: str, second: str) -> list[Spread]:
        """`first` less `second` method on the same draws, trial by trial."""
        name = self._known(column)
        words = [method.replace("'", "''") for method in (first, second)]
        found = self.query(
            f"WITH gap AS (SELECT a.cell AS cell, a.{name} - b.{name} AS d FROM rows a JOIN rows b "
            f"ON a.cell = b.cell AND a.trial = b.trial AND a.method = '{words[0]}' AND b.method = '{words[1]}') "
            "SELECT cell, '', count(d), avg(d), stddev_samp(d), min(d), max(d), "
            f"{self._quantiles('d')} FROM gap WHERE d IS NOT NULL GROUP BY cell ORDER BY cell"
        )
        return [_spread(f"{column}: {first} less {second}", row) for row in found]

    def summary(self) -> dict[str, Any]:
        """Everything a report needs, as plain data."""
        wanted = [c for c in self.columns if not c.startswith(("z:", "estimate:", "true:")) and c != CHECKED]
        return {
            "format": "ltsim-campaign-summary/1",
            "title": self.manifest.title,
            "trials": self.manifest.trials,
            "factors": [asdict(factor) for factor in self.factors],
            "cells": [
                cell.model_dump() | {"levels": own} for cell, own in zip(self.manifest.cells, self.levels, strict=True)
            ],
            "ends": [asdict(entry) for entry in self.checked()],
            "levels": LEVELS,
            "columns": [
                asdict(entry) | {"unit": self.units.get(column, "")}
                for column in wanted
                for entry in self.spread(column)
            ],
            "z_scores": [asdict(entry) for entry in self.z_scores()],
        }


def summary_csv(summary: Mapping[str, Any]) -> str:
    """The content of `summary.csv`: one line a cell, method and column."""
    table, columns = _tidy(summary)
    return table.text(zip(*columns.values(), strict=True))


def _tidy(summary: Mapping[str, Any]) -> tuple[ResultTable, Columns]:
    """The statistics with the settings of their cells, column by column, and how they are written."""
    table = summary_table({factor["name"]: factor["kind"] for factor in summary["factors"]})
    levels = {cell["cell"]: cell["levels"] for cell in summary["cells"]}
    rows = [entry | levels[entry["cell"]] for entry in summary["columns"]]
    fixed = {name: [row[name] for row in rows] for name in table.header[: -len(LEVELS)]}
    quantiles = {name: [row["quantiles"][k] for row in rows] for k, name in enumerate(table.header[-len(LEVELS) :])}
    return table, fixed | quantiles


def _factors(manifest: ManifestFile) -> tuple[tuple[Factor, ...], list[dict[str, Any]]]:
    """What differs between cells, and its values in each; of an earlier version's folder by its settings."""
    if manifest.factors:
        return tuple(Factor(f.name, f.keys, f.unit, f.kind) for f in manifest.factors), [
            cell.levels for cell in manifest.cells
        ]
    found = factors_of_settings([cell.settings for cell in manifest.cells])
    return found, [{f.name: cell.settings.get(f.keys[0]) for f in found} for cell in manifest.cells]


def _units(schema: pa.Schema) -> dict[str, str]:
    """Units in the metadata of a shard's columns; the added improvements are in percent."""
    said = {f.name: (f.metadata or {}).get(b"unit", b"").decode() or unit_of_key(f.name) for f in schema}
    added = {f"{kind}_improvement_percent": "%" for kind in IMPROVEMENTS}
    return {name: unit for name, unit in (said | added).items() if unit}


def _literal(path: Path) -> str:
    """A path as SQL takes it, its brackets and stars no pattern."""
    plain = "".join(f"[{c}]" if c in "[*?" else c for c in str(path))
    return "'" + plain.replace("'", "''") + "'"


def _improvements(names: list[str]) -> str:
    """SQL of the added columns, for the criteria that the rows hold."""
    added = [
        f', (100 * (1 - "{kind}_after_mean_um" / "{kind}_before_mean_um"))::FLOAT AS {kind}_improvement_percent'
        for kind in IMPROVEMENTS
        if {f"{kind}_after_mean_um", f"{kind}_before_mean_um"} <= set(names)
    ]
    return "".join(added)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _spread(column: str, row: tuple[Any, ...]) -> Spread:
    cell, method, count, mean, deviation, least, largest, quantiles = row
    spread = _number(deviation)
    within = NORMAL_95 * spread / math.sqrt(count)
    return Spread(
        cell, method, column, count, mean, spread, mean - within, mean + within, least, largest, tuple(quantiles)
    )


def _damaged(folder: Path, problem: Exception) -> SetupError:
    reason = str(problem).split("\n")[0]
    return SetupError(f"{folder}: a shard cannot be read ({reason}); run the campaign with --resume to repair it")

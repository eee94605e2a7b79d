"""Statistics of the rows of a campaign, computed by SQL queries that read the files of rows column by column."""

from __future__ import annotations

import math
import shutil
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ltsim.campaigns.columns import columns_from_rows
from ltsim.campaigns.row_queries import (
    MAX_COPIED_VALUES,
    column_units,
    damaged_folder_error,
    database_memory_limit,
    improvement_sql,
    interruptible_query,
    nan_if_none,
    rows_sql,
)
from ltsim.campaigns.schema import (
    FULL_SOLVER,
    QUANTILE_LEVELS,
    RATIO_STATISTICS,
    SOLVER_DIFFERENCE_COLUMN,
    WITHOUT_RESULT,
    ManifestFile,
    error_columns_of_ratio,
    find_result_column,
    sql_identifier,
    statistic_sql_expressions,
    summary_table,
)
from ltsim.campaigns.stopping import interval_error_rate, student_t_quantile
from ltsim.campaigns.store import CampaignFolder
from ltsim.campaigns.summary import CampaignSummary, SolverComparison, StatisticSummary, ZScoreSummary, unchecked_entry
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, ModelError, unknown_name_error
from ltsim.core.results import ColumnValues, Table
from ltsim.recordings.result_file import Entry

NORMAL_QUANTILE_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""
DATABASE_SETTINGS: dict[str, Any] = {
    "threads": 1,  # sums are computed in the same order in each run, so that no digit of a table changes
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
}
"""Settings of the database DuckDB; no query or file can make it download or load an extension."""
MAX_ROWS_FOR_EXACT_QUANTILES = 50_000_000
"""Largest number of rows with exact quantiles. They need all values of a column in memory; for more rows they are
approximated (t-digest)."""

MAX_Z_SCORE_BLOCK_CELLS = 256
"""Largest number of cells (combinations of factor levels) whose z-scores are summarised together; a summary of one
parameter takes 0.7 kB."""


class CampaignStatistics:
    """Rows in a campaign's folder, as tables for SQL queries.

    Parameters
    ----------
    folder : Path
    max_shards : int, optional
        Largest number of shards that are read in each cell (combination of factor levels); default all.

    Raises
    ------
    InputError
        If there is no campaign, no file of rows is complete, or a file of rows is damaged.

    Attributes
    ----------
    folder : Path
    manifest : ManifestFile
    factors : tuple of Factor
        Factors whose levels differ between cells; each has a column in the rows.
    levels : list of dict
        Levels of the factors in each cell, by name.
    columns : tuple of str
        Names of the columns of results, and of ratios over all trials such as `share_removed`.
    units : dict
        Units by column name, for columns with a unit.

    Notes
    -----
    The table `rows` has one row per trial and method, with the factor levels of the cell and two additional columns:
    ``distance_improvement_percent`` and ``coordinate_improvement_percent``. The table `cells` has the factor levels.
    """

    def __init__(self, folder: Path, max_shards: int | None = None) -> None:
        store = CampaignFolder(folder)
        self.manifest = store.manifest()
        self.factors = self.manifest.factors
        self.levels = [cell.levels for cell in self.manifest.cells]
        shards = store.shard_paths(max_shards)
        if not shards:
            raise InputError(f"{folder}: no file of rows of this campaign is complete yet")
        self._database = duckdb.connect(config={**DATABASE_SETTINGS, "memory_limit": database_memory_limit(shards)})
        self._set_temporary_folder()
        try:
            store.verify_shards(shards, {cell.cell: cell.digest for cell in self.manifest.cells})
            with interruptible_query():
                source, n_values = rows_sql(shards)
                names = [row[0] for row in self._database.execute(f"DESCRIBE {source}").fetchall()]
                self._has_copied_rows = n_values <= MAX_COPIED_VALUES
                kind = "TABLE" if self._has_copied_rows else "VIEW"
                self._database.execute(f"CREATE {kind} rows AS SELECT *{improvement_sql(names)} FROM ({source})")
                self._check_cells()
                self._create_cells_table()
                held = [row[0] for row in self._database.execute("DESCRIBE rows").fetchall() if row[1] == "FLOAT"]
            self.columns: tuple[str, ...] = (
                *held,
                *(name for name in RATIO_STATISTICS if set(error_columns_of_ratio(name)) <= {*held}),
            )
            self.units = {f.name: f.unit for f in self.factors if f.unit} | column_units(pq.read_schema(shards[0]))
        except (duckdb.Error, pa.ArrowException, OSError, ValueError) as problem:
            raise damaged_folder_error(folder, problem) from None
        self.folder = folder
        self._cache: dict[str, list[tuple[Any, ...]]] = {}

    def _set_temporary_folder(self) -> None:
        """Setting of a temporary folder for query data that exceeds the memory limit of the database.

        It is removed with this object. DuckDB's default would be `.tmp` in the working folder, even if that is a link.
        """
        temporary_folder = mkdtemp(prefix="ltsim-")
        weakref.finalize(self, shutil.rmtree, temporary_folder, ignore_errors=True)
        self._database.execute("SET temp_directory = ?", [temporary_folder])

    def _cell_columns(self) -> dict[str, list[Any]]:
        """Columns of the table `cells`: index, label and factor levels of each cell."""
        cells = self.manifest.cells
        plain: dict[str, list[Any]] = {"cell": [c.cell for c in cells], "label": [c.label for c in cells]}
        return plain | {f.name: [level[f.name] for level in self.levels] for f in self.factors}

    def _check_cells(self) -> None:
        """Check that the manifest contains the factor levels (cells) and methods of all rows; raises ValueError."""
        for cell, method in self._database.execute("SELECT DISTINCT cell, method FROM rows").fetchall():
            if cell not in range(len(self.levels)) or method not in self.manifest.methods:
                raise ValueError(
                    f"the folder has rows of cell {cell} and method {method}, which are not in {ManifestFile.FILE}"
                )

    def _create_cells_table(self) -> None:
        """Creation of the table `cells` (combinations of factor levels), with column types as in the table `rows`.

        The table is created by plain SQL, because a transfer from Arrow would import pandas.
        """
        cells = self._cell_columns()
        columns = "".join(f", {sql_identifier(factor.name)}" for factor in self.factors)
        self._database.execute(f"CREATE TABLE cells AS SELECT cell, method AS label{columns} FROM rows LIMIT 0")
        places = ", ".join("?" * len(cells))
        self._database.executemany(f"INSERT INTO cells VALUES ({places})", [*zip(*cells.values(), strict=True)])

    def _summary_lines(self) -> list[str]:
        manifest = self.manifest
        title = f"{manifest.title}: " if manifest.title else ""
        cells, methods = manifest.cells, manifest.methods
        return [
            f"Campaign: {title}{manifest.trials} trials of {len(cells)} cells, methods {', '.join(methods)}",
            f"{self.query('SELECT count(*) FROM rows')[0][0]} rows in {self.folder}",
        ]

    def _table_makers(self) -> Mapping[str, Callable[[], Table | ColumnValues]]:
        return {
            "summary": self._summary,
            "cells": self._cell_columns,
            "solver_comparisons": lambda: columns_from_rows(self.with_factor_levels(self.solver_comparisons())),
            "z_scores": lambda: columns_from_rows(self.with_factor_levels(self.z_score_summaries())),
            "rows": self._row_columns,
        }

    def _summary(self) -> Table:
        """Table `summary.csv`: all statistics for each cell (combination of factor levels) and method."""
        return self.summary_rows((entry for _, entries in self.summaries_by_column() for entry in entries))

    def summary_rows(self, entries: Iterable[StatisticSummary]) -> Table:
        """Table with the columns of `summary.csv`, one row for each of the `entries`."""
        table = summary_table({factor.name: factor.kind for factor in self.factors})
        names, rows = table.header[-len(QUANTILE_LEVELS) :], self.with_factor_levels(entries)
        return table.with_rows(row | dict(zip(names, row["quantiles"], strict=True)) for row in rows)

    def summaries_by_column(self) -> Iterator[tuple[str, list[StatisticSummary]]]:
        """Name and statistics of each column of the summary, computed one after the other."""
        return ((column, self.statistic_summaries(column)) for column in self._summarised_columns())

    def _summarised_columns(self) -> list[str]:
        """Names of the columns and ratios in the summary: all except those that exist once per parameter."""
        is_of_parameter = ("z:", "estimate:", "true:")
        return [c for c in self.columns if not c.startswith(is_of_parameter) and c != SOLVER_DIFFERENCE_COLUMN]

    def _row_columns(self) -> ColumnValues:
        """All rows as columns, ordered by cell (combination of factor levels), method and trial."""
        with interruptible_query():
            rows = self._database.execute("SELECT * FROM rows ORDER BY cell, method, trial")
            names = [column[0] for column in rows.description]
            return dict(zip(names, zip(*rows.fetchall(), strict=True), strict=True))

    def with_factor_levels(self, entries: Iterable[Entry]) -> Iterator[dict[str, Any]]:
        """Entries as mappings, each with its factor levels added."""
        for entry in entries:
            row = entry.model_dump(mode="json")
            yield {"cell": row["cell"]} | self.levels[row["cell"]] | row

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        """Rows that an SQL query over the tables `rows` and `cells` returns.

        Raises
        ------
        ModelError
            If the query is not valid SQL for these tables.
        InputError
            If a file of rows is damaged.
        """
        try:
            with interruptible_query():
                return self._database.execute(sql).fetchall()
        except (duckdb.IOException, duckdb.InvalidInputException) as problem:
            raise damaged_folder_error(self.folder, problem) from None
        except duckdb.Error as problem:
            raise ModelError(f"the query failed: {' '.join(str(problem).split())}") from None

    def _sql_column(self, column: str) -> str:
        """Quoted name of a column of the rows; raises ModelError for an unknown name."""
        if column not in self.columns:
            raise unknown_name_error("column of these rows", column, self.columns)
        return sql_identifier(column)

    def half_width_of_interval(self, n_trials: int, sigma: float) -> float:
        """Half-width of the 95 % confidence interval of the mean of `n_trials` values with standard deviation `sigma`.

        The interval is wider if the campaign has a stopping rule, because it is then evaluated several times.
        """
        stops = bool(self.manifest.settings.get("stop"))
        level = interval_error_rate(self.manifest.trials, self.manifest.trials_per_shard or 1, is_stopping=stops)
        return student_t_quantile(n_trials, level) * sigma / math.sqrt(n_trials)

    def statistic_summaries(self, column: str) -> list[StatisticSummary]:
        """Mean with confidence interval, standard deviation and quantiles of a column.

        There is one summary for each cell (combination of factor levels) and method.
        """
        name = self._sql_column(column)
        if column in RATIO_STATISTICS:
            return self._ratios_of_means(column)
        n_values = self.manifest.trials * len(self.manifest.cells) * len(self.manifest.methods)
        kind = "quantile_cont" if n_values <= MAX_ROWS_FOR_EXACT_QUANTILES else "approx_quantile"
        select_list = (
            f"count({name}), avg({name}), stddev_samp({name}), min({name}), max({name}), {kind}({name}, "
            f"{[*QUANTILE_LEVELS]})"
        )
        summaries = []
        for cell, method, count, mean, deviation, low, high, quantiles in self._query_each_cell(
            select_list, f"isfinite({name})"
        ):
            half = self.half_width_of_interval(count, nan_if_none(deviation))
            summaries.append(
                unchecked_entry(
                    StatisticSummary,
                    cell=cell,
                    method=method,
                    column=column,
                    trials=count,
                    mean=mean,
                    low=mean - half,
                    high=mean + half,
                    standard_deviation=nan_if_none(deviation),
                    minimum=low,
                    maximum=high,
                    quantiles=tuple(quantiles),
                    unit=self.units.get(column, ""),
                )
            )
        return summaries

    def _query_each_cell(
        self, expressions: str, condition: str = "true", row_selection: str = "rows"
    ) -> list[tuple[Any, ...]]:
        """Result of an SQL query of the `expressions`, one row per combination of factor levels and method."""
        sql = f"SELECT cell, method, {expressions} FROM {row_selection} WHERE {condition} "
        sql += "GROUP BY cell, method ORDER BY cell, method"
        if self._has_copied_rows:
            return self.query(sql)
        if sql not in self._cache:  # a report needs the same query for its figures and its tables
            self._cache[sql] = self.query(sql)
        return self._cache[sql]

    def _ratios_of_means(self, column: str) -> list[StatisticSummary]:
        """Ratio of two means over all trials, with its confidence interval by the delta method.

        There is one ratio for each cell (combination of factor levels) and method.
        """
        gained, correctable = statistic_sql_expressions(column)
        row_selection = f"(SELECT cell, method, {gained} AS a, {correctable} AS b FROM rows)"
        select_list = "count(a), avg(a), avg(b), var_samp(a), covar_samp(a, b), var_samp(b)"
        shares = []
        for cell, method, count, above, below, *moments in self._query_each_cell(
            select_list, "a IS NOT NULL AND b IS NOT NULL", row_selection
        ):
            value = half = math.nan
            if below > 0:
                value, (aa, ab, bb) = above / below, map(nan_if_none, moments)
                half = self.half_width_of_interval(
                    count, math.sqrt(max(aa - 2 * value * ab + value**2 * bb, 0.0)) / below
                )
            place = {"cell": cell, "method": method, "column": column, "trials": count}
            limits = {"low": value - half, "high": value + half}
            shares.append(unchecked_entry(StatisticSummary, **place, mean=value, **limits))
        return shares

    def column_values(self, column: str, cell: int, method: str, *, max_trials: int) -> Floats:
        """Finite values (trials,) of a column for one cell and method, in the first `max_trials` trials.

        `cell` is the index of the combination of factor levels.
        """
        name = self._sql_column(column)
        return self.sql_expression_values((name,), cell, method, f"isfinite({name}) AND trial < {int(max_trials)}")[0]

    def sql_expression_values(self, sql_expressions: Sequence[str], cell: int, method: str, condition: str) -> Floats:
        """Values (expressions, trials) of SQL expressions in the rows of a cell and method that satisfy `condition`.

        `cell` is the index of the combination of factor levels.
        """
        word = method.replace("'", "''")
        query_rows = self.query(
            f"SELECT {', '.join(sql_expressions)} FROM rows WHERE cell = {int(cell)} AND method = '{word}' "
            f"AND {condition} ORDER BY trial"
        )
        return np.array(query_rows, dtype=np.float64).reshape(len(query_rows), len(sql_expressions)).T

    def z_score_summaries(self) -> list[ZScoreSummary]:
        """Mean, standard deviation and coverage of the z-scores of each parameter.

        There is one summary for each cell (combination of factor levels) and method.
        """
        return [*self.iterate_z_score_summaries()]

    def iterate_z_score_summaries(self) -> Iterator[ZScoreSummary]:
        """Summaries of the z-scores in the order of `z_score_summaries`, computed cell by cell in blocks.

        A cell is a combination of factor levels. Rows that are read from their files for each query are queried once.
        """
        n_cells = len(self.levels)
        step = MAX_Z_SCORE_BLOCK_CELLS if self._has_copied_rows else n_cells
        for first in range(0, n_cells, step):
            is_in_block = f" AND cell BETWEEN {first} AND {first + step - 1}" if step < n_cells else ""
            yield from sorted(self._z_scores_of_columns(is_in_block), key=lambda s: (s.cell, s.method))

    def _z_scores_of_columns(self, further_condition: str) -> Iterator[ZScoreSummary]:
        """Summaries of the z-scores, column by column, of the rows that satisfy an SQL condition (` AND ...`)."""
        for column in (c for c in self.columns if c.startswith("z:")):
            name, parameter = self._sql_column(column), column.removeprefix("z:")
            what = f"count({name}), avg({name}), stddev_samp({name}), avg((abs({name}) <= {NORMAL_QUANTILE_95})::INT)"
            for cell, method, count, mean, deviation, coverage in self._query_each_cell(
                what, f"isfinite({name}){further_condition}"
            ):
                values = {"mean": mean, "standard_deviation": nan_if_none(deviation), "coverage_95": coverage}
                place = {"cell": cell, "method": method, "parameter": parameter}
                yield unchecked_entry(ZScoreSummary, **place, trials=count, **values)

    def solver_comparisons(self) -> list[SolverComparison]:
        """Numbers of trials by solver, and largest difference between the solvers.

        There is one comparison for each cell (combination of factor levels) and method.
        """
        ended = f"count(*) FILTER (status = '{WITHOUT_RESULT}'), count(*) FILTER (status = '{FULL_SOLVER}')"
        query_rows = self._query_each_cell(
            f"count(*), {ended}, count({SOLVER_DIFFERENCE_COLUMN}), max({SOLVER_DIFFERENCE_COLUMN})"
        )
        return [SolverComparison(**dict(zip(SolverComparison.model_fields, row, strict=True))) for row in query_rows]

    def summary(self) -> CampaignSummary:
        """Statistics of all columns, for each cell (combination of factor levels) and method."""
        columns = tuple(entry for _, entries in self.summaries_by_column() for entry in entries)
        entries = {"columns": columns, "z_scores": tuple(self.z_score_summaries())}
        return self.summary_without_entries().model_copy(update=entries)

    def summary_without_entries(self) -> CampaignSummary:
        """Summary of the campaign whose lists `columns` and `z_scores` are empty."""
        cells = zip(self.manifest.cells, self.levels, strict=True)
        return CampaignSummary(
            title=self.manifest.title,
            trials=self.manifest.trials,
            factors=tuple(self.factors),
            cells=tuple(cell.model_copy(update={"levels": levels}) for cell, levels in cells),
            solver_comparisons=tuple(self.solver_comparisons()),
            meanings={c: d.meaning for c in self._summarised_columns() if (d := find_result_column(c))},
            columns=(),
            z_scores=(),
        )

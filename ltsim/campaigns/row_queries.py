"""SQL queries of the rows of a campaign from its files of rows: their text, memory, interruption and errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ltsim.campaigns.store import path_as_sql_text
from ltsim.core.errors import InputError, option_text
from ltsim.core.limits import BYTES_PER_MIB, MAX_DATABASE_MEMORY_BYTES, MAX_FILE_BYTES
from ltsim.recordings.files import safe_excerpt

MAX_COPIED_VALUES = 4_000_000
"""Largest number of values (rows times columns) of a campaign that the database copies into its memory, up to 8 bytes
each. The rows of larger campaigns are read from their files for each query; opening 3,660 files takes a second."""
CRITERIA_WITH_REPORTED_IMPROVEMENT = ("distance", "coordinate")
"""Measures of the disagreement between stations (in distances between targets, in coordinates of targets) whose
reduction by the calibration [%] is reported."""


def rows_sql(shards: Sequence[Path]) -> tuple[str, int]:
    """SQL query of the rows of all files `shards`, and number of their values (rows times columns).

    A column that a file does not have is empty in its rows. Files with equal columns are read by one function, which
    opens them one after the other. A function that unites files by the names of their columns would keep a description
    of each file in memory, 100 kB for 40 columns.
    """
    shards_by_columns: dict[tuple[tuple[str, str], ...], list[Path]] = {}
    n_values = 0
    for shard in shards:
        with pq.ParquetFile(shard) as file:  # `metadata.schema` would remain until a collection of cyclic garbage
            columns = tuple((field.name, str(field.type)) for field in file.schema_arrow)
            n_values += file.metadata.num_rows * len(columns)
        shards_by_columns.setdefault(columns, []).append(shard)
    selections = (
        f"SELECT * FROM read_parquet([{', '.join(map(path_as_sql_text, group))}], hive_partitioning = false)"
        for group in shards_by_columns.values()
    )
    return " UNION ALL BY NAME ".join(selections), n_values


def column_units(schema: pa.Schema) -> dict[str, str]:
    """Units by column name, from the metadata of a file of rows, and of the columns `..._improvement_percent`."""
    units = {f.name: (f.metadata or {}).get(b"unit", b"").decode() for f in schema}
    added = {f"{kind}_improvement_percent": "%" for kind in CRITERIA_WITH_REPORTED_IMPROVEMENT}
    return {name: unit for name, unit in (units | added).items() if unit}


def improvement_sql(names: list[str]) -> str:
    """SQL expressions of the reduction of station disagreement by calibration [%], for the columns `names`."""
    added = [
        f', (100 * (1 - "{kind}_after_mean_um" / "{kind}_before_mean_um"))::FLOAT AS {kind}_improvement_percent'
        for kind in CRITERIA_WITH_REPORTED_IMPROVEMENT
        if {f"{kind}_after_mean_um", f"{kind}_before_mean_um"} <= set(names)
    ]
    return "".join(added)


def database_memory_limit(shards: Sequence[Path]) -> str:
    """Largest memory of DuckDB for queries over the files `shards`, as text for its settings: `250MiB`."""
    n_bytes = sum(shard.stat().st_size for shard in shards)
    return f"{MAX_DATABASE_MEMORY_BYTES * max(1.0, n_bytes / MAX_FILE_BYTES) / BYTES_PER_MIB:.0f}MiB"


@contextmanager
def interruptible_query() -> Iterator[None]:
    """Context in which an interrupted query raises KeyboardInterrupt instead of DuckDB's RuntimeError."""
    try:
        yield
    except RuntimeError as problem:
        if str(problem) != "Query interrupted":
            raise
        raise KeyboardInterrupt from None


def nan_if_none(value: float | None) -> float:
    """Number, or NaN in place of None."""
    return math.nan if value is None else float(value)


def damaged_folder_error(folder: Path, problem: Exception) -> InputError:
    """InputError for a file of rows that cannot be read, with the reason and the repair."""
    reason = safe_excerpt(str(problem).split("\n")[0], 200)
    repair = f"Run the campaign again with {option_text('resume=True')} to repair the folder"
    return InputError(f"{folder}: a file of rows (shard) cannot be read: {reason}. {repair}")

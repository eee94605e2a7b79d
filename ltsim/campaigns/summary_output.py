"""Statistics of a campaign as mapping, CSV, JSON and first rows of a table, computed column by column.

The summary of 4,000 cells (combinations of factor levels) has 150,000 entries, 1.5 kB each. Here the entries of one
result column are in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

from ltsim.campaigns.statistics import CampaignStatistics
from ltsim.campaigns.summary import StatisticSummary
from ltsim.core.json_text import json_object_parts
from ltsim.core.results import Table


class SummariesByColumn(Mapping[str, list[StatisticSummary]]):
    """Statistics of each result column by its name, computed at each access; without columns of single parameters."""

    def __init__(self, results: CampaignStatistics) -> None:
        self._results = results
        self._names = dict.fromkeys(name for name in results.columns if ":" not in name)

    def __getitem__(self, name: str) -> list[StatisticSummary]:
        if name not in self._names:
            raise KeyError(name)
        return self._results.statistic_summaries(name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def summary_csv_text(results: CampaignStatistics) -> str:
    """Content of `summary.csv`."""
    header = results.summary_rows(()).csv_text()
    texts = (results.summary_rows(entries).csv_text() for _, entries in results.summaries_by_column())
    return "".join(chain([header], (text.removeprefix(header) for text in texts)))


def first_summary_rows(results: CampaignStatistics, max_rows: int) -> tuple[Table, int]:
    """Table with the first `max_rows` rows of `summary.csv`, and the number of all its rows."""
    table, n_rows = results.summary_rows(()), 0
    for _, entries in results.summaries_by_column():
        added = entries[: max(max_rows - n_rows, 0)]
        n_rows += len(entries)
        if added:
            table = replace(table, rows=table.rows + results.summary_rows(added).rows)
    return table, n_rows


def summary_json_parts(results: CampaignStatistics) -> Iterator[str]:
    """Parts of the JSON text of the summary, equal to the text of `CampaignStatistics.summary` in JSON."""
    summary = results.summary_without_entries()
    return json_object_parts(
        summary.model_dump(mode="json"),
        {
            "columns": map(_json_value, chain.from_iterable(entries for _, entries in results.summaries_by_column())),
            "z_scores": map(_json_value, results.iterate_z_score_summaries()),
        },
    )


def _json_value(entry: Any) -> Any:
    """JSON value of an entry of the summary."""
    return entry.model_dump(mode="json")

"""Comparison of the calibration methods of a campaign on the same random draws: sentence and paired differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ltsim.campaigns.schema import METHOD_DIFFERENCES_TABLE, find_result_column
from ltsim.core.notation import number_text
from ltsim.reports.document_model import TableBlock, table_blocks
from ltsim.reports.figures.campaign_factors import cell_descriptions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ltsim.campaigns.results import CampaignResults, PairedDifference
    from ltsim.campaigns.summary import StatisticSummary

COMPARED_STATISTIC_TEXTS = {
    "new_point_error_calibrated_um": "error of a new point",
    "target_error_um": "error of the targets",
    "error_calibrated_um": "error of a point",
}
"""Name for users of each error by which methods may be compared, by column. The first column that a campaign has is
used."""
MAX_COMPARED_CELLS = 48
"""Largest number of combinations of factor levels (cells) in a comparison of methods, since each takes two queries per
method."""


@dataclass(frozen=True)
class MethodComparison:
    """Comparison of calibration methods by paired differences of errors: each other method minus the best method.

    The best method has the smallest mean error.
    """

    statistic: str
    """Name of the result column with the error by which methods are compared."""
    best_method: str
    """Calibration method with the smallest mean error over all cells (combinations of factor levels)."""
    cell_texts: tuple[str, ...]
    """Description of each combination of factor levels (cell)."""
    differences_by_method: Mapping[str, Sequence[PairedDifference]]
    """Differences for each combination of factor levels, by the method that is compared with the best method."""

    @classmethod
    def from_results(
        cls, results: CampaignResults, summaries: Mapping[str, list[StatisticSummary]]
    ) -> MethodComparison | None:
        """Comparison of the methods of a campaign; None for one method, too many cells, or without an error column.

        A cell is a combination of factor levels.
        """
        statistic = next((name for name in COMPARED_STATISTIC_TEXTS if summaries.get(name)), "")
        means: dict[str, list[float]] = {}
        for summary in summaries.get(statistic, []):
            means.setdefault(summary.method, []).append(summary.mean)
        if len(means) < 2 or len(results.levels) > MAX_COMPARED_CELLS or len({len(m) for m in means.values()}) > 1:
            return None
        best_method = min(means, key=lambda method: sum(means[method]))
        differences = {
            method: results.paired_differences(statistic, method=(method, best_method)).entries
            for method in means
            if method != best_method
        }
        names = cell_descriptions(results)
        return cls(statistic, best_method, tuple(names[cell] for cell in range(len(results.levels))), differences)

    @property
    def statistic_label(self) -> str:
        """Text for the compared error, such as `error of a new point`."""
        return COMPARED_STATISTIC_TEXTS[self.statistic]

    def sentence(self) -> str:
        """Sentence on the combinations of factor levels in which the best method is significantly better or worse."""
        clauses = [_best_method_text(method, entries) for method, entries in self.differences_by_method.items()]
        return (
            f"With the same random draws, the {self.statistic_label} with {self.best_method} is {'; '.join(clauses)} "
            "(paired differences that are significant at 95 %)."
        )

    def blocks(self) -> list[TableBlock]:
        """List with the table of the differences and the definition of the compared error."""
        table_rows = [
            [cell_text, f"{method} minus {self.best_method}", entry.difference, entry.low, entry.high,
             _better_method_text(entry), entry.trials]
            for method, entries in self.differences_by_method.items()
            for cell_text, entry in zip(self.cell_texts, entries, strict=True)
        ]  # fmt: skip
        declared = find_result_column(self.statistic)
        meaning = "" if declared is None else declared.meaning.replace("`", "")
        label = f"{self.statistic_label[0].upper()}{self.statistic_label[1:]}"
        note = (
            f"{label}: {meaning}. Each difference is the mean, over trials with the same random draws, of the error "
            "with the first method minus the error with the second method."
        )
        table = METHOD_DIFFERENCES_TABLE.with_rows(table_rows)
        return table_blocks(f"Which method is better: {self.statistic_label}", table, note=note)


def _best_method_text(method: str, differences: Sequence[PairedDifference]) -> str:
    """Text on the combinations of factor levels in which the best method differs significantly from another method.

    The text contains the range of the significant differences of each sign, and the number of combinations without a
    significant difference.
    """
    smaller = [entry.difference for entry in differences if entry.low > 0]
    larger = [-entry.difference for entry in differences if entry.high < 0]
    n_open, total = len(differences) - len(smaller) - len(larger), len(differences)
    texts = []
    for comparison, sizes in (("smaller than with", smaller), ("larger than with", larger)):
        ends = list(dict.fromkeys(number_text(limit(sizes)) for limit in (min, max))) if sizes else []
        size = f"by {' to '.join(ends)} um"
        count = f"{'all' if len(sizes) == total else f'{len(sizes)} of'} {total} combinations of factor levels"
        if sizes:
            texts.append(
                f"{comparison} {method} {size}" if total == 1 else f"{comparison} {method} in {count} ({size})"
            )
    if n_open:
        texts.append(
            f"not significantly different from that with {method}" + (f" in {n_open} of {total}" if texts else "")
        )
    return ", ".join(texts)


def _better_method_text(difference: PairedDifference) -> str:
    """Text with the method of smaller error if the interval of the difference excludes 0; otherwise `not decided`."""
    better = difference.second_name if difference.low > 0 else difference.first_name if difference.high < 0 else ""
    return f"{better} is better" if better else "not decided"

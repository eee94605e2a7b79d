"""Summary of a campaign: statistics for each combination of factor levels and method, as objects and as JSON."""

import math
from functools import cache
from typing import Annotated, Any, Literal, TypeVar

from pydantic import PlainSerializer

from ltsim.campaigns.design import Factor
from ltsim.campaigns.schema import QUANTILE_LEVELS, CellEntry
from ltsim.recordings.result_file import Entry


def _null_if_not_finite(value: float) -> float | None:
    """Number, or None in place of NaN and infinity."""
    return value if math.isfinite(value) else None


NumberOrNaN = Annotated[float, PlainSerializer(_null_if_not_finite, return_type=float | None, when_used="json")]
"""Number, or NaN for a missing number; NaN becomes null in JSON."""


class CellMethodEntry(Entry):
    """Summary of the trials of one cell (combination of factor levels) and calibration method."""

    cell: int
    """Index of the cell (combination of factor levels) in the campaign, from 0."""
    method: str
    """Name of the calibration method."""


class StatisticSummary(CellMethodEntry):
    """Statistics of one column over the trials of one cell (combination of factor levels) and method.

    A ratio over all trials has only a mean and a confidence interval.
    """

    column: str
    """Name of the result column, or of a ratio over all trials."""
    trials: int
    """Number of trials of this cell (combination of factor levels) and method that have a value in this column."""
    mean: NumberOrNaN
    """Mean over the trials, or ratio over all trials."""
    low: NumberOrNaN
    """Lower 95 % confidence limit of the mean, which is valid also with adaptive stopping."""
    high: NumberOrNaN
    """Upper 95 % confidence limit of the mean, which is valid also with adaptive stopping."""
    standard_deviation: NumberOrNaN = math.nan
    """Standard deviation over the trials."""
    minimum: NumberOrNaN = math.nan
    """Smallest value over the trials."""
    maximum: NumberOrNaN = math.nan
    """Largest value over the trials."""
    quantiles: tuple[NumberOrNaN, ...] = (math.nan,) * len(QUANTILE_LEVELS)
    """Quantiles over the trials, at the probabilities `quantile_levels` of the summary."""
    unit: str = ""
    """Unit of the values."""


class ZScoreSummary(CellMethodEntry):
    """Summary of the z-scores, (estimate - true value) / sigma, of one parameter in one combination of factor levels.

    There is one summary per calibration method. The z-scores are standard normal if the true values are drawn from the
    prior of the parameter and the covariance is correct.
    """

    parameter: str
    """Name of the parameter."""
    trials: int
    """Number of trials of this cell (combination of factor levels) and method that have a z-score."""
    mean: NumberOrNaN
    """Mean of the z-scores."""
    standard_deviation: NumberOrNaN
    """Standard deviation of the z-scores."""
    coverage_95: NumberOrNaN
    """Fraction of the trials whose 95 % interval contains the true value."""


class SolverComparison(CellMethodEntry):
    """Comparison of two solvers, in the trials of one cell (combination of factor levels) and method.

    The batch solver calibrates many trials together, the full solver (`lt.calibrate`) one at a time.
    """

    trials: int
    """Number of trials of this cell (combination of factor levels) and method."""
    failed_trials: int
    """Number of trials without a result."""
    full_solver_trials: int
    """Number of trials that `lt.calibrate` calibrated one by one (full solver), because the joint calibration of many
    trials did not converge."""
    verified_trials: int
    """Number of trials that both batch solver and full solver (`lt.calibrate`) calibrated, for verification."""
    largest_difference_sigma: NumberOrNaN | None
    """Largest difference [sigma] between batch solver and full solver (`lt.calibrate`), over the trials that both
    calibrated; null without such trials."""


class CampaignSummary(Entry):
    """Statistics of a campaign, the output of `ltsim campaign --json`."""

    format: Literal["ltsim-campaign-summary/1"] = "ltsim-campaign-summary/1"
    """Format and version of this content."""
    title: str
    """Title of the campaign."""
    trials: int
    """Largest number of trials of a cell (combination of factor levels); adaptive stopping may use fewer."""
    factors: tuple[Factor, ...]
    """Factors of the campaign: keys of the scenario whose values differ between cells (combinations of factor levels).
    """
    cells: tuple[CellEntry, ...]
    """Cells (combinations of factor levels) of the campaign."""
    solver_comparisons: tuple[SolverComparison, ...]
    """Comparison of the calibration of many trials together with `lt.calibrate`, for each cell (combination of factor
    levels) and method."""
    quantile_levels: tuple[float, ...] = QUANTILE_LEVELS
    """Probabilities of the quantiles in `columns`."""
    meanings: dict[str, str]
    """Meaning of each result column, by the name of the column."""
    columns: tuple[StatisticSummary, ...]
    """Statistics of each result column, for each cell (combination of factor levels) and method."""
    z_scores: tuple[ZScoreSummary, ...]
    """Summary of the z-scores of each parameter, for each cell (combination of factor levels) and method."""


EntryType = TypeVar("EntryType", bound=Entry)
"""Type of an entry of the summary."""


def unchecked_entry(model: type[EntryType], **values: Any) -> EntryType:
    """Entry with `values` that queries returned, without validation.

    All entries of a model share the set of the names of their fields, which takes 700 bytes of the 2,300 of an entry.
    """
    return model.model_construct(_fields_set=_names_of_fields(model), **values)


@cache
def _names_of_fields(model: type[Entry]) -> set[str]:
    """Names of all fields of `model`, the same object in each call."""
    return {*model.model_fields}

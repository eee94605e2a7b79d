"""Summary of a campaign: statistics of its combinations of settings and methods, as Python objects and as JSON."""

import math
from typing import Annotated, Literal

from pydantic import PlainSerializer

from ltsim.campaigns.design import Factor
from ltsim.campaigns.schema import QUANTILE_LEVELS, CellEntry
from ltsim.recordings.result_file import Entry


def _null_if_not_finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


NumberOrNaN = Annotated[float, PlainSerializer(_null_if_not_finite, return_type=float | None, when_used="json")]
"""A number, or NaN for one that does not exist, which is null in JSON."""


class StatisticSummary(Entry):
    """Statistic over the trials of one combination of settings and method.

    A ratio over all trials has only a mean and an interval.
    """

    cell: int
    """Index of the combination of settings in the campaign, from 0."""
    method: str
    """Name of the method."""
    column: str
    """Column of the rows, or ratio over all trials."""
    trials: int
    """Number of trials with a value."""
    mean: NumberOrNaN
    """Mean over the trials."""
    low: NumberOrNaN
    """Lower 95 % confidence limit of the mean, valid also with adaptive stopping."""
    high: NumberOrNaN
    """Upper 95 % confidence limit of the mean."""
    deviation: NumberOrNaN = math.nan
    """Standard deviation over the trials."""
    least: NumberOrNaN = math.nan
    """Smallest value."""
    largest: NumberOrNaN = math.nan
    """Largest value."""
    quantiles: tuple[NumberOrNaN, ...] = (math.nan,) * len(QUANTILE_LEVELS)
    """Quantiles at the probabilities `levels` of the summary."""
    unit: str = ""
    """Unit of the values."""


class ZScoreSummary(Entry):
    """Summary of the z-scores of one parameter, (estimate - truth) / sigma.

    The z-scores are standard normal if the truth is drawn from the prior and the covariance is correct.
    """

    cell: int
    """Index of the combination of settings in the campaign, from 0."""
    method: str
    """Name of the method."""
    parameter: str
    """Name of the parameter."""
    trials: int
    """Number of trials with a z-score."""
    mean: NumberOrNaN
    """Mean of the z-scores."""
    deviation: NumberOrNaN
    """Standard deviation of the z-scores."""
    coverage_95: NumberOrNaN
    """Fraction of the trials whose 95 % interval contains the truth."""


class SolverComparison(Entry):
    """Comparison of the batch and the full solver in the trials of one combination of factors, for one method."""

    cell: int
    """Index of the combination of settings in the campaign, from 0."""
    method: str
    """Name of the method."""
    trials: int
    """Number of trials."""
    failed: int
    """Number of trials without a result."""
    by_full_solver: int
    """Number of trials that the full solver calibrated."""
    checked: int
    """Number of trials that the full solver repeated for verification."""
    largest_difference_sigma: NumberOrNaN | None
    """Largest difference [sigma] between batch and full solver in these trials; null without such trials."""


class CampaignSummary(Entry):
    """Statistics of a campaign: what `ltsim campaign --json` prints."""

    format: Literal["ltsim-campaign-summary/1"] = "ltsim-campaign-summary/1"
    """Format and version of this content."""
    title: str
    """Title of the campaign."""
    trials: int
    """Largest number of trials of each combination of settings."""
    factors: tuple[Factor, ...]
    """Settings that differ between combinations of settings."""
    cells: tuple[CellEntry, ...]
    """Cells of the campaign."""
    solver_comparisons: tuple[SolverComparison, ...]
    """Numbers of trials by solver."""
    levels: tuple[float, ...] = QUANTILE_LEVELS
    """Probabilities of the quantiles."""
    meanings: dict[str, str]
    """Meaning of each column."""
    columns: tuple[StatisticSummary, ...]
    """Statistics of each column, combination of settings and method."""
    z_scores: tuple[ZScoreSummary, ...]
    """Summaries of the z-scores of each parameter."""

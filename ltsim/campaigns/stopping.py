"""Adaptive stopping: round by round, cells (combinations of factor levels) with an imprecise mean get further trials.

A round depends only on the rows of previous rounds, and thus neither on the number of workers nor on interruptions. The
trials of a stopped cell are the first trials of a run without stopping.

A cell is evaluated after every round, and repeated evaluation favours intervals that are narrow by chance. The error
rate of 5 % is therefore divided by the number of possible evaluations of a cell (Bonferroni, with quantiles of
Student's t). All intervals of a cell together, and thus also the last one, contain the mean with a probability of 95 %.
The first evaluation needs at least `MIN_TRIALS_BEFORE_STOP` trials, so that the variance is well estimated and the mean
of skewed values is nearly normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from scipy import special

from ltsim.campaigns.schema import number_of_shards

if TYPE_CHECKING:
    from ltsim.campaigns.spec import CampaignFile

ROUND_GROWTH_FACTOR = 1.5
"""Ratio of the number of trials of a cell (combination of factor levels) after a round to the number before."""
MIN_TRIALS_BEFORE_STOP = 64
"""Smallest number of trials before the first evaluation of a cell (combination of factor levels)."""
INTERVAL_ERROR_RATE = 0.05
"""Probability that at least one of the confidence intervals of a cell (combination of factor levels) does not contain
the mean. Without adaptive stopping, a cell has one interval."""
CellAndShardIndex = tuple[int, int]
"""Index of a cell (combination of factor levels), and index of a file of rows (shard) in it, both from 0."""


def student_t_quantile(n_values: int, error_rate: float) -> float:
    """Two-sided quantile of Student's t distribution for the mean of `n_values` values.

    `error_rate` is the probability that the quantile is exceeded.
    """
    return -float(special.stdtrit(n_values - 1, 0.5 * error_rate)) if n_values > 1 else math.inf


def interval_error_rate(n_trials: int, shard_size: int, *, is_stopping: bool) -> float:
    """Error rate of each confidence interval of a cell, so that all intervals of the cell have `INTERVAL_ERROR_RATE`.

    A cell is a combination of factor levels, `n_trials` is its largest number of trials, and `shard_size` is the number
    of trials in a file of rows (shard). With `is_stopping`, the campaign has a stopping rule and therefore several
    intervals per cell.
    """
    return (
        INTERVAL_ERROR_RATE / len(stopping_evaluation_schedule(n_trials, shard_size))
        if is_stopping
        else INTERVAL_ERROR_RATE
    )


def stopping_evaluation_schedule(n_trials: int, shard_size: int) -> list[int]:
    """Numbers of finished files of rows after which a cell (combination of factor levels) is evaluated.

    The cell has `n_trials` trials, each file has `shard_size` trials.
    """
    n_shards = number_of_shards(n_trials, shard_size)
    schedule = [min(number_of_shards(MIN_TRIALS_BEFORE_STOP, shard_size), n_shards)]
    while schedule[-1] < n_shards:
        schedule.append(min(math.ceil(ROUND_GROWTH_FACTOR * schedule[-1]), n_shards))
    return schedule


def iterate_stopping_rounds(
    campaign: CampaignFile, n_cells: int, interval_half_widths: Callable[[str, int], Mapping[tuple[int, str], float]]
) -> Iterator[list[CellAndShardIndex]]:
    """Lists of the files of rows (shards) that each round computes, round by round.

    A round begins when all shards of the previous round are finished. `interval_half_widths` is a function of a
    statistic and the number of finished shards per cell (combination of factor levels). It returns the half-width of
    the confidence interval of the mean, by cell and method.
    """
    if (stop := campaign.stop) is None:
        yield [(cell, shard) for cell in range(n_cells) for shard in range(campaign.n_shards_per_cell)]
        return
    open_, done = list(range(n_cells)), 0
    for goal in stopping_evaluation_schedule(campaign.trials, campaign.trials_per_shard):
        yield [(cell, shard) for cell in open_ for shard in range(done, goal)]
        half, done = interval_half_widths(stop.statistic, goal), goal
        sure = {place for place, half_width in half.items() if half_width <= stop.max_half_width}
        open_ = [cell for cell in open_ if not {(cell, method.title) for method in campaign.methods} <= sure]
        if not open_:
            return

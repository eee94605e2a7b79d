"""Adaptive stopping: the trials that are still needed, round by round, for cells whose mean is imprecise.

A cell is one combination of settings.

A round depends only on the rows of previous rounds, and thus neither on the number of workers nor on interruptions. The
trials of a stopped cell are the first trials of the full run.

A cell is evaluated after every round, and repeated evaluation favours intervals that are narrow by chance. The error
rate of 5 % is therefore divided by the number of possible evaluations of a cell (Bonferroni, with quantiles of t). All
intervals together, and thus also the last one, contain the mean with 95 %. The first evaluation has at least
`MIN_TRIALS_BEFORE_STOP` trials, so that the variance is known and the mean of skewed values is nearly normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from scipy import special

if TYPE_CHECKING:
    from ltsim.campaigns.spec import CampaignFile

ROUND_GROWTH_FACTOR = 1.5
"""Ratio of the number of trials after a round to the number before the round."""
MIN_TRIALS_BEFORE_STOP = 64
"""Smallest number of trials before the first evaluation of a combination of settings."""
INTERVAL_ERROR_RATE = 0.05
"""Probability that any confidence interval of a combination of settings does not contain the mean; without
adaptive stopping, the probability for each interval."""
ShardKey = tuple[int, int]
"""Index of the combination of settings, and index of the shard among its files, both from 0."""


def student_quantile(n_values: int, error_rate: float) -> float:
    """Two-sided quantile of Student's t for the mean of `n_values` values at an error rate."""
    return -float(special.stdtrit(n_values - 1, 0.5 * error_rate)) if n_values > 1 else math.inf


def interval_error_rate(n_trials: int, shard_size: int, *, is_stopping: bool) -> float:
    """Error rate of each confidence interval of a combination of settings; all its intervals have 5 % together."""
    return INTERVAL_ERROR_RATE / len(evaluation_schedule(n_trials, shard_size)) if is_stopping else INTERVAL_ERROR_RATE


def evaluation_schedule(n_trials: int, shard_size: int) -> list[int]:
    """Numbers of finished shards after which a combination of settings is evaluated."""
    n_shards = -(-n_trials // shard_size)
    schedule = [min(-(-MIN_TRIALS_BEFORE_STOP // shard_size), n_shards)]
    while schedule[-1] < n_shards:
        schedule.append(min(math.ceil(ROUND_GROWTH_FACTOR * schedule[-1]), n_shards))
    return schedule


def iterate_rounds(
    campaign: CampaignFile, n_cells: int, half_intervals: Callable[[str, int], Mapping[tuple[int, str], float]]
) -> Iterator[list[ShardKey]]:
    """Shards to be computed, round by round; a round begins when all shards of the previous one are finished.

    `half_intervals` is a function of the statistic's name and the number of shards per combination of settings (cell).
    It returns the half-width of the confidence interval of the mean, by cell and method.
    """
    if (stop := campaign.stop) is None:
        yield [(cell, shard) for cell in range(n_cells) for shard in range(campaign.n_shards_per_cell)]
        return
    open_, done = list(range(n_cells)), 0
    for goal in evaluation_schedule(campaign.trials, campaign.shard):
        yield [(cell, shard) for cell in open_ for shard in range(done, goal)]
        half, done = half_intervals(stop.statistic, goal), goal
        sure = {place for place, half_width in half.items() if half_width <= stop.within}
        open_ = [cell for cell in open_ if not {(cell, method.title) for method in campaign.methods} <= sure]
        if not open_:
            return

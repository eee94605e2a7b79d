"""Adaptive stopping: the trials that are still required, round by round for cells whose mean is not precise enough.

A round depends only on the rows of previous rounds, and thus neither on the number of workers nor on interruptions.
Trials are those of the full run, from the first on.

Repeated looks favour intervals that are narrow by chance. The error rate of 5 % is therefore divided by the number of
possible looks of a cell (Bonferroni, with quantiles of t): all intervals together contain the mean with 95 %, and so
does the one at which a cell stops. The first look has at least `MIN_TRIALS` trials, so that the variance is known and
the mean of skewed values is nearly normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from scipy import special

if TYPE_CHECKING:
    from ltsim.campaigns.spec import Campaign

GROWTH = 1.5
"""Ratio of the number of trials after a round to that before it."""
MIN_TRIALS = 64
"""Smallest number of trials before the first look."""
ERROR_RATE = 0.05
"""Two-sided error rate of all intervals of a cell together; without adaptive stopping, of each interval."""
Shard = tuple[int, int]
"""Shard as a pair of cell number and shard number."""


def quantile(count: int, level: float) -> float:
    """Two-sided quantile of Student's t for the mean of `count` values at an error rate."""
    return -float(special.stdtrit(count - 1, 0.5 * level)) if count > 1 else math.inf


def level_of(trials: int, shard: int, *, stops: bool) -> float:
    """Error rate of each interval of a cell, such that the interval at which it stops has the rate `ERROR_RATE`."""
    return ERROR_RATE / len(schedule(trials, shard)) if stops else ERROR_RATE


def schedule(trials: int, shard: int) -> list[int]:
    """Numbers of shards after which a cell is evaluated."""
    whole = -(-trials // shard)
    done = [min(-(-MIN_TRIALS // shard), whole)]
    while done[-1] < whole:
        done.append(min(math.ceil(GROWTH * done[-1]), whole))
    return done


def rounds(
    campaign: Campaign, cells: int, half_intervals: Callable[[str, int], Mapping[tuple[int, str], float]]
) -> Iterator[list[Shard]]:
    """Shards to be computed, round by round; a round begins when all shards of the previous one are finished.

    `half_intervals` returns the half-width of the interval of the statistic's mean over the first shards, by cell and
    method.
    """
    if (stop := campaign.stop) is None:
        yield [(cell, shard) for cell in range(cells) for shard in range(campaign.shards)]
        return
    open_, done = list(range(cells)), 0
    for goal in schedule(campaign.trials, campaign.shard):
        yield [(cell, shard) for cell in open_ for shard in range(done, goal)]
        half, done = half_intervals(stop.statistic, goal), goal
        sure = {place for place, half_width in half.items() if half_width <= stop.within}
        open_ = [cell for cell in open_ if not {(cell, method.title) for method in campaign.methods} <= sure]
        if not open_:
            return

"""Trials still required: all of them, or round by round those of cells whose mean is not precise enough.

What a round does is decided by the rows of the rounds before it alone: the same whatever the number of workers, and
after any stop. Trials are those of the full run, from the first on.

Who looks several times and stops at a narrow interval stops more often where it is narrow by luck. So the error rate
of 5 % is divided by the number of looks that a cell can have (Bonferroni, by quantiles of t): all intervals together
hold the mean with 95 %, and so does the one at which a cell stops. The first look waits for `LEAST` trials, so that the
variance is known and a mean of skewed values is near normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

from scipy import special

if TYPE_CHECKING:
    from ltsim.campaigns.spec import Campaign

GROWTH = 1.5
"""Ratio of the trials after a round to those before it."""
LEAST = 64
"""Trials before the first look."""
LEVEL = 0.05
"""Two-sided error rate of all intervals of a cell together; without a stop, of each."""
Shard = tuple[int, int]
"""Cell and number."""


def quantile(count: int, level: float) -> float:
    """Two-sided quantile of Student's t, for the mean of so many values at an error rate."""
    return -float(special.stdtrit(count - 1, 0.5 * level)) if count > 1 else math.inf


def level_of(trials: int, shard: int, *, stops: bool) -> float:
    """Error rate of each interval of a cell of so many trials, so that that at which it stops keeps `LEVEL`."""
    return LEVEL / len(schedule(trials, shard)) if stops else LEVEL


def schedule(trials: int, shard: int) -> list[int]:
    """Numbers of shards after which a cell is looked at."""
    whole = -(-trials // shard)
    done = [min(-(-LEAST // shard), whole)]
    while done[-1] < whole:
        done.append(min(math.ceil(GROWTH * done[-1]), whole))
    return done


def rounds(
    campaign: Campaign, cells: int, half_intervals: Callable[[str, int], Mapping[tuple[int, str], float]]
) -> Iterator[list[Shard]]:
    """Shards to be done, round by round; a round is asked for when all of the one before are finished.

    `known` gives half of the interval of a statistic's mean by so many first shards, by cell and method.
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

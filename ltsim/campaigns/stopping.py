"""Which trials are still wanted: all of them, or round by round those of cells that are not known well enough.

What a round does is decided by the rows of the rounds before it alone: the same whatever the number of workers, and
after any stop. Trials are those of the full run, from the first on.

Who looks several times and stops at a narrow interval stops more often where it is narrow by luck. So the error rate
of 5 % is divided by the number of looks that a cell can have (Bonferroni, by quantiles of t): all intervals together
hold the mean with 95 %, and so does the one at which a cell stops. The first look waits for `LEAST` trials, so that the
variance is known and a mean of skewed values is near normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from scipy import special

from ltsim.arrays import Floats
from ltsim.errors import unknown_name

if TYPE_CHECKING:
    from ltsim.campaigns.spec import Campaign

GROWTH = 1.5
"""Trials after a round over those before it."""
LEAST = 64
"""Trials before the first look."""
LEVEL = 0.05
"""Two-sided, of every interval."""
IMPROVEMENT = "_improvement_percent"
Shard = tuple[int, int]
"""Cell and number."""


@dataclass
class Mean:
    """Running mean of a sample, by sums of it and of its squares about the first value."""

    count: int = 0
    shift: float = 0.0
    total: float = 0.0
    squares: float = 0.0

    def add(self, values: Floats) -> None:
        """Take in further values (n,); NaN is no value."""
        kept = values[np.isfinite(values)]
        if not self.count and len(kept):
            self.shift = float(kept[0])
        self.count += len(kept)
        self.total += float(np.sum(kept - self.shift))
        self.squares += float(np.sum((kept - self.shift) ** 2))

    @property
    def mean(self) -> float:
        """Of all values so far."""
        return self.shift + self.total / self.count

    def half(self, level: float) -> float:
        """Half of the mean's two-sided interval at an error rate; infinite for fewer than two values."""
        if self.count < 2:
            return math.inf
        variance = max(self.squares - self.total**2 / self.count, 0.0) / (self.count - 1)
        return quantile(self.count, level) * math.sqrt(variance / self.count)


def quantile(count: int, level: float) -> float:
    """Of t, two-sided, for the mean of so many values at an error rate."""
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


def statistic_of(rows: pa.Table, name: str) -> Floats:
    """A column (n,) of rows, or an improvement [%]; NaN where there is none. Raises ModelError for another name."""

    def column(which: str) -> Floats:
        if which not in rows.column_names:
            known = [n for n in rows.column_names if pa.types.is_floating(rows[n].type)]
            raise unknown_name("statistic of these rows", name, known)
        return np.asarray(rows[which].to_numpy(), dtype=np.float64)

    if not name.endswith(IMPROVEMENT):
        return column(name)
    kind = name.removesuffix(IMPROVEMENT)
    return 100.0 * (1.0 - column(f"{kind}_after_mean_um") / column(f"{kind}_before_mean_um"))


def rounds(campaign: Campaign, cells: int, read: Callable[[int, int], pa.Table]) -> Iterator[list[Shard]]:
    """Shards to be done, round by round; a round is asked for when all of the one before are finished.

    `read` gives the rows of a finished shard, named by its cell and number.
    """
    if (stop := campaign.stop) is None:
        yield [(cell, shard) for cell in range(cells) for shard in range(campaign.shards)]
        return
    means = [{method.title: Mean() for method in campaign.methods} for _ in range(cells)]
    level, open_, done = level_of(campaign.trials, campaign.shard, stops=True), list(range(cells)), 0
    for goal in schedule(campaign.trials, campaign.shard):
        now = [(cell, shard) for cell in open_ for shard in range(done, goal)]
        yield now
        for cell, shard in now:
            rows = read(cell, shard)
            values, methods = statistic_of(rows, stop.statistic), np.array(rows["method"].to_pylist())
            for title, mean in means[cell].items():
                mean.add(values[methods == title])
        done = goal
        open_ = [cell for cell in open_ if any(mean.half(level) > stop.within for mean in means[cell].values())]
        if not open_:
            return

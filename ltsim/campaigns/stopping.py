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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from scipy import special

from ltsim.arrays import Floats
from ltsim.campaigns.spec import Campaign
from ltsim.errors import unknown_name

GROWTH = 1.5
"""Trials after a round over those before it."""
LEAST = 64
"""Trials before the first look."""
LEVEL = 0.05
"""Two-sided, of every interval; of the differences all together."""
IMPROVEMENT = "_improvement_percent"
Shard = tuple[int, int]
"""Cell and number."""
Read = Callable[[int, int], pa.Table]


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


@dataclass
class Watch:
    """What the rows say so far of the statistic that decides."""

    campaign: Campaign
    """With a `stop`."""
    pairs: Sequence[tuple[int, int]]
    """Cells that are neighbours."""
    read: Read
    """Gives the rows of a finished shard."""
    done: dict[int, int] = field(default_factory=dict)
    means: dict[tuple[int, str], Mean] = field(default_factory=dict)
    gaps: dict[tuple[int, int, str], Mean] = field(default_factory=dict)
    compared: dict[tuple[int, int], int] = field(default_factory=dict)

    def take(self, shards: Sequence[Shard]) -> None:
        """Take in the rows of a finished round."""
        for cell, shard in shards:
            for method, values in self._values(cell, shard).items():
                self.means.setdefault((cell, method), Mean()).add(values)
            self.done[cell] = shard + 1
        for pair in self.pairs if self._apart else ():
            first, last = self.compared.get(pair, 0), min(self.done.get(cell, 0) for cell in pair)
            for shard in range(first, last):
                one, other = (self._values(cell, shard) for cell in pair)
                for method, values in one.items():
                    self.gaps.setdefault((*pair, method), Mean()).add(values - other[method])
            self.compared[pair] = last

    @property
    def _apart(self) -> float | None:
        return self.campaign.stop.apart if self.campaign.stop else None

    def _values(self, cell: int, shard: int) -> Mapping[str, Floats]:
        """The statistic (n,) of a shard for each method."""
        assert self.campaign.stop is not None
        rows = self.read(cell, shard)
        values = statistic_of(rows, self.campaign.stop.statistic)
        methods = np.array(rows["method"].to_pylist())
        return {method.title: values[methods == method.title] for method in self.campaign.methods}

    def wanting(self) -> set[int]:
        """Cells that are not known well enough."""
        stop = self.campaign.stop
        assert stop is not None
        level = level_of(self.campaign.trials, self.campaign.shard, stops=True)
        found = {cell for (cell, _), mean in self.means.items() if mean.half(level) > stop.within}
        level /= max(len(self.gaps), 1)
        for (one, other, _), gap in self.gaps.items():
            half = gap.half(level)
            if stop.apart is not None and not (half <= stop.apart or abs(gap.mean) > half):
                found |= {one, other}
        return found


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


def rounds(campaign: Campaign, cells: int, pairs: Sequence[tuple[int, int]], read: Read) -> Iterator[list[Shard]]:
    """Shards to be done, round by round; a round is asked for when all of the one before are finished.

    Parameters
    ----------
    campaign : Campaign
    cells : int
    pairs : sequence of (int, int)
        Cells that are neighbours.
    read : callable
        Gives the rows of a finished shard.
    """
    if campaign.stop is None:
        yield [(cell, shard) for cell in range(cells) for shard in range(campaign.shards)]
        return
    watch, open_ = Watch(campaign, pairs, read), list(range(cells))
    done, looks = dict.fromkeys(range(cells), 0), schedule(campaign.trials, campaign.shard)
    while open_:
        goal = {cell: next(count for count in looks if count > done[cell]) for cell in open_}
        now = [(cell, shard) for cell in open_ for shard in range(done[cell], goal[cell])]
        yield now
        watch.take(now)
        done |= goal
        wanting = watch.wanting()
        open_ = [cell for cell in range(cells) if cell in wanting and done[cell] < campaign.shards]


def neighbours(levels: Sequence[Mapping[str, object]]) -> list[tuple[int, int]]:
    """Pairs of cells that are one step apart along one factor and the same in all others."""
    steps = {name: list(dict.fromkeys(cell[name] for cell in levels)) for name in (levels[0] if levels else ())}
    places = {tuple(steps[name].index(cell[name]) for name in steps): k for k, cell in enumerate(levels)}
    pairs = []
    for place, cell in places.items():
        for axis in range(len(place)):
            beside = places.get((*place[:axis], place[axis] + 1, *place[axis + 1 :]))
            if beside is not None:
                pairs.append((cell, beside))
    return pairs

"""Search for a layout: exchange of stations over a grid of set-ups, then continuous refinement, from many starts.

Both steps replace one station at a time by the best of many candidates, evaluated as one batch; only the candidates'
own contributions are computed anew. Every step lowers the objective, so a start ends at a layout that no
single station improves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import SetupError
from ltsim.model.construction import Construction, misalignment
from ltsim.planning.fast import Reducer, StationBlocks
from ltsim.planning.objective import LEAST_IMPROVEMENT, Objective
from ltsim.planning.placement import Placement
from ltsim.planning.site import Site
from ltsim.planning.survey import Survey
from ltsim.randomness import stream

CHUNK = 64
SWEEPS = 12
TRIES = 12
MOST_NAMED = 8
PACE = 0.985
"""What a step leaves of the way to the end, for somebody who watches: how many steps it takes is not known before."""


def unheard(_share: float) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class Layout:
    """Stations of a layout and what they are worth."""

    position: Floats
    """(S, 3) [m]."""
    yaw: Floats
    """(S,) [rad]."""
    value: float
    """The objective; infinite where the layout is not allowed."""


def unkept(_layout: Layout) -> None:
    """Keep nothing."""


@dataclass(frozen=True)
class Pool:
    """Set-ups with their contributions."""

    position: Floats
    """(N, 3) (N,) (N, T)."""
    yaw: Floats
    seen: Bools
    blocks: StationBlocks

    def take(self, which: Ints) -> Pool:
        """Some of the set-ups."""
        return Pool(self.position[which], self.yaw[which], self.seen[which], self.blocks.take(which))


@dataclass
class Searcher:
    """Search on one site for one objective."""

    site: Site
    objective: Objective = field(default_factory=Objective)
    construction: Construction = field(default_factory=misalignment)
    step: float = 0.5
    """[m]: grid of the exchange."""
    yaws: int = 6
    heights: int = 2
    """Turns and heights tried at each place of the grid."""
    tell: Callable[[float], None] = unheard
    """Hears the share of a start that is done."""
    keep: Callable[[Layout], None] = unkept
    """Is given each better layout."""

    def __post_init__(self) -> None:
        self.reducer = Reducer(self.site.survey, self.construction, self.objective.effects)
        self._tables: dict[int, Pool] = {}
        self._steps = 0

    @property
    def stations(self) -> int:
        """Stations of a layout."""
        return self.reducer.stations

    def pool(self, position: Floats, yaw: Floats, slot: int, seen: Bools | None = None) -> Pool:
        """Set-ups that stand for station `slot`; who is `seen` (N, T) is looked up where it is not given."""
        seen, parts = self.site.seen(position) if seen is None else seen, []
        for a in range(0, len(position), CHUNK):
            some = slice(a, a + CHUNK)
            slots = np.full(len(position[some]), slot, dtype=np.int64)
            parts.append(self.reducer.blocks(position[some], yaw[some], slots, seen[some]))
            self._step()
        return Pool(position, yaw, seen, StationBlocks.joined(parts))

    def table(self, slot: int) -> Pool:
        """The grid of candidate set-ups; it depends on the slot only where effects know the time."""
        key = slot if self.objective.effects else 0
        if key not in self._tables:
            places = self.placement.position
            if not len(places):
                raise SetupError("no place on the floor sees three reflectors; widen the floor or move obstacles")
            if self.site.least >= self.stations and not self.placement.seen.all(axis=1).any():
                raise SetupError(self._nowhere())
            turns = np.arange(self.yaws) * (2 * np.pi / self.yaws)
            position: Floats = np.repeat(places, self.yaws, axis=0)
            seen: Bools = np.repeat(self.placement.seen, self.yaws, axis=0)
            good = seen.all(axis=1) if self.site.least >= self.stations else np.ones(len(seen), dtype=bool)
            yaw = np.tile(turns, len(places))
            self._tables[key] = self.pool(position[good], yaw[good], key, seen[good])
        return self._tables[key]

    @cached_property
    def placement(self) -> Placement:
        """Where stations may stand on the grid, and what is in sight from there."""
        return self.site.placement(self.step, self.heights)

    def _nowhere(self) -> str:
        """A sentence: which targets cannot be seen from everywhere."""
        share = self.placement.seen.mean(axis=0)
        worst = self.site.survey.target_names[int(np.argmin(share))]
        return (
            f"no place on the floor sees every reflector: {worst} is seen from {100 * share.min():.0f} % of the "
            "places; move it, widen the floor, or ask for fewer stations a reflector"
        )

    def layout(self, survey: Survey) -> Pool:
        """The stations of a survey, each as the one that it is."""
        return self._joined([self.pool(survey.position[[s]], survey.yaw[[s]], s) for s in range(self.stations)])

    def evaluate(self, position: Floats, yaw: Floats) -> Layout:
        """A layout as it is."""
        here = self.layout(self.site.survey.replace(position=position, yaw=yaw))
        good = self.site.allowed(position).all() and self.site.joined(position[None], here.seen[None])[0]
        value = self._values(here.blocks, np.arange(self.stations)[None])[0] if good else np.inf
        return Layout(position, yaw, float(value))

    @staticmethod
    def _joined(pools: list[Pool]) -> Pool:
        return Pool(
            np.concatenate([p.position for p in pools]),
            np.concatenate([p.yaw for p in pools]),
            np.concatenate([p.seen for p in pools]),
            StationBlocks.joined([p.blocks for p in pools]),
        )

    def _values(self, blocks: StationBlocks, chosen: Ints) -> Floats:
        found = [
            self.objective.values(
                self.reducer.reduce(blocks, chosen[a : a + CHUNK], targets=self.objective.wants_targets),
                self.construction.size,
            )
            for a in range(0, len(chosen), CHUNK)
        ]
        return np.concatenate(found) if found else np.zeros(0)

    def _step(self) -> None:
        """A word to whoever watches."""
        self._steps += 1
        self.tell(1.0 - PACE**self._steps)

    def replacements(self, layout: Pool, slot: int, candidates: Pool, *, anywhere: bool = False) -> Floats:
        """Values (N,) of the layout with each candidate as station `slot`; infinite where the rules forbid it."""
        count = len(candidates.position)
        position = np.broadcast_to(layout.position, (count, *layout.position.shape)).copy()
        seen = np.broadcast_to(layout.seen, (count, *layout.seen.shape)).copy()
        position[:, slot], seen[:, slot] = candidates.position, candidates.seen
        good = np.arange(count) if anywhere else np.flatnonzero(self.site.joined(position, seen))
        values = np.full(count, np.inf)
        blocks = StationBlocks.joined([layout.blocks, candidates.blocks])
        chosen = np.tile(np.arange(self.stations), (len(good), 1))
        chosen[:, slot] = self.stations + good
        values[good] = self._values(blocks, chosen)
        return values

    def best_replacement(self, layout: Pool, slot: int, candidates: Pool) -> tuple[int, float]:
        """The candidate that serves best as station `slot`, and the value; infinite where none may."""
        self._step()
        values = self.replacements(layout, slot, candidates)
        best = int(np.argmin(values))
        return best, float(values[best])

    def _with(self, layout: Pool, slot: int, candidates: Pool, which: int) -> Pool:
        rows = [layout.blocks.take(np.array([s])) for s in range(self.stations)]
        rows[slot] = candidates.blocks.take(np.array([which]))
        position, yaw, seen = layout.position.copy(), layout.yaw.copy(), layout.seen.copy()
        position[slot], yaw[slot] = candidates.position[which], candidates.yaw[which]
        seen[slot] = candidates.seen[which]
        return Pool(position, yaw, seen, StationBlocks.joined(rows))

    @property
    def _free(self) -> list[int]:
        return [s for s in range(self.stations) if s not in self.site.fixed]

    def exchange(self, layout: Pool, value: float) -> tuple[Pool, float]:
        """Replace stations by set-ups of the grid until none of them helps."""
        for _ in range(SWEEPS):
            before = value
            for slot in self._free:
                table = self.table(slot)
                which, best = self.best_replacement(layout, slot, table)
                if best < value:
                    layout, value = self._with(layout, slot, table, which), best
                    self.keep(Layout(layout.position, layout.yaw, value))
            if not value < before * (1 - LEAST_IMPROVEMENT):
                break
        return layout, value

    def refine(self, layout: Pool, value: float, rng: np.random.Generator) -> tuple[Pool, float]:
        """Move stations off the grid: a pattern search with shrinking steps, along the axes and at random."""
        reach = 0.5 * self.step
        while reach > 0.004:
            before = value
            for slot in self._free:
                candidates = self._around(layout, slot, reach, rng)
                if candidates is None:
                    continue
                which, best = self.best_replacement(layout, slot, candidates)
                if best < value:
                    layout, value = self._with(layout, slot, candidates, which), best
                    self.keep(Layout(layout.position, layout.yaw, value))
            if not value < before * (1 - LEAST_IMPROVEMENT):
                reach *= 0.5
        return layout, value

    def _around(self, layout: Pool, slot: int, reach: float, rng: np.random.Generator) -> Pool | None:
        """Set-ups near a station: x, y, height and yaw moved alone and together."""
        turn = reach / self.step
        axes = np.concatenate([np.eye(4), -np.eye(4)])
        moves = np.concatenate([axes, rng.uniform(-1, 1, (16, 4))]) * [reach, reach, reach, turn]
        position = layout.position[slot] + moves[:, :3]
        position[:, 2] = np.clip(position[:, 2], *self.site.heights)
        good = self.site.allowed(position)
        if not good.any():
            return None
        return self.pool(position[good], layout.yaw[slot] + moves[good, 3], slot)

    def random_layout(self, rng: np.random.Generator) -> Pool:
        """An allowed layout: stations placed one by one with some chance, fixed ones kept; the first try without.

        Raises
        ------
        SetupError
            When none is found, with the targets that lack sights.
        """
        survey, free = self.site.survey, self._free
        tables = {slot: self.table(slot) for slot in free}
        lacking: list[int] | None = None
        for _ in range(TRIES):
            chosen = self.placement.stations(len(free), self.site.least, rng)
            if len(chosen) < len(free) or self.placement.missing(chosen, self.site.least):
                lacking = chosen
                break
            pools = [self.pool(survey.position[[s]], survey.yaw[[s]], s) for s in range(self.stations)]
            for slot, place in zip(free, chosen, strict=True):
                at = np.flatnonzero((tables[slot].position == self.placement.position[place]).all(axis=1))
                pools[slot] = tables[slot].take(rng.choice(at, size=1)) if len(at) else pools[slot]
            made = self._joined(pools)
            if self.site.joined(made.position[None], made.seen[None])[0]:
                return made
        where = "" if lacking is None else self._lacking(lacking)
        raise SetupError(
            f"no layout of {self.stations} stations was found among {len(self.placement.position)} places that keeps "
            f"them {self.site.spacing:g} m apart and every reflector in sight of {self.site.least}{where}; "
            "ask for less, or widen the floor"
        )

    def _lacking(self, chosen: list[int]) -> str:
        """Which targets lack sights where the fewest are missing, in words."""
        count = self.placement.counted + self.placement.seen[chosen].sum(axis=0)
        names = [n for n, k in zip(self.site.survey.target_names, count, strict=True) if k < self.site.least]
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return f" (the nearest one lacks {', '.join(names[:MOST_NAMED])}{more})" if names else ""

    def from_start(self, seed: int, start: int) -> Layout:
        """One start: number 0 begins at the site's own layout where that is allowed, the others at random."""
        rng = stream(seed, "plan", self.stations, start)
        survey = self.site.survey
        layout: Pool | None = None
        if start == 0 and np.isfinite(self.evaluate(survey.position, survey.yaw).value):
            layout = self.layout(survey)
        layout = layout or self.random_layout(rng)
        value = float(self._values(layout.blocks, np.arange(self.stations)[None])[0])
        self.keep(Layout(layout.position, layout.yaw, value))
        layout, value = self.exchange(layout, value)
        layout, value = self.refine(layout, value, rng)
        return Layout(layout.position, np.mod(layout.yaw, 2 * np.pi), value)

"""Search for a layout: exchange of stations over a grid of set-ups, then continuous refinement, from many starts.

Both steps replace one station at a time by the best of many candidates, evaluated as one batch; only the candidates'
own contributions are computed anew. Every step lowers the objective, so a start ends at a layout that no
single station improves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import SetupError
from ltsim.model.construction import Construction, misalignment
from ltsim.planning.fast import Reducer, StationBlocks
from ltsim.planning.objective import LEAST_IMPROVEMENT, Objective
from ltsim.planning.site import Site
from ltsim.randomness import stream

CHUNK = 64
SWEEPS = 12
TRIES = 200
PACE = 0.985
"""What a step leaves of the way to the end, for somebody who watches: how many steps it takes is not known before."""
DRAWS = 24


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


@dataclass(frozen=True)
class Pool:
    """Set-ups with their contributions."""

    position: Floats
    """(N, 3) (N,) (N, T)."""
    yaw: Floats
    seen: Bools
    blocks: StationBlocks


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

    def __post_init__(self) -> None:
        self.reducer = Reducer(self.site.survey, self.construction, self.objective.effects)
        self._tables: dict[int, Pool] = {}
        self._steps = 0

    @property
    def stations(self) -> int:
        """Stations of a layout."""
        return self.reducer.stations

    def pool(self, position: Floats, yaw: Floats, slot: int) -> Pool:
        """Set-ups that stand for station `slot`."""
        seen, parts = self.site.seen(position), []
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
            position, yaw = self.site.grid(self.step, self.yaws, self.heights)
            enough = 3 if self.site.least < self.stations else self.reducer.survey.points.shape[0]
            good = self.site.seen(position).sum(axis=1) >= enough
            if not good.any():
                raise SetupError(self._nowhere(position))
            self._tables[key] = self.pool(position[good], yaw[good], key)
        return self._tables[key]

    def _nowhere(self, position: Floats) -> str:
        """A sentence: which targets cannot be seen."""
        if not len(position):
            return "the floor has no place where a tripod may stand; widen it or move obstacles"
        share = self.site.seen(position).mean(axis=0)
        worst = self.site.survey.target_names[int(np.argmin(share))]
        return (
            f"no place on the floor sees every reflector: {worst} is seen from {100 * share.min():.0f} % of the "
            "places; move it, widen the floor, or ask for fewer stations a reflector"
        )

    def evaluate(self, position: Floats, yaw: Floats) -> Layout:
        """A layout as it is."""
        pools = [self.pool(position[s : s + 1], yaw[s : s + 1], s) for s in range(self.stations)]
        here = self._joined(pools)
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

    def best_replacement(self, layout: Pool, slot: int, candidates: Pool) -> tuple[int, float]:
        """The candidate that serves best as station `slot`, and the value; -1 and infinite where none may."""
        self._step()
        count = len(candidates.position)
        position = np.broadcast_to(layout.position, (count, *layout.position.shape)).copy()
        seen = np.broadcast_to(layout.seen, (count, *layout.seen.shape)).copy()
        position[:, slot], seen[:, slot] = candidates.position, candidates.seen
        good = np.flatnonzero(self.site.joined(position, seen))
        if not len(good):
            return -1, np.inf
        blocks = StationBlocks.joined([layout.blocks, candidates.blocks])
        chosen = np.tile(np.arange(self.stations), (len(good), 1))
        chosen[:, slot] = self.stations + good
        values = self._values(blocks, chosen)
        best = int(np.argmin(values))
        return int(good[best]), float(values[best])

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
        """An allowed layout: stations drawn one by one from the grid, fixed ones kept.

        Each is the one of a few random set-ups that brings most targets nearer to the sights they need.

        Raises
        ------
        SetupError
            When none is found.
        """
        survey = self.site.survey
        for _ in range(TRIES):
            pools: list[Pool] = [
                self.pool(survey.position[s : s + 1], survey.yaw[s : s + 1], s) for s in self.site.fixed
            ]
            slots = [*self.site.fixed]
            for slot in self._free:
                pools.append(self._drawn(self.table(slot), pools, rng))
                slots.append(slot)
            made = self._joined([pools[slots.index(s)] for s in range(self.stations)])
            if self.site.joined(made.position[None], made.seen[None])[0]:
                return made
        raise SetupError(
            f"no layout of {self.stations} stations was found in {TRIES} tries that keeps them "
            f"{self.site.spacing:g} m apart and every reflector in sight of {self.site.least}; "
            "ask for less, or widen the floor"
        )

    def _drawn(self, table: Pool, others: list[Pool], rng: np.random.Generator) -> Pool:
        """One set-up of the grid, apart from the others."""
        some = rng.integers(len(table.position), size=DRAWS)
        count = np.zeros(table.seen.shape[1], dtype=np.int64)
        apart = np.ones(DRAWS, dtype=bool)
        for other in others:
            gap = np.linalg.norm(table.position[some, :2] - other.position[0, :2], axis=1)
            apart &= gap >= self.site.spacing
            count += other.seen[0]
        gained = np.minimum(count + table.seen[some], self.site.least).sum(axis=1) * apart
        pick = some[[int(np.argmax(gained))]]
        return Pool(table.position[pick], table.yaw[pick], table.seen[pick], table.blocks.take(pick))

    def from_start(self, seed: int, start: int) -> Layout:
        """One start: number 0 begins at the site's own layout where that is allowed, the others at random."""
        rng = stream(seed, "plan", self.stations, start)
        survey = self.site.survey
        layout: Pool | None = None
        if start == 0 and np.isfinite(self.evaluate(survey.position, survey.yaw).value):
            layout = self._joined(
                [self.pool(survey.position[s : s + 1], survey.yaw[s : s + 1], s) for s in range(self.stations)]
            )
        layout = layout or self.random_layout(rng)
        value = float(self._values(layout.blocks, np.arange(self.stations)[None])[0])
        layout, value = self.exchange(layout, value)
        layout, value = self.refine(layout, value, rng)
        return Layout(layout.position, np.mod(layout.yaw, 2 * np.pi), value)

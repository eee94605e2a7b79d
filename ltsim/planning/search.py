"""Search for a layout from many starts: exchange of stations over a grid of set-ups, then continuous refinement.

Both steps replace one station at a time by the best of many candidates, evaluated as one batch; only the candidates'
own contributions are computed anew. Every step decreases the objective, so that a start ends at a layout that no change
of a single station improves.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment.remedies.next_measurement import no_progress
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import SetupError
from ltsim.core.randomness import stream
from ltsim.physics.model.construction import Construction, misalignment_construction
from ltsim.planning.fast import LayoutScorer, NormalBlocks
from ltsim.planning.objective import MIN_IMPROVEMENT, Objective
from ltsim.planning.site import Placement, SearchSpace

CHUNK = 64
SWEEPS = 12
TRIES = 12
PROGRESS_FACTOR = 0.985
"""Factor on the remaining part of the progress bar for each step; the number of steps is unknown in advance."""
MIN_STEP = 0.004
"""Step [m] of the last moves off the grid."""


@dataclass(frozen=True)
class PlannedLayout:
    """Stations of a layout and its objective."""

    position: Floats
    """Positions of the stations, (S, 3) [m]."""
    yaw: Floats
    """Yaw of each station, (S,) [rad]."""
    value: float
    """Objective; infinite for a layout that breaks a rule."""


@dataclass
class LayoutSearcher:
    """Search in one search space for one objective."""

    site: SearchSpace
    objective: Objective = field(default_factory=Objective)
    construction: Construction = field(default_factory=misalignment_construction)
    step: float = 0.5
    """Step of the grid [m]."""
    yaws: int = 6
    heights: int = 2
    """Number of yaws and of heights that are tried at each place of the grid."""
    tell: Callable[[float], None] = no_progress
    """Callback for the finished fraction of a start."""
    keep: Callable[[PlannedLayout], None] = no_progress
    """Callback for each better layout."""

    def __post_init__(self) -> None:
        self.reducer = LayoutScorer(self.site.survey, self.construction, self.objective.effects)
        self.stations = self.reducer.stations
        self._free = [s for s in range(self.stations) if s not in self.site.fixed]
        self._tables: dict[int, NormalBlocks] = {}
        self._steps = 0

    def pool(self, position: Floats, yaw: Floats, slot: int, visible: Bools | None = None) -> NormalBlocks:
        """Set-ups as alternatives for station `slot`; `visible` (N, T) is computed unless given."""
        visible, parts = self.site.visible(position) if visible is None else visible, []
        for a in range(0, len(position), CHUNK):
            chunk = slice(a, a + CHUNK)
            slots = np.full(len(position[chunk]), slot, dtype=np.int64)
            parts.append(self.reducer.blocks(position[chunk], yaw[chunk], slots, visible[chunk]))
            self._step()
        return NormalBlocks.concatenated(parts)

    def table(self, slot: int) -> NormalBlocks:
        """Grid of candidate set-ups; it depends on the slot only for time-dependent effects."""
        key = slot if self.objective.effects else 0
        if key not in self._tables:
            places, visible = self.placement.position, self.placement.visible
            whole = self.site.min_sights >= self.stations
            good = visible.all(axis=1) if whole else np.ones(len(visible), dtype=bool)
            if not good.any():
                raise SetupError(self._nowhere())
            turns = np.arange(self.yaws) * (2 * np.pi / self.yaws)
            position: Floats = np.repeat(places[good], self.yaws, axis=0)
            yaw = np.tile(turns, int(good.sum()))
            self._tables[key] = self.pool(position, yaw, key, np.repeat(visible[good], self.yaws, axis=0))
        return self._tables[key]

    @cached_property
    def placement(self) -> Placement:
        """Candidate places of stations on the grid, with the targets visible from each."""
        return self.site.placement(self.step, self.heights)

    def _nowhere(self) -> str:
        """Sentence on targets that cannot be seen from all stations, or from any."""
        share = self.placement.visible.mean(axis=0)
        if not share.all():
            return self.site.out_of_sight(np.flatnonzero(share == 0))
        worst = self.site.survey.target_names[int(np.argmin(share))]
        return (
            f"no place on the floor sees every reflector: {worst} is visible from {100 * share.min():.0f} % of the "
            "places; move it, enlarge the floor, or set a smaller stations.min_stations_per_target"
        )

    def layout(self, position: Floats, yaw: Floats) -> NormalBlocks:
        """Stations of a layout (positions (S, 3), yaws (S,)) as set-ups."""
        return NormalBlocks.concatenated([self.pool(position[[s]], yaw[[s]], s) for s in range(self.stations)])

    def evaluate(self, position: Floats, yaw: Floats) -> PlannedLayout:
        """Layout with its objective."""
        here = self.layout(position, yaw)
        good = self.site.allowed(position).all() and self.site.feasible(position[None], here.visible[None])[0]
        return PlannedLayout(position, yaw, self._value(here) if good else np.inf)

    def _value(self, layout: NormalBlocks) -> float:
        return float(self._values(layout, np.arange(self.stations)[None])[0])

    def _values(self, blocks: NormalBlocks, chosen: Ints) -> Floats:
        """Objective (B,) of layouts; each row of `chosen` (B, S) has indices into `blocks`."""
        values = [
            self.objective.values(
                self.reducer.reduce(blocks, chosen[a : a + CHUNK], targets=self.objective.wants_targets),
                self.construction.n_parameters,
            )
            for a in range(0, len(chosen), CHUNK)
        ]
        return np.concatenate(values) if values else np.zeros(0)

    def _step(self) -> None:
        """Report of progress to the callback."""
        self._steps += 1
        self.tell(1.0 - PROGRESS_FACTOR**self._steps)

    def replacements(self, layout: NormalBlocks, slot: int, candidates: NormalBlocks) -> Floats:
        """Objective (N,) of the layout with each candidate as station `slot`; infinite if a rule is broken."""
        count, (position, visible) = len(candidates.position), _with_each(layout, slot, candidates)
        good = np.flatnonzero(self.site.feasible(position, visible))
        values = np.full(count, np.inf)
        chosen = np.tile(np.arange(self.stations), (len(good), 1))
        chosen[:, slot] = self.stations + good
        values[good] = self._values(NormalBlocks.concatenated([layout, candidates]), chosen)
        return values

    def best_replacement(self, layout: NormalBlocks, slot: int, candidates: NormalBlocks) -> tuple[int, float]:
        """Best candidate for station `slot` and its objective; infinite if all candidates break a rule."""
        self._step()
        values = self.replacements(layout, slot, candidates)
        best = int(np.argmin(values))
        return best, float(values[best])

    def _sweep(
        self, layout: NormalBlocks, value: float, candidates: Callable[[NormalBlocks, int], NormalBlocks | None]
    ) -> tuple[NormalBlocks, float]:
        """Layout after one sweep, in which each station is replaced by the best of its candidates if that is better."""
        for slot in self._free:
            offered = candidates(layout, slot)
            if offered is None:
                continue
            which, best = self.best_replacement(layout, slot, offered)
            if best < value:
                layout, value = layout.with_station(slot, offered.take(np.array([which]))), best
                self.keep(PlannedLayout(layout.position, layout.yaw, value))
        return layout, value

    def exchange(self, layout: NormalBlocks, value: float) -> tuple[NormalBlocks, float]:
        """Layout after exchanges of stations for set-ups of the grid, until none improves it."""
        for _ in range(SWEEPS):
            before = value
            layout, value = self._sweep(layout, value, lambda _, slot: self.table(slot))
            if not value < before * (1 - MIN_IMPROVEMENT):
                break
        return layout, value

    def refine(self, layout: NormalBlocks, value: float, rng: np.random.Generator) -> tuple[NormalBlocks, float]:
        """Layout after moves of stations off the grid.

        It is a pattern search with shrinking steps along the axes and at random.
        """
        reach = 0.5 * self.step

        def around(layout: NormalBlocks, slot: int) -> NormalBlocks | None:
            """Set-ups near a station, with x, y, height and yaw changed separately and together."""
            axes = np.concatenate([np.eye(4), -np.eye(4)])
            steps = [reach, reach, reach, reach / self.step]
            moves = np.concatenate([axes, rng.uniform(-1, 1, (16, 4))]) * steps
            position = layout.position[slot] + moves[:, :3]
            position[:, 2] = np.clip(position[:, 2], *self.site.heights)
            good = self.site.allowed(position)
            return self.pool(position[good], layout.yaw[slot] + moves[good, 3], slot) if good.any() else None

        while reach > MIN_STEP:
            before = value
            layout, value = self._sweep(layout, value, around)
            if not value < before * (1 - MIN_IMPROVEMENT):
                reach *= 0.5
        return layout, value

    def random_layout(self, rng: np.random.Generator) -> NormalBlocks:
        """Permitted random layout; fixed stations remain.

        It determines all poses and targets if a few draws give such a layout. Raises SetupError, with the targets that
        lack sights, if none is permitted.
        """
        survey, free, places = self.site.survey, self._free, self.placement
        tables = {slot: self.table(slot) for slot in free}
        lacking = ""
        loose: NormalBlocks | None = None
        for _ in range(TRIES):
            chosen = places.stations(len(free), self.site.min_sights, rng)
            if len(chosen) < len(free) or places.missing(chosen, self.site.min_sights).any():
                lacking = self.site.unseen_targets(places, chosen) if chosen else ""
                break
            made = self.layout(survey.position, survey.yaw)
            for slot, place in zip(free, chosen, strict=True):
                at = np.flatnonzero((tables[slot].position == places.position[place]).all(axis=1))
                if len(at):
                    made = made.with_station(slot, tables[slot].take(rng.choice(at, size=1)))
            if self.site.feasible(made.position[None], made.visible[None])[0]:
                if np.isfinite(self._value(made)):
                    return made
                loose = made
        if loose is not None:
            return loose
        raise SetupError(
            f"the search found no layout of {self.stations} stations among {len(places.position)} places that are "
            f"{self.site.spacing:g} m apart and have every reflector in sight of {self.site.min_sights}"
            f"{f' (the closest one lacks sights of {lacking})' if lacking else ''}; lower "
            "stations.min_stations_per_target or stations.spacing_mm, or enlarge the floor"
        )

    def _bound(self, layout: NormalBlocks) -> NormalBlocks:
        """Layout in which stations are exchanged for better connected ones until the network is determined."""
        for slot in self._free * 2:
            table = self.table(slot)
            position, visible = _with_each(layout, slot, table)
            worth = np.where(self.site.feasible(position, visible), self.site.connectivity(visible), -1.0)
            if worth.max() < 0:
                continue
            layout = layout.with_station(slot, table.take(np.array([worth.argmax()])))
            if np.isfinite(self._value(layout)):
                break
        return layout

    def from_start(self, seed: int, start: int) -> PlannedLayout:
        """Result of a start: number 0 begins at the declared layout if that is permitted, the others at random."""
        rng = stream(seed, "plan", self.stations, start)
        current = self.site.survey.position, self.site.survey.yaw
        begins_there = start == 0 and np.isfinite(self.evaluate(*current).value)
        layout = self.layout(*current) if begins_there else self.random_layout(rng)
        if not np.isfinite(value := self._value(layout)):
            value = self._value(layout := self._bound(layout))
        self.keep(PlannedLayout(layout.position, layout.yaw, value))
        layout, value = self.exchange(layout, value)
        layout, value = self.refine(layout, value, rng)
        return PlannedLayout(layout.position, np.mod(layout.yaw, 2 * np.pi), value)


def _with_each(layout: NormalBlocks, slot: int, candidates: NormalBlocks) -> tuple[Floats, Bools]:
    """Positions (N, S, 3) and visibility (N, S, T) of the layout with each candidate as station `slot`."""
    count = len(candidates.position)
    position: Floats = np.repeat(layout.position[None], count, axis=0)
    visible: Bools = np.repeat(layout.visible[None], count, axis=0)
    position[:, slot], visible[:, slot] = candidates.position, candidates.visible
    return position, visible

"""Search for a layout from many starts: exchange of stations over a grid of set-ups, then refinement off the grid.

A set-up is a position and a yaw of a station. Both steps replace one station at a time by the best of many candidate
set-ups, which are evaluated together. Every step decreases the objective. Each start ends at a layout that no further
replacement of a single station improves.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ltsim.adjustment.remedies.next_measurement import no_progress
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.planning.layout_scorer import LayoutScorer
from ltsim.planning.normal_blocks import NormalBlocks
from ltsim.planning.objective import MIN_SWEEP_IMPROVEMENT, LayoutObjective
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.station_placement import StationPlacement

SETUPS_PER_BATCH = 64
"""Number of candidate set-ups whose objectives are computed together."""
MAX_LAYOUT_SWEEPS = 12
"""Largest number of sweeps, in each of which every station may be exchanged once."""
MAX_RANDOM_LAYOUTS = 12
"""Largest number of random layouts that are drawn, for the initial layout of a search, until one of them determines all
poses and targets."""
REMAINING_PROGRESS_FACTOR = 0.985
"""Factor by which each step of a search reduces the unfinished part of the progress bar; the number of steps is
unknown."""
MIN_REFINEMENT_STEP = 0.004
"""Step [m] of the pattern search off the grid at which the search ends."""


@dataclass(frozen=True)
class StationLayout:
    """Poses of the stations of a layout, with the objective of the layout."""

    positions: Floats
    """Positions (S, 3) [m] of the S stations."""
    yaws: Floats
    """Yaw (direction of azimuth zero, counter-clockwise from x) of each of the S stations, (S,) [rad]."""
    objective_value: float
    """Objective, smaller is better; infinite for a layout that breaks a rule."""


@dataclass
class LayoutSearcher:
    """Searcher for the layout in `search_space` with the smallest `objective`.

    `construction` is the geometric error model whose parameters a calibration would estimate.
    """

    search_space: SearchSpace
    """Permitted positions and rules of a layout."""
    objective: LayoutObjective = field(default_factory=LayoutObjective)
    """Objective that the search minimises."""
    construction: GeometricErrorModel = field(default_factory=misalignment_construction)
    """Geometric error model whose parameters a calibration would estimate."""
    grid_step: float = 0.5
    """Horizontal step [m] of the grid of candidate positions of stations."""
    n_yaws: int = 6
    """Number of candidate yaws at each grid position."""
    n_heights: int = 2
    """Number of candidate heights at each grid position."""
    on_progress: Callable[[float], None] = no_progress
    """Callback with the finished fraction of the search from one initial layout."""
    on_better_layout: Callable[[StationLayout], None] = no_progress
    """Callback with each layout that is better than all layouts before it in the same search."""

    def __post_init__(self) -> None:
        self.scorer = LayoutScorer(self.search_space.survey, self.construction, self.objective.effects)
        self.n_stations = self.scorer.n_stations
        self._movable_stations = [s for s in range(self.n_stations) if s not in self.search_space.fixed_station_indices]
        self._grid_tables: dict[int, NormalBlocks] = {}
        self._n_steps = 0

    def normal_blocks_of_setups(
        self, position: Floats, yaw: Floats, station_index: int, is_visible: Bools | None = None
    ) -> NormalBlocks:
        """Contributions of N set-ups at `position` (N, 3) [m] with `yaw` (N,) [rad] to the normal equations.

        The set-ups are alternatives for the station with index `station_index`. `is_visible` (N, T) is True where a
        set-up sees one of T targets; computed by default.
        """
        is_visible, parts = self.search_space.is_visible(position) if is_visible is None else is_visible, []
        for a in range(0, len(position), SETUPS_PER_BATCH):
            chunk = slice(a, a + SETUPS_PER_BATCH)
            station_indices = np.full(len(position[chunk]), station_index, dtype=np.int64)
            parts.append(self.scorer.normal_blocks(position[chunk], yaw[chunk], station_indices, is_visible[chunk]))
            self._report_step()
        return NormalBlocks.concatenate(parts)

    def normal_blocks_of_grid(self, station_index: int) -> NormalBlocks:
        """Contributions of all set-ups of the grid to the normal equations, as alternatives for one station.

        The contributions are computed once for all stations, or once per station if the objective contains effects,
        because effects may depend on time.
        """
        key = station_index if self.objective.effects else 0
        if key not in self._grid_tables:
            places, visible = self.grid_placement.candidate_positions, self.grid_placement.is_visible
            whole = self.search_space.min_sights_per_target >= self.n_stations
            is_permitted = visible.all(axis=1) if whole else np.ones(len(visible), dtype=bool)
            if not is_permitted.any():
                raise InputError(self._invisible_targets_sentence())
            turns = np.arange(self.n_yaws) * (2 * np.pi / self.n_yaws)
            position: Floats = np.repeat(places[is_permitted], self.n_yaws, axis=0)
            yaw = np.tile(turns, int(is_permitted.sum()))
            self._grid_tables[key] = self.normal_blocks_of_setups(
                position, yaw, key, np.repeat(visible[is_permitted], self.n_yaws, axis=0)
            )
        return self._grid_tables[key]

    @cached_property
    def grid_placement(self) -> StationPlacement:
        """Candidate positions of stations on the grid, with the targets visible from each."""
        return self.search_space.candidate_placement(self.grid_step, self.n_heights)

    def _invisible_targets_sentence(self) -> str:
        """Sentence on targets that no grid position sees, or on the target that the fewest grid positions see."""
        share = self.grid_placement.is_visible.mean(axis=0)
        if not share.all():
            return self.search_space.invisible_targets_sentence(np.flatnonzero(share == 0))
        worst_target = self.search_space.survey.target_names[int(np.argmin(share))]
        return (
            f"no place on the floor sees every reflector: {worst_target} is visible "
            f"from {100 * share.min():.0f} % of the "
            "places; move it, enlarge the floor, or set a smaller stations.min_stations_per_target"
        )

    def normal_blocks_of_layout(self, position: Floats, yaw: Floats) -> NormalBlocks:
        """Contributions to the normal equations of the S stations at `position` (S, 3) [m] with `yaw` (S,) [rad]."""
        return NormalBlocks.concatenate(
            [self.normal_blocks_of_setups(position[[s]], yaw[[s]], s) for s in range(self.n_stations)]
        )

    def evaluate_layout(self, position: Floats, yaw: Floats) -> StationLayout:
        """Layout of S stations at `position` (S, 3) [m] with `yaw` (S,) [rad], with its objective.

        The objective is infinite if the layout breaks a rule.
        """
        blocks = self.normal_blocks_of_layout(position, yaw)
        is_permitted = (
            self.search_space.is_allowed_station(self.search_space.survey.replace(station_positions=position)).all()
            and self.search_space.is_feasible(position[None], blocks.is_visible[None])[0]
        )
        return StationLayout(position, yaw, self._objective_of_layout(blocks) if is_permitted else np.inf)

    def _objective_of_layout(self, layout: NormalBlocks) -> float:
        """Objective of a layout, from the contributions of its stations to the normal equations."""
        return float(self._objectives_of_layouts(layout, np.arange(self.n_stations)[None])[0])

    def _objectives_of_layouts(self, blocks: NormalBlocks, setup_indices: Ints) -> Floats:
        """Objectives (B,) of B layouts of S stations; `setup_indices` (B, S) are the indices of set-ups in `blocks`."""
        objective_batches = [
            self.objective.objective_values(
                self.scorer.evaluate_layouts(
                    blocks,
                    setup_indices[a : a + SETUPS_PER_BATCH],
                    with_target_errors=self.objective.needs_target_errors,
                ),
                self.construction.n_parameters,
            )
            for a in range(0, len(setup_indices), SETUPS_PER_BATCH)
        ]
        return np.concatenate(objective_batches) if objective_batches else np.zeros(0)

    def _report_step(self) -> None:
        """Report of one more finished step of the search to the callback for progress."""
        self._n_steps += 1
        self.on_progress(1.0 - REMAINING_PROGRESS_FACTOR**self._n_steps)

    def replacement_objectives(self, layout: NormalBlocks, station_index: int, candidates: NormalBlocks) -> Floats:
        """Objective (N,) of a layout after each of N candidate set-ups has replaced the station `station_index`.

        The objective is infinite if a rule is broken.
        """
        count, (position, visible) = (
            len(candidates.setup_positions),
            _layouts_with_candidates(layout, station_index, candidates),
        )
        permitted_candidates = np.flatnonzero(self.search_space.is_feasible(position, visible))
        objectives = np.full(count, np.inf)
        chosen = np.tile(np.arange(self.n_stations), (len(permitted_candidates), 1))
        chosen[:, station_index] = self.n_stations + permitted_candidates
        objectives[permitted_candidates] = self._objectives_of_layouts(
            NormalBlocks.concatenate([layout, candidates]), chosen
        )
        return objectives

    def best_replacement(self, layout: NormalBlocks, station_index: int, candidates: NormalBlocks) -> tuple[int, float]:
        """Index of the best candidate set-up (smallest objective) in place of one station, and its objective.

        The station is given by its index. The objective is infinite if every candidate breaks a rule.
        """
        self._report_step()
        objectives = self.replacement_objectives(layout, station_index, candidates)
        best_index = int(np.argmin(objectives))
        return best_index, float(objectives[best_index])

    def _exchange_sweep(
        self,
        layout: NormalBlocks,
        objective_value: float,
        candidate_function: Callable[[NormalBlocks, int], NormalBlocks | None],
    ) -> tuple[NormalBlocks, float]:
        """Layout and objective after a sweep: the best candidate replaces a station if the objective decreases.

        `candidate_function` gives the candidates for a layout and the index of a station, or None if there are none.
        """
        for station_index in self._movable_stations:
            alternatives = candidate_function(layout, station_index)
            if alternatives is None:
                continue
            which, best = self.best_replacement(layout, station_index, alternatives)
            if best < objective_value:
                layout, objective_value = (
                    layout.with_replaced_station(station_index, alternatives.select(np.array([which]))),
                    best,
                )
                self.on_better_layout(StationLayout(layout.setup_positions, layout.setup_yaws, objective_value))
        return layout, objective_value

    def exchange_on_grid(self, layout: NormalBlocks, objective_value: float) -> tuple[NormalBlocks, float]:
        """Layout and objective after exchanges of stations for set-ups of the grid, until no exchange improves them.

        `objective_value` is the objective of the initial `layout`.
        """
        for _ in range(MAX_LAYOUT_SWEEPS):
            before = objective_value
            layout, objective_value = self._exchange_sweep(
                layout, objective_value, lambda _, station_index: self.normal_blocks_of_grid(station_index)
            )
            if not objective_value < before * (1 - MIN_SWEEP_IMPROVEMENT):
                break
        return layout, objective_value

    def refine_off_grid(
        self, layout: NormalBlocks, objective_value: float, random_generator: np.random.Generator
    ) -> tuple[NormalBlocks, float]:
        """Layout and objective after small moves of stations away from the grid.

        The moves are those of a pattern search with shrinking steps, along the axes and in random directions.
        `objective_value` is the objective of the initial `layout`.
        """
        reach = 0.5 * self.grid_step

        def neighbouring_setups(layout: NormalBlocks, station_index: int) -> NormalBlocks | None:
            """Contributions of trial set-ups near a station; None if no trial position is permitted.

            x, y, z and yaw of the station are changed separately and together.
            """
            axes = np.concatenate([np.eye(4), -np.eye(4)])
            steps = [reach, reach, reach, reach / self.grid_step]
            moves = np.concatenate([axes, random_generator.uniform(-1, 1, (16, 4))]) * steps
            position = layout.setup_positions[station_index] + moves[:, :3]
            position[:, 2] = np.clip(position[:, 2], *self.search_space.head_heights)
            is_permitted = self.search_space.is_allowed(position)
            return (
                self.normal_blocks_of_setups(
                    position[is_permitted], layout.setup_yaws[station_index] + moves[is_permitted, 3], station_index
                )
                if is_permitted.any()
                else None
            )

        while reach > MIN_REFINEMENT_STEP:
            before = objective_value
            layout, objective_value = self._exchange_sweep(layout, objective_value, neighbouring_setups)
            if not objective_value < before * (1 - MIN_SWEEP_IMPROVEMENT):
                reach *= 0.5
        return layout, objective_value

    def random_layout(self, random_generator: np.random.Generator) -> NormalBlocks:
        """Random layout that meets the rules; fixed stations keep their poses.

        Of at most `MAX_RANDOM_LAYOUTS` draws the first that determines all poses and targets is used, otherwise the
        last that meets the rules. If no draw meets the rules, InputError names the targets that too few stations see.
        """
        survey, free, places = self.search_space.survey, self._movable_stations, self.grid_placement
        tables = {station_index: self.normal_blocks_of_grid(station_index) for station_index in free}
        lacking = ""
        loose: NormalBlocks | None = None
        for _ in range(MAX_RANDOM_LAYOUTS):
            chosen = places.place_stations(len(free), self.search_space.min_sights_per_target, random_generator)
            if len(chosen) < len(free) or places.missing_sights(chosen, self.search_space.min_sights_per_target).any():
                lacking = self.search_space.unseen_targets_text(places, chosen) if chosen else ""
                break
            made = self.normal_blocks_of_layout(survey.station_positions, survey.station_yaws)
            for station_index, place in zip(free, chosen, strict=True):
                at = np.flatnonzero(
                    (tables[station_index].setup_positions == places.candidate_positions[place]).all(axis=1)
                )
                if len(at):
                    made = made.with_replaced_station(
                        station_index, tables[station_index].select(random_generator.choice(at, size=1))
                    )
            if self.search_space.is_feasible(made.setup_positions[None], made.is_visible[None])[0]:
                if np.isfinite(self._objective_of_layout(made)):
                    return made
                loose = made
        if loose is not None:
            return loose
        raise InputError(
            f"the search found no layout of {self.n_stations} stations, {self.search_space.min_station_spacing:g} m "
            f"apart, among {len(places.candidate_positions)} candidate positions, in which at least "
            f"{self.search_space.min_sights_per_target} stations see every reflector"
            f"{f' (the closest layout lacks sights of {lacking})' if lacking else ''}; lower "
            "stations.min_stations_per_target or stations.spacing_mm, or enlarge the floor"
        )

    def _connect_stations(self, layout: NormalBlocks) -> NormalBlocks:
        """Layout after exchanges of stations for set-ups that see more common targets, until it is determined.

        The exchanges end after two rounds over all stations, even if unknowns are still undetermined.
        """
        for station_index in self._movable_stations * 2:
            table = self.normal_blocks_of_grid(station_index)
            position, visible = _layouts_with_candidates(layout, station_index, table)
            worth = np.where(
                self.search_space.is_feasible(position, visible), self.search_space.connectivity_scores(visible), -1.0
            )
            if worth.max() < 0:
                continue
            layout = layout.with_replaced_station(station_index, table.select(np.array([worth.argmax()])))
            if np.isfinite(self._objective_of_layout(layout)):
                break
        return layout

    def search_from(self, seed: int, start_number: int) -> StationLayout:
        """Layout at the end of the search from the initial layout with number `start_number`.

        Number 0 is the layout in the scenario if the rules permit it; all others are random and depend on `seed`.
        """
        rng = random_stream(seed, "plan", self.n_stations, start_number)
        current = self.search_space.survey.station_positions, self.search_space.survey.station_yaws
        begins_there = start_number == 0 and np.isfinite(self.evaluate_layout(*current).objective_value)
        layout = self.normal_blocks_of_layout(*current) if begins_there else self.random_layout(rng)
        if not np.isfinite(value := self._objective_of_layout(layout)):
            value = self._objective_of_layout(layout := self._connect_stations(layout))
        self.on_better_layout(StationLayout(layout.setup_positions, layout.setup_yaws, value))
        layout, value = self.exchange_on_grid(layout, value)
        layout, value = self.refine_off_grid(layout, value, rng)
        return StationLayout(layout.setup_positions, np.mod(layout.setup_yaws, 2 * np.pi), value)


def _layouts_with_candidates(
    layout: NormalBlocks, station_index: int, candidates: NormalBlocks
) -> tuple[Floats, Bools]:
    """Positions (N, S, 3) [m] of S stations, and visibility (N, S, T) of T targets, in N layouts.

    In each layout one of the N candidates replaces the station `station_index`.
    """
    n_candidates = len(candidates.setup_positions)
    position: Floats = np.repeat(layout.setup_positions[None], n_candidates, axis=0)
    visible: Bools = np.repeat(layout.is_visible[None], n_candidates, axis=0)
    position[:, station_index], visible[:, station_index] = candidates.setup_positions, candidates.is_visible
    return position, visible

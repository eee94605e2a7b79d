"""Number of stations that must see each reflector: its largest feasible value, and points that no position sees."""

import numpy as np

from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.planning.search import LayoutSearcher
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import PlanFile
from ltsim.planning.station_placement import StationPlacement
from ltsim.scene.floor import tripod_grid_spacing

MAX_PROPOSED_ADDITIONAL_STATIONS = 3
"""Largest number of additional stations that an error message proposes for points with too few sights."""


def never_visible_text(search_space: SearchSpace, placement: StationPlacement) -> str:
    """Names of the points that lack sights even in the best placement of stations on the grid; empty for none.

    It is also empty if the present layout of `search_space` is feasible.
    """
    position = search_space.survey.station_positions
    if search_space.is_feasible(position[None], search_space.is_visible(position)[None])[0]:
        return ""
    return search_space.unseen_targets_text(
        placement,
        placement.place_stations(len(position) - len(search_space.fixed_station_indices), search_space.min_sights),
    )


def max_stations_seeing_every_target(search_space: SearchSpace, step: float, n_heights: int) -> tuple[int, str]:
    """Largest number of stations that can see every reflector, and name of the reflector seen from fewest positions.

    `step` [m] and `n_heights` define the grid of candidate positions. The number is a lower bound, found by placing one
    station after the other at the best position, and exact if one position on the floor sees everything.
    """
    placement, names = search_space.candidate_placement(step, n_heights), search_space.survey.target_names
    limiting = names[int(np.argmin(placement.is_visible.mean(axis=0)))]
    n_free_stations = len(search_space.survey.station_positions) - len(search_space.fixed_station_indices)
    enough = (
        k
        for k in range(search_space.min_sights, 0, -1)
        if not placement.missing_sights(placement.place_stations(n_free_stations, k), k).any()
    )
    return next(enough, 0), limiting


def with_feasible_min_sights(file: PlanFile, search_space: SearchSpace) -> PlanFile:
    """Plan file whose value of `stations.min_stations_per_target` can be met by some layout.

    A default value is reduced if necessary. For a value that the file gives, InputError reports the largest possible
    value.
    """
    settings, count = file.search, len(search_space.survey.station_positions)
    step = tripod_grid_spacing(search_space.allowed_areas, settings.grid_step_mm)
    reachable, limiting = max_stations_seeing_every_target(search_space, step, settings.height_count)
    if reachable >= search_space.min_sights:
        return file

    def layout_error(min_sights: int) -> InputError | None:
        """Error of the search for an initial layout with `min_sights` stations per target; None if one is found."""
        searcher = LayoutSearcher(
            search_space.replace(min_sights=min_sights), grid_step=step, n_yaws=1, n_heights=settings.height_count
        )
        try:
            searcher.random_layout(random_stream(settings.seed, "plan", "sights"))
        except InputError as problem:
            return problem
        return None

    if not file.gives_min_stations and reachable:
        while reachable > 1 and layout_error(reachable):
            reachable -= 1
        return file.with_min_stations(reachable)
    problem = layout_error(search_space.min_sights)
    if problem is None:
        return file
    placement = candidate_placement_seeing_all_points(search_space, file)
    if not reachable:
        raise problem
    cure = (
        "remove a station from stations.fixed_stations"
        if len(search_space.fixed_station_indices)
        else "enlarge the floor"
    )
    larger_count = (
        0 if file.stations.min_stations_per_target == "all" else _smallest_sufficient_count(search_space, placement)
    )
    count_text = f"set stations.count = {larger_count}, " if larger_count else ""
    raise InputError(
        f"stations.min_stations_per_target requires {search_space.min_sights} of {count} stations to see every "
        f"reflector, but at most {reachable} can, and {limiting} is visible from the fewest positions: set "
        f"stations.min_stations_per_target = {reachable}, {count_text}move {limiting}, or {cure}"
    )


def _smallest_sufficient_count(search_space: SearchSpace, placement: StationPlacement) -> int:
    """Smallest larger number of stations that can give every target its sights, from the positions of `placement`.

    At most `MAX_PROPOSED_ADDITIONAL_STATIONS` more stations than in `search_space` are tried; 0 if they do not suffice.
    """
    count, wanted_sights = len(search_space.survey.station_positions), search_space.min_sights
    for n_added in range(1, MAX_PROPOSED_ADDITIONAL_STATIONS + 1):
        places = placement.place_stations(count + n_added - len(search_space.fixed_station_indices), wanted_sights)
        if not placement.missing_sights(places, wanted_sights).any():
            return count + n_added
    return 0


def candidate_placement_seeing_all_points(search_space: SearchSpace, file: PlanFile) -> StationPlacement:
    """Candidate positions of stations on the grid; raises InputError, which names points that no position sees."""
    placement = search_space.candidate_placement(
        tripod_grid_spacing(search_space.allowed_areas, file.search.grid_step_mm), file.search.height_count
    )
    is_visible = placement.is_visible.any(axis=0) | (placement.n_fixed_sights > 0)
    if not is_visible.all():
        raise InputError(search_space.invisible_targets_sentence(np.flatnonzero(~is_visible)))
    return placement

"""Number of stations that must see each reflector: the largest feasible number, and points that no position sees."""

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


def points_lacking_sights_text(search_space: SearchSpace, placement: StationPlacement) -> str:
    """Names of the points that too few stations see even in the best placement of stations on the grid.

    The text is empty if all points have enough sights, and if the present layout of `search_space` is feasible.
    """
    position = search_space.survey.station_positions
    if search_space.is_feasible(position[None], search_space.is_visible(position)[None])[0]:
        return ""
    return search_space.unseen_targets_text(
        placement,
        placement.place_stations(
            len(position) - len(search_space.fixed_station_indices), search_space.min_sights_per_target
        ),
    )


def max_stations_seeing_every_target(search_space: SearchSpace, step: float, n_heights: int) -> tuple[int, str]:
    """Largest number of stations that can see every reflector, and name of the reflector seen from fewest positions.

    `step` [m] and `n_heights` define the grid of candidate positions. The number is a lower bound, from a placement of
    one station after the other at the best position. It is exact if one position on the floor sees all reflectors.
    """
    placement, names = search_space.candidate_placement(step, n_heights), search_space.survey.target_names
    limiting = names[int(np.argmin(placement.is_visible.mean(axis=0)))]
    n_free_stations = len(search_space.survey.station_positions) - len(search_space.fixed_station_indices)
    enough = (
        k
        for k in range(search_space.min_sights_per_target, 0, -1)
        if not placement.missing_sights(placement.place_stations(n_free_stations, k), k).any()
    )
    return next(enough, 0), limiting


def with_feasible_min_sights(file: PlanFile, search_space: SearchSpace) -> PlanFile:
    """Plan file whose number of stations per target (`stations.min_stations_per_target`) some layout can have.

    A default value is reduced if necessary. If the file gives a value that is too large, InputError reports the largest
    possible value.
    """
    settings, count = file.search, len(search_space.survey.station_positions)
    step = tripod_grid_spacing(search_space.allowed_areas, settings.grid_step_mm)
    reachable, limiting = max_stations_seeing_every_target(search_space, step, settings.height_count)
    if reachable >= search_space.min_sights_per_target:
        return file

    def layout_error(min_sights_per_target: int) -> InputError | None:
        """Error of the search for an initial layout with this number of stations per target; None if there is one."""
        searcher = LayoutSearcher(
            search_space.replace(min_sights_per_target=min_sights_per_target),
            grid_step=step,
            n_yaws=1,
            n_heights=settings.height_count,
        )
        try:
            searcher.random_layout(random_stream(settings.seed, "plan", "sights"))
        except InputError as problem:
            return problem
        return None

    if not file.gives_min_stations_per_target and reachable:
        while reachable > 1 and layout_error(reachable):
            reachable -= 1
        return file.with_min_stations_per_target(reachable)
    problem = layout_error(search_space.min_sights_per_target)
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
        f"stations.min_stations_per_target requires {search_space.min_sights_per_target} of {count} stations to see "
        f"every reflector, but at most {reachable} can, and {limiting} is visible from the fewest positions: set "
        f"stations.min_stations_per_target = {reachable}, {count_text}move {limiting}, or {cure}"
    )


def _smallest_sufficient_count(search_space: SearchSpace, placement: StationPlacement) -> int:
    """Smallest number of stations, larger than the present one, with which every target has enough sights.

    The stations are at positions of `placement`.

    At most `MAX_PROPOSED_ADDITIONAL_STATIONS` more stations than in `search_space` are tried; 0 if they do not suffice.
    """
    count, wanted_sights = len(search_space.survey.station_positions), search_space.min_sights_per_target
    for n_added in range(1, MAX_PROPOSED_ADDITIONAL_STATIONS + 1):
        places = placement.place_stations(count + n_added - len(search_space.fixed_station_indices), wanted_sights)
        if not placement.missing_sights(places, wanted_sights).any():
            return count + n_added
    return 0


def candidate_placement_seeing_all_points(search_space: SearchSpace, file: PlanFile) -> StationPlacement:
    """Candidate positions of stations on the grid, which together see all points.

    Raises InputError with the names of points that no position sees.
    """
    placement = search_space.candidate_placement(
        tripod_grid_spacing(search_space.allowed_areas, file.search.grid_step_mm), file.search.height_count
    )
    is_visible = placement.is_visible.any(axis=0) | (placement.n_fixed_sights > 0)
    if not is_visible.all():
        raise InputError(search_space.invisible_targets_sentence(np.flatnonzero(~is_visible)))
    return placement

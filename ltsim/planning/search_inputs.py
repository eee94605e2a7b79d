"""Inputs of a search for a layout: survey, search space and objective, from a plan file and its scenario."""

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects import find_effect
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import misalignment_construction
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.planning.objective import (
    DIAGNOSIS_QUALITY_NAME,
    INSTRUMENT_QUALITY_NAME,
    TARGETS_QUALITY_NAME,
    LayoutObjective,
)
from ltsim.planning.search_space import SearchSpace
from ltsim.planning.spec import WALLS_NAME, PlanFile
from ltsim.planning.survey import PlannedSurvey
from ltsim.planning.tolerances import point_weights
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.scene.clearance import StandClearance
from ltsim.scene.floor import areas_and_keep_outs
from ltsim.scene.meshes import candidate_nest_positions, wall_triangles
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import PlacingSigmas
from ltsim.simulation.simulator import simulate
from ltsim.simulation.workshop import (
    WorkshopLayout,
    make_obstacles,
    make_sight_limits,
    make_visibility,
    placed_obstacles,
    planned_layout,
)

MAX_REFLECTOR_PLACES = 3_000
"""Largest number of candidate positions (places) of reflectors in a plan. The search holds the distances of all pairs
(70 MB at this limit), and 7 kB for each place."""
MAX_TILT_COSINE_DEFICIT = 1e-3
"""Largest value of 1 - cos(tilt) of the axis of an upright station in a plan (2.6 deg)."""
RANGE_ONLY_OBSERVABLES = ("distance",)
"""Names of the observables of an instrument that measures distances without angles."""
MIN_STATIONS_FOR_RANGES_ONLY = 3
"""Smallest number of stations that determine the position of a reflector if they measure ranges without angles."""
ZERO_PLACEMENT_SCATTER = PlacingSigmas(station_mm=0.0, yaw_deg=0.0, tilt_deg=0.0, target_mm=0.0, gauge_mm=0.0)
"""Standard deviations of the placing of stations, targets and gauge, all zero, so that they stand exactly as planned.
"""


def planned_survey(scenario: Scenario) -> PlannedSurvey:
    """Planned survey of a scenario: layout, set-up, order and timing of the measurements.

    Raises InputError for an inclined station, for several trackers, and for an instrument that does not record ranges.
    """
    if scenario.instruments:
        named = ", ".join(scenario.instruments)
        raise InputError(f"the scenario has several trackers ({named}); a plan needs one, in the table [instrument]")
    if scenario.instrument.observables not in (OBSERVABLES, RANGE_ONLY_OBSERVABLES):
        raise InputError("instrument.observables: a plan needs ranges and both angles, or ranges only")
    layout, work = planned_layout(scenario), scenario.work
    lean = 1.0 - layout.station_rotations[:, 2, 2]
    if lean.max() > MAX_TILT_COSINE_DEFICIT:
        raise InputError(f"station {layout.station_names[int(lean.argmax())]} is tilted; a plan needs upright stations")
    recording, _ = simulate(scenario.model_copy(update={"placing": ZERO_PLACEMENT_SCATTER}), 0)
    return PlannedSurvey(
        setup=recording.setup,
        station_names=layout.station_names,
        target_names=layout.target_names,
        station_positions=layout.station_positions,
        station_yaws=np.arctan2(layout.station_rotations[:, 1, 0], layout.station_rotations[:, 0, 0]),
        target_points=layout.target_points,
        is_visible=make_visibility(scenario, layout).is_visible,
        faces=tuple(range(1, work.faces + 1)),
        repeats=work.repeats,
        seconds_per_pointing=work.seconds_per_pointing,
        seconds_per_move=60.0 * work.minutes_per_move,
        target_ranks=None if work.order == "as-listed" else _target_ranks(recording, layout),
        measures_face_by_face=work.face_order == "per-station",
        observables=scenario.instrument.observables,
    )


def _target_ranks(recording: Recording, layout: WorkshopLayout) -> Ints:
    """Rank (S, T) of each of T targets in the order in which each of S stations measures its first round.

    Targets that a station does not see come last. The order is that of the times in `recording`, a simulated
    measurement of the scenario's `layout`.
    """
    n_targets = len(layout.target_names)
    first_ranks = np.full((len(layout.station_names), n_targets), np.inf)
    target = np.array([layout.target_names.index(name) for name in recording.targets])[recording.target]
    station = np.array([layout.station_names.index(name) for name in recording.stations])[recording.station]
    np.minimum.at(first_ranks, (station, target), recording.time)
    return np.asarray(np.argsort(np.argsort(first_ranks, axis=1, kind="stable"), axis=1, kind="stable"), dtype=np.int64)


def make_search_space(
    plan: PlanFile, scenario: Scenario, *, n_stations: int, n_faces: int, n_repeats: int = 1
) -> SearchSpace:
    """Search space of a plan for a number of stations, of faces and of rounds (`n_repeats`)."""
    survey, layout, mm, air = (
        planned_survey(scenario),
        planned_layout(scenario),
        MILLIMETRE,
        scenario.air or AirUncertainty(),
    )
    levels, moves = survey.station_positions[:, 2], plan.budget.minutes_per_move
    areas, keep_outs = areas_and_keep_outs(
        plan.floor, scenario.workshop.size_mm, (float(levels.min()), float(levels.max()))
    )
    longest = max(np.linalg.norm(area.outline[:, None] - survey.target_points[:, :2], axis=2).max() for area in areas)
    places, names = candidate_reflector_places(plan, scenario)
    min_stations = plan.stations.min_stations_per_target
    least = n_stations if min_stations == "all" else min(min_stations, n_stations)
    if not survey.records_angles and least < MIN_STATIONS_FOR_RANGES_ONLY:
        if n_stations < MIN_STATIONS_FOR_RANGES_ONLY or plan.gives_min_stations_per_target:
            raise InputError(
                f"ranges alone determine a reflector from {MIN_STATIONS_FOR_RANGES_ONLY} stations, but the plan "
                f"requires only {least} to see it; give more stations, or a larger stations.min_stations_per_target"
            )
        least = MIN_STATIONS_FOR_RANGES_ONLY
    obstacles, clearance = make_obstacles(scenario), plan.stations.clearance_mm * mm
    return SearchSpace(
        survey=survey_with_station_count(survey, n_stations).replace(
            faces=tuple(range(1, n_faces + 1)),
            repeats=n_repeats,
            target_weights=point_weights(plan),
            air=air if air.is_relevant(float(longest)) else None,
            seconds_per_pointing=plan.budget.seconds_per_pointing or survey.seconds_per_pointing,
            seconds_per_move=survey.seconds_per_move if moves is None else 60.0 * moves,
        ),
        allowed_areas=areas,
        forbidden_areas=keep_outs,
        sight_limits=make_sight_limits(scenario, scenario.instrument),
        position_tolerance=plan.stations.position_tolerance_mm * mm,
        is_aimed_nest=~layout.is_reaimed,
        obstacles=obstacles,
        stand_clearance=None if obstacles is None else StandClearance(obstacles, clearance),
        min_station_spacing=plan.stations.spacing_mm * mm,
        min_sights_per_target=least,
        fixed_station_indices=tuple(survey.station_names.index(name) for name in plan.stations.fixed_stations),
        candidate_reflector_places=places,
        reflector_place_names=names,
        min_reflector_spacing=plan.reflectors.spacing_mm * mm,
    )


def min_sights_of_reflector(scenario: Scenario) -> int:
    """Smallest number of stations that determine a reflector: 1 with angles, `MIN_STATIONS_FOR_RANGES_ONLY` without."""
    return 1 if scenario.instrument.observables == OBSERVABLES else MIN_STATIONS_FOR_RANGES_ONLY


def plan_without_search(file: PlanFile, scenario: Scenario) -> tuple[PlanFile, SearchSpace]:
    """Plan file, and search space with the layout in the scenario, for an evaluation without a search.

    If the plan file does not give the number of stations that must see each target, the smallest sufficient number is
    used.
    """
    asked = (
        file
        if file.gives_min_stations_per_target
        else file.with_min_stations_per_target(min_sights_of_reflector(scenario))
    )
    work = scenario.work
    site = make_search_space(
        asked, scenario, n_stations=len(scenario.stations), n_faces=work.faces, n_repeats=work.repeats
    )
    return asked, site.replace(survey=site.survey.replace(is_visible=site.is_visible(site.survey.station_positions)))


def candidate_procedures(plan_file: PlanFile, scenario: Scenario) -> tuple[list[int], list[int]]:
    """Candidate numbers of faces, and candidate numbers of rounds, of the measuring procedure.

    If the plan does not choose the procedure, each list contains only the number of the scenario.
    """
    if not plan_file.chooses_measuring_procedure:
        return [scenario.work.faces], [scenario.work.repeats]
    usual = sorted({1, 2, scenario.work.repeats})
    return sorted(set(plan_file.budget.faces or (1, 2))), sorted(set(plan_file.budget.repeats or usual))


def survey_with_station_count(survey: PlannedSurvey, n_stations: int) -> PlannedSurvey:
    """Survey with the first `n_stations` stations of `survey`; missing stations are added at provisional positions."""
    have = len(survey.station_positions)
    names = [*survey.station_names]
    free = (f"S{i}" for i in range(1, have + n_stations + 1) if f"S{i}" not in names)
    names += [next(free) for _ in range(max(n_stations - have, 0))]
    index = np.arange(n_stations) % have
    shift = (np.arange(n_stations) // have)[:, None] * [0.37, 0.23, 0.0]
    rank = survey.target_ranks
    return survey.replace(
        station_names=tuple(names[:n_stations]),
        station_positions=survey.station_positions[index] + shift,
        station_yaws=survey.station_yaws[index] + np.arange(n_stations) // have,
        is_visible=survey.is_visible[index],
        target_ranks=None if rank is None else rank[index],
    )


def candidate_reflector_places(plan: PlanFile, scenario: Scenario) -> tuple[Floats | None, tuple[str, ...]]:
    """Coordinates (P, 3) [m] and names of P candidate positions of reflectors; (None, ()) if reflectors do not move.

    Raises InputError for more than `MAX_REFLECTOR_PLACES`.
    """
    surfaces = plan.reflectors.surfaces
    _require_few_reflector_places(
        len(plan.reflectors.places) + sum(surface.rows * surface.columns for surface in surfaces)
    )
    points = [np.array(p.position_mm, dtype=np.float64)[None] for p in plan.reflectors.places]
    names = [p.name for p in plan.reflectors.places]
    for body in plan.reflectors.candidate_bodies:
        points.append(_places_on_body(plan, scenario, body))
        names += [f"{body}-{i}" for i in range(1, len(points[-1]) + 1)]
    _require_few_reflector_places(sum(map(len, points)) + sum(surface.rows * surface.columns for surface in surfaces))
    for surface in surfaces:
        steps = np.linspace(0, 1, surface.rows), np.linspace(0, 1, surface.columns)
        up, across = (share.reshape(-1, 1) for share in np.meshgrid(*steps, indexing="ij"))
        points.append(surface.origin_mm + up * np.array(surface.up_mm) + across * np.array(surface.across_mm))
        names += [f"{surface.name}-{r + 1}-{c + 1}" for r in range(surface.rows) for c in range(surface.columns)]
    if not points:
        return None, ()
    return np.concatenate(points) * MILLIMETRE, tuple(names)


def _require_few_reflector_places(n_places: int) -> None:
    """Check that a plan has at most `MAX_REFLECTOR_PLACES` candidate positions of reflectors; raises InputError."""
    if n_places > MAX_REFLECTOR_PLACES:
        raise InputError(
            f"reflectors: {n_places} candidate places, expected at most {MAX_REFLECTOR_PLACES}; "
            "give fewer rows and columns of surfaces, or a larger place_spacing_mm"
        )


def _places_on_body(plan: PlanFile, scenario: Scenario, obstacle_name: str) -> Floats:
    """Candidate positions (P, 3) [mm] of P reflectors on an obstacle or on the walls of the hall, rounded to 1 mm."""
    if obstacle_name == WALLS_NAME:
        triangles = wall_triangles(np.array(scenario.workshop.size_mm) * MILLIMETRE)
    else:
        triangles = np.concatenate(
            [part.triangles for part in placed_obstacles(scenario) if part.name == obstacle_name]
        )
    standoff, spacing = plan.reflectors.standoff_mm * MILLIMETRE, plan.reflectors.place_spacing_mm * MILLIMETRE
    places = candidate_nest_positions(
        triangles, standoff, spacing, make_obstacles(scenario), is_closed=obstacle_name != WALLS_NAME
    )
    return np.asarray(np.round(places / MILLIMETRE))


def is_target_fixed_in_search(plan: PlanFile, scenario: Scenario) -> Bools:
    """Flags (T,): True for a target of the scenario that stays where it is in the search.

    If the plan has no candidate positions of reflectors, all targets stay.
    """
    names, given = scenario.target_names, plan.reflectors
    if not (given.surfaces or given.places or given.candidate_bodies):
        return np.ones(len(names), dtype=bool)
    return _fixed_target_flags(plan, scenario, names, [point.name for point in plan.listed_points])


def is_target_never_moved(plan: PlanFile, scenario: Scenario, survey: PlannedSurvey) -> Bools:
    """Flags (T,): True for a target of the survey that stays in the search and in the later tests of single changes."""
    free = plan.reflectors.movable_points
    demanded = [point.name for point in plan.listed_points if point.name not in free and point.group not in free]
    return _fixed_target_flags(plan, scenario, survey.target_names, demanded)


def _fixed_target_flags(plan: PlanFile, scenario: Scenario, names: Sequence[str], fixed_names: Sequence[str]) -> Bools:
    """Flags (T,): True for each of T target `names` that is in `fixed_names`, in the gauge, or fixed by the plan."""
    fixed = {*plan.reflectors.fixed_reflectors, *fixed_names, *(scenario.gauge.targets if scenario.gauge else ())}
    return np.array([name in fixed for name in names], dtype=bool)


def layout_objective(plan: PlanFile, survey: PlannedSurvey) -> LayoutObjective:
    """Objective of a plan for layouts with the stations of `survey`.

    An effect that acts on a single station is included once for every station. Raises InputError for effects that act
    on single targets or readings.
    """
    goal = plan.goal
    weights = {
        INSTRUMENT_QUALITY_NAME: goal.instrument_weight,
        TARGETS_QUALITY_NAME: goal.targets_weight,
        DIAGNOSIS_QUALITY_NAME: goal.diagnosis_weight,
    }
    effects: list[Effect] = []
    for name in goal.effects if goal.diagnosis_weight else ():
        kind = find_effect(name)
        if kind.scope == "station":
            effects += [kind(stations=(station,)) for station in survey.station_names]
        elif kind.scope == "all":
            effects.append(kind())
        else:
            message = "acts on single targets or readings; name effects that act on all or on a station"
            raise InputError(f"goal.effects: {name} {message}")
    built = misalignment_construction()
    sightings = sightings_at_state(survey.noise_free_recording(built), survey.nominal_state(built)) if effects else None
    places = {e.name: len(type(e).candidates(sightings)) for e in effects} if sightings else {}
    return LayoutObjective(weights, goal.criterion, tuple(effects), places)

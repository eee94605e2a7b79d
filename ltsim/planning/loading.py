"""Reader of plan files, of their lists of points, and of the scenario or hall to which a plan refers."""

import difflib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, RecordError, reraise_as_input_error
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects import CATALOGUE
from ltsim.planning.layout_rules import ClearanceRule, SpacingRule, floor_rules, meets_position_rules
from ltsim.planning.spec import WALLS_NAME, PlanFile, PlanPoint
from ltsim.planning.station_placement import StationPlacement
from ltsim.recordings.coordinates import PointList, read_points as read_coordinates
from ltsim.recordings.files import parse_comma_number, safe_excerpt
from ltsim.recordings.settings import read_toml, validate_settings
from ltsim.scene.clearance import StandClearance
from ltsim.scene.floor import areas_and_keep_outs, grid_over_area, tripod_grid_spacing
from ltsim.scene.visibility import compute_visibility
from ltsim.simulation.builtin import builtin_names
from ltsim.simulation.scenario import SCENARIO_FORMAT, Scenario, load_scenario, validate_scenario
from ltsim.simulation.sections import PlannedStation, PlannedTarget
from ltsim.simulation.workshop import make_obstacles, make_sight_limits, planned_layout

SCENARIO_TABLES_IN_PLAN_FILE = ("workshop", "instrument", "smr", "work")
"""Tables of a scenario that a plan file may contain."""
USUAL_HEAD_HEIGHTS_MM = (1400.0, 1800.0)
"""Lowest and highest usual height [mm] of the centre of a tracker head on a stand: the default range of heights for a
plan file that describes a hall."""
MAX_PLAN_POINTS = 2_000
"""Largest number of points in the list of a plan. The search needs 130 kB of memory for each point."""
MAX_SAME_POINT_DISTANCE_MM = 0.1
"""Limit of the distance [mm] between a point of a list and the target of the same name in the scenario. A larger
distance is an error."""
DEFAULT_STATION_COUNT = 4
"""Number of initial stations in a hall if the plan file gives no number."""
MAX_GRID_SETUPS = 200_000
"""Largest number of candidate set-ups (position and yaw of a station) of a grid. A plan with more is rejected, because
a search holds all of them in memory."""
BUILTIN_PLAN_FOLDER = files("ltsim.planning") / "builtin"
"""Folder of the built-in plan files."""


def builtin_plan_names() -> tuple[str, ...]:
    """Names of the built-in plan files, and of the built-in scenarios, which are plans with default settings."""
    plans = sorted(f.name.removesuffix(".toml") for f in BUILTIN_PLAN_FOLDER.iterdir() if f.name.endswith(".toml"))
    return (*plans, *(name for name in builtin_names() if name not in plans))


def builtin_plan_text(name: str) -> str:
    """Content of the commented plan file of the built-in plan `name`, which users take as a template.

    Raises InputError if there is no such plan.
    """
    path = BUILTIN_PLAN_FOLDER / f"{name}.toml"
    if not path.is_file():
        similar = _similar_names_clause(name, builtin_plan_names())
        raise InputError(f"{safe_excerpt(name)}: there is no built-in plan of this name; {similar}")
    return path.read_text(encoding="utf-8")


def load_plan(name_or_path: str | Path) -> tuple[PlanFile, Scenario]:
    """Plan file and scenario from the path of a plan file or scenario, or from the name of a built-in one.

    Raises InputError.
    """
    name = str(name_or_path)
    built = BUILTIN_PLAN_FOLDER / f"{name}.toml"
    path = Path(str(built)) if built.is_file() else Path(name)
    if not path.is_file():
        if name in builtin_names():
            return PlanFile(scenario=name), load_scenario(name)
        similar = _similar_names_clause(name, builtin_plan_names())
        raise InputError(f"{safe_excerpt(name)}: there is no such file, and no built-in plan of this name; {similar}")
    with reraise_as_input_error():
        data = read_toml(path, "plan")
        if data.get("format") == SCENARIO_FORMAT:
            return PlanFile(scenario=name), load_scenario(path)
        made = validate_settings(data, PlanFile, "plan", path)
    made = made.model_copy(update=_completed_fields(made, path))
    scenario = _scenario_of_plan(made, data, path)
    if made.air is not None:
        scenario = scenario.model_copy(update={"air": made.air})
    _check_names(made, scenario, path)
    _check_dependent_keys(made, scenario, path)
    return made, scenario


def _similar_names_clause(name: str, candidates: Sequence[str]) -> str:
    """Clause for an error about an unknown `name`, which asks for the most similar names among `candidates`."""
    names = ", ".join(difflib.get_close_matches(name, candidates, n=3, cutoff=0.4) or candidates[:8])
    return f"did you mean {names}?" if names else "no name is defined here"


def _completed_fields(plan_file: PlanFile, path: Path) -> dict[str, Any]:
    """New values of fields of a plan file, by name: points read from the list, and defaults that depend on other keys.

    `path` is the path of the plan file. Raises InputError for too many points.
    """
    points = read_points(path.parent / plan_file.points) if isinstance(plan_file.points, str) else plan_file.points
    _require_few_points(len(points), path)
    new_fields: dict[str, Any] = {"points": points}
    if plan_file.workshop is not None and plan_file.floor.height_mm is None:
        new_fields["floor"] = plan_file.floor.model_copy(update={"height_mm": USUAL_HEAD_HEIGHTS_MM})
    if points and not {"instrument_weight", "targets_weight", "diagnosis_weight"} & plan_file.goal.model_fields_set:
        new_fields["goal"] = plan_file.goal.model_copy(update={"instrument_weight": 0.0, "targets_weight": 1.0})
    return new_fields


def _scenario_of_plan(plan_file: PlanFile, plan_tables: dict[str, Any], path: Path) -> Scenario:
    """Scenario that a plan file names, or that its tables describe, with the plan's points as targets.

    `plan_tables` are the TOML tables of the plan file at `path`. Raises InputError for contradictory keys.
    """
    points = plan_file.listed_points
    tables = [name for name in SCENARIO_TABLES_IN_PLAN_FILE if name in plan_tables]
    if plan_file.workshop is None and tables:
        raise InputError(
            f"{path}: [{tables[0]}] needs a [workshop] in the same plan; remove it, or set it in the scenario"
        )
    if plan_file.workshop is not None:
        if "scenario" in plan_tables:
            raise InputError(f"{path}: the plan has both scenario and [workshop]; remove one of them")
        return _hall_scenario(plan_file, plan_tables, points, path)
    scenario_path = path.parent / plan_file.scenario
    return _with_points_as_targets(
        load_scenario(scenario_path if scenario_path.is_file() else plan_file.scenario), points, path
    )


def _check_names(plan_file: PlanFile, scenario: Scenario, file: object) -> None:
    """Check that names in a plan file refer to objects of `scenario`, and that names of new reflectors are unused.

    Raises InputError, which names `file`.
    """
    group_names = sorted({point.group for point in plan_file.listed_points if point.group})
    obstacles = [obstacle.name for obstacle in scenario.workshop.obstacles if obstacle.name]
    for key, wanted, names in (
        ("stations.fixed_stations", plan_file.stations.fixed_stations, list(scenario.stations)),
        ("reflectors.candidate_bodies", plan_file.reflectors.candidate_bodies, [WALLS_NAME, *obstacles]),
        ("reflectors.fixed_reflectors", plan_file.reflectors.fixed_reflectors, scenario.target_names),
        ("goal.effects", plan_file.goal.effects, [effect.name for effect in CATALOGUE]),
        (
            "reflectors.movable_points",
            plan_file.reflectors.movable_points,
            [*group_names, *(point.name for point in plan_file.listed_points)],
        ),
        ("goal.tolerances", [t.group for t in plan_file.goal.tolerances if t.group], group_names),
    ):
        for name in wanted:
            if name not in names:
                similar = _similar_names_clause(name, names)
                raise InputError(f"{file}: {key} names '{safe_excerpt(name)}', which does not exist; {similar}")
    new_names = [p.name for p in plan_file.reflectors.places] + [s.name for s in plan_file.reflectors.surfaces]
    targets = frozenset(scenario.target_names)
    for name, count in Counter(new_names).items():
        if count > 1 or name in targets:
            fault = "the name of a target" if name in targets else "given twice"
            raise InputError(f"{file}: reflectors: the name '{safe_excerpt(name)}' is {fault}")


def _check_dependent_keys(plan_file: PlanFile, scenario: Scenario, file: object) -> None:
    """Check that keys which need other keys have them, and that numbers of stations are consistent.

    Raises InputError, which names `file`.
    """
    if plan_file.goal.tolerances and not plan_file.listed_points:
        raise InputError(f"{file}: goal.tolerances needs points; give them as a list or a file")
    fixed_keys = [f"budget.{key}" for key in ("faces", "repeats") if getattr(plan_file.budget, key) is not None]
    if fixed_keys and not plan_file.chooses_measuring_procedure:
        raise InputError(
            f"{file}: {' and '.join(fixed_keys)} {'have' if len(fixed_keys) > 1 else 'has'} no effect without "
            "budget.max_hours or tolerances; give one of them, or fix faces and repeats in the table [work] of the "
            "scenario"
        )
    if plan_file.goal.diagnosis_weight and not plan_file.goal.effects:
        raise InputError(f"{file}: goal.diagnosis_weight is above 0, but goal.effects names no effect")
    count, min_stations = plan_file.stations.count or len(scenario.stations), plan_file.stations.min_stations_per_target
    if isinstance(min_stations, int) and min_stations > count:
        raise InputError(
            f"{file}: stations.min_stations_per_target is {min_stations}, but there are {count} stations; reduce it"
        )


def read_points(path: Path) -> tuple[PlanPoint, ...]:
    """Points of a plan from a list of coordinates in any format that ltsim reads.

    Additional columns are keys of `PlanPoint`, such as ``weight``. Raises InputError.
    """
    columns = list(PlanPoint.model_fields)[4:]
    with reraise_as_input_error():
        table = read_coordinates(path)
        for name in table.additional_columns:
            if name not in columns:
                wanted = f"expected name, x, y, z and, optional, {', '.join(columns)}"
                raise RecordError(f"the file has the unknown column '{safe_excerpt(name)}'; {wanted}", file=path)
        _require_few_points(len(table.names), path)
        return tuple(_point_from_table(table, i, path) for i in range(len(table.names)))


def _require_few_points(n_points: int, file: object) -> None:
    """Check that a plan has at most `MAX_PLAN_POINTS` points; raises InputError, which names `file`."""
    if n_points > MAX_PLAN_POINTS:
        raise InputError(
            f"{file}: the plan has {n_points} points, expected at most {MAX_PLAN_POINTS}; plan parts of it separately"
        )


def _point_from_table(table: PointList, row: int, path: Path) -> PlanPoint:
    """Point of a plan from the row with index `row` of a list of coordinates; raises RecordError for an invalid cell.

    `path` is the path of the list.
    """
    location: dict[str, Any] = {"file": path, "row": table.line_numbers[row]}

    def optional_number(column: str, default: float | None) -> float | None:
        text = table.additional_columns[column][row] if column in table.additional_columns else ""
        if not text:
            return default
        value = parse_comma_number(text, column=column, **location)
        if not (value > 0 or (value == 0 and column == "weight")):
            raise RecordError(f"found {value:g}, expected a positive number", column=column, **location)
        return value

    place = dict(zip(("x_mm", "y_mm", "z_mm"), (table.points[row] / MILLIMETRE).round(9).tolist(), strict=True))
    missing = next((column for column, value in place.items() if not math.isfinite(value)), None)
    if missing:
        raise RecordError("the value is missing, expected a number", column=missing, **location)
    group = table.additional_columns["group"][row] if "group" in table.additional_columns else ""
    other_fields = {"weight": optional_number("weight", 1.0), "tolerance_mm": optional_number("tolerance_mm", None)}
    try:
        return PlanPoint.model_validate({"name": table.names[row], "group": group, **place, **other_fields})
    except ValidationError as problem:
        first = problem.errors()[0]
        wanted = first["msg"].removeprefix("Value error, ")
        raise RecordError(
            f"found {safe_excerpt(str(first['input']))}: {wanted}", column=str(first["loc"][0]), **location
        ) from None


def _hall_scenario(plan_file: PlanFile, tables: Mapping[str, Any], points: Sequence[PlanPoint], file: Path) -> Scenario:
    """Scenario of a hall that a plan file describes by its TOML tables and points, with initial stations.

    Raises InputError, which names `file`.
    """
    table: dict[str, Any] = {"format": SCENARIO_FORMAT, "title": plan_file.title}
    table |= {name: tables[name] for name in SCENARIO_TABLES_IN_PLAN_FILE if name in tables}
    table["work"] = {"order": "as-listed", **tables.get("work", {})}
    wide, deep, _ = plan_file.workshop.size_mm if plan_file.workshop else (0.0, 0.0, 0.0)
    table["stations"] = {"S1": {"position_mm": [wide / 2, deep / 2, USUAL_HEAD_HEIGHTS_MM[0]], "yaw_deg": 0.0}}
    table["targets"] = {p.name: {"position_mm": [p.x_mm, p.y_mm, p.z_mm]} for p in points}
    scenario = validate_scenario(table, file)
    _require_plausible_extent(points, scenario, file)
    require_small_grid(plan_file, scenario)
    n_stations = plan_file.stations.count or DEFAULT_STATION_COUNT
    places = _initial_station_positions(plan_file, scenario, n_stations)
    stations = {
        f"S{i}": PlannedStation(position_mm=tuple(np.round(place / MILLIMETRE, 1).tolist()), yaw_deg=0.0)
        for i, place in enumerate(places, 1)
    }
    return scenario.model_copy(update={"stations": stations})


def _require_plausible_extent(points: Sequence[PlanPoint], scenario: Scenario, file: object) -> None:
    """Check that not all points lie within a thousandth of the hall's size from the corner of the hall.

    If they do, the coordinates may be in metres, or a full stop may separate thousands (7.000 for 7000 mm). Raises
    InputError.
    """
    spread = np.array([[p.x_mm, p.y_mm, p.z_mm] for p in points]).reshape(-1, 3)
    if len(points) and np.all(1000.0 * np.abs(spread) <= scenario.workshop.size_mm):
        raise InputError(
            f"{file}: all points lie within {np.abs(spread).max():g} mm of the corner of the hall; if the coordinates "
            "are in metres, name the columns x_m, y_m, z_m; if a full stop separates thousands, remove it"
        )


def _with_points_as_targets(scenario: Scenario, points: Sequence[PlanPoint], file: object) -> Scenario:
    """Scenario with the points of a plan as additional targets, except points that are already targets.

    Raises InputError if a target of the same name is at another position.
    """
    _require_plausible_extent(points, scenario, file)
    for point in points:
        there = scenario.targets.get(point.name)
        place = np.array([point.x_mm, point.y_mm, point.z_mm])
        if there is not None and np.abs(np.array(there.position_mm) - place).max() < MAX_SAME_POINT_DISTANCE_MM:
            continue
        if point.name in scenario.target_names:
            raise InputError(
                f"{file}: points: '{point.name}' is the name of a target at another position in the scenario"
            )
    existing = scenario.targets
    added = {p.name: PlannedTarget(position_mm=(p.x_mm, p.y_mm, p.z_mm)) for p in points if p.name not in existing}
    return scenario.model_copy(update={"targets": {**existing, **added}})


def require_small_grid(plan_file: PlanFile, scenario: Scenario) -> None:
    """Check that the number of candidate set-ups is at most `MAX_GRID_SETUPS`; raises InputError."""
    step = plan_file.search.grid_step_mm
    if step is None:
        return
    wide, deep, _ = scenario.workshop.size_mm
    floor = plan_file.floor
    outlines = [area.corners_mm for area in floor.areas] or [floor.corners_mm or ((0.0, 0.0), (wide, deep))]
    area_sizes = np.array([np.ptp(np.array(outline), axis=0) for outline in outlines])
    n_places = (
        float(np.prod(1.0 + area_sizes / step, axis=1).sum())
        * plan_file.search.yaw_count
        * plan_file.search.height_count
    )
    if n_places > MAX_GRID_SETUPS:
        raise InputError(
            f"search: a grid of {step:g} mm over {area_sizes[:, 0].max():g} x {area_sizes[:, 1].max():g} mm "
            f"has {n_places:.2g} "
            f"set-ups, the limit is {MAX_GRID_SETUPS}; give a larger grid_step_mm or a smaller floor"
        )


def _initial_station_positions(plan_file: PlanFile, scenario: Scenario, n_stations: int) -> Floats:
    """Initial positions (`n_stations`, 3) [m] of the stations in a hall.

    Stations are placed one after the other, each at the grid point that sees most of the targets not yet seen. Raises
    InputError if the floor has no room for the stations.
    """
    heights = (USUAL_HEAD_HEIGHTS_MM[0] * MILLIMETRE, USUAL_HEAD_HEIGHTS_MM[1] * MILLIMETRE)
    areas, keep_outs = areas_and_keep_outs(plan_file.floor, scenario.workshop.size_mm, heights)
    obstacles, points = make_obstacles(scenario), planned_layout(scenario).target_points
    grid = np.concatenate(
        [grid_over_area(area, tripod_grid_spacing(areas, plan_file.search.grid_step_mm), 1) for area in areas]
    )
    rules = floor_rules(areas, keep_outs, obstacles)
    if obstacles is not None:
        rules = (*rules, ClearanceRule(StandClearance(obstacles, plan_file.stations.clearance_mm * MILLIMETRE)))
    grid = grid[meets_position_rules(rules, grid)]
    if not len(grid):
        raise InputError(
            "the floor has no place for a tripod; enlarge the floor, move obstacles, or reduce search.grid_step_mm "
            "or stations.clearance_mm"
        )
    visible = compute_visibility(
        grid, points, make_sight_limits(scenario, scenario.instrument), obstacles=obstacles
    ).is_visible
    spacing, none = plan_file.stations.spacing_mm * MILLIMETRE, np.zeros(len(points), dtype=np.int64)
    placement = StationPlacement.from_grid(grid, visible, SpacingRule(spacing), np.zeros((0, 3)), none)
    chosen = placement.place_stations(n_stations, 1)
    if len(chosen) < n_stations:
        raise InputError(
            f"the floor has no room for {n_stations} tripods {spacing:g} m apart; "
            "give fewer stations, or enlarge the floor"
        )
    return placement.candidate_positions[chosen]

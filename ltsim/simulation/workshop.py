"""Planned layout of a hall: stations, targets, gauge (reflectors at known distances), nests, obstacles, visibility."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError
from ltsim.core.randomness import random_stream
from ltsim.core.units import DEGREE, MICROMETRE, MILLIMETRE
from ltsim.geometry.expansion import ThermalExpansion
from ltsim.scene.cad import CadFile, extent_text, implausible_size_question, is_inside_hall, read_cad_file
from ltsim.scene.meshes import Obstacles, box_triangles, cylinder_triangles, join_obstacles, rotate_and_shift_triangles
from ltsim.scene.visibility import (
    SightLimits,
    Visibility,
    compute_visibility,
    join_visibility_tables,
    nest_normals_of_smallest_incidence,
)
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.sections import CoordinateMeasuringMachine, Obstacle, ScenarioGauge, ScenarioInstrument

PAPER_GAUGE_LENGTHS_MM = MappingProxyType(
    {
        "columns": (357.6066, 388.0144, 454.4203, 590.1060, 386.7815, 355.9437),
        "rows": (357.6066, 590.1060, 355.9437, 388.0144, 386.7815, 454.4203),
    }
)
"""Lengths [mm] of the gauge in Sensors 2021, 21, 7479 (Table 2), for both orders in which the table can be read. The
target pairs are 25-26, 25-27, 25-28, 26-27, 26-28 and 27-28. The keys are the values of
`ScenarioGauge.table_reading_order`."""
MAX_GAUGE_LENGTH_DIFFERENCE = 1e-7
"""Largest difference [m] between a declared length of a gauge and the length in the rigid frame that is fitted to all
declared lengths. A larger difference means that the declared lengths contradict each other."""


@dataclass(frozen=True)
class GaugeFrame:
    """Gauge (reflectors at known distances) as a rigid frame, at its calibration temperature."""

    target_names: tuple[str, ...]
    """Names of the targets of the gauge."""
    points: Floats
    """Coordinates of the targets in the axes of the frame, relative to its centre, shape (targets, 3) [m]."""
    first_targets: Ints
    """Index of the target at the first end of each reference length, shape (lengths,)."""
    second_targets: Ints
    """Index of the target at the second end of each reference length, shape (lengths,)."""

    @property
    def lengths(self) -> Floats:
        """True reference lengths, shape (lengths,) [m]."""
        return np.linalg.norm(self.points[self.first_targets] - self.points[self.second_targets], axis=1)


def make_gauge_frame(gauge: ScenarioGauge) -> GaugeFrame:
    """Rigid frame fitted to the declared lengths of a gauge.

    InputError is raised if a length is missing or repeated, or if the lengths contradict each other.
    """
    names = gauge.targets
    target_pairs = list(combinations(range(len(names)), 2))
    lengths = np.array(_declared_lengths(gauge, target_pairs)) * MILLIMETRE
    first, second = np.array(target_pairs, dtype=np.int64).T
    frame = GaugeFrame(names, points_from_distances(len(names), first, second, lengths), first, second)
    worst_length = int(np.argmax(np.abs(frame.lengths - lengths)))
    if abs(frame.lengths[worst_length] - lengths[worst_length]) > MAX_GAUGE_LENGTH_DIFFERENCE:
        a, b = names[first[worst_length]], names[second[worst_length]]
        has, wanted = frame.lengths[worst_length] / MILLIMETRE, lengths[worst_length] / MILLIMETRE
        message = f"{a}-{b} is declared as {wanted:.4f} mm, but the other lengths require {has:.4f} mm"
        raise InputError(f"gauge: the lengths contradict each other; {message}")
    return frame


def _declared_lengths(gauge: ScenarioGauge, target_pairs: list[tuple[int, int]]) -> list[float]:
    """Declared length [mm] of each pair of target indices; raises InputError for missing or repeated lengths."""
    names = gauge.targets
    if not gauge.distance:
        if len(names) != 4:
            message = "the built-in gauge has four; give the lengths of another gauge as [[gauge.distance]]"
            raise InputError(f"gauge.targets has {len(names)} reflectors, but {message}")
        return list(PAPER_GAUGE_LENGTHS_MM[gauge.table_reading_order])
    certificates: dict[frozenset[str], float] = {}
    for i, line in enumerate(gauge.distance):
        key = frozenset((line.from_, line.to))
        if len(key) != 2 or not key <= set(names) or key in certificates:
            problem = "has two entries" if key in certificates else "is not a pair of different gauge.targets"
            raise InputError(f"gauge.distance.{i + 1}: {line.from_}-{line.to} {problem}")
        certificates[key] = line.length_mm
    for a, b in target_pairs:
        if frozenset((names[a], names[b])) not in certificates:
            raise InputError(
                f"gauge.distance: the length {names[a]}-{names[b]} is missing, expected all {len(target_pairs)}"
            )
    return [certificates[frozenset((names[a], names[b]))] for a, b in target_pairs]


def points_from_distances(n_points: int, first_points: Ints, second_points: Ints, lengths: Floats) -> Floats:
    """Points (n_points, 3) [m], relative to their centroid, whose mutual distances fit the given `lengths` best.

    `lengths` has the shape (lengths,) [m]. Length i joins the points with the indices `first_points[i]` and
    `second_points[i]`. The method is classical scaling (Torgerson, Psychometrika 17 (1952) 401-419): the coordinates
    are eigenvectors of the doubly centred squared distances. The first axis is along the largest extent, and the first
    point has no negative coordinate.
    """
    squared = np.zeros((n_points, n_points))
    squared[first_points, second_points] = squared[second_points, first_points] = lengths**2
    centring = np.eye(n_points) - 1.0 / n_points
    value, vector = np.linalg.eigh(-0.5 * centring @ squared @ centring)
    largest = np.argsort(value)[::-1][:3]
    points = np.zeros((n_points, 3))
    points[:, : len(largest)] = vector[:, largest] * np.sqrt(np.maximum(value[largest], 0.0))
    points *= np.where(points[0] < 0, -1.0, 1.0)
    return points


def gauge_expansion_factor(gauge: ScenarioGauge, workshop_temperature_c: float) -> float:
    """Ratio of the gauge's lengths at the hall's temperature to its lengths at the calibration temperature."""
    measured = workshop_temperature_c if gauge.measured_at_c is None else gauge.measured_at_c
    return ThermalExpansion.from_temperature_difference(
        gauge.expansion_per_k, measured - gauge.calibrated_at_c
    ).length_ratio


def gauge_rotation(gauge: ScenarioGauge) -> Floats:
    """Rotation matrix (3, 3) from the axes of the gauge's frame to the axes of the hall."""
    angles = np.array([gauge.roll_deg, gauge.pitch_deg, gauge.yaw_deg]) * DEGREE
    return Rotation.from_euler("xyz", angles).as_matrix()


def gauge_points_in_workshop(gauge: ScenarioGauge, gauge_frame: GaugeFrame, workshop_temperature_c: float) -> Floats:
    """Coordinates (targets, 3) [m] of the gauge's targets at its planned pose and at the hall's temperature."""
    points: Floats = (
        gauge_expansion_factor(gauge, workshop_temperature_c) * gauge_frame.points @ gauge_rotation(gauge).T
    )
    return points + np.array(gauge.position_mm) * MILLIMETRE


def cmm_length_sigmas(measuring_machine: CoordinateMeasuringMachine, lengths: Floats) -> Floats:
    """Standard deviation [m] of each length: the machine's maximum permissible error divided by its coverage factor."""
    largest = measuring_machine.constant_um + lengths / MILLIMETRE / measuring_machine.length_divisor_mm
    return largest * MICROMETRE / measuring_machine.coverage_factor


def measure_points_by_cmm(
    points: Floats,
    names: tuple[str, ...],
    measuring_machine: CoordinateMeasuringMachine,
    seed: int,
    *stream_key: str | int,
) -> Floats:
    """Coordinates (targets, 3) [m] that a coordinate measuring machine measures, from the true `points`.

    The maximum permissible error of a length L is A + L / K. The part A is a random error with half of its variance at
    each end of the length. The part L / K is a scale error of each axis. A and K are `constant_um` and
    `length_divisor_mm` of `measuring_machine`. `names` are the targets. `seed` and `stream_key` determine the random
    errors.
    """
    random = measuring_machine.constant_um * MICROMETRE / measuring_machine.coverage_factor / np.sqrt(2.0)
    scale = MICROMETRE / MILLIMETRE / measuring_machine.length_divisor_mm / measuring_machine.coverage_factor
    axes = scale * random_stream(seed, *stream_key, "cmm", "axes").standard_normal(3)
    draws = np.array([random_stream(seed, *stream_key, "cmm", "point", name).standard_normal(3) for name in names])
    centre = points.mean(axis=0)
    error: Floats = measuring_machine.noise_factor * ((points - centre) * axes + random * draws.reshape(-1, 3))
    return points + error


@dataclass(frozen=True)
class WorkshopLayout:
    """Poses of the stations and positions of the targets of a scenario, in the frame of the hall and in SI units."""

    station_names: tuple[str, ...]
    target_names: tuple[str, ...]
    station_positions: Floats
    """Positions of the stations, shape (stations, 3) [m]."""
    station_rotations: Floats
    """Rotation matrices from instrument to hall, shape (stations, 3, 3)."""
    target_points: Floats
    """Positions of the targets, shape (targets, 3) [m]."""
    nest_normals: Floats
    """Unit normals of the nests, shape (targets, 3); NaN for a nest whose normal is not defined."""
    is_reaimed: Bools
    """Mask of the reflectors that are turned towards each station, shape (targets,)."""


def planned_layout(scenario: Scenario) -> WorkshopLayout:
    """Planned layout of a scenario; the reflectors of the gauge come after all other reflectors.

    InputError is raised if no rigid frame has the declared lengths of the gauge.
    """
    stations = scenario.stations.values()
    position = np.array([s.position_mm for s in stations], dtype=np.float64) * MILLIMETRE
    angles = np.array([[s.roll_deg, s.pitch_deg, s.yaw_deg] for s in stations], dtype=np.float64) * DEGREE
    points = np.array([t.position_mm for t in scenario.targets.values()], dtype=np.float64).reshape(-1, 3) * MILLIMETRE
    if scenario.gauge is not None:
        frame = make_gauge_frame(scenario.gauge)
        points = np.concatenate(
            [points, gauge_points_in_workshop(scenario.gauge, frame, scenario.workshop.temperature_c)]
        )
    normal, reaimed = _nest_normals_and_reaimed_mask(scenario, position, points)
    return WorkshopLayout(
        station_names=tuple(scenario.stations),
        target_names=scenario.target_names,
        station_positions=position,
        station_rotations=Rotation.from_euler("xyz", angles).as_matrix(),
        target_points=points,
        nest_normals=normal,
        is_reaimed=reaimed,
    )


def _nest_normals_and_reaimed_mask(scenario: Scenario, position: Floats, points: Floats) -> tuple[Floats, Bools]:
    """Unit normals of the nests (targets, 3), and mask (targets,) of reflectors that are turned to each station.

    `position` (stations, 3) and `points` (targets, 3) are planned positions [m]. A fixed nest without a declared normal
    faces the centre of the stations.
    """
    missing = (np.nan, np.nan, np.nan)
    normals = [t.nest_normal or missing for t in scenario.targets.values()]
    declared = [t.reaimed for t in scenario.targets.values()]
    if scenario.gauge is not None:
        normals += [scenario.gauge.nest_normal or missing] * len(scenario.gauge.targets)
        declared += [None] * len(scenario.gauge.targets)
    normal = np.array(normals, dtype=np.float64).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    usual = scenario.smr.nest_orientation == "re-aimed"
    reaimed = np.array([usual if value is None else value for value in declared], dtype=bool)
    open_ = ~reaimed & ~np.isfinite(normal[:, 0])
    if open_.any():
        normal[open_] = _aimed_nest_normals(position.tobytes(), points[open_].tobytes())
    return normal, reaimed


@lru_cache(maxsize=64)
def _aimed_nest_normals(position: bytes, points: bytes) -> Floats:
    """Unit normals (targets, 3) of fixed nests at `points` that face the stations at `position` [m], both as bytes.

    They are stored, because thousands of cells of a campaign have the same hall.
    """
    coordinates = [np.frombuffer(content).reshape(-1, 3) for content in (position, points)]
    normals = nest_normals_of_smallest_incidence(*coordinates)[0]
    normals.flags.writeable = False
    return normals


def make_sight_limits(scenario: Scenario, tracker: ScenarioInstrument) -> SightLimits:
    """Limits of elevation, range and incidence angle for lines of sight from a tracker to the scenario's reflectors."""
    limits, cone = tracker.limits, scenario.workshop.shadow_cone_deg
    return SightLimits(
        elevation_min=limits.elevation_min_deg * DEGREE,
        elevation_max=limits.elevation_max_deg * DEGREE,
        range_min=limits.range_min_mm * MILLIMETRE,
        range_max=limits.range_max_mm * MILLIMETRE,
        max_incidence_angle=scenario.smr.acceptance_deg * DEGREE,
        declared_shadow_cone_opening=None if cone is None else cone * DEGREE,
    )


@dataclass(frozen=True)
class PlacedObstacle:
    """Obstacle at its position in the hall."""

    name: str
    triangles: Floats
    """Corners of the triangles of the obstacle's surface, shape (triangles, 3, 3) [m]."""
    cad_file: CadFile | None
    """CAD file of the obstacle; None for a box or cylinder."""

    @property
    def description(self) -> str:
        """Description of the obstacle for people: name, interpretation of its CAD file, size and position."""
        file_text = f" ({self.cad_file.path.name}, {self.cad_file.interpretation_text})" if self.cad_file else ""
        return f"{self.name or 'obstacle'}{file_text}: {extent_text(self.triangles)}"


def make_obstacles(scenario: Scenario) -> Obstacles | None:
    """Obstacles that can block lines of sight; None for a workshop without obstacles; raises InputError."""
    obstacle_parts = placed_obstacles(scenario)
    if not obstacle_parts:
        return None
    return join_obstacles(
        (body.triangles for body in obstacle_parts), body_names=[body.name for body in obstacle_parts]
    )


def placed_obstacles(scenario: Scenario) -> list[PlacedObstacle]:
    """Obstacles at their positions in the workshop.

    InputError is raised for a CAD file that cannot be read, or whose size or position is implausible.
    """
    hall = np.array(scenario.workshop.size_mm) * MILLIMETRE
    obstacle_parts = []
    for i, entry in enumerate(scenario.workshop.obstacles, 1):
        cad = None
        if entry.file is not None:
            cad = read_cad_file(Path(entry.file), entry.unit, entry.up)
            triangles = cad.triangles
        elif entry.box_mm is not None:
            triangles = box_triangles(np.array(entry.box_mm) * MILLIMETRE)
        elif entry.cylinder_mm is not None:
            diameter, height = np.array(entry.cylinder_mm) * MILLIMETRE
            triangles = cylinder_triangles(float(diameter), float(height))
        else:
            raise InputError("an obstacle has no shape: expected file, box_mm or cylinder_mm")
        body = PlacedObstacle(entry.name or f"obstacle {i}", _placed_triangles(entry, triangles), cad)
        if cad is not None and (
            asked := implausible_size_question(cad, hall) or _implausible_position_message(entry, body, cad, hall)
        ):
            raise InputError(asked)
        obstacle_parts.append(body)
    return obstacle_parts


def _placed_triangles(obstacle_entry: Obstacle, triangles: Floats) -> Floats:
    """Triangles of an obstacle after its rotation and translation to its position in the hall."""
    return rotate_and_shift_triangles(
        triangles, np.array(obstacle_entry.position_mm) * MILLIMETRE, obstacle_entry.yaw_deg * DEGREE
    )


def _implausible_position_message(
    obstacle_entry: Obstacle, placed_body: PlacedObstacle, cad_file: CadFile, hall_size: Floats
) -> str:
    """Message about an obstacle that extends beyond the hall, with possible corrections; empty for one inside it."""
    if obstacle_entry.beyond_room or is_inside_hall(placed_body.triangles, hall_size):
        return ""
    other_axis = "z" if cad_file.vertical_axis == "y" else "y"
    turned = _placed_triangles(obstacle_entry, cad_file.triangles_with_other_vertical_axis)
    size_text = " x ".join(f"{v:g}" for v in hall_size)
    problem = "reaches below the floor" if placed_body.triangles[..., 2].min() < 0 else "reaches beyond the hall"
    fits = (
        f'with up = "{other_axis}" it is inside the hall'
        if is_inside_hall(turned, hall_size)
        else "move it by position_mm"
    )
    return (
        f"{cad_file.path}: {problem} of {size_text} m "
        f"({cad_file.interpretation_text}: {extent_text(placed_body.triangles)}); "
        f"{fits}; if this is correct, set beyond_room = true"
    )


def make_visibility(scenario: Scenario, workshop_layout: WorkshopLayout | None = None) -> Visibility:
    """Visibility of the targets from each station, within the limits of each tracker.

    `workshop_layout` contains the poses of the stations and the positions of the targets, by default the planned
    layout.
    """
    there = planned_layout(scenario) if workshop_layout is None else workshop_layout
    obstacles = make_obstacles(scenario)
    stations_of_tracker = [
        [there.station_names.index(s) for s in scenario.stations_of_tracker(name)] for name in scenario.trackers_in_use
    ]
    tables = [
        compute_visibility(
            there.station_positions[stations],
            there.target_points,
            make_sight_limits(scenario, tracker),
            rotation=there.station_rotations[stations],
            nest_normals=there.nest_normals,
            is_reaimed=there.is_reaimed,
            obstacles=obstacles,
        )
        for stations, tracker in zip(stations_of_tracker, scenario.trackers_in_use.values(), strict=True)
    ]
    return join_visibility_tables(tables, np.argsort(np.concatenate(stations_of_tracker)))

"""Scene of a measuring hall as reports draw it: stations, targets, gauge, floor, walls, obstacles, lines of sight.

The gauge is a group of reflectors at known distances. A scene is made from a recording, a calibration or a scenario.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.adjustment import Adjustment
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.remedies.candidates import FloorPlanTransform
from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import ConvergenceError, InputError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.physics.model.construction import declared_construction, ideal_construction
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import ElevationLimits, Setup
from ltsim.scene.cad import implausible_size_question, read_cad_file
from ltsim.scene.visibility import InvisibilityReason, Visibility, default_shadow_cone_opening, stand_shadow_radii
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.workshop import WorkshopLayout, make_obstacles, make_sight_limits, make_visibility, planned_layout

MAX_LOWEST_HEIGHT_WITH_FLOOR_AT_ZERO = 3.0
"""Limit of the height [m] above z = 0 of the lowest target or tracker in a plan. Below it, the floor is drawn at z = 0;
above it, at the lowest target. The limit is above the height of a tracker on its tripod.

If all targets and trackers are higher, the floor is drawn at the lowest target. The limit is above the height of a
tracker on its tripod."""
MIN_WALL_NEST_NORMAL_COMPONENT = 0.25
"""Limit of the component, perpendicular to a wall, of the unit normal of a nest. Above it the nest can belong to the
wall: the normal is at most 75 degrees from the perpendicular of the wall. The value is a choice for drawing."""
MAX_WALL_NEST_DEPTH_DIFFERENCE = 0.2
"""Largest distance [m] of a nest on a wall from the rearmost target on this wall."""
DRAWN_FLOOR_MARGIN = 0.4
"""Margin [m] of the drawn floor around stations and targets."""


@dataclass(frozen=True)
class DrawnSights:
    """Lines of sight to draw, n of them, each with a value that determines its colour."""

    station_indices: Ints
    """Index (n,) of the station of each line of sight."""
    target_indices: Ints
    """Index (n,) of the target of each line of sight."""
    colour_values: Floats
    """Value (n,) of each line of sight, which determines its colour."""
    colour_label: str
    """Name of the values of the lines of sight, with their unit."""


@dataclass(frozen=True)
class WorkshopScene(ValueEquality):
    """Scene of a hall: stations, targets and surroundings in a frame with a vertical z axis, in metres and radians."""

    title: str
    """Title of the scene, free text."""
    stations: tuple[str, ...]
    """Names of the S stations."""
    station_positions: Floats
    """Positions (S, 3) [m] of the S stations."""
    station_rotations: Floats
    """Rotation matrices (S, 3, 3) from the instrument frame of each of S stations to the frame of the scene."""
    targets: tuple[str, ...]
    """Names of the T targets."""
    target_points: Floats
    """Coordinates (T, 3) [m] of the T targets."""
    nest_normals: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """Unit normals (T, 3) of the nests of T targets; NaN for a reflector that is turned to each station."""
    floor_corners: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """Coordinates x, y (k, 2) [m] of the k corners of the floor."""
    floor_height: float = 0.0
    """Height z [m] of the floor."""
    wall_corners: Floats = field(default_factory=lambda: np.zeros((0, 4, 3)))
    """Coordinates (W, 4, 3) [m] of the four corners of each of W walls."""
    gauge_pairs: tuple[tuple[int, int], ...] = ()
    """Pairs of indices of targets with a reference length between them."""
    shadow_cone_opening: float = 70.0 * DEGREE
    """Full opening angle [rad] of the cone below each tracker in which it sees nothing."""
    sights: DrawnSights | None = None
    """Lines of sight to draw; None if they are not drawn."""
    target_covariances: Floats | None = None
    """Covariance (T, 3, 3) [m^2] of each of T targets; None if unknown."""
    target_corrections: Floats | None = None
    """Change (T, 3) [m] of the coordinates of each of T targets by a calibration, or by a finding of a diagnosis; None
    if unknown."""
    obstacle_triangles: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """Corners (k, 3, 3) [m] of the k triangles of obstacles."""
    blocked_sights: Ints = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    """Index of station and target (k, 2) of each of k lines of sight that an obstacle blocks."""
    notes: tuple[str, ...] = ()
    """Notes for the reader, such as an assumed floor."""

    @property
    def station_yaws(self) -> Floats:
        """Direction (S,) [rad] of azimuth zero at each of S stations, counter-clockwise (seen from above) from x."""
        return np.arctan2(self.station_rotations[:, 1, 0], self.station_rotations[:, 0, 0])

    @property
    def shadow_radii_on_floor(self) -> Floats:
        """Radius (S,) [m] on the floor of the cone below each of S stations in which the tracker sees nothing."""
        return stand_shadow_radii(self.station_positions, self.floor_height, self.shadow_cone_opening)

    @property
    def gauge_targets(self) -> tuple[int, ...]:
        """Indices of the targets that belong to the gauge (reflectors at known distances)."""
        return tuple(sorted({i for pair in self.gauge_pairs for i in pair}))

    @property
    def largest_extent(self) -> float:
        """Largest extent [m] of the targets and stations along an axis."""
        points = np.concatenate([self.target_points, self.station_positions])
        return float(np.max(np.ptp(points, axis=0)))

    def incidence_sights(self) -> DrawnSights | None:
        """Lines of sight to nests with a normal, and the angle [deg] between beam and normal; None without normals."""
        if self.sights is None or not np.isfinite(self.nest_normals).any():
            return None
        station, target = self.sights.station_indices, self.sights.target_indices
        beam = self.station_positions[station] - self.target_points[target]
        cosine = np.sum(beam * self.nest_normals[target], axis=1) / np.linalg.norm(beam, axis=1)
        has_normal = np.isfinite(cosine)
        angle = np.arccos(np.clip(cosine[has_normal], -1.0, 1.0)) / DEGREE
        return DrawnSights(station[has_normal], target[has_normal], angle, "incidence on the nest [°]")

    def with_sights_coloured_by(self, quantity: str) -> WorkshopScene:
        """Scene with lines of sight coloured by incidence angle if `quantity` is 'incidence' and nests have normals.

        Otherwise the scene is unchanged; the colours of a new scene show residuals, if there are any.
        """
        sights = self.incidence_sights() if quantity == "incidence" else None
        return self if sights is None else replace(self, sights=sights)


def workshop_from_adjustment(
    adjustment: Adjustment, *, adjustment_without_parameters: Adjustment | None = None
) -> WorkshopScene:
    """Scene of an adjusted network; arrows show the change of the targets by the estimation of instrument parameters.

    The change is relative to `adjustment_without_parameters`. If this is None, the scene has no arrows.
    """
    recording, state = adjustment.recording, adjustment.state
    largest_residuals = np.nanmax(np.abs(np.nan_to_num(adjustment.normalised_residuals)), axis=1)
    has_plan_position = np.asarray(np.isfinite(adjustment.target_covariances[:, :2, :2]).all(axis=(1, 2)))
    rows, new_index = has_plan_position[recording.target], np.cumsum(has_plan_position) - 1
    target_changes = (
        None
        if adjustment_without_parameters is None
        else (state.target_points - adjustment_without_parameters.state.target_points)[has_plan_position]
    )
    network = WorkshopScene(
        title=recording.setup.title,
        stations=recording.stations,
        station_positions=state.station_positions,
        station_rotations=state.station_rotations,
        targets=tuple(name for name, is_drawn in zip(recording.targets, has_plan_position, strict=True) if is_drawn),
        target_points=state.target_points[has_plan_position],
        sights=DrawnSights(
            recording.station[rows],
            new_index[recording.target[rows]],
            largest_residuals[rows],
            "largest normalised residual",
        ),
        target_covariances=np.nan_to_num(adjustment.target_covariances[has_plan_position]),
        target_corrections=target_changes,
    )
    return workshop_with_surroundings(network, recording.setup)


def workshop_from_recording(recording: Recording) -> WorkshopScene:
    """Scene of a recording adjusted with the instrument's parameters and the identified causes of a misfit.

    Arrows show the change of the adjusted targets that results from the estimation of these parameters.
    """
    selection = identify_causes(recording)
    ideal_adjustment = IdentifiedNetwork.from_cause_selection(recording, ideal_construction(), selection).adjustment
    construction = declared_construction(recording)
    try:
        adjustment_with_errors = IdentifiedNetwork.from_cause_selection(recording, construction, selection).adjustment
    except ConvergenceError:
        adjustment_with_errors = ideal_adjustment
    return workshop_from_adjustment(adjustment_with_errors, adjustment_without_parameters=ideal_adjustment)


def workshop_with_surroundings(scene: WorkshopScene, setup: Setup) -> WorkshopScene:
    """Scene of a network with floor, walls and gauge, in the frame of the floor plan if the set-up has one.

    The gauge is a group of reflectors at known distances.
    """
    floor_plan = FloorPlanTransform.from_positions(
        setup, scene.stations, scene.station_positions, scene.station_rotations
    )
    rotation, has_plan = floor_plan.rotation_to_plan, floor_plan.has_plan
    points, position = (
        floor_plan.positions_on_plan(scene.target_points),
        floor_plan.positions_on_plan(scene.station_positions),
    )
    nest_normals = _normals_of_nests(setup, scene.targets)
    lowest = float(np.concatenate([points, position])[:, 2].min())
    floor_height = (
        0.0 if has_plan and -0.05 < lowest < MAX_LOWEST_HEIGHT_WITH_FLOOR_AT_ZERO else float(points[:, 2].min())
    )
    wall_planes = _find_wall_planes(points, nest_normals) if has_plan else []
    instrument = next(iter(setup.instruments.values()), setup.instrument)
    lowest_elevation = (instrument.limits or ElevationLimits()).elevation_min_deg * DEGREE
    index_by_name = {name: i for i, name in enumerate(scene.targets)}
    lengths = setup.gauge.distance if setup.gauge else ()
    floor = _floor_rectangle(np.concatenate([points, position])[:, :2], wall_planes)
    return replace(
        scene,
        station_positions=position,
        station_rotations=rotation @ scene.station_rotations,
        target_points=points,
        nest_normals=np.where(_is_reaimed(setup, scene.targets)[:, None], np.nan, nest_normals),
        floor_corners=floor,
        floor_height=floor_height,
        wall_corners=_wall_corners(wall_planes, floor, floor_height, float(points[:, 2].max()) + 0.3),
        gauge_pairs=tuple(
            (index_by_name[g.from_], index_by_name[g.to])
            for g in lengths
            if g.from_ in index_by_name and g.to in index_by_name
        ),
        shadow_cone_opening=default_shadow_cone_opening(lowest_elevation),
        target_covariances=None
        if scene.target_covariances is None
        else rotation @ scene.target_covariances @ rotation.T,
        target_corrections=None if scene.target_corrections is None else scene.target_corrections @ rotation.T,
        notes=() if floor_height == 0.0 else ("the floor is assumed at the lowest target",),
    )


def _normals_of_nests(setup: Setup, targets: tuple[str, ...]) -> Floats:
    """Unit normals (T, 3) of the nests of T targets; NaN for a target without a declared normal."""
    nest_normals = [setup.targets[t].nest_normal if t in setup.targets else None for t in targets]
    normal = np.array([row or (np.nan, np.nan, np.nan) for row in nest_normals], dtype=np.float64).reshape(-1, 3)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _is_reaimed(setup: Setup, targets: tuple[str, ...]) -> Bools:
    """Mask (T,) of T targets: True for reflectors that are turned towards the station before each pointing."""
    return np.array([t not in setup.targets or setup.targets[t].reaimed for t in targets], dtype=bool)


def _find_wall_planes(points: Floats, nest_normals: Floats) -> list[tuple[int, float, float]]:
    """Vertical walls with at least four nests: each is an axis (0: x, 1: y), a sign, and a coordinate [m] on that axis.

    The sign is the direction from the wall into the hall. The nests face the hall, and no target is behind the wall.
    `points` and `nest_normals` are the coordinates and the unit normals of the nests.
    """
    planes = []
    for axis in range(2):
        for direction in (1.0, -1.0):
            depths = direction * points[:, axis]
            rearmost = float(depths.min())
            faces_hall = np.nan_to_num(direction * nest_normals[:, axis]) > MIN_WALL_NEST_NORMAL_COMPONENT
            if np.sum(faces_hall & (depths < rearmost + MAX_WALL_NEST_DEPTH_DIFFERENCE)) >= 4:
                planes.append((axis, direction, direction * (rearmost - 0.05)))
    return planes


def _floor_rectangle(positions: Floats, wall_planes: list[tuple[int, float, float]]) -> Floats:
    """Corners (4, 2) [m] of the axis-parallel rectangle around n positions (n, 2), with a margin where no wall is."""
    (x0, y0), (x1, y1) = positions.min(axis=0) - DRAWN_FLOOR_MARGIN, positions.max(axis=0) + DRAWN_FLOOR_MARGIN
    wall_by_direction = {(0, 1.0): x0, (0, -1.0): x1, (1, 1.0): y0, (1, -1.0): y1}
    wall_by_direction |= {(axis, side): place for axis, side, place in wall_planes}
    x0, x1, y0, y1 = (
        wall_by_direction[0, 1.0],
        wall_by_direction[0, -1.0],
        wall_by_direction[1, 1.0],
        wall_by_direction[1, -1.0],
    )
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _wall_corners(wall_planes: list[tuple[int, float, float]], floor: Floats, lower: float, upper: float) -> Floats:
    """Corners (W, 4, 3) [m] of W walls along the sides of the floor, between the heights `lower` and `upper`."""
    walls = np.zeros((len(wall_planes), 4, 3))
    for wall, (axis, _, place) in zip(walls, wall_planes, strict=True):
        begin, end = floor[:, 1 - axis].min(), floor[:, 1 - axis].max()
        wall[:, axis] = place
        wall[:, 1 - axis] = [begin, end, end, begin]
        wall[:, 2] = [lower, lower, upper, upper]
    return walls


def workshop_from_scenario(scenario: Scenario) -> WorkshopScene:
    """Scene of a scenario: stations, targets, walls, obstacles, and visible lines of sight.

    Raises
    ------
    InputError
        If the gauge (reflectors at known distances) or a CAD file of the scenario is invalid.
    """
    layout = planned_layout(scenario)
    visibility = make_visibility(scenario, layout)
    obstacles = make_obstacles(scenario)
    n_blocked = int((~visibility.is_visible).sum())
    notes = (f"{n_blocked} of {visibility.is_visible.size} lines of sight are blocked.",) if n_blocked else ()
    x, y, z = np.array(scenario.workshop.size_mm) * MILLIMETRE
    floor = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    gauge = range(len(scenario.targets), len(layout.target_names))
    return WorkshopScene(
        title=scenario.title,
        stations=layout.station_names,
        station_positions=layout.station_positions,
        station_rotations=layout.station_rotations,
        targets=layout.target_names,
        target_points=layout.target_points,
        nest_normals=np.where(layout.is_reaimed[:, None], np.nan, layout.nest_normals),
        floor_corners=floor,
        wall_corners=_wall_corners([(0, 1.0, 0.0), (1, 1.0, 0.0)], floor, 0.0, z),
        gauge_pairs=tuple((i, j) for i in gauge for j in gauge if i < j),
        shadow_cone_opening=max(
            make_sight_limits(scenario, tracker).shadow_cone_opening for tracker in scenario.trackers_in_use.values()
        ),
        sights=_visible_sights(layout, visibility),
        obstacle_triangles=np.zeros((0, 3, 3)) if obstacles is None else obstacles.triangles,
        blocked_sights=np.argwhere(visibility.reason_codes == InvisibilityReason.HIDDEN_BY_OBSTACLE),
        notes=notes,
    )


def workshop_with_cad(
    workshop: WorkshopScene, file: Path, unit: str | None = None, vertical_axis: str | None = None
) -> WorkshopScene:
    """Scene with the bodies of a CAD file; `unit` and `vertical_axis` override the convention of the file format.

    Raises
    ------
    InputError
        When the file cannot be read, or its size is implausible.
    """
    cad = read_cad_file(file, unit, vertical_axis)
    if asked := implausible_size_question(cad, np.ptp(workshop.floor_corners, axis=0)):
        raise InputError(asked)
    return replace(workshop, obstacle_triangles=np.concatenate([workshop.obstacle_triangles, cad.triangles]))


def _visible_sights(layout: WorkshopLayout, visibility: Visibility) -> DrawnSights:
    """Lines of sight that nothing blocks, with the elevation [deg] of the beam."""
    station, target = np.nonzero(visibility.is_visible)
    elevation = visibility.elevations[station, target] / DEGREE
    return DrawnSights(station.astype(np.int64), target.astype(np.int64), elevation, "elevation of the beam [°]")

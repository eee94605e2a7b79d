"""True positions of the stations and targets of a scenario, and its pointings; several trials can share them."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import InputError, reraise_as_input_error
from ltsim.core.limits import MAX_SIMULATED_POINTINGS
from ltsim.core.randomness import random_stream
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE
from ltsim.geometry.polar import to_polar
from ltsim.geometry.rigid import matrix_from_rotation_vector, rotation_about_z
from ltsim.physics.effects.effect import Effect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.reflectors import excess_radii_from_smr_names
from ltsim.scene.sightings import Sightings
from ltsim.scene.visibility import Visibility
from ltsim.simulation.physics import make_scenario_construction, scenario_effects
from ltsim.simulation.scenario import Scenario
from ltsim.simulation.workshop import WorkshopLayout, make_visibility, planned_layout

MAX_LISTED_HIDDEN_PAIRS = 20
"""Largest number of pairs of station and target without a line of sight that are listed individually; more pairs are
only counted."""
MIN_HEIGHT_LEVEL_SEPARATION = 0.5
"""Smallest gap [m] between the heights of targets that separates two height levels."""


@dataclass(frozen=True)
class MeasurementGeometry:
    """Scenario with the true positions of its stations and targets, and its pointings in the order of measurement.

    `simulator.measure_trial` draws instrument errors and noise for these pointings.
    """

    scenario: Scenario
    """Scenario that is simulated."""
    layout: WorkshopLayout
    """True poses of the stations and true positions of all targets, including targets that no station sees."""
    sightings: Sightings
    """Pointings to the visible targets at the true positions, with the readings of the air sensors as covariates."""
    effects: tuple[Effect, ...]
    """Effects of the scenario that change readings in addition to the instrument's errors."""
    hidden_pair_notes: tuple[str, ...]
    """Sentences on the pairs of station and target without a line of sight, with the reason for each pair. If there are
    more than `MAX_LISTED_HIDDEN_PAIRS` pairs, one sentence states the number of pairs for each reason."""

    @cached_property
    def construction(self) -> GeometricErrorModel:
        """Geometric error model of all trackers of the scenario."""
        return make_scenario_construction(self.scenario)


def make_measurement_geometry(
    scenario: Scenario, seed: int, *stream_key: str | int, plan: WorkshopLayout | None = None
) -> MeasurementGeometry:
    """Measurement geometry of a scenario: drawn true positions, and pointings to the visible targets in order.

    `plan` are the planned poses and targets of the scenario; None if they are not computed yet. `seed` and `stream_key`
    determine the random draws of the positions. InputError is raised if a station sees no target, a CAD file is
    damaged, or an effect does not exist. It is also raised if a nest without a declared normal holds an SMR whose
    radius differs from the reference radius.
    """
    layout = draw_true_layout(scenario, seed, *stream_key, plan=plan)
    table = make_visibility(scenario, layout)
    for s, name in enumerate(layout.station_names):
        if not table.is_visible[s].any():
            reason = table.reason_texts()[s][0]
            raise InputError(f"station {name} sees no reflector ({layout.target_names[0]} is {reason}); move {name}")
    sightings = _sightings_in_measurement_order(scenario, layout, table.is_visible, seed, *stream_key)
    sightings = replace(sightings, sight_vector_offsets=true_smr_offsets(scenario, sightings, seed, *stream_key))
    return MeasurementGeometry(
        scenario=scenario,
        layout=layout,
        sightings=sightings,
        effects=scenario_effects(scenario),
        hidden_pair_notes=_hidden_pair_notes(layout, table),
    )


def draw_true_layout(
    scenario: Scenario, seed: int, *stream_key: str | int, plan: WorkshopLayout | None = None
) -> WorkshopLayout:
    """True poses of stations and positions of targets: the plan with random deviations from the table `[placing]`.

    The gauge (reflectors at known distances) is displaced as a rigid body. `plan` are the planned poses and targets of
    the scenario; None if they are not computed yet. `seed` and `stream_key` determine the deviations.
    """
    plan, placing = plan or planned_layout(scenario), scenario.placing
    position, rotation, points = plan.station_positions.copy(), plan.station_rotations.copy(), plan.target_points.copy()
    draws = np.array(
        [random_stream(seed, *stream_key, "placing", "station", name).standard_normal(6) for name in scenario.stations]
    )
    levelled = [s.levelling_sigma_arcsec * ARCSECOND if s.levelled else None for s in scenario.stations.values()]
    tilt = [placing.tilt_deg * DEGREE if tilt_of_station is None else tilt_of_station for tilt_of_station in levelled]
    leans = matrix_from_rotation_vector(np.array([[t * d[3], t * d[4], 0.0] for t, d in zip(tilt, draws, strict=True)]))
    yaws = np.array([rotation_about_z(placing.yaw_deg * DEGREE * draw[5]) for draw in draws])
    position += placing.station_mm * MILLIMETRE * draws[:, :3]
    rotation = leans @ yaws @ rotation
    moves = [
        random_stream(seed, *stream_key, "placing", "target", name).standard_normal(3) for name in scenario.targets
    ]
    points[: len(moves)] += placing.target_mm * MILLIMETRE * np.array(moves).reshape(-1, 3)
    if scenario.gauge is not None:
        body = slice(len(scenario.targets), None)
        draw = random_stream(seed, *stream_key, "placing", "gauge").standard_normal(6)
        turn = matrix_from_rotation_vector(placing.yaw_deg * DEGREE * draw[3:])
        centre = points[body].mean(axis=0)
        points[body] = (points[body] - centre) @ turn.T + centre + placing.gauge_mm * MILLIMETRE * draw[:3]
    return replace(plan, station_positions=position, station_rotations=rotation, target_points=points)


def _hidden_pair_notes(workshop_layout: WorkshopLayout, visibility: Visibility) -> tuple[str, ...]:
    """Sentences on pairs of station and target without a line of sight; many pairs are only counted by reason."""
    lost = visibility.invisible_pair_sentences(workshop_layout.station_names, workshop_layout.target_names)
    if len(lost) <= MAX_LISTED_HIDDEN_PAIRS:
        return tuple(lost)
    reasons = Counter(reason for line in visibility.short_reason_texts() for reason in line if reason)
    counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    return (f"{len(lost)} of {visibility.is_visible.size} pairs of station and target have no line of sight: {counts}",)


def _sightings_in_measurement_order(
    scenario: Scenario, workshop_layout: WorkshopLayout, is_visible: Bools, seed: int, *stream_key: str | int
) -> Sightings:
    """Pointings, in the order of measurement, to all targets that at least one station sees.

    `is_visible` (stations, targets) is the mask of the visible targets. InputError is raised for more than
    `MAX_SIMULATED_POINTINGS` pointings.
    """
    n_pointings = int(is_visible.sum()) * scenario.work.faces * scenario.work.repeats
    if n_pointings > MAX_SIMULATED_POINTINGS:
        raise InputError(
            f"the scenario has {n_pointings} pointings, expected at most {MAX_SIMULATED_POINTINGS}: "
            "give fewer stations, targets or work.repeats"
        )
    pointed = np.flatnonzero(is_visible.any(axis=0))
    renumbered = np.full(len(workshop_layout.target_names), -1)
    renumbered[pointed] = np.arange(len(pointed))
    visits = [
        _setup_pointings(scenario, workshop_layout, s, is_visible[s], seed, *stream_key)
        for s in range(len(workshop_layout.station_names))
    ]
    station = np.repeat(np.arange(len(visits)), [len(visit) for visit in visits])
    target, face, repeat = np.concatenate(visits).T
    work = scenario.work
    spent = [np.append(np.full(len(v), work.seconds_per_pointing), 60.0 * work.minutes_per_move) for v in visits]
    time = np.concatenate([[0.0], np.cumsum(np.concatenate(spent))])[np.arange(len(station)) + station]
    index = {name: i for i, name in enumerate(scenario.trackers_in_use)}
    of_station = np.array([index[s.instrument or ""] for s in scenario.stations.values()], dtype=np.int64)
    return Sightings(
        station=station,
        target=renumbered[target],
        instrument=of_station[station],
        face=face,
        repeat=repeat,
        time=time,
        station_positions=workshop_layout.station_positions,
        station_rotations=workshop_layout.station_rotations,
        target_points=workshop_layout.target_points[pointed],
        nest_normals=workshop_layout.nest_normals[pointed],
        is_reaimed=workshop_layout.is_reaimed[pointed],
        station_names=workshop_layout.station_names,
        target_names=tuple(workshop_layout.target_names[k] for k in pointed),
        covariates=_air_sensor_readings(scenario, time),
    )


def _setup_pointings(
    scenario: Scenario,
    workshop_layout: WorkshopLayout,
    station: int,
    is_visible: Bools,
    seed: int,
    *stream_key: str | int,
) -> Ints:
    """Target index, face and repeat of each pointing from one station, shape (pointings, 3), in measurement order.

    `station` is the index of the station, `is_visible` (stations, targets) the mask of the visible targets.
    """
    work = scenario.work
    faces, pointings = np.arange(1, work.faces + 1), []
    for repeat in range(1, work.repeats + 1):
        order = _target_order(scenario, workshop_layout, station, repeat, seed, *stream_key)
        order = order[is_visible[order]]
        if work.face_order == "per-target":
            pair = np.repeat(order, len(faces)), np.tile(faces, len(order))
        else:
            pair = np.tile(order, len(faces)), np.repeat(faces, len(order))
        pointings.append(np.stack([*pair, np.full(len(pair[0]), repeat)], axis=1))
    return np.concatenate(pointings)


def _target_order(
    scenario: Scenario,
    workshop_layout: WorkshopLayout,
    station: int,
    repeat_number: int,
    seed: int,
    *stream_key: str | int,
) -> Ints:
    """Indices of the targets in the order in which a station measures them in round `repeat_number`.

    `seed` and `stream_key` determine a random order.
    """
    n_targets = len(workshop_layout.target_names)
    if scenario.work.order == "as-listed":
        return np.arange(n_targets)
    if scenario.work.order == "level-by-level":
        azimuth = to_polar(workshop_layout.target_points - workshop_layout.station_positions[station])[:, 1]
        levels = _height_levels(workshop_layout.target_points[:, 2])
        return np.lexsort((azimuth, levels))
    draw = random_stream(seed, *stream_key, "order", workshop_layout.station_names[station], repeat_number)
    return draw.permutation(n_targets)


def _height_levels(heights: Floats) -> Floats:
    """Number of the height level of each target, shape (targets,); 0 is the highest level."""
    down = np.argsort(-heights, kind="stable")
    steps = np.concatenate([[0.0], -np.diff(heights[down]) > MIN_HEIGHT_LEVEL_SEPARATION])
    levels = np.zeros(len(heights))
    levels[down] = np.cumsum(steps)
    return levels


def _air_sensor_readings(scenario: Scenario, time: Floats) -> dict[str, Floats]:
    """Readings [deg C, hPa, %] of the air sensors at the times `time` [s], by column name, rounded to 0.1."""
    hall = scenario.workshop
    temperature = hall.temperature_c + hall.temperature_rise_c_per_h * time / 3600.0
    return {
        "air_temperature_c": np.round(temperature, 1),
        "air_pressure_hpa": np.full(len(time), round(hall.pressure_hpa, 1)),
        "relative_humidity_pct": np.full(len(time), round(hall.humidity_pct, 1)),
    }


def smr_names_of_pointings(scenario: Scenario, sightings: Sightings) -> tuple[str, ...]:
    """Name of the SMR in each pointing, from station, target or table `[smr]`; '' for an SMR without a name."""
    stations = [scenario.stations[name].reflector for name in sightings.station_names]
    targets = [scenario.targets[n].reflector if n in scenario.targets else None for n in sightings.target_names]
    places = zip(sightings.station, sightings.target, strict=True)
    return tuple(stations[s] or targets[t] or scenario.smr.reflector or "" for s, t in places)


def true_smr_offsets(scenario: Scenario, sightings: Sightings, seed: int, *stream_key: str | int) -> Floats | None:
    """Vector from target to SMR centre in each pointing, (pointings, 3) [m]; None without declared SMR radii.

    InputError is raised for an SMR without a table `[reflectors.NAME]`, and for a missing reference radius. It is also
    raised if a nest without a declared normal holds an SMR whose radius differs from the reference radius.
    """
    reflectors = scenario.reflectors
    if not reflectors:
        return None
    names = smr_names_of_pointings(scenario, sightings)
    if "" in names:
        target = sightings.target_names[sightings.target[names.index("")]]
        raise InputError(
            f"targets.{target}.reflector is missing: name one of the tables [reflectors.NAME] here, in every station "
            "or in [smr]"
        )
    aimed = np.isfinite(sightings.nest_normals[:, 0])
    targets = [sightings.target_names[t] for t in sightings.target]
    targets_without_normal = [
        name for name, has_normal in zip(sightings.target_names, aimed, strict=True) if not has_normal
    ]
    with reraise_as_input_error():
        lengths = excess_radii_from_smr_names(
            names, targets, targets_without_normal, reflectors, scenario.reference_radius_mm
        )
    for name in dict.fromkeys(names):
        error = (reflectors[name].sigma_radius_mm or 0.0) * random_stream(
            seed, *stream_key, "reflector", name
        ).standard_normal()
        lengths[np.array(names) == name] += error * MILLIMETRE
    return lengths[:, None] * np.nan_to_num(sightings.nest_normals)[sightings.target]

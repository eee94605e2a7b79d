"""Forward model: readings predicted from the unknowns of a network, its instruments and effects, with derivatives."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.units import EARTH_RADIUS, MILLIMETRE
from ltsim.geometry.rigid import pose_jacobian
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.smr_incidence import SmrIncidence
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.declared_plan import DeclaredPlan
from ltsim.physics.model.incidence import IncidenceErrors, incidence_errors, incidence_reading_change
from ltsim.physics.model.nuisances import (
    CentringErrors,
    HeightErrors,
    centring_errors,
    height_errors,
    refraction_unknowns,
    shared_errors,
)
from ltsim.physics.model.state import NetworkState as NetworkState, Prediction as Prediction
from ltsim.recordings.recording import Recording
from ltsim.recordings.reflectors import excess_radii
from ltsim.scene.sightings import Sightings


def sightings_at_state(recording: Recording, state: NetworkState) -> Sightings:
    """Sightings of a recording, with the poses of the stations and the coordinates of the targets in `state`.

    Nest normals are transformed from the floor plan to the network frame.
    """
    plan = DeclaredPlan.from_recording(recording)
    return _sightings_with_rotated_nests(
        recording, state, plan.rotation_to_network(state.station_positions, state.station_rotations)
    )


def _sightings_with_rotated_nests(recording: Recording, state: NetworkState, nest_rotation: Floats) -> Sightings:
    """Sightings for poses and coordinates in `state`, with nest normals rotated by `nest_rotation` (3, 3)."""
    return Sightings(
        station=recording.station,
        target=recording.target,
        instrument=recording.instrument,
        face=recording.face,
        repeat=recording.repeat,
        time=recording.time,
        station_positions=state.station_positions,
        station_rotations=state.station_rotations,
        target_points=state.target_points,
        nest_normals=_nest_normals(recording) @ nest_rotation.T,
        is_reaimed=np.array([recording.target_setup(name).reaimed for name in recording.targets], dtype=bool),
        station_names=recording.stations,
        target_names=recording.targets,
        covariates=recording.regressor_covariates,
        sight_vector_offsets=sight_vector_offsets(recording),
    )


def _nest_normals(recording: Recording) -> Floats:
    """Declared normals (T, 3) of the nests of T targets, in the frame of the floor plan; NaN for an unknown normal."""
    missing = (np.nan, np.nan, np.nan)
    return _unit_vectors([recording.target_setup(name).nest_normal or missing for name in recording.targets])


def plumb_directions(recording: Recording) -> Floats:
    """Unit vectors (S, 3) upward along the plumb lines at the S stations, in the network frame."""
    return _unit_vectors([recording.station_setup(name).vertical or (0.0, 0.0, 1.0) for name in recording.stations])


def with_spherical_earth_plumb_lines(recording: Recording, station_positions: Floats) -> Recording:
    """Copy of a recording whose levelled stations have the plumb lines of a spherical earth.

    If the set-up does not declare `curved`, the recording itself is returned. `station_positions` (S, 3) [m] are the
    positions of the S stations. Declared plumb lines are not replaced.
    """
    if not recording.setup.curved:
        return recording
    stations = dict(recording.setup.stations)
    lean = (station_positions - station_positions.mean(axis=0))[:, :2] / EARTH_RADIUS
    for name, (x, y) in zip(recording.stations, lean.tolist(), strict=True):
        station = recording.station_setup(name)
        if station.levelled and station.vertical is None:
            stations[name] = station.model_copy(update={"vertical": (x, y, 1.0)})
    return recording.replace(setup=recording.setup.model_copy(update={"stations": stations}))


def _unit_vectors(directions: list[tuple[float, float, float]]) -> Floats:
    """Unit vectors (n, 3) in the n given directions (n, 3)."""
    vectors = np.array(directions, dtype=np.float64).reshape(-1, 3)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def sight_vector_offsets(recording: Recording) -> Floats | None:
    """Offsets (n, 3) [m] of the reflector from the ground mark of its target in n pointings, network frame.

    They are added to the vector from station to target; None if all are 0. The height of the instrument above its
    ground mark, as declared for the set-up, is part of the station's position. If a pointing has another instrument
    height, the difference is subtracted from the offset.
    """
    instrument, target = recording.heights_above_marks()
    setup_heights = [recording.station_setup(name).instrument_height_mm * MILLIMETRE for name in recording.stations]
    height = target - (instrument - np.array(setup_heights)[recording.station])
    height_offset = height[:, None] * plumb_directions(recording)[recording.station] if np.any(height) else None
    radius_offset = smr_radius_offsets(recording)
    return (
        radius_offset
        if height_offset is None
        else height_offset
        if radius_offset is None
        else height_offset + radius_offset
    )


def smr_radius_offsets(recording: Recording) -> Floats | None:
    """Offsets (n, 3) [m] of the reflector in n pointings because of an SMR with another radius than the reference SMR.

    The offset is along the normal of the nest, in the frame of the set-up. The result is None if all radii are equal.
    `adjust` refuses a network in another frame than the set-up.
    """
    excess = excess_radii(recording)
    return None if excess is None else excess[:, None] * np.nan_to_num(_nest_normals(recording))[recording.target]


class PredictionCache:
    """Cache of the predicted readings for the unknowns for which they were last computed."""

    def __init__(self) -> None:
        self._state: NetworkState | None = None
        self._readings: Floats = np.zeros((0, 3))

    def readings_at_state(self, state: NetworkState, compute_readings: Callable[[NetworkState], Floats]) -> Floats:
        """Copy of the readings (n, 3) predicted for `state`; they are not computed again for the same object."""
        if state is not self._state:
            self._state, self._readings = state, compute_readings(state)
        return self._readings.copy()


@dataclass(frozen=True)
class MeasurementModel:
    """Forward model of a recording, with the geometric error model of its instruments and with effects."""

    recording: Recording
    """Recording with the pointings and the declared set-up."""
    construction: GeometricErrorModel
    """Geometric error model of all instruments."""
    effects: tuple[LinearEffect, ...] = ()
    """Effects whose parameters are unknowns, in addition to instrument parameters and nuisance errors."""
    prediction_cache: PredictionCache = field(default_factory=PredictionCache, init=False, repr=False, compare=False)
    """Cache of the readings of the last call of `predict`, which several tests need for the adjusted unknowns."""

    @cached_property
    def height_errors(self) -> tuple[HeightErrors, ...]:
        """Errors of the heights of instruments and reflectors; none if the set-up does not declare their sigma."""
        return height_errors(self.recording, plumb_directions(self.recording))

    @cached_property
    def incidence_errors(self) -> tuple[IncidenceErrors, ...]:
        """Incidence errors of reflectors in fixed nests; none if `effects` contain incidence errors."""
        free = any(isinstance(effect, SmrIncidence) and not effect.place_text for effect in self.effects)
        return () if free or not self._declared_plan.determines_rotation else incidence_errors(self.recording)

    @property
    def incidence_parameter_slices(self) -> tuple[slice, ...]:
        """Slices of the parameters of each of `incidence_errors` in the vector of effect and nuisance parameters."""
        first_column = self.n_effect_parameters + sum(len(heads.parameters) for heads in self.height_errors)
        boundaries = first_column + np.cumsum([0, *(len(error.parameters) for error in self.incidence_errors)])
        return tuple(slice(int(begin), int(end)) for begin, end in itertools.pairwise(boundaries))

    def incidence_parameters_by_reflector(self, parameters: Floats) -> dict[str, Floats]:
        """Parameters (p, ...) [SI] of the effect `smr-incidence` by the name of the reflector.

        `parameters` (q, ...) are the values of all q parameters of effects and nuisance errors.
        """
        columns = zip(self.incidence_errors, self.incidence_parameter_slices, strict=True)
        return {error.reflector: error.smr_incidence_parameters(parameters[at]) for error, at in columns}

    @cached_property
    def centring_errors(self) -> tuple[CentringErrors, ...]:
        """Centring errors that the set-up declares; their parameters follow those of all other nuisance errors."""
        return centring_errors(self.recording)

    @property
    def centring_parameter_slices(self) -> tuple[slice, ...]:
        """Slices of the parameters of each of `centring_errors` in the vector of effect and nuisance parameters."""
        n_parameters = [len(errors.parameters) for errors in self.centring_errors]
        boundaries = self.n_extra_parameters - sum(n_parameters) + np.cumsum([0, *n_parameters])
        return tuple(slice(int(begin), int(end)) for begin, end in itertools.pairwise(boundaries))

    @cached_property
    def nuisance_errors(self) -> tuple[LinearEffect, ...]:
        """Nuisance errors with a prior: heights, incidence on reflectors, shared errors, refraction, centring."""
        return (
            *self.height_errors,
            *self.incidence_errors,
            *shared_errors(self.recording),
            *refraction_unknowns(self.recording),
            *self.centring_errors,
        )

    @property
    def effects_and_nuisance_errors(self) -> tuple[LinearEffect, ...]:
        """Effects, followed by the nuisance errors with a prior; their q parameters are the additional parameters."""
        return *self.effects, *self.nuisance_errors

    @property
    def n_extra_parameters(self) -> int:
        """Number q of additional parameters: parameters of `effects` and of the nuisance errors."""
        return sum(len(effect.parameters) for effect in self.effects_and_nuisance_errors)

    @property
    def n_effect_parameters(self) -> int:
        """Number of parameters of `effects`. In the vector of all effect and nuisance parameters they come first."""
        return sum(len(effect.parameters) for effect in self.effects)

    def _instrument_parameter_values(self, state: NetworkState) -> Floats:
        """Values [SI] in `state` of the p instrument parameters, (p,), or by pointing (n, p) for several trackers."""
        if len(state.instrument_parameters) == 1:
            return state.instrument_parameters[0]
        return state.instrument_parameters[self.recording.instrument]

    @cached_property
    def _declared_plan(self) -> DeclaredPlan:
        """Floor plan that the set-up declares."""
        return DeclaredPlan.from_recording(self.recording)

    @cached_property
    def _static_sightings(self) -> Sightings:
        """Sightings without poses and coordinates, computed once; nest normals are in the frame of the floor plan."""
        stations, targets = len(self.recording.stations), len(self.recording.targets)
        none = np.zeros((stations, 3)), np.tile(np.eye(3), (stations, 1, 1)), np.zeros((targets, 3))
        return _sightings_with_rotated_nests(self.recording, NetworkState(*none, np.zeros((0, 0))), np.eye(3))

    @cached_property
    def _is_horizontal_distance(self) -> Bools | None:
        """Mask (n,) of the pointings whose distance is horizontal; None if all are slope distances."""
        flat = self.recording.is_horizontal_distance
        return flat if flat.any() else None

    def sightings(self, state: NetworkState) -> Sightings:
        """Sightings of the pointings for the poses, coordinates and instrument parameters in `state`."""
        geometry = self.sightings_without_covariates(state)
        return self._with_normals_and_readings(geometry, state, self._instrument_readings(geometry, state))

    def _with_normals_and_readings(self, geometry: Sightings, state: NetworkState, readings: Floats) -> Sightings:
        """Sightings `geometry` completed by nest normals in the network frame and by raw readings (n, 3)."""
        turn = self._declared_plan.rotation_to_network(state.station_positions, state.station_rotations)
        return replace(geometry, nest_normals=geometry.nest_normals @ turn.T, encoder_readings=readings)

    def _instrument_readings(self, geometry: Sightings, state: NetworkState) -> Floats:
        """Raw readings (n, 3) of n pointings with instrument errors, without effects and nuisance errors."""
        return self.construction.readings_from_points(
            geometry.local_points, geometry.face, self._instrument_parameter_values(state)
        )

    def sightings_without_covariates(self, state: NetworkState) -> Sightings:
        """Sightings for the poses and coordinates in `state`, without the data that only effects need."""
        return self._static_sightings.with_geometry(
            state.station_positions, state.station_rotations, state.target_points
        )

    def extra_design(self, sightings: Sightings) -> Floats:
        """Derivatives (n, 3, q) of n readings with respect to the q parameters of effects and nuisance errors."""
        if not self.effects_and_nuisance_errors:
            return np.zeros((len(sightings), 3, 0))
        return np.concatenate([effect.design(sightings) for effect in self.effects_and_nuisance_errors], axis=2)

    def change_by_extra_parameters(self, sightings: Sightings, parameters: Floats) -> Floats:
        """Change (n, 3) of n readings by effects and nuisance errors, for the values (q,) [SI] of their parameters."""
        return self._linear_effects_change(self.effects_and_nuisance_errors, sightings, parameters)

    def change_by_effects(self, sightings: Sightings, parameters: Floats) -> Floats:
        """Change (n, 3) of the readings of n pointings by `effects`; `parameters` (q,) [SI] include nuisance errors."""
        return self._linear_effects_change(self.effects, sightings, parameters)

    def change_by_incidence_errors(self, sightings: Sightings, parameters: Floats) -> Floats:
        """Change (n, 3) of the readings of n pointings by incidence errors; `parameters` (q,) include effects."""
        return incidence_reading_change(self.recording, sightings, self.incidence_parameters_by_reflector(parameters))

    def _linear_effects_change(
        self, linear_effects: tuple[LinearEffect, ...], sightings: Sightings, parameters: Floats
    ) -> Floats:
        """Change (n, 3) of the readings of n pointings by `linear_effects`.

        The `linear_effects` must be the first of `effects_and_nuisance_errors`. `parameters` (q,) are the values of all
        q parameters of effects and nuisance errors.
        """
        change = np.zeros((len(sightings), 3))
        for linear_effect, values in zip(linear_effects, self._values_by_effect(parameters), strict=False):
            change += linear_effect.reading_change(sightings, values)
        return change

    def predict(self, state: NetworkState) -> Floats:
        """Predicted raw readings (n, 3) [m, rad, rad] of n pointings for the unknowns in `state`."""
        return self.prediction_cache.readings_at_state(state, self._predicted_readings)

    def _predicted_readings(self, state: NetworkState) -> Floats:
        """Predicted raw readings (n, 3) of n pointings for the unknowns in `state`, without the cache."""
        sightings = self.sightings_without_covariates(state)
        raw_readings = self._instrument_readings(sightings, state)
        if self.effects_and_nuisance_errors:
            sightings = self._with_normals_and_readings(sightings, state, raw_readings)
            raw_readings = raw_readings + self.change_by_extra_parameters(sightings, state.extra_parameters)
        if self._is_horizontal_distance is not None:
            raw_readings[self._is_horizontal_distance, 0] *= np.abs(
                np.cos(raw_readings[self._is_horizontal_distance, 2])
            )
        return raw_readings

    def _values_by_effect(self, parameters: Floats) -> list[Floats]:
        """Parameter values of each of `effects_and_nuisance_errors`; values that `parameters` lacks are zero."""
        n_parameters = [len(effect.parameters) for effect in self.effects_and_nuisance_errors]
        all_values = np.pad(parameters, (0, sum(n_parameters) - len(parameters)))
        return np.split(all_values, np.cumsum(n_parameters)[:-1]) if n_parameters else []

    def linearise(self, state: NetworkState) -> Prediction:
        """Predicted readings for the unknowns in `state`, and their derivatives with respect to all unknowns."""
        sightings = self.sightings_without_covariates(state)
        values = self._instrument_parameter_values(state)
        raw, by_point, by_instrument = self.construction.readings_and_design(
            sightings.local_points, sightings.face, values
        )
        if self.effects_and_nuisance_errors:
            sightings = self._with_normals_and_readings(sightings, state, raw)
        by_target = by_point @ np.swapaxes(state.station_rotations, 1, 2)[sightings.station]
        by_pose = pose_jacobian(by_target, sightings.sight_vectors)
        by_extra = np.zeros((len(sightings), 3, 0))
        if self.effects_and_nuisance_errors:
            extra = zip(self.effects_and_nuisance_errors, self._values_by_effect(state.extra_parameters), strict=True)
            parts = [effect.linearise(sightings, values) for effect, values in extra]
            raw = raw + np.sum([part.reading_change for part in parts], axis=0)
            by_extra = np.concatenate([part.parameter_derivatives for part in parts], axis=2)
            for further in (part.geometry_derivatives for part in parts if part.geometry_derivatives is not None):
                by_target, by_pose = by_target + further[0], by_pose + further[1]
        derivatives = by_pose, by_target, by_instrument, by_extra
        if self._is_horizontal_distance is not None:
            reduce_to_horizontal(raw, derivatives, self._is_horizontal_distance)
        return Prediction(raw, *derivatives)


def reduce_to_horizontal(readings: Floats, derivatives: tuple[Floats, ...], is_horizontal_distance: Bools) -> None:
    """Reduction, in place, of slope distances and their derivatives to horizontal distances.

    `is_horizontal_distance` (n,) flags those of n pointings that are reduced. `readings` (n, 3) and each derivative (n,
    3, k) with respect to k unknowns are changed.
    """
    range_, level = readings[is_horizontal_distance, 0], readings[is_horizontal_distance, 2]
    cosine = np.cos(level)
    sign = np.sign(cosine)
    for by in derivatives:
        by[is_horizontal_distance, 0] = (sign * cosine)[:, None] * by[is_horizontal_distance, 0] - (
            sign * range_ * np.sin(level)
        )[:, None] * by[is_horizontal_distance, 2]
    readings[is_horizontal_distance, 0] = range_ * np.abs(cosine)

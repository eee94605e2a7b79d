"""Planned survey: positions of stations and targets, order of the pointings, and duration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints, as_finite_floats
from ltsim.core.errors import InputError
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import rotation_about_z
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.recording import OBSERVABLES, Recording, reading_sigmas_from_noise
from ltsim.recordings.setup import Setup, Station
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class PlannedSurvey:
    """Planned survey of T targets from S upright stations: layout, measuring procedure and instrument."""

    setup: Setup
    """Set-up of the survey as in a recording: noise, priors, gauge (reflectors at known distances), nests."""
    station_names: tuple[str, ...]
    """Names of the S stations, in the order of measurement."""
    target_names: tuple[str, ...]
    """Names of the T targets."""
    station_positions: Floats
    """Position (S, 3) [m] of the centre of the instrument at each of S stations."""
    station_yaws: Floats
    """Yaw (direction of azimuth zero, counter-clockwise from x) at each of S stations, (S,) [rad]."""
    target_points: Floats
    """Coordinates (T, 3) [m] of the T targets."""
    is_visible: Bools
    """Flags (S, T): True where one of S stations measures one of T targets."""
    faces: tuple[int, ...] = (1, 2)
    """Faces in which each target is measured: (1,), (2,) or (1, 2)."""
    repeats: int = 1
    """Number of rounds: pointings to each target in each face."""
    seconds_per_pointing: float = 10.0
    """Time [s] from one pointing to the next."""
    seconds_per_move: float = 1200.0
    """Time [s] to move the instrument and set it up, per station."""
    target_ranks: Ints | None = None
    """Rank (S, T) of each of T targets in the order of measurement at each of S stations; None for the order of
    `target_names`."""
    measures_face_by_face: bool = True
    """True if a station measures all targets in one face and then all in the other; False if it measures both faces of
    a target in succession."""
    observables: tuple[str, ...] = OBSERVABLES
    """Names of the observables of each pointing: range and both angles, or the range alone."""
    target_weights: Mapping[str, float] = field(default_factory=dict)
    """Weight of each squared point error, by name of the target, in the weighted root mean square; default 1."""

    air: AirUncertainty | None = None
    """Uncertainty of the air that a search includes; None if all lines of sight are so short that it is neglected.
    Final results use the uncertainty of the air in `setup`."""

    def __post_init__(self) -> None:
        stations, targets = len(self.station_names), len(self.target_names)
        as_finite_floats(self.station_positions, (stations, 3), "position")
        as_finite_floats(self.station_yaws, (stations,), "yaw")
        as_finite_floats(self.target_points, (targets, 3), "points")
        if self.is_visible.shape != (stations, targets):
            entries = " x ".join(map(str, self.is_visible.shape))
            raise InputError(f"the table of visibility has {entries} entries, expected {stations} x {targets}")
        if not set(self.faces) <= {1, 2} or not self.faces or len(set(self.faces)) < len(self.faces):
            raise InputError(f"faces are {list(self.faces)}, expected [1], [2] or [1, 2]")

    def noise_sigmas(self, sightings: Sightings) -> Floats:
        """Standard deviations (n, 3) of range [m], azimuth and elevation [rad] of n pointings by the declared noise.

        Effects of the air are not included.
        """
        nominal = [self.setup.instrument.noise]
        return reading_sigmas_from_noise(nominal, sightings.instrument, sightings.range_, sightings.elevation)

    @property
    def n_pointings(self) -> int:
        """Number of pointings of the whole measurement."""
        return int(self.is_visible.sum()) * len(self.faces) * self.repeats

    @property
    def duration(self) -> float:
        """Duration [s] of the whole measurement: set-up and pointings of every station."""
        return self.n_pointings * self.seconds_per_pointing + len(self.station_positions) * self.seconds_per_move

    @property
    def extent_text(self) -> str:
        """Text with the numbers of stations, reflectors, faces, rounds and pointings, and with the duration."""
        faces = "both faces" if len(self.faces) == 2 else f"face {self.faces[0]}"
        rounds = "once" if self.repeats == 1 else f"{self.repeats} times"
        return (
            f"{len(self.station_positions)} stations, {len(self.target_points)} reflectors, {faces}, "
            f"{rounds}: {self.n_pointings} "
            f"pointings in {self.duration / 3600:.1f} h"
        )

    @property
    def is_recorded_observable(self) -> Bools:
        """Flags (3,): True for each observable (range, azimuth, elevation) that is recorded."""
        return np.array([name in self.observables for name in OBSERVABLES])

    @property
    def records_angles(self) -> bool:
        """True if range and both angles are recorded; False for ranges alone."""
        return bool(self.is_recorded_observable.all())

    @property
    def normalised_target_weights(self) -> Floats:
        """Weight (T,) of each of T squared point errors in the mean over the targets; the mean weight is 1."""
        weight = np.array([self.target_weights.get(name, 1.0) for name in self.target_names], dtype=np.float64)
        return weight / weight.mean() if weight.any() else np.ones_like(weight)

    @property
    def station_rotations(self) -> Floats:
        """Rotation (S, 3, 3) from the instrument frame to the network frame, for each of S stations."""
        return np.stack([rotation_about_z(float(yaw)) for yaw in self.station_yaws])

    def nominal_state(self, construction: GeometricErrorModel) -> NetworkState:
        """Poses, target coordinates and parameters of the network for a perfect instrument at the planned positions.

        Parameters of the instrument (error model `construction`) and of reflectors are zero.
        """
        empty = self._empty_recording()
        zero_errors = np.zeros((len(empty.instruments), construction.n_parameters))
        errors = np.zeros(MeasurementModel(empty, construction).n_extra_parameters)
        return NetworkState(self.station_positions, self.station_rotations, self.target_points, zero_errors, errors)

    def noise_free_recording(self, construction: GeometricErrorModel) -> Recording:
        """Recording of all planned pointings by a perfect instrument without noise.

        Rows are in the order of measurement, station by station. A round is a complete measurement of all targets from
        a station.
        """
        empty = self._empty_recording()
        readings = MeasurementModel(empty, construction).predict(self.nominal_state(construction))
        readings[:, ~self.is_recorded_observable] = np.nan
        return empty.with_readings(readings)

    def pointing_ranks(self, station: Ints, target: Ints, face: Ints) -> Ints:
        """Rank (n,), from 0, of each of n pointings in the first round of its station.

        Each pointing is given by the indices `station` (n,) and `target` (n,) and by its face `face` (n,).
        """
        rank = target if self.target_ranks is None else self.target_ranks[station, target]
        face_ranks = np.searchsorted(np.sort(self.faces), face)
        if self.measures_face_by_face:
            return np.asarray(face_ranks * len(self.target_points) + rank)
        return np.asarray(rank * len(self.faces) + face_ranks)

    @property
    def _placed_setup(self) -> Setup:
        """Set-up that declares the planned positions and yaws of the stations, towards which nests are aimed."""
        places = zip(
            self.station_names,
            (self.station_positions / MILLIMETRE).tolist(),
            np.degrees(self.station_yaws).tolist(),
            strict=True,
        )
        station_by_name = {
            name: self.setup.stations.get(name, Station()).model_copy(update={"position_mm": tuple(p), "yaw_deg": yaw})
            for name, p, yaw in places
        }
        return self.setup.model_copy(update={"stations": station_by_name})

    def _empty_recording(self) -> Recording:
        """Recording of the planned pointings in the order of measurement, with NaN for all readings."""
        rounds, faces = np.arange(1, self.repeats + 1), np.sort(self.faces)
        axes = np.arange(len(self.station_positions)), rounds, faces, np.arange(len(self.target_points))
        station, repeat, face, target = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        order = np.lexsort((self.pointing_ranks(station, target, face), repeat, station))
        order = order[self.is_visible[station[order], target[order]]]
        station, repeat, face, target = (axis[order].astype(np.int64) for axis in (station, repeat, face, target))
        return Recording(
            setup=self._placed_setup,
            stations=self.station_names,
            targets=self.target_names,
            station=station,
            target=target,
            face=face,
            repeat=repeat,
            time=np.arange(len(station)) * self.seconds_per_pointing + station * self.seconds_per_move,
            readings=np.full((len(station), 3), np.nan),
        )

    def without_station(self, station: int) -> PlannedSurvey:
        """Survey without the station with the index `station`."""
        keep = np.arange(len(self.station_positions)) != station
        return self.replace(
            station_names=tuple(n for n, k in zip(self.station_names, keep, strict=True) if k),
            station_positions=self.station_positions[keep],
            station_yaws=self.station_yaws[keep],
            is_visible=self.is_visible[keep],
            target_ranks=None if self.target_ranks is None else self.target_ranks[keep],
        )

    def with_targets_only(self, is_selected: Bools) -> PlannedSurvey:
        """Survey that measures only those of the T targets that `is_selected` (T,) flags."""
        if is_selected.all():
            return self
        return self.replace(
            target_names=tuple(n for n, k in zip(self.target_names, is_selected, strict=True) if k),
            target_points=self.target_points[is_selected],
            is_visible=self.is_visible[:, is_selected],
            target_ranks=None
            if self.target_ranks is None
            else np.argsort(np.argsort(self.target_ranks[:, is_selected], axis=1), axis=1),
        )

    def replace(self, **changes: Any) -> PlannedSurvey:
        """Copy of the survey in which `changes` replace the fields with these names."""
        return replace(self, **changes)

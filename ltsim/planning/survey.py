"""Planned survey: positions of stations and targets, pointings and their cost, before measurement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints, as_floats
from ltsim.core.errors import SetupError
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rotations import about_z
from ltsim.physics.model.construction import Construction
from ltsim.physics.model.measurement import MeasurementModel, NetworkState
from ltsim.recordings.air import Air
from ltsim.recordings.recording import OBSERVABLES, Recording, noise_sigma
from ltsim.recordings.setup import Setup, Station
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class Survey:
    """Survey with upright stations, targets, and the pointings between them."""

    setup: Setup
    """Set-up of the survey: noise, priors, gauge, nests, as in a recording."""
    station_names: tuple[str, ...]
    target_names: tuple[str, ...]
    position: Floats
    """Centre of each instrument, (S, 3) [m]."""
    yaw: Floats
    """Yaw of each instrument, (S,) [rad]."""
    points: Floats
    """Coordinates of the targets, (T, 3) [m]."""
    visible: Bools
    """Flags (S, T) of the targets that each station measures."""
    faces: tuple[int, ...] = (1, 2)
    """Faces that are measured: 1, 2 or both."""
    repeats: int = 1
    """Number of pointings to each target on each face."""
    seconds_per_pointing: float = 10.0
    seconds_per_move: float = 1200.0
    """Time [s] to move the instrument and set it up, per station."""
    rank: Ints | None = None
    """Rank of each target in each station's visit, (S, T); default as listed."""
    face_by_face: bool = True
    """True if all targets are measured on one face and then on the other; False if both faces of each target follow
    each other.
    """
    observables: tuple[str, ...] = OBSERVABLES
    """Observables of each pointing: range and both angles, or the range alone."""
    importance: Mapping[str, float] = field(default_factory=dict)
    """Weight of targets by name in the root mean square of point errors; default 1."""

    air: Air | None = None
    """Air that a search includes; None if no line of sight can be long enough. Final results use that of the set-up."""

    def __post_init__(self) -> None:
        stations, targets = len(self.station_names), len(self.target_names)
        as_floats(self.position, (stations, 3), "position")
        as_floats(self.yaw, (stations,), "yaw")
        as_floats(self.points, (targets, 3), "points")
        if self.visible.shape != (stations, targets):
            entries = " x ".join(map(str, self.visible.shape))
            raise SetupError(f"the table of visibility has {entries} entries, expected {stations} x {targets}")
        if not set(self.faces) <= {1, 2} or not self.faces or len(set(self.faces)) < len(self.faces):
            raise SetupError(f"faces are {list(self.faces)}, expected [1], [2] or [1, 2]")

    def noise(self, sightings: Sightings) -> Floats:
        """Nominal standard deviations (n, 3) [m, rad, rad] of the readings, without the air."""
        nominal = [self.setup.instrument.noise]
        return noise_sigma(nominal, sightings.instrument, sightings.range_, sightings.elevation)

    @property
    def pointings(self) -> int:
        """Number of pointings n."""
        return int(self.visible.sum()) * len(self.faces) * self.repeats

    @property
    def seconds(self) -> float:
        """Duration [s] of the whole measurement: set-up and pointings of every station."""
        return self.pointings * self.seconds_per_pointing + len(self.position) * self.seconds_per_move

    @property
    def words(self) -> str:
        """Text of extent and duration of the measurement, in one line."""
        faces = "both faces" if len(self.faces) == 2 else f"face {self.faces[0]}"
        rounds = "once" if self.repeats == 1 else f"{self.repeats} times"
        return (
            f"{len(self.position)} stations, {len(self.points)} reflectors, {faces}, {rounds}: {self.pointings} "
            f"pointings in {self.seconds / 3600:.1f} h"
        )

    @property
    def used(self) -> Bools:
        """Flags (3,) of the recorded observables: range, azimuth, elevation."""
        return np.array([name in self.observables for name in OBSERVABLES])

    @property
    def is_whole(self) -> bool:
        """True for ranges with both angles, False for ranges alone."""
        return bool(self.used.all())

    @property
    def weight(self) -> Floats:
        """Weight (T,) of each target's squared error, with mean one."""
        weight = np.array([self.importance.get(name, 1.0) for name in self.target_names], dtype=np.float64)
        return weight / weight.mean() if weight.any() else np.ones_like(weight)

    @property
    def rotation(self) -> Floats:
        """Instrument frame to network frame, (S, 3, 3)."""
        return np.stack([about_z(float(yaw)) for yaw in self.yaw])

    def state(self, construction: Construction) -> NetworkState:
        """Nominal state: a perfect instrument at the planned positions."""
        empty = self._empty()
        values = np.zeros((len(empty.instruments), construction.n_parameters))
        errors = np.zeros(MeasurementModel(empty, construction).n_extra_parameters)
        return NetworkState(self.position, self.rotation, self.points, values, errors)

    def recording(self, construction: Construction) -> Recording:
        """Recording of a perfect instrument without noise.

        Rows are in the order of measurement, station by station; a repeat is another complete visit.
        """
        empty = self._empty()
        readings = MeasurementModel(empty, construction).predict(self.state(construction))
        readings[:, ~self.used] = np.nan
        return empty.with_readings(readings)

    def turn(self, station: Ints, target: Ints, face: Ints) -> Ints:
        """Rank (n,) of pointings in the first round of their station's visit, from 0."""
        rank = target if self.rank is None else self.rank[station, target]
        number = np.searchsorted(np.sort(self.faces), face)
        if self.face_by_face:
            return np.asarray(number * len(self.points) + rank)
        return np.asarray(rank * len(self.faces) + number)

    @property
    def _placed_setup(self) -> Setup:
        """Set-up with the survey's positions of the stations, which determine the directions of nests."""
        places = zip(
            self.station_names, (self.position / MILLIMETRE).tolist(), np.degrees(self.yaw).tolist(), strict=True
        )
        declared = {
            name: self.setup.stations.get(name, Station()).model_copy(update={"position_mm": tuple(p), "yaw_deg": yaw})
            for name, p, yaw in places
        }
        return self.setup.model_copy(update={"stations": declared})

    def _empty(self) -> Recording:
        rounds, faces = np.arange(1, self.repeats + 1), np.sort(self.faces)
        axes = np.arange(len(self.position)), rounds, faces, np.arange(len(self.points))
        station, repeat, face, target = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
        order = np.lexsort((self.turn(station, target, face), repeat, station))
        order = order[self.visible[station[order], target[order]]]
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

    def without(self, station: int) -> Survey:
        """The survey without one station."""
        keep = np.arange(len(self.position)) != station
        return self.replace(
            station_names=tuple(n for n, k in zip(self.station_names, keep, strict=True) if k),
            position=self.position[keep],
            yaw=self.yaw[keep],
            visible=self.visible[keep],
            rank=None if self.rank is None else self.rank[keep],
        )

    def only(self, targets: Bools) -> Survey:
        """Survey with a selection of its targets."""
        if targets.all():
            return self
        return self.replace(
            target_names=tuple(n for n, k in zip(self.target_names, targets, strict=True) if k),
            points=self.points[targets],
            visible=self.visible[:, targets],
            rank=None if self.rank is None else np.argsort(np.argsort(self.rank[:, targets], axis=1), axis=1),
        )

    def replace(self, **changes: Any) -> Survey:
        """Copy with other values of some fields."""
        return replace(self, **changes)

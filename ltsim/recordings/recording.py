"""Recording: pointings of a tracker network as arrays, with the prior knowledge about the set-up."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import ModelError, NetworkError, option_text
from ltsim.core.limits import MAX_NETWORK_SETUPS, POINTINGS_LIMIT_VARIABLE, overridable_limit
from ltsim.core.results import ColumnValues, Result
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE, PPM
from ltsim.recordings.setup import Instrument, LengthGauge, Noise, Setup, Station, Target

OBSERVABLES = ("distance", "azimuth", "elevation")
"""Names of the readings of a pointing, in the order of the columns of `Recording.readings`."""
SIGMA_COLUMNS = ("sigma_distance_mm", "sigma_azimuth_arcsec", "sigma_elevation_arcsec")
"""Columns with the standard deviations of range, azimuth and elevation of each pointing; an empty cell stands for the
declared noise of the instrument."""
SIGMA_UNITS = (MILLIMETRE, ARCSECOND, ARCSECOND)
"""Units, as SI values, of the columns `SIGMA_COLUMNS`: millimetre, arc second, arc second."""
OBSERVABLE_NAMES_WITH_UNIT = tuple(name.removeprefix("sigma_") for name in SIGMA_COLUMNS)
"""Names of the observables with the unit of their standard deviation, such as `azimuth_arcsec`."""
HEIGHT_COLUMNS = ("instrument_height_mm", "target_height_mm")
"""Columns with the heights of instrument and reflector above their marks in each pointing; an empty cell stands for the
height in `setup.toml`."""
SHARED_ERROR_COLUMN_PATTERN = re.compile(f"shared_(.+)_({'|'.join(OBSERVABLE_NAMES_WITH_UNIT)})")
"""Pattern of the names of columns that give the change of each reading by one standard deviation of a shared error. The
name contains the name of the error, then the observable with its unit."""
NON_REGRESSOR_COLUMNS = (*SIGMA_COLUMNS, *HEIGHT_COLUMNS)
"""Columns of standard deviations and heights, on which a diagnosis does not test a dependence of the readings."""
DISTANCE_KIND_COLUMN = "distance_kind"
"""Column with the kind of each distance: ``slope`` (also an empty cell) or ``horizontal``."""
DISTANCE_METER_COLUMN = "distance_mode"
"""Column with the distance meter of each pointing: ``adm``, ``ifm`` or an empty cell."""
REFLECTOR_COLUMN = "reflector"
"""Column with the name of the SMR of each pointing; an empty cell stands for the SMR that `setup.toml` gives the
target."""
_DEFAULT_STATION, _DEFAULT_TARGET = Station(), Target()
MAX_POINTING_TIME_S = 2e18
"""Largest permitted time [s] of a pointing. Unix time in nanoseconds (1.8e18), read as seconds, is below this limit."""
MIN_COS_ELEVATION_DIVISOR = 1e-6
"""Smallest divisor in place of the cosine of the elevation. The standard deviation across the beam is divided by this
cosine."""
MIN_COS_ELEVATION_FOR_ANGLES = 1e-4
"""Smallest cosine of the elevation of a pointing whose angles the adjustment uses (21 arcsec from the vertical axis).
Nearer to the axis, an error of 1 arcsec across the beam changes the azimuth by 2.8 deg, and the elevation is not
differentiable, so that linearised equations are not valid.

There an error of 1 arcsec across the beam changes the azimuth by 2.8 deg, and the elevation is not differentiable, so
that linearised equations are not valid."""
OCCUPATION_COLUMNS = ("instrument_setup", "target_setup")
"""Columns with the name of the occupation (time on a survey mark) of the instrument, and of the reflector, in each
pointing."""


def reading_sigmas_from_noise(
    noise_declarations: Sequence[Noise], instrument: Ints, range_: Floats, elevation: Floats
) -> Floats:
    """Declared standard deviations (n, 3) [m, rad, rad] of the ranges, azimuths and elevations of n pointings.

    `instrument` (n,) is the index into `noise_declarations` of each pointing's instrument; `range_` (n,) is in m,
    `elevation` (n,) in rad. The standard deviation of a range is distance_mm + distance_ppm * range. That of an azimuth
    is the declared value across the beam, divided by the cosine of the elevation.
    """
    noise_values = [[m.distance_mm, m.distance_ppm, m.azimuth_arcsec, m.elevation_arcsec] for m in noise_declarations]
    units = np.array([MILLIMETRE, PPM, ARCSECOND, ARCSECOND])
    constant, per_metre, azimuth_sigma, elevation_sigma = (np.array(noise_values) * units)[instrument].T
    cos_elevation = np.maximum(np.abs(np.cos(elevation)), MIN_COS_ELEVATION_DIVISOR)
    return np.stack([constant + per_metre * range_, azimuth_sigma / cos_elevation, elevation_sigma], axis=1)


def repeat_numbers(station: Ints, target: Ints, face: Ints) -> Ints:
    """Number (n,), from 1, of each of n pointings among those from one station to one target in one face."""
    order = np.lexsort((face, target, station))
    keys = np.stack([station, target, face], axis=1)[order]
    first_rows_of_sights = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=-1), axis=1))
    counts = np.diff(first_rows_of_sights, append=len(order))
    repeat = np.empty(len(order), dtype=np.int64)
    repeat[order] = np.arange(len(order)) - np.repeat(first_rows_of_sights, counts) + 1
    return repeat


@dataclass(frozen=True, repr=False)
class Recording(Result):
    """Readings of n pointings in a tracker network, with the prior knowledge about the set-up."""

    setup: Setup
    """Prior knowledge about instruments, stations, targets and reference values: the content of `setup.toml`."""
    stations: tuple[str, ...]
    """Names of the stations, to which the indices in `station` refer."""
    targets: tuple[str, ...]
    """Names of the targets, to which the indices in `target` refer."""
    station: Ints
    """Index into `stations` of the station of each of the n pointings, (n,)."""
    target: Ints
    """Index into `targets` of the target of each of the n pointings, (n,)."""
    face: Ints
    """Face (1 or 2) of each of the n pointings, (n,)."""
    repeat: Ints
    """Number, from 1, of each of n pointings among those from one station to one target in one face, (n,)."""
    time: Floats
    """Time [s] of each of n pointings since the start of the recording, (n,); the index of the row if there is no
    clock."""
    readings: Floats
    """Raw range, azimuth and elevation of each of n pointings, (n, 3) [m, rad, rad]; NaN if not measured."""
    covariates: Mapping[str, Floats] = field(default_factory=dict)
    """Additional columns of numbers by name, each (n,) for n pointings, such as the air temperature at the instrument.
    """
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Additional columns of texts by name, each with n entries."""
    has_clock: bool = True
    """True if `time` was measured; False if it is the index of the row."""
    notes: tuple[str, ...] = ()
    """Sentences for the user: how the reader interpreted an ambiguous file, and which content it ignored."""
    sources: tuple[str, ...] = ()
    """File and line of each pointing, as text; empty for the native format."""

    def __post_init__(self) -> None:
        """Check that all times are finite and at most `MAX_POINTING_TIME_S` in magnitude; raises ModelError."""
        invalid_rows = np.flatnonzero(~(np.abs(np.asarray(self.time, dtype=np.float64)) <= MAX_POINTING_TIME_S))
        if len(invalid_rows):
            row, value = int(invalid_rows[0]) + 1, self.time[invalid_rows[0]]
            raise ModelError(
                f"the time of row {row} is {value}, expected seconds of at most {MAX_POINTING_TIME_S:g}; for a "
                "recording without a clock give time=np.arange(n) and has_clock=False"
            )

    def __len__(self) -> int:
        return len(self.station)

    @property
    def headline(self) -> str:
        """Summary line with the title and the numbers of pointings, stations, targets, faces and known lengths."""
        faces = np.unique(self.face)
        in_faces = "two faces" if len(faces) == 2 else f"face {faces[0]} only" if len(faces) else "no face"
        title = f"{self.setup.title}: " if self.setup.title else ""
        differences = f", {len(self.setup.differences)} known differences" if self.setup.differences else ""
        return (
            f"{title}{len(self)} pointings, {len(self.stations)} stations, {len(self.targets)} targets, "
            f"{in_faces}, {len(self.gauge.distance)} known lengths{differences}"
        )

    def _summary_lines(self) -> list[str]:
        """Lines of the printed summary of the recording."""
        return [f"Recording: {self.headline}", *self.notes]

    def _table_makers(self) -> Mapping[str, Callable[[], ColumnValues]]:
        """Tables of the recording for export, by name."""
        return {"pointings": self._pointings_table}

    def _pointings_table(self) -> ColumnValues:
        """Columns of the table of pointings, by name."""
        distance, azimuth, elevation = (self.readings / [MILLIMETRE, DEGREE, DEGREE]).T
        return {
            "station": [self.stations[i] for i in self.station],
            "target": [self.targets[i] for i in self.target],
            "face": self.face.tolist(),
            "repeat": self.repeat.tolist(),
            "time_s": self.time.tolist(),
            "distance_mm": distance.tolist(),
            "azimuth_deg": azimuth.tolist(),
            "elevation_deg": elevation.tolist(),
            **{name: column.tolist() for name, column in self.covariates.items()},
            **self.labels,
        }

    def row_text(self, row: int) -> str:
        """Text such as "row 7", with the file and line of this row if known; `row` counts from 1."""
        return f"row {row} ({self.sources[row - 1]})" if self.sources else f"row {row}"

    @property
    def is_measured(self) -> Bools:
        """Flags (n, 3) of the measured ones of the ranges, azimuths and elevations of n pointings."""
        return np.isfinite(self.readings)

    @property
    def is_usable_reading(self) -> Bools:
        """Flags (n, 3) of the readings of n pointings that an adjustment uses; it uses no angles of vertical sights."""
        return self.is_measured & ~(self.is_along_standing_axis[:, None] & [False, True, True])

    @property
    def is_along_standing_axis(self) -> Bools:
        """Flags (n,) of those of n pointings that go straight up or down, along the standing axis of the tracker."""
        return np.asarray(np.abs(np.cos(self.readings[:, 2])) < MIN_COS_ELEVATION_FOR_ANGLES)

    @cached_property
    def instruments(self) -> tuple[str, ...]:
        """Names of the instruments in use; an instrument without a name is ''."""
        names = {self._instrument_name(s) for s in self.stations}
        return tuple(sorted(names))

    @cached_property
    def instrument(self) -> Ints:
        """Index into `instruments` of the instrument of each of the n pointings, (n,)."""
        index = {name: i for i, name in enumerate(self.instruments)}
        index_by_station = [index[self._instrument_name(s)] for s in self.stations]
        return np.array(index_by_station, dtype=np.int64)[self.station]

    def _instrument_name(self, station: str) -> str:
        """Name of the instrument at a station; '' for the instrument without a name."""
        name = self.setup.stations.get(station, _DEFAULT_STATION).instrument
        return name if name is not None and name in self.setup.instruments else ""

    def instrument_of(self, station: str) -> Instrument:
        """Declared instrument of the station with this name."""
        return self.setup.instrument_of(station)

    @property
    def is_corrected(self) -> bool:
        """True if the readings of all instruments are declared as corrected for instrument errors."""
        return all(self.setup.instrument_named(name).corrected for name in self.instruments)

    def station_setup(self, station: str) -> Station:
        """Prior knowledge about the station with this name; default values if the set-up has no table for it."""
        return self.setup.stations.get(station, _DEFAULT_STATION)

    def target_setup(self, target: str) -> Target:
        """Prior knowledge about the target with this name; default values if the set-up has no table for it."""
        return self.setup.targets.get(target, _DEFAULT_TARGET)

    @property
    def gauge(self) -> LengthGauge:
        """Reference lengths of the set-up with their temperatures; a gauge without lengths if none are declared."""
        return self.setup.gauge or LengthGauge()

    def reading_sigmas(self) -> Floats:
        """Declared standard deviations (n, 3) [m, rad, rad] of the ranges, azimuths and elevations of n pointings.

        A value in the columns `SIGMA_COLUMNS` replaces the noise of the instrument. The standard deviation of an
        azimuth refers to the reading, not to the direction across the beam.
        """
        noise = [self.instrument_of(name).noise for name in self.stations]
        range_, _, elevation = np.nan_to_num(self.readings).T
        sigma = reading_sigmas_from_noise(noise, self.station, range_, elevation)
        for column, (name, unit) in enumerate(zip(SIGMA_COLUMNS, SIGMA_UNITS, strict=True)):
            if name in self.covariates:
                column_sigma = self.covariates[name] * unit
                sigma[:, column] = np.where(np.isfinite(column_sigma), column_sigma, sigma[:, column])
        return sigma

    def heights_above_marks(self) -> tuple[Floats, Floats]:
        """Heights [m] above survey marks of the instrument (n,) and of the reflector (n,) in each of n pointings."""
        instrument = [self.station_setup(s).instrument_height_mm for s in self.stations]
        target = [self.target_setup(t).height_mm for t in self.targets]
        default_heights = np.array(instrument)[self.station], np.array(target)[self.target]
        row_heights = [self.covariates.get(name, np.full(len(self), np.nan)) for name in HEIGHT_COLUMNS]
        first, second = (
            np.where(np.isfinite(row_height), row_height, default_height) * MILLIMETRE
            for row_height, default_height in zip(row_heights, default_heights, strict=True)
        )
        return first, second

    @property
    def regressor_covariates(self) -> Mapping[str, Floats]:
        """Covariates by name, each (n,) for n pointings, on which a diagnosis tests a dependence of the readings.

        Excluded are standard deviations, heights and shared errors. If both distance meters were used, `distance_mode`
        is included: 1 for the IFM, 0 otherwise.
        """
        columns = {name: column for name, column in self.covariates.items() if name not in NON_REGRESSOR_COLUMNS}
        regressors = {
            name: column for name, column in columns.items() if not SHARED_ERROR_COLUMN_PATTERN.fullmatch(name)
        }
        modes = self.labels.get(DISTANCE_METER_COLUMN, ())
        if {"adm", "ifm"} <= set(modes):
            regressors[DISTANCE_METER_COLUMN] = np.array([mode == "ifm" for mode in modes], dtype=np.float64)
        return regressors

    @property
    def is_horizontal_distance(self) -> Bools:
        """Flags (n,) of those of n pointings whose distance is reduced to the horizontal plane of the instrument."""
        kinds = self.labels.get(DISTANCE_KIND_COLUMN, ("",) * len(self))
        return np.array([kind == "horizontal" for kind in kinds], dtype=bool)

    def select(self, selection: Bools | Ints) -> Recording:
        """Recording with the pointings in `selection` (mask or indices), and with their stations and targets only."""
        row_indices = np.arange(len(self))[selection]
        station_ids, station = np.unique(self.station[row_indices], return_inverse=True)
        target_ids, target = np.unique(self.target[row_indices], return_inverse=True)
        names = tuple(self.targets[k] for k in target_ids)
        gauge = self.setup.gauge
        if gauge is not None:
            present = [g for g in gauge.distance if g.from_ in names and g.to in names]
            gauge = gauge.model_copy(update={"distance": tuple(present)})
        stations = tuple(self.stations[s] for s in station_ids)
        centring = tuple(filter(None, (entry.restricted_to(stations, names) for entry in self.setup.centring)))
        return dataclasses.replace(
            self,
            setup=self.setup.model_copy(update={"gauge": gauge, "centring": centring}),
            stations=stations,
            targets=names,
            station=station.astype(np.int64),
            target=target.astype(np.int64),
            face=self.face[row_indices],
            repeat=self.repeat[row_indices],
            time=self.time[row_indices],
            readings=self.readings[row_indices],
            covariates={name: column[row_indices] for name, column in self.covariates.items()},
            labels={name: tuple(column[i] for i in row_indices) for name, column in self.labels.items()},
            sources=tuple(self.sources[i] for i in row_indices) if self.sources else (),
        )

    def face_pair_rows(self, is_usable_pointing: Bools | None = None) -> Ints:
        """Indices (m, 2) of m pairs of pointings in face 1 and face 2, from one station to one target in one repeat.

        `is_usable_pointing` (n,) flags the pointings that may belong to a pair, by default the complete ones.
        """
        is_usable = np.all(self.is_usable_reading, axis=1) if is_usable_pointing is None else is_usable_pointing
        rows_by_key: dict[tuple[int, int, int], dict[int, int]] = {}
        keys = zip(self.station.tolist(), self.target.tolist(), self.repeat.tolist(), strict=True)
        for row, key in enumerate(keys):
            if is_usable[row]:
                rows_by_key.setdefault(key, {})[int(self.face[row])] = row
        row_pairs = [(faces[1], faces[2]) for faces in rows_by_key.values() if len(faces) == 2]
        return np.array(row_pairs, dtype=np.int64).reshape(-1, 2)

    def thin(self, row_step: int) -> Recording:
        """Recording with every `row_step`-th of the pointings from each station to each target in each face."""
        return self.select((repeat_numbers(self.station, self.target, self.face) - 1) % row_step == 0)

    def require_at_most(self, pointings: int, targets: int, command: str) -> None:
        """Check of the numbers of pointings, targets and set-ups against limits of a `command`; raises NetworkError.

        `pointings` and `targets` are the limits, `MAX_NETWORK_SETUPS` is that of set-ups. The error says how to divide
        or thin the recording. An environment variable raises the limit of pointings, and the other limits by the same
        factor.
        """
        setups, pointings, targets = (overridable_limit(n) for n in (MAX_NETWORK_SETUPS, pointings, targets))
        if len(self.stations) > setups:
            raise NetworkError(
                f"the recording holds {len(self.stations)} set-ups; {command} takes at most {setups}: divide it by "
                f"station; {self._larger_limits_phrase}"
            )
        if len(self.targets) > targets:
            raise NetworkError(
                f"the recording holds {len(self.targets)} targets; {command} takes at most {targets}: leave out "
                f"targets that one set-up alone measured; {self._larger_limits_phrase}"
            )
        if len(self) <= pointings:
            return
        sights = np.unique(np.stack([self.station, self.target, self.face]), axis=1, return_counts=True)[1]
        smallest_step, advice = -(-len(self) // pointings), "divide it by station or by time"
        for row_step in (smallest_step, 2 * smallest_step, int(sights.max())):
            count = int(np.sum(-(-sights // row_step)))
            if count <= pointings:
                advice = f"convert it with {option_text('every')} {row_step}, which leaves {count} of them"
                break
        raise NetworkError(
            f"the recording holds {len(self)} pointings; {command} takes at most {pointings}: {advice}; "
            f"{self._larger_limits_phrase}"
        )

    @property
    def _larger_limits_phrase(self) -> str:
        """Advice to the user: environment variable that raises the limits so that this recording is permitted."""
        return f"on a machine with more memory set the environment variable {POINTINGS_LIMIT_VARIABLE} to {len(self)}"

    def with_readings(self, readings: Floats) -> Recording:
        """Copy of the recording in which `readings` (n, 3) [m, rad, rad] replace the readings of its n pointings."""
        return self.replace(readings=readings)

    def replace(self, **changes: Any) -> Recording:
        """Copy of the recording with changed fields: `changes` are the new values by name of the field."""
        return dataclasses.replace(self, **changes)

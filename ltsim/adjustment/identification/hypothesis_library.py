"""Library of hypotheses: errors that are possible at a station, at a target, in a reference value, and in the noise.

A family contains the hypotheses on one kind of shift of readings: one hypothesis for each station, target or
instrument, and for each possible onset time. Their design columns are computed from one array, so that a network with
thousands of stations and targets is tested at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

import numpy as np

from ltsim.adjustment.blunders import correct_faces, correct_units, detect_blunders
from ltsim.adjustment.identification.evidence import log_prior_of_kind
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CauseKind,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
    RowCorrection,
)
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.reference_values import ReferenceValueRows, reference_values
from ltsim.adjustment.significance import MIN_REPEATS_FOR_VARIANCE
from ltsim.adjustment.station_motions import UniformMotion
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.effects.nest_lift import NestLift
from ltsim.physics.effects.smr_offset import SmrOffset
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.laws.law import MAX_CANDIDATE_SWITCH_EDGES
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.scene.sightings import Sightings

PlaceKind = Literal["station", "target", "instrument", "sight"]
"""Kind of place where a shift of readings acts: one station, one target, all stations of an instrument, or the sight
from one station to one target."""


@dataclass(frozen=True)
class ShiftPlace:
    """Stations and targets where a shift of readings may act, and their pointings."""

    stations: tuple[str, ...]
    """Names of the stations; empty for all."""
    targets: tuple[str, ...]
    """Names of the targets; empty for all."""
    pointing_indices: Ints
    """Indices of the pointings of these stations and targets, in the order of measurement."""


@dataclass(frozen=True)
class ShiftFamily:
    """Hypotheses on one kind of shift of readings, for example an offset of distances, at each station (or target)."""

    kind: CauseKind
    """Kind of the error."""
    acts_on: str
    """Observable that is shifted, or `position`."""
    place_kind: PlaceKind
    """Kind of place where the error acts: station, target, instrument or sight."""
    design: Floats
    """Change (n, 3, p) of the readings of n pointings per unit of each of p parameters, if all pointings are
    shifted."""
    min_pointings_around_onset: int = 0
    """Smallest number of pointings before and after the onset of the shift at its station or target; 0 for a shift that
    acts from the first pointing on."""
    drift_interval: Literal["occupation", "recording"] | None = None
    """Interval in which the shift grows at a constant rate from zero; None for other shifts."""
    time_constant: float | None = None
    """Time constant [s] with which the station settles; None for other shifts."""

    def candidate_onset_times(self, sightings: Sightings, rows: Ints) -> list[float]:
        """Times [s] at which a shift may begin at a station or target.

        `rows` are the indices of the pointings of this station or target in the order of measurement. A shift from the
        first pointing on has the time -inf.
        """
        if not self.min_pointings_around_onset:
            return [-np.inf]
        times = sightings.time[rows]
        middle, gap = 0.5 * (times[1:] + times[:-1]), np.diff(times)
        allowed_range = slice(
            self.min_pointings_around_onset - 1,
            max(len(middle) - self.min_pointings_around_onset + 1, self.min_pointings_around_onset - 1),
        )
        indices = np.flatnonzero(gap[allowed_range] > 0.0) + self.min_pointings_around_onset - 1
        if self.place_kind == "target":  # a motion between two pointings of one station may be one of the station
            moved = np.diff(sightings.station[rows])[indices] != 0
            indices = indices[moved] if moved.any() else indices
        if self.place_kind == "instrument":  # a change at the last station alone is a hypothesis of this station
            last = sightings.station[rows[-1]]
            indices = indices[indices < np.flatnonzero(sightings.station[rows] != last)[-1]]
        if len(indices) > MAX_CANDIDATE_SWITCH_EDGES:
            indices = indices[np.linspace(0, len(indices) - 1, MAX_CANDIDATE_SWITCH_EDGES).round().astype(int)]
        return middle[indices].tolist()

    def make_effect(self, place: ShiftPlace, onset_time: float) -> LinearEffect:
        """Effect that shifts readings at the stations and targets `place` from the time `onset_time` [s] on."""
        stations, targets = place.stations, place.targets
        if self.kind == "station-bump":
            return StationBump(stations, targets, time=onset_time)
        if self.kind == "station-drift":
            return UniformMotion(stations, targets)
        if self.time_constant is not None:
            return StationSettling(stations, targets, time_constant=self.time_constant)
        if self.kind == "target-moved":
            return TargetMoved(stations, targets, time=onset_time)
        if self.kind == "reflector-radius":
            return SmrOffset(stations, targets)
        if self.kind == "reflector-seating":
            return NestLift(stations, targets, "free")
        is_scale_error = self.kind == "scale-error"
        return ReadingShift(
            self.acts_on, is_scale_error, stations, targets, onset_time, drift_interval=self.drift_interval
        )


def shift_places(sightings: Sightings, place_kind: PlaceKind) -> list[ShiftPlace]:
    """All stations, targets, instruments or sights of a recording where a shift of readings may act.

    Instruments are listed only if they were used at several stations.
    """
    order = sightings.measurement_order
    if place_kind == "instrument":
        places = []
        for instrument in np.unique(sightings.instrument):
            rows = order[sightings.instrument[order] == instrument]
            stations = tuple(sightings.station_names[i] for i in np.unique(sightings.station[rows]))
            if len(stations) > 1:
                places.append(ShiftPlace(stations if len(rows) < len(order) else (), (), rows))
        return places
    stations, targets = sightings.station_names, sightings.target_names
    sights = sightings.station * len(targets) + sightings.target
    index = {"station": sightings.station, "target": sightings.target, "sight": sights}[place_kind]
    order = order[np.argsort(index[order], kind="stable")]
    values, starts = np.unique(index[order], return_index=True)
    edges = np.append(starts, len(order))
    places = []
    for i, value in enumerate(values.tolist()):
        station, target = divmod(value, len(targets)) if place_kind == "sight" else (value, value)
        station_names = () if place_kind == "target" else (stations[station],)
        target_names = () if place_kind == "station" else (targets[target],)
        places.append(ShiftPlace(station_names, target_names, order[edges[i] : edges[i + 1]]))
    return places


def shift_families(sightings: Sightings) -> Iterator[ShiftFamily]:
    """Groups of hypotheses on possible shifts of readings in a recording, one group per kind of shift and place."""
    stations = len(sightings.station_names) > 1
    distance, azimuth, elevation = (
        ReadingShift(observable).design(sightings) for observable in ("distance", "azimuth", "elevation")
    )
    if stations:
        yield ShiftFamily("constant-offset", "distance", "station", distance)
        yield ShiftFamily("constant-offset", "elevation", "station", elevation)
        step_places: tuple[PlaceKind, ...] = ("station", "instrument")
        for observable, offset in (
            ("distance", distance),
            ("elevation", elevation),
        ):  # a step of the azimuth is a rotation of the station
            for place_kind in step_places:
                yield ShiftFamily(
                    "constant-step", observable, place_kind, offset, min_pointings_around_onset=MIN_POINTS_FOR_POSE
                )
            drift = offset * sightings.elapsed_occupation_fraction[:, None, None]
            yield ShiftFamily("constant-drift", observable, "station", drift, drift_interval="occupation")
        yield ShiftFamily("constant-offset", "distance", "instrument", distance)
        instrument_places = shift_places(sightings, "instrument")
        intervals: tuple[Literal["occupation", "recording"], ...] = ("occupation", "recording")
        for observable, interval in product(OBSERVABLES, intervals):
            if (observable, interval) == ("azimuth", "recording"):  # orientations absorb the rest of such a drift
                continue
            drifts = [
                ReadingShift(observable, stations=place.stations, drift_interval=interval).design(sightings)
                for place in instrument_places
            ]
            design = np.sum([0.0 * distance, *drifts], axis=0)
            yield ShiftFamily("constant-drift", observable, "instrument", design, drift_interval=interval)
        scale = distance * sightings.range_[:, None, None]
        yield ShiftFamily("scale-error", "distance", "station", scale)
        yield ShiftFamily("scale-error", "distance", "instrument", scale)
        yield ShiftFamily("constant-offset", "distance", "target", distance)
        yield ShiftFamily(
            "target-moved", "position", "target", sightings.target_derivatives, min_pointings_around_onset=1
        )
        yield ShiftFamily("reflector-seating", "position", "sight", sightings.target_derivatives)
        if np.isfinite(sightings.nest_normals).all(axis=1).any():
            yield ShiftFamily("reflector-radius", "position", "station", SmrOffset().design(sightings))
    motion = sightings.pose_derivatives
    yield ShiftFamily("orientation", "azimuth", "station", azimuth, min_pointings_around_onset=MIN_POINTS_FOR_POSE)
    yield ShiftFamily("station-bump", "position", "station", motion, min_pointings_around_onset=MIN_POINTS_FOR_POSE)
    yield ShiftFamily("station-drift", "position", "station", UniformMotion().design(sightings))
    for time_constant in StationSettling.shape_parameters[0].grid_values().tolist():
        design = StationSettling(time_constant=time_constant).design(sightings)
        yield ShiftFamily("station-settling", "position", "station", design, time_constant=time_constant)


@dataclass(frozen=True)
class ShiftCandidate:
    """Candidate hypothesis: shift of readings of one kind, at one station, target or instrument, from a time on."""

    family: ShiftFamily
    """Group of all shifts of the same kind, with their common design matrix."""
    place: ShiftPlace
    """Stations and targets where the shift acts."""
    onset_time: float
    """Time [s] from which the shift acts; minus infinity for the whole recording."""
    affected_rows: Ints
    """Indices of the pointings that are shifted."""
    earlier_rows: Ints
    """Indices of the pointings at the same stations and targets before the onset of the shift."""
    n_candidates_of_kind: int
    """Number of candidates of this kind, which share the prior probability of the kind equally."""

    def make_hypothesis(self, start_values: Floats) -> CauseHypothesis:
        """Hypothesis of the candidate, with start values (p,) [SI] of its p parameters."""
        effect = self.family.make_effect(self.place, self.onset_time)
        kind, acts_on = self.family.kind, self.family.acts_on
        change = ReadingShiftChange(effect, tuple(start_values.tolist()))
        return CauseHypothesis(kind, acts_on, effect.stations, effect.targets, self.log_prior, change)

    @property
    def place_key(self) -> tuple[object, ...]:
        """Key from kind, stations and targets of a shift; candidates with equal keys differ only in the onset time."""
        return self.family.kind, self.family.acts_on, self.place.stations, self.place.targets

    @property
    def log_prior(self) -> float:
        """Logarithm of the prior odds of the candidate relative to no error."""
        return log_prior_of_kind(self.family.kind, self.n_candidates_of_kind)


def shift_candidates(sightings: Sightings) -> list[ShiftCandidate]:
    """Candidate shifts of all kinds, at all stations, targets and instruments, with all possible onset times."""
    places = {kind: shift_places(sightings, kind) for kind in get_args(PlaceKind)}
    shifts: list[tuple[ShiftFamily, ShiftPlace, float, Ints, Ints]] = []
    for family in shift_families(sightings):
        for place in places[family.place_kind]:
            rows = place.pointing_indices
            for since in family.candidate_onset_times(sightings, rows):
                late = sightings.time[rows] >= since
                shifts.append((family, place, since, rows[late], rows[~late]))
    n_by_kind: dict[CauseKind, int] = {}
    for family, *_ in shifts:
        n_by_kind[family.kind] = n_by_kind.get(family.kind, 0) + 1
    return [ShiftCandidate(*shift, n_by_kind[shift[0].kind]) for shift in shifts]


def reference_omissions(fit: NetworkFit) -> list[CauseHypothesis]:
    """Hypotheses that a reference value is wrong, one for each reference value in a fit."""
    return omissions_of_reference_values(fit.recording, list(reference_values(fit.problem, fit.state)))


def omissions_of_reference_values(recording: Recording, values: Sequence[ReferenceValueRows]) -> list[CauseHypothesis]:
    """Hypotheses that a reference value is wrong, one for each of the reference values `values` of a recording."""
    hypotheses = []
    for v in values:
        ends = (v.name, *v.name.partition("#")[0].split("-")) if v.kind in ("length", "difference") else (v.name,)
        targets = (
            tuple(name for name in recording.targets if name in ends) if v.kind not in ("level", "yaw", "mark") else ()
        )
        stations = tuple(name for name in recording.stations if name in ends) if not targets else ()
        prior = log_prior_of_kind("reference-value", len(values))
        hypotheses.append(
            CauseHypothesis("reference-value", v.kind, stations, targets, prior, ReferenceOmission(v), v.name)
        )
    return hypotheses


CAUSE_KIND_BY_BLUNDER: dict[str, CauseKind] = {
    "target-swap": "names",
    "wrong-unit": "unit",
    "face-confusion": "unit",
    "outlier": "height",
}
"""Kind of cause under which a blunder is reported, by the name of the blunder in the list of physical effects."""


def row_corrections(fit: NetworkFit) -> list[CauseHypothesis]:
    """Hypotheses on wrongly recorded pointings: outliers that fit a target after correction of a typical blunder."""
    places, hypotheses = len(fit.recording.stations) * len(fit.recording.targets), []
    is_suspect = np.asarray((fit.is_outlier & fit.is_gross_reading).any(axis=1)) | fit.adjustment.is_gross_pointing
    for mistake, readings, target in detect_blunders(replace(fit.adjustment, is_gross_pointing=is_suspect)):
        kind = CAUSE_KIND_BY_BLUNDER[mistake.effect_name]
        change = RowCorrection(mistake.pointing_indices, readings, target, fit.recording.face[mistake.pointing_indices])
        rows = tuple((mistake.pointing_indices + 1).tolist())
        prior = log_prior_of_kind(kind, places)
        hypotheses.append(
            CauseHypothesis(kind, "position", mistake.stations, mistake.targets, prior, change, mistake.sentence, rows)
        )
    return hypotheses


def convention_corrections(recording: Recording) -> list[CauseHypothesis]:
    """Hypotheses on set-ups that were recorded in another unit, sense of rotation or face.

    The shape of the measured points of each set-up shows these errors before any adjustment.
    """
    converted, slips = correct_units(recording)
    faced, faces = correct_faces(converted)
    hypotheses = []
    for mistake in (*(slips if converted is not recording else ()), *faces):
        rows = mistake.pointing_indices
        change = RowCorrection(rows, converted.readings[rows], recording.target[rows], faced.face[rows])
        prior = log_prior_of_kind("unit", len(recording.stations))
        hypotheses.append(CauseHypothesis("unit", "position", mistake.stations, (), prior, change, mistake.sentence))
    return hypotheses


def noise_hypotheses(fit: NetworkFit) -> Iterator[tuple[CauseHypothesis, Bools]]:
    """Hypotheses that the noise differs from the declared noise, each with the mask (n, 3) of the affected readings.

    The hypotheses concern all readings of the n pointings, one observable, both angles, one target, or one station.
    """
    recording = fit.recording
    full_mask = np.ones((len(recording), 3), dtype=bool)
    is_multiple = len(recording.stations) > 1
    columns = {name: np.arange(3) == k for k, name in enumerate(OBSERVABLES)} | {"angles": np.arange(3) > 0}
    places = len(columns) + len(recording.targets) + is_multiple * len(recording.stations)

    def noise_hypothesis(
        acts_on: str, stations: tuple[str, ...], targets: tuple[str, ...], n_rivals: int, is_scaled: Bools
    ) -> CauseHypothesis:
        prior = log_prior_of_kind("noise-level", n_rivals)
        return CauseHypothesis("noise-level", acts_on, stations, targets, prior, NoiseFactorChange(is_scaled))

    yield noise_hypothesis("noise", (), (), 1, full_mask), full_mask
    for acts_on, is_column in columns.items():
        readings = full_mask & is_column
        yield noise_hypothesis(acts_on, (), (), places, readings), readings
    for t, name in enumerate(recording.targets):
        rows = full_mask & (recording.target == t)[:, None]
        if rows[:, 0].sum() >= MIN_REPEATS_FOR_VARIANCE:
            yield noise_hypothesis("noise", (), (name,), places, rows), rows
    for s, name in enumerate(recording.stations) if is_multiple else ():
        rows = full_mask & (recording.station == s)[:, None]
        yield noise_hypothesis("noise", (name,), (), places, rows), rows

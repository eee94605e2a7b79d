"""Identification of blunders: exchanged reflectors, wrong heights, wrong units, wrong faces.

A pointing with an error of millimetres or more is compared with typical blunders. If one of them explains the error,
the pointing can be corrected; otherwise it is rejected. Stations recorded completely in another unit, convention or
face are detected before the adjustment, because the shape of their points differs from that of other stations.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.frame import StationTargetPairs
from ltsim.adjustment.reference_tests import MAX_HORIZONTAL_TO_VERTICAL_RATIO
from ltsim.adjustment.significance import MAX_TRACKER_ERROR, MIN_CERTAIN_ERROR_SIGMAS
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.notation import MAX_LISTED_ITEMS
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import MIN_POINTS_FOR_POSE, align_sets_robustly
from ltsim.physics.effects.face_confusion import FaceConfusion
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.effects.wrong_unit import WrongUnit
from ltsim.physics.model.measurement import plumb_directions
from ltsim.recordings.face_units import face_unit_errors
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.transcription_errors import UNIT_AND_CONVENTION_ERRORS, WRONG_FACE_ERRORS, shared_target_counts

MAX_COMPARED_STATIONS = 30
"""Largest number of stations with which each station is compared: those that share most targets with it. The limit
saves time, as each comparison takes a millisecond. It is also the largest number of stations whose units are corrected:
if more stations differ, the whole file is wrong.
"""
MIN_STATION_MISFIT_OF_WRONG_UNIT = 5e-3
"""Limit of the median distance [m] between common points of two stations after alignment. If it is exceeded, a wrong
unit or convention of a station is suspected, because neither tracker errors nor a single blunder cause such distances.
"""


@dataclass(frozen=True)
class IdentifiedBlunder:
    """Blunder that was identified in k pointings."""

    effect_name: str
    """Name of the blunder in the list of physical effects: target-swap, wrong-unit, face-confusion or outlier."""
    pointing_indices: Ints
    """Indices (k,) of the k pointings with the blunder."""
    stations: tuple[str, ...]
    """Names of the stations of the pointings; empty for a centring error of a mark."""
    targets: tuple[str, ...]
    """Names of the targets concerned; empty for a blunder in all pointings of a station."""
    observables: tuple[str, ...]
    """Names of the wrong observables; empty for all three."""
    displacement: float
    """Largest displacement [m] of a measured point by the blunder."""
    sentence: str
    """Sentence for the user on the blunder."""
    displacement_sigma: float = 0.0
    """Standard deviation of `displacement` [m]; 0 if the network does not determine it."""


BlunderWithCorrection = tuple[IdentifiedBlunder, Floats, Ints]
"""Tuple of a blunder, the corrected readings (k, 3) [m, rad, rad] and the correct target indices (k,) of its
pointings."""


def apply_corrections(recording: Recording, blunders: Sequence[BlunderWithCorrection]) -> Recording:
    """Recording with corrected readings and targets of the pointings with blunders."""
    if not blunders:
        return recording
    readings, target = recording.readings.copy(), recording.target.copy()
    for finding, read, target_read in blunders:
        readings[finding.pointing_indices], target[finding.pointing_indices] = read, target_read
    return recording.replace(readings=readings, target=target)


def detect_blunders(adjustment: Adjustment) -> list[BlunderWithCorrection]:
    """Blunders that explain pointings with gross errors, each with corrected readings and targets."""
    remaining, corrections = adjustment.is_gross_pointing.copy(), []
    for kind in (_swapped_targets, _wrong_heights, _unit_and_face_errors):
        for mend in kind(adjustment, remaining) if remaining.any() else ():
            corrections.append(mend)
            remaining[mend[0].pointing_indices] = False
    return corrections


def _network_points_from_readings(adjustment: Adjustment, readings: Floats, rows: Ints) -> Floats:
    """Points (k, 3) [m] in the network frame, from `readings` (k, 3) in place of those of k pointings `rows` (k,)."""
    station, instrument = adjustment.recording.station[rows], adjustment.recording.instrument[rows]
    local_points = adjustment.construction.points_from_readings(
        readings, adjustment.state.instrument_parameters[instrument]
    )
    rotated = np.einsum("nij,nj->ni", adjustment.state.station_rotations[station], local_points)
    network_points: Floats = rotated + adjustment.state.station_positions[station]
    lift = adjustment.problem.model.sightings_without_covariates(adjustment.state).sight_vector_offsets
    return network_points if lift is None else network_points - lift[rows]


def _distances_from_targets(adjustment: Adjustment, readings: Floats, rows: Ints) -> Floats:
    """Distances (k,) [m] of measured points from adjusted targets, for `readings` (k, 3) of k pointings `rows`."""
    goal = adjustment.state.target_points[adjustment.recording.target[rows]]
    return np.asarray(np.linalg.norm(_network_points_from_readings(adjustment, readings, rows) - goal, axis=1))


def _tolerances(adjustment: Adjustment, rows: Ints) -> Floats:
    """Largest distances (k,) [m] between measured point and target without a blunder, for k pointings `rows` (k,).

    They are `MAX_TRACKER_ERROR`, or `MIN_CERTAIN_ERROR_SIGMAS` standard deviations if that is more (total stations).
    """
    sigmas = np.nan_to_num(adjustment.problem.reading_sigmas * adjustment.sightings.displacement_per_reading)[rows]
    return np.maximum(MAX_TRACKER_ERROR, MIN_CERTAIN_ERROR_SIGMAS * np.linalg.norm(sigmas, axis=1))


def _swapped_targets(adjustment: Adjustment, is_gross: Bools) -> Iterator[BlunderWithCorrection]:
    """Blunders in target names: two targets exchanged at a station, or one target mistaken for another.

    `is_gross` (n,) flags those of the n pointings that have gross errors.
    """
    recording, points = adjustment.recording, adjustment.state.target_points
    indices = np.flatnonzero(is_gross & recording.is_measured.all(axis=1))
    if not len(indices):
        return
    gaps = np.linalg.norm(
        _network_points_from_readings(adjustment, recording.readings[indices], indices)[:, None] - points[None], axis=2
    )
    nearest_targets = np.argmin(gaps, axis=1)
    lands = gaps[np.arange(len(indices)), nearest_targets] < _tolerances(adjustment, indices)
    rows_by_pair: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero(lands & (nearest_targets != recording.target[indices])):
        a, b = sorted((int(recording.target[indices[i]]), int(nearest_targets[i])))
        rows_by_pair.setdefault((int(recording.station[indices[i]]), a, b), []).append(int(i))
    for (s, a, b), members in rows_by_pair.items():
        station, names = recording.stations[s], (recording.targets[a], recording.targets[b])
        gap = float(np.linalg.norm(points[a] - points[b]))
        booked = sorted(set(recording.target[indices[members]].tolist()))
        if len(booked) == 2:
            sentence = (
                f"At station {station} the reflectors {names[0]} and {names[1]}, {gap:.2f} m apart, "
                f"were exchanged in {len(members)} pointings."
            )
        else:
            booked_name, meant = names if booked[0] == a else names[::-1]
            numbers = ", ".join(str(indices[i] + 1) for i in members[:MAX_LISTED_ITEMS])
            sentence = (
                f"At station {station} the pointing recorded for {booked_name} (row {numbers}) was made to {meant}, "
                f"{gap:.2f} m away."
            )
        finding = IdentifiedBlunder("target-swap", indices[members], (station,), names, (), gap, sentence)
        yield finding, recording.readings[indices[members]], nearest_targets[members]


def _wrong_heights(adjustment: Adjustment, is_gross: Bools) -> Iterator[BlunderWithCorrection]:
    """Blunders in heights: points directly above or below their target; `is_gross` (n,) flags pointings with errors."""
    recording = adjustment.recording
    indices = np.flatnonzero(is_gross & recording.is_measured.all(axis=1))
    if not len(indices):
        return
    point_deviations = (
        _network_points_from_readings(adjustment, recording.readings[indices], indices)
        - adjustment.state.target_points[recording.target[indices]]
    )
    plumb_lines = plumb_directions(recording)[recording.station[indices]]
    vertical_parts = np.einsum("ni,ni->n", point_deviations, plumb_lines)
    horizontal_parts = np.linalg.norm(point_deviations - vertical_parts[:, None] * plumb_lines, axis=1)
    tolerances = _tolerances(adjustment, indices)
    is_vertical = horizontal_parts < np.minimum(
        np.maximum(tolerances, MAX_HORIZONTAL_TO_VERTICAL_RATIO * np.abs(vertical_parts)),
        adjustment.sightings.range_[indices],
    )
    lift = np.zeros((len(recording), 3))
    lift[indices] = vertical_parts[:, None] * plumb_lines
    new_readings = recording.readings - reading_change_by_displacement(adjustment.sightings, lift)
    rows_by_setup: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero((np.abs(vertical_parts) > tolerances) & is_vertical):
        key = (
            int(recording.station[indices[i]]),
            int(recording.target[indices[i]]),
            round(vertical_parts[i] / (2.0 * tolerances[i])),
        )
        rows_by_setup.setdefault(key, []).append(int(i))
    for (s, t, _), members in rows_by_setup.items():
        station, target, size = recording.stations[s], recording.targets[t], float(np.mean(vertical_parts[members]))
        numbers = ", ".join(str(indices[i] + 1) for i in members[:MAX_LISTED_ITEMS])
        where = "above" if size > 0 else "below"
        sentence = (
            f"From station {station} the pointing to {target} (row {numbers}) is {abs(size) / MILLIMETRE:.1f} mm "
            f"{where} the target: the height of the target or the instrument is wrong, or the target moved vertically."
        )
        rows_ = indices[members]
        finding = IdentifiedBlunder("outlier", rows_, (station,), (target,), (), abs(size), sentence)
        yield finding, new_readings[rows_], recording.target[rows_]


def _unit_and_face_errors(adjustment: Adjustment, is_gross: Bools) -> Iterator[BlunderWithCorrection]:
    """Blunders in unit or face of single pointings, which agree with their target after a correction.

    `is_gross` (n,) flags those of the n pointings that have gross errors.
    """
    recording = adjustment.recording
    kinds = (WrongUnit.name, UNIT_AND_CONVENTION_ERRORS), (FaceConfusion.name, WRONG_FACE_ERRORS)
    for effect, slip in ((effect, slip) for effect, slips in kinds for slip in slips):
        readings = slip.without_error(recording.readings)
        at = np.flatnonzero(is_gross & np.isfinite(readings).all(axis=1))
        at = at[_distances_from_targets(adjustment, readings[at], at) < _tolerances(adjustment, at)]
        if len(at):
            stations = tuple(sorted({recording.stations[s] for s in recording.station[at]}))
            targets = tuple(sorted({recording.targets[t] for t in recording.target[at]}))
            size = float(_distances_from_targets(adjustment, recording.readings[at], at).max())
            where = f"{', '.join(stations)} to {', '.join(targets[:6])}"
            sentence = f"{len(at)} pointings at station {where} contain {slip.description}."
            observables = tuple(OBSERVABLES[c] for c in slip.changed_columns)
            finding = IdentifiedBlunder(effect, at, stations, targets, observables, size, sentence)
            yield finding, readings[at], recording.target[at]


def correct_units(recording: Recording) -> tuple[Recording, list[IdentifiedBlunder]]:
    """Recording with corrected readings of stations or faces recorded in another unit or convention, and the blunders.

    The faces of each station are compared first, because their difference needs no other station.

    Returns
    -------
    recording : Recording
        Recording with converted readings.
    findings : list of IdentifiedBlunder
        Blunders, one for each error of a face and each corrected station. Without an error of a face, the list is
        empty if the points of all stations have the same shape, if no unit or convention explains the difference, or
        if more than `MAX_COMPARED_STATIONS` stations differ.
    """
    recording, findings = _correct_face_units(recording)
    suspects = np.flatnonzero(_station_point_misfits(recording) > MIN_STATION_MISFIT_OF_WRONG_UNIT)
    if len(recording.stations) == 2:
        return recording, [*findings, *(_mirror_image_blunders(recording) if len(suspects) else ())]
    if len(suspects) > MAX_COMPARED_STATIONS:
        return recording, findings
    for s in suspects.tolist():
        name, rows = recording.stations[s], np.flatnonzero(recording.station == s)
        for effect in WrongUnit.blunders_at_station(name):
            readings = recording.readings.copy()
            readings[rows] = effect.transcription_error.without_error(readings[rows])
            corrected = recording.with_readings(readings)
            if _station_point_misfits(corrected, [s])[s] < MIN_STATION_MISFIT_OF_WRONG_UNIT:
                moved = from_polar(readings[rows]) - from_polar(recording.readings[rows])
                size = float(np.nanmax(np.linalg.norm(moved, axis=1)))
                sentence = f"Station {name} was recorded with {effect.transcription_error.description}."
                findings.append(IdentifiedBlunder(effect.name, rows, (name,), (), effect.observables, size, sentence))
                recording = corrected
                break
    return recording, findings


def _correct_face_units(recording: Recording) -> tuple[Recording, list[IdentifiedBlunder]]:
    """Recording with corrected readings of faces that were recorded in another unit or convention, and the blunders."""
    findings, readings = [], recording.readings.copy()
    for error in face_unit_errors(recording):
        rows = error.pointing_indices
        moved = from_polar(error.corrected_readings) - from_polar(recording.readings[rows])
        size = float(np.nanmax(np.linalg.norm(moved, axis=1), initial=0.0))
        readings[rows] = error.corrected_readings
        findings.append(
            IdentifiedBlunder(WrongUnit.name, rows, error.stations, (), error.observables, size, error.sentence)
        )
    return (recording.with_readings(readings) if findings else recording), findings


def _mirror_image_blunders(recording: Recording) -> list[IdentifiedBlunder]:
    """Blunder that two stations measured mirror images of each other, as a list; empty without mirror images.

    One of the stations has clockwise azimuths, but the readings do not show which one.
    """
    readings = recording.readings.copy()
    second_station_rows = np.flatnonzero(recording.station == 1)
    readings[second_station_rows, 1] *= -1.0
    if not _station_point_misfits(recording.with_readings(readings))[1] < MIN_STATION_MISFIT_OF_WRONG_UNIT:
        return []
    a, b = recording.stations
    sentence = f"Stations {a} and {b} measured mirror images: the azimuths of one of them are clockwise."
    return [IdentifiedBlunder(WrongUnit.name, second_station_rows, (a, b), (), ("azimuth",), 0.0, sentence)]


def correct_faces(recording: Recording) -> tuple[Recording, list[IdentifiedBlunder]]:
    """Recording with wrong faces of pointings corrected, and the blunders; the raw elevation shows the true face.

    If most pointings stored in one face have raw elevations of the other face, this is a convention of the file and no
    blunder; the recording is then unchanged.

    Returns
    -------
    recording : Recording
    findings : list of IdentifiedBlunder
        Blunders, one for each corrected station.
    """
    apparent_faces = np.where(np.cos(recording.readings[:, 2]) < 0.0, 2, 1)
    wrong = recording.is_usable_reading[:, 2] & (apparent_faces != recording.face)
    is_back_face = recording.face == 2
    if not wrong.any() or any(2 * np.sum(wrong & face) > np.sum(face) for face in (is_back_face, ~is_back_face)):
        return recording, []
    findings = []
    for s in np.unique(recording.station[wrong]):
        rows = np.flatnonzero(wrong & (recording.station == s))
        name, stored = recording.stations[s], sorted(set(recording.face[rows].tolist()))
        far = float(np.max(np.nan_to_num(recording.readings[rows, 0])))
        faces = " and ".join(str(face) for face in stored)
        sentence = (
            f"{len(rows)} pointings at station {name} are stored as face {faces}, but their raw elevations are those "
            "of the other face."
        )
        observables = ("azimuth", "elevation")
        findings.append(IdentifiedBlunder("face-confusion", rows, (name,), (), observables, 2 * far, sentence))
    return recording.replace(face=np.where(wrong, apparent_faces, recording.face)), findings


def _station_point_misfits(recording: Recording, stations: Collection[int] | None = None) -> Floats:
    """Misfits (S,) [m] of the points of S stations to those of other stations; 0 without enough common targets.

    The misfit of a pair of stations is the median distance of their common points after a rigid alignment. The misfit
    of a station is the median over the pairs with the stations that share most targets with it. `stations` restricts
    the comparison to pairs with one of these station indices.
    """
    pairs, count = StationTargetPairs.from_recording(recording), len(recording.stations)
    n_shared = shared_target_counts(pairs.station_indices, pairs.target_indices, count)
    np.fill_diagonal(n_shared, 0)
    neighbours = np.argsort(-n_shared, axis=1, kind="stable")[:, :MAX_COMPARED_STATIONS]
    is_pair, gaps = np.zeros((count, count), dtype=bool), np.full((count, count), np.nan)
    np.put_along_axis(
        is_pair, neighbours, np.take_along_axis(n_shared, neighbours, axis=1) > MIN_POINTS_FOR_POSE, axis=1
    )
    common: dict[int, list[tuple[int, int, Floats, Floats]]] = {}
    for a, b in np.argwhere(np.triu(is_pair | is_pair.T)).tolist():
        if not (stations is None or a in stations or b in stations):
            continue
        of_a, of_b = pairs.pair_slice_of_station(a), pairs.pair_slice_of_station(b)
        _, in_a, in_b = np.intersect1d(pairs.target_indices[of_a], pairs.target_indices[of_b], return_indices=True)
        points = pairs.local_points[of_b][in_b], pairs.local_points[of_a][in_a]
        common.setdefault(len(in_a), []).append((a, b, *points))
    for group in common.values():  # pairs with equal numbers of common points are aligned together
        first, second = np.array([(a, b) for a, b, *_ in group]).T
        here, there = (np.stack([pair[k] for pair in group]) for k in (2, 3))
        rotation, shift, is_determined = align_sets_robustly(here, there)
        moved = here @ np.swapaxes(rotation, 1, 2) + shift[:, None]
        misfits = np.where(is_determined, np.median(np.linalg.norm(moved - there, axis=2), axis=1), np.nan)
        gaps[first, second] = gaps[second, first] = misfits
    is_compared = np.isfinite(gaps).any(axis=1)
    median_misfits = np.zeros(count)
    median_misfits[is_compared] = np.nanmedian(gaps[is_compared], axis=1)
    return median_misfits

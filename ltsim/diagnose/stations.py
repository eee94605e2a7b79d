"""Whole stations recorded in another unit, convention or face: seen before anything is adjusted.

The targets that a station measured, as a cloud of points, must have the shape that other stations saw. One that
does not is tried with the mistakes people make; the mend that gives the shape back is the explanation. The face is
written in the raw elevation itself, which exceeds 90 degrees on face 2.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ltsim.adjust.start import robust_align, station_clouds
from ltsim.arrays import Floats
from ltsim.diagnose.gross import GrossFinding
from ltsim.errors import NetworkError
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording

WRONG_SHAPE = 5e-3
"""[m] median misfit of two stations' clouds that no tracker error and no single blunder makes."""

Mend = Callable[[Floats], Floats]


def _scaled(column: int, factor: float) -> Mend:
    def mend(readings: Floats) -> Floats:
        mended = readings.copy()
        mended[:, column] = mended[:, column] * factor
        return mended

    return mend


def _zenith(readings: Floats) -> Floats:
    mended = readings.copy()
    mended[:, 2] = np.pi / 2 - mended[:, 2]
    return mended


def _clockwise(readings: Floats) -> Floats:
    mended = readings.copy()
    mended[:, 1] = -mended[:, 1]
    return mended


def _both_angles(factor: float) -> Mend:
    def mend(readings: Floats) -> Floats:
        mended = readings.copy()
        mended[:, 1:] = mended[:, 1:] * factor
        return mended

    return mend


MENDS: tuple[tuple[str, tuple[str, ...], Mend], ...] = (
    ("metres in the column of millimetres", ("distance",), _scaled(0, 1e3)),
    ("micrometres in the column of millimetres", ("distance",), _scaled(0, 1e-3)),
    ("inches in the column of millimetres", ("distance",), _scaled(0, 25.4)),
    ("feet in the column of millimetres", ("distance",), _scaled(0, 304.8)),
    ("centimetres in the column of millimetres", ("distance",), _scaled(0, 10.0)),
    ("gon in the columns of degrees", ("azimuth", "elevation"), _both_angles(0.9)),
    ("radians in the columns of degrees", ("azimuth", "elevation"), _both_angles(180 / np.pi)),
    ("gon in the column of degrees of the azimuth", ("azimuth",), _scaled(1, 0.9)),
    ("gon in the column of degrees of the elevation", ("elevation",), _scaled(2, 0.9)),
    ("zenith angles in the column of elevations", ("elevation",), _zenith),
    ("azimuths counted clockwise", ("azimuth",), _clockwise),
)


def mend_stations(recording: Recording) -> tuple[Recording, list[GrossFinding]]:
    """Mend stations that were recorded in another unit or convention.

    Returns
    -------
    recording : Recording
        With their readings converted.
    findings : list of GrossFinding
        One a station; empty where every shape agrees or nothing explains the difference.
    """
    findings: list[GrossFinding] = []
    for s in _odd_stations(recording):
        for cause, observables, mend in MENDS:
            rows = np.flatnonzero(recording.station == s)
            readings = recording.readings.copy()
            readings[rows] = mend(readings[rows])
            mended = recording.with_readings(readings)
            if _misfit(mended)[s] < WRONG_SHAPE:
                name = recording.stations[s]
                moved = from_polar(readings[rows]) - from_polar(recording.readings[rows])
                size = float(np.nanmax(np.linalg.norm(moved, axis=1)))
                sentence = f"Station {name} was recorded with {cause}."
                findings.append(GrossFinding("wrong-unit", rows, (name,), (), observables, size, sentence))
                recording = mended
                break
    return recording, findings


def mend_faces(recording: Recording) -> tuple[Recording, list[GrossFinding]]:
    """Put pointings into the face that their raw elevations show, where the stored one is another.

    Where most pointings of face 2 read like face 1, that is how the file states elevations, and nobody's mistake.

    Returns
    -------
    recording : Recording
    findings : list of GrossFinding
        One a station.
    """
    shown = np.where(np.cos(recording.readings[:, 2]) < 0.0, 2, 1)
    wrong = np.isfinite(recording.readings[:, 2]) & (shown != recording.face)
    back = recording.face == 2
    if not wrong.any() or any(2 * np.sum(wrong & face) > np.sum(face) for face in (back, ~back)):
        return recording, []
    findings = []
    for s in np.unique(recording.station[wrong]):
        rows = np.flatnonzero(wrong & (recording.station == s))
        name, stored = recording.stations[s], sorted(set(recording.face[rows].tolist()))
        far = float(np.nanmax(recording.readings[rows, 0]))
        faces = " and ".join(str(face) for face in stored)
        sentence = (
            f"{len(rows)} pointings at station {name} are stored as face {faces}, but their raw elevations are those "
            "of the other face."
        )
        observables = ("azimuth", "elevation")
        findings.append(GrossFinding("face-confusion", rows, (name,), (), observables, 2 * far, sentence))
    return recording.replace(face=np.where(wrong, shown, recording.face)), findings


def _odd_stations(recording: Recording) -> list[int]:
    """Stations whose cloud differs in shape from most others."""
    if len(recording.stations) < 3:
        return []
    return [int(s) for s in np.flatnonzero(_misfit(recording) > WRONG_SHAPE)]


def _misfit(recording: Recording) -> Floats:
    """Median over the other stations of the median misfit (S,) [m] of two clouds; 0 without common targets."""
    cloud, seen = station_clouds(recording)
    count = len(recording.stations)
    gaps = np.full((count, count), np.nan)
    for a in range(count):
        for b in range(a):
            common = seen[a] & seen[b]
            if common.sum() < 4:
                continue
            try:
                rotation, translation = robust_align(cloud[a][common], cloud[b][common])
            except NetworkError:
                continue
            miss = np.linalg.norm(cloud[a][common] @ rotation.T + translation - cloud[b][common], axis=1)
            gaps[a, b] = gaps[b, a] = float(np.median(miss))
    known = np.isfinite(gaps).any(axis=1)
    middle = np.zeros(count)
    middle[known] = np.nanmedian(gaps[known], axis=1)
    return middle

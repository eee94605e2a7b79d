"""Whole stations recorded in another unit, convention or face: seen before anything is adjusted.

The targets that a station measured, as a cloud of points, must have the shape that other stations saw. One that
does not is tried with the mistakes people make; the mend that gives the shape back is the explanation. The face is
written in the raw elevation itself, which exceeds 90 degrees on face 2.
"""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.gross import GrossFinding
from ltsim.adjustment.start import station_clouds
from ltsim.arrays import Floats
from ltsim.effects.wrong_unit import WrongUnit
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import robust_align
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording

WRONG_SHAPE = 5e-3
"""[m] median misfit of two stations' clouds that no tracker error and no single blunder makes."""


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
    odd = np.flatnonzero(_misfit(recording) > WRONG_SHAPE)
    if len(recording.stations) == 2:
        return recording, _mirrored_pair(recording) if len(odd) else findings
    for s in odd:
        name, rows = recording.stations[s], np.flatnonzero(recording.station == s)
        for effect in WrongUnit.at(name):
            readings = recording.readings.copy()
            readings[rows] = effect.slip.mended(readings[rows])
            mended = recording.with_readings(readings)
            if _misfit(mended)[s] < WRONG_SHAPE:
                moved = from_polar(readings[rows]) - from_polar(recording.readings[rows])
                size = float(np.nanmax(np.linalg.norm(moved, axis=1)))
                sentence = f"Station {name} was recorded with {effect.slip.cause}."
                findings.append(GrossFinding(effect.name, rows, (name,), (), effect.observables, size, sentence))
                recording = mended
                break
    return recording, findings


def _mirrored_pair(recording: Recording) -> list[GrossFinding]:
    """Of two stations that see each other's targets in a mirror nobody can tell which has its azimuths clockwise."""
    readings = recording.readings.copy()
    rows = np.flatnonzero(recording.station == 1)
    readings[rows, 1] *= -1.0
    if not _misfit(recording.with_readings(readings))[1] < WRONG_SHAPE:
        return []
    a, b = recording.stations
    sentence = f"Stations {a} and {b} saw mirror images: the azimuths of one of them are clockwise."
    return [GrossFinding(WrongUnit.name, rows, (a, b), (), ("azimuth",), 0.0, sentence)]


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

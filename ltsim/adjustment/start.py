"""Approximate coordinates from the recording alone: stations joined one by one, in closed form where possible."""

from __future__ import annotations

import numpy as np

from ltsim.adjustment.frame import Frame
from ltsim.adjustment.growth import BEGINNINGS, Growth
from ltsim.adjustment.pairs import Pairs
from ltsim.arrays import Bools, Floats
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording


def station_clouds(recording: Recording, points: Floats | None = None) -> tuple[Floats, Bools]:
    """Each station's targets in its own frame (S, T, 3) [m], and which it measured (S, T).

    `points` (n, 3) are the measured points; by default those of an ideal tracker. Faces and repeats are combined by
    the median, which a single blunder does not move.
    """
    pairs = Pairs.of(recording, points)
    cloud = np.full((len(recording.stations), len(recording.targets), 3), np.nan)
    cloud[pairs.station, pairs.target] = pairs.points
    return cloud, np.isfinite(cloud[:, :, 0])


def start_network(recording: Recording) -> tuple[Floats, Floats, Floats]:
    """Positions (S, 3), rotations (S, 3, 3) and targets (T, 3) [m] in the first station's frame.

    Levels and known points define the frame where there are any. The station that shares most targets with what is
    known already is joined next; where too few were measured with range and both angles, single beams are
    intersected, stations resected, and a network of beams or of ranges alone begins by algebra.

    Raises
    ------
    NetworkError
        When the readings do not tie a station or a target to the rest.
    """
    growth = _grown(recording)
    growth.require_stations()
    growth.require_targets()
    return growth.result()


def reached_network(recording: Recording) -> tuple[tuple[Floats, Floats, Floats], Bools]:
    """The same, and the targets (T,) that the readings tie to nothing: these stand amid the others, to be left out.

    Raises
    ------
    NetworkError
        When the readings do not tie a station to the rest.
    """
    growth = _grown(recording)
    growth.require_stations()
    position, rotation, points = growth.result()
    lost = np.asarray(np.isnan(points).any(axis=1))
    return (position, rotation, np.where(lost[:, None], points[~lost].mean(axis=0), points)), lost


def _grown(recording: Recording) -> Growth:
    """The network as far as it grows."""
    pairs = Pairs.of(recording, _flat_points(recording))
    frame = Frame.of(recording)
    farthest: Growth | None = None
    for beginning in BEGINNINGS if frame.is_stated else BEGINNINGS[1:]:
        growth = Growth(recording, pairs, frame)
        growth.run(beginning)
        if growth.is_complete:
            return growth
        if farthest is None or growth.reach > farthest.reach:
            farthest = growth
    assert farthest is not None
    return farthest


def _flat_points(recording: Recording) -> Floats | None:
    """Measured points (n, 3) with horizontal distances turned into slope ones; None where there is none."""
    flat = recording.is_horizontal
    if not flat.any():
        return None
    readings = recording.readings.copy()
    readings[flat & np.isnan(readings[:, 2]), 2] = 0.0  # a network in plan has no elevations
    readings[flat, 0] /= np.abs(np.cos(readings[flat, 2]))
    return from_polar(readings)

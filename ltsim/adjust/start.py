"""Start values from the recording alone: stations joined one by one by closed-form alignment."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import align
from ltsim.geometry.polar import from_polar
from ltsim.recording.recording import Recording

ROBUST_PASSES = 8


def station_clouds(recording: Recording, points: Floats | None = None) -> tuple[Floats, Bools]:
    """Each station's targets in its own frame (S, T, 3) [m], and which it measured (S, T).

    `points` (n, 3) are the measured points; by default those of an ideal tracker. Faces and repeats are combined by
    the median, which a single blunder does not move.
    """
    size = (len(recording.stations), len(recording.targets))
    measured = from_polar(recording.readings) if points is None else points
    cloud = np.full((*size, 3), np.nan)
    whole = np.isfinite(measured).all(axis=1)
    for s in range(size[0]):
        here = np.flatnonzero((recording.station == s) & whole)
        for t in np.unique(recording.target[here]):
            cloud[s, t] = np.median(measured[here[recording.target[here] == t]], axis=0)
    return cloud, np.isfinite(cloud[:, :, 0])


def robust_align(source: Floats, goal: Floats) -> tuple[Floats, Floats]:
    """Rigid alignment by least absolute deviations (reweighted), so that a swapped target does not tilt it."""
    rotation, translation = align(source, goal)
    if len(source) < 4:
        return rotation, translation
    for _ in range(ROBUST_PASSES):
        miss = np.linalg.norm(source @ rotation.T + translation - goal, axis=1)
        floor = max(1e-5, 0.5 * float(np.median(miss)))
        rotation, translation = align(source, goal, 1.0 / np.maximum(miss, floor))
    return rotation, translation


def start_network(recording: Recording) -> tuple[Floats, Floats, Floats]:
    """Positions (S, 3), rotations (S, 3, 3) and targets (T, 3) [m] in the first station's frame.

    The station that shares most targets with what is known already is joined next.

    Raises
    ------
    NetworkError
        When a station shares fewer than three targets with all others together.
    """
    cloud, seen = station_clouds(recording)
    count = len(recording.stations)
    position, rotation = np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1))
    placed = np.full_like(cloud, np.nan)
    placed[0] = cloud[0]
    have, joined = seen[0].copy(), np.zeros(count, dtype=bool)
    joined[0] = True
    while not joined.all():
        shared = np.where(joined, -1, np.sum(seen & have, axis=1))
        best = int(np.argmax(shared))
        if shared[best] < 3:
            lost = ", ".join(recording.stations[s] for s in np.flatnonzero(~joined))
            raise NetworkError(
                f"station {lost}: shares only {max(shared)} targets with the rest of the network; "
                "at least three are needed"
            )
        common = seen[best] & have
        known = np.nanmedian(placed[joined][:, common], axis=0)
        rotation[best], position[best] = robust_align(cloud[best][common], known)
        placed[best] = cloud[best] @ rotation[best].T + position[best]
        joined[best] = True
        have |= seen[best]
    unseen = ~seen.any(axis=0)
    if unseen.any():
        name = recording.targets[int(np.argmax(unseen))]
        raise NetworkError(f"target {name}: has no pointing with range and both angles")
    return position, rotation, np.nanmedian(placed, axis=0)

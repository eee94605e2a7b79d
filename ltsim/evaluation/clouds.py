"""Each station's targets as points in its own frame, and all stations brought into one frame."""

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import align
from ltsim.geometry.polar import from_polar
from ltsim.model.construction import Construction
from ltsim.recording.recording import Recording


def measured_points(
    recording: Recording, construction: Construction | None = None, values: Floats | None = None
) -> Floats:
    """Points (n, 3) [m] in the instruments' frames; NaN where a reading is missing.

    They are corrected by a construction's parameters (p,), or (n, p) where instruments differ [SI]; by default raw.
    """
    whole = recording.measured.all(axis=1)
    points = np.full((len(recording), 3), np.nan)
    raw = recording.readings[whole]
    if construction is None or values is None:
        points[whole] = from_polar(raw)
    else:
        points[whole] = construction.point(raw, values if values.ndim == 1 else values[whole])
    return points


def station_means(recording: Recording, points: Floats, use: Bools | None = None) -> Floats:
    """Mean (S, T, 3) over faces and repeats of the points (n, 3) of each station and target; NaN: none."""
    size = (len(recording.stations), len(recording.targets))
    whole = np.isfinite(points).all(axis=1)
    if use is not None:
        whole &= use
    at = (recording.station[whole], recording.target[whole])
    total, count = np.zeros((*size, 3)), np.zeros(size)
    np.add.at(total, at, points[whole])
    np.add.at(count, at, 1.0)
    return np.where(count[:, :, None] > 0, total / np.maximum(count, 1.0)[:, :, None], np.nan)


def on_points(cloud: Floats, goal: Floats) -> Floats:
    """A cloud (T, 3) moved rigidly onto `goal` (T, 3) by least squares over the targets both have.

    Raises NetworkError when they share fewer than three targets off one line.
    """
    shared = np.isfinite(cloud[:, 0]) & np.isfinite(goal[:, 0])
    rotation, translation = align(cloud[shared], goal[shared])
    return cloud @ rotation.T + translation


def in_first_frame(clouds: Floats, names: tuple[str, ...]) -> Floats:
    """Clouds (S, T, 3), each moved rigidly into the first station's frame.

    A station that shares fewer than three targets with the first is moved onto the mean of those that are
    there already; the paper's stations all see all targets. Raises NetworkError, naming a station that cannot be
    joined.
    """
    placed = np.full_like(clouds, np.nan)
    placed[0] = clouds[0]
    seen = np.isfinite(clouds[:, :, 0])
    total, count = np.where(seen[0][:, None], clouds[0], 0.0), seen[0].astype(np.int64)
    direct, known = seen @ seen[0].astype(np.int64), seen @ seen[0].astype(np.int64)
    waiting = np.arange(len(clouds)) > 0
    while waiting.any():
        station = int(np.argmax(np.where(waiting, direct, -1)))
        goal = clouds[0]
        if direct[station] < 3:
            station = int(np.argmax(np.where(waiting, known, -1)))
            goal = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], np.nan)
        waiting[station] = False
        try:
            placed[station] = on_points(clouds[station], goal)
        except NetworkError as problem:
            message = f"station {names[station]} cannot be joined to the others: {problem}"
            raise NetworkError(message) from None
        new = seen[station] & (count == 0)
        known += seen[:, new].sum(axis=1)
        total[seen[station]] += placed[station, seen[station]]
        count += seen[station]
    return placed

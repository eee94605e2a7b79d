"""Sights in both directions between two marks: the range of one sight as approximate range of the opposite one."""

import numpy as np

from ltsim.adjustment.marks import StationMarks
from ltsim.recordings.recording import Recording


def with_ranges_of_opposite_sights(recording: Recording, marks: StationMarks) -> Recording:
    """Recording whose sights with angles but without range have the range of the opposite sight, if there is one.

    The station of the opposite sight stands over the target of the sight, and the reverse. The ranges differ by the
    heights of instruments and reflectors, and are therefore for start values only. The recording itself is returned if
    no range is added.
    """
    mark, has_range = marks.target_indices[recording.station], recording.is_measured[:, 0]
    usable = has_range & (mark >= 0) & ~recording.is_horizontal_distance
    range_by_ends = {
        ends: float(length)
        for ends, length in zip(
            zip(mark[usable].tolist(), recording.target[usable].tolist(), strict=True),
            recording.readings[usable, 0],
            strict=True,
        )
    }
    readings = recording.readings.copy()
    for row in np.flatnonzero(~has_range & (mark >= 0) & recording.is_measured[:, 1:].all(axis=1)).tolist():
        readings[row, 0] = range_by_ends.get((int(recording.target[row]), int(mark[row])), np.nan)
    return recording.with_readings(readings) if np.isfinite(readings[:, 0]).sum() > has_range.sum() else recording

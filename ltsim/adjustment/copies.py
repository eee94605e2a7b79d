"""Rows that repeat another to the last digit: copies of one pointing, which tell nothing new."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Bools
from ltsim.recording.recording import Recording

LEAST = 10
"""Rows without a clock that must repeat others, all of those that could, before they count as copies."""


def copied_rows(recording: Recording) -> Bools:
    """(n,) True for rows that an earlier row of the same time, set-up, target and face equals in every digit.

    Where the recording has no clock, two pointings may read the same by chance: then rows are copies only if every
    repeated pointing repeats to the last digit.
    """
    values = np.sort(recording.readings, axis=None)
    if not np.any(values[1:] == values[:-1]):
        return np.zeros(len(recording), dtype=bool)
    place = np.stack([recording.station, recording.target, recording.face], axis=1)
    clock = recording.time[:, None] if recording.has_clock else np.zeros((len(recording), 0))
    whole = np.concatenate([place, clock, np.nan_to_num(recording.readings, nan=np.inf)], axis=1)
    repeated = _later(np.concatenate([place, clock], axis=1))
    copied = _later(whole) & recording.measured.any(axis=1)
    if recording.has_clock:
        return copied
    return copied & (copied.sum() >= max(LEAST, int(repeated.sum())))


def _later(rows: np.ndarray) -> Bools:
    """(n,) True for rows that equal an earlier one."""
    later = np.ones(len(rows), dtype=bool)
    later[np.unique(rows, axis=0, return_index=True)[1]] = False
    return later

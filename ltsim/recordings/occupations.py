"""Days of the pointings of a recording, and occupations of its targets by reflectors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Ints
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.recording import Recording

DAY_COLUMN = "date"
"""Column of a recording with the day of each pointing."""
DAY_LENGTH_S = 86_400.0
"""Length [s] of a day."""


def days_of_pointings(recording: Recording) -> tuple[str, ...]:
    """Day of each pointing as written in the recording, or counted by the clock; empty without days."""
    if DAY_COLUMN in recording.labels:
        return recording.labels[DAY_COLUMN]
    if not recording.has_clock or np.ptp(recording.time) < DAY_LENGTH_S:
        return ()
    return tuple(f"day {int(day) + 1}" for day in (recording.time - recording.time.min()) // DAY_LENGTH_S)


def target_occupations(recording: Recording, centring: CentringUncertainty) -> Ints:
    """Index of the occupation of a target by a reflector, (n,); -1 for pointings that `centring` does not concern.

    A recording without the column or the days that distinguish occupations has one for each target.
    """
    keys: Sequence[object] = ("",) * len(recording)
    if centring.occupation == "station":
        keys = recording.station.tolist()
    elif centring.occupation == "day":
        keys = days_of_pointings(recording) or keys
    else:
        keys = recording.labels.get(centring.occupation, keys)
    acts = np.ones(len(recording), dtype=bool)
    for chosen, names, index in (
        (centring.stations, recording.stations, recording.station),
        (centring.targets, recording.targets, recording.target),
    ):
        if chosen:
            acts &= np.isin(np.array(names)[index], chosen)
    number_of: dict[object, int] = {}
    occupation = np.full(len(recording), -1, dtype=np.int64)
    for row in np.flatnonzero(acts).tolist():
        occupation[row] = number_of.setdefault((int(recording.target[row]), keys[row]), len(number_of))
    return occupation

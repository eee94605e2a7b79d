"""Days of pointings, and occupations of targets (times during which the reflector on a target is not moved)."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Ints
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.recording import OCCUPATION_COLUMNS, Recording

DAY_COLUMN = "date"
"""Name of the column with the day of each pointing, as text."""
DAY_LENGTH_S = 86_400.0
"""Length [s] of a day."""
MAX_NAMES_IN_MESSAGE = 12
"""Largest number of names that a message lists if none is similar to the unknown name."""


def days_of_pointings(recording: Recording) -> tuple[str, ...]:
    """Name of the day of each of n pointings: the text in the column `date`, or "day 1", "day 2" and so on by time.

    The result is empty if there is no such column and the recording has no clock or is shorter than a day.
    """
    if DAY_COLUMN in recording.labels:
        return recording.labels[DAY_COLUMN]
    if not recording.has_clock or np.ptp(recording.time) < DAY_LENGTH_S:
        return ()
    return tuple(f"day {int(day) + 1}" for day in (recording.time - recording.time.min()) // DAY_LENGTH_S)


def check_centring_tables(recording: Recording, file: object) -> None:
    """Check that each table `[[centring]]` of the set-up names stations, targets and columns that the recording has.

    Raises RecordError, which names `file` and proposes similar names.
    """
    for i, entry in enumerate(recording.setup.centring):
        location = SourceLocation(file, column=f"centring {i + 1}")
        for key, name, names in entry.unknown_names(recording.stations, recording.targets):
            near = ", ".join(difflib.get_close_matches(name, names, n=3, cutoff=0.3) or names[:MAX_NAMES_IN_MESSAGE])
            raise location.error(f"{key} contains '{safe_excerpt(name)}', which is not measured; did you mean {near}?")
        has_days = bool(days_of_pointings(recording))
        if entry.occupation == "day" and not has_days:
            message = f"occupation = \"day\" needs a column '{DAY_COLUMN}', or times over several days"
            raise location.error(f"{message}; the recording has neither")
        if entry.occupation in OCCUPATION_COLUMNS and entry.occupation not in recording.labels:
            raise location.error(
                f'occupation = "{entry.occupation}" needs a column of this name; the recording has none'
            )


def target_occupations(recording: Recording, centring: CentringUncertainty) -> Ints:
    """Index (n,) of the target occupation of each of n pointings; -1 for a pointing without centring error.

    In one occupation the reflector on a target is not moved. `centring` gives the rule that separates occupations, and
    the stations and targets with centring errors. If the recording lacks the column or the days for this rule, each
    target has one occupation.
    """
    keys: Sequence[object] = ("",) * len(recording)
    if centring.occupation == "station":
        keys = recording.station.tolist()
    elif centring.occupation == "day":
        keys = days_of_pointings(recording) or keys
    else:
        keys = recording.labels.get(centring.occupation, keys)
    is_affected = np.ones(len(recording), dtype=bool)
    for declared_names, names, index in (
        (centring.stations, recording.stations, recording.station),
        (centring.targets, recording.targets, recording.target),
    ):
        if declared_names:
            declared = frozenset(declared_names)
            is_affected &= np.array([name in declared for name in names], dtype=bool)[index]
    index_by_key: dict[object, int] = {}
    occupation = np.full(len(recording), -1, dtype=np.int64)
    for row in np.flatnonzero(is_affected).tolist():
        occupation[row] = index_by_key.setdefault((int(recording.target[row]), keys[row]), len(index_by_key))
    return occupation

"""Times and time intervals of a recording, as texts for messages."""

from collections.abc import Sequence
from datetime import datetime, time as clock, timedelta

import numpy as np

from ltsim.recordings.recording import Recording

MIN_PLAUSIBLE_TARGET_INTERVAL_S = 0.1
"""Smallest plausible median time [s] from one target to the next. For a smaller one the user is asked to check the unit
of the time column."""
MAX_PLAUSIBLE_TARGET_INTERVAL_S = 7200.0
"""Largest plausible median time [s] from one target to the next. For a larger one the user is asked to check the unit
of the time column."""
MIN_TARGET_CHANGES_FOR_TIME_CHECK = 8
"""Number of changes from one target to another that a recording needs for the check of its time unit."""


def time_text(recording: Recording, time: float) -> str:
    """Text of a `time` [s] since the start of a recording with a clock.

    The text is the date and time, or the time of day, if the set-up declares the start; otherwise a number of seconds.
    """
    started = recording.setup.started
    try:
        return f"{datetime.fromisoformat(started) + timedelta(seconds=time):%Y-%m-%d %H:%M:%S}"
    except ValueError:
        pass
    try:
        start = datetime.combine(datetime(2000, 1, 1), clock.fromisoformat(started))
    except ValueError:
        return f"{time:.1f} s"
    return f"{start + timedelta(seconds=time):%H:%M:%S}"


def interval_text(
    recording: Recording, first_index: int, second_index: int, row_numbers: Sequence[int] | None = None
) -> str:
    """Text of the interval between two pointings, such as `between 310.0 s and 320.0 s (rows 32 and 33)`.

    `first_index` and `second_index` are the indices of the pointings in the recording. `row_numbers` (n,) are the
    numbers, from 1, that the n pointings have in the larger recording from which this one was selected; by default
    indices plus 1. Without a clock the text has only the rows.
    """
    first, second = (index + 1 if row_numbers is None else row_numbers[index] for index in (first_index, second_index))
    rows = f"rows {first} and {second}"
    if not recording.has_clock:
        return f"between {rows}"
    times = " and ".join(time_text(recording, float(recording.time[index])) for index in (first_index, second_index))
    return f"between {times} ({rows})"


def time_unit_questions(recording: Recording) -> tuple[str, ...]:
    """Question about the unit of the time column if the time between targets is implausible; otherwise empty."""
    is_change = (np.diff(recording.target) != 0) & (np.diff(recording.station) == 0)
    paces = np.abs(np.diff(recording.time))[is_change]
    paces = paces[np.isfinite(paces)]
    if not recording.has_clock or len(paces) < MIN_TARGET_CHANGES_FOR_TIME_CHECK:
        return ()
    pace = float(np.median(paces))
    if MIN_PLAUSIBLE_TARGET_INTERVAL_S <= pace <= MAX_PLAUSIBLE_TARGET_INTERVAL_S:
        return ()
    span_s = float(np.nanmax(recording.time) - np.nanmin(recording.time))
    return (
        f"the {len(recording)} pointings take {span_s:.4g} s, {pace:.3g} s from one target to the next: check the unit "
        "of the time column and give it with --columns, such as time=HEADER[h]; drifts in time depend on it",
    )

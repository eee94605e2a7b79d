"""Texts of times and time intervals of a recording, for messages."""

from collections.abc import Sequence
from datetime import datetime, time as clock, timedelta

from ltsim.recordings.recording import Recording


def time_text(recording: Recording, time: float) -> str:
    """Text of a `time` [s] since the start of a recording with a clock.

    The text is date and clock time, or clock time, as the set-up declares the start; otherwise the number of seconds.
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
    """Text of the interval between the times of two pointings, given by their indices in the recording.

    The numbers of both rows follow the times: `between 310.0 s and 320.0 s (rows 32 and 33)`; without a clock only the
    rows are given. `row_numbers` (n,) are the row numbers, from 1, of the n pointings in the larger recording of which
    this recording is a part; by default indices plus 1.
    """
    first, second = (index + 1 if row_numbers is None else row_numbers[index] for index in (first_index, second_index))
    rows = f"rows {first} and {second}"
    if not recording.has_clock:
        return f"between {rows}"
    times = " and ".join(time_text(recording, float(recording.time[index])) for index in (first_index, second_index))
    return f"between {times} ({rows})"

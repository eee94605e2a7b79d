"""Text of times of a recording, for sentences on what happened when."""

from collections.abc import Sequence
from datetime import datetime, time as clock, timedelta

from ltsim.recordings.recording import Recording


def time_text(recording: Recording, time: float) -> str:
    """Text of a time [s] since the start of a recording with a clock.

    The text is the clock time if the start is declared, otherwise the number of seconds.
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

    Their rows follow the times, or replace them if the recording has no clock: `between 310.0 s and 320.0 s (rows 32
    and 33)`. `row_numbers` (n,) are the rows of the n pointings, from 1, if the recording is a part of a larger one.
    """
    first, second = (index + 1 if row_numbers is None else row_numbers[index] for index in (first_index, second_index))
    rows = f"rows {first} and {second}"
    if not recording.has_clock:
        return f"between {rows}"
    times = " and ".join(time_text(recording, float(recording.time[index])) for index in (first_index, second_index))
    return f"between {times} ({rows})"

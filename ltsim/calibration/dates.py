"""Days between calibrations."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError


def days_of(labels: Sequence[str], dates: Sequence[str | None]) -> Floats | None:
    """Days (K,) since the first of dates in ISO form; None where one is missing; raises RecordError."""
    if len(dates) != len(labels):
        raise RecordError(f"found {len(dates)} dates for {len(labels)} calibrations, expected one each")
    stated = [date for date in dates if date]
    if len(stated) < len(dates):
        return None
    try:
        times = [datetime.datetime.fromisoformat(date).replace(tzinfo=None) for date in stated]
    except ValueError:
        raise RecordError(f"found the dates {', '.join(stated)}, expected such as 2026-05-31") from None
    days = np.array([(time - times[0]) / datetime.timedelta(days=1) for time in times])
    back = np.flatnonzero(np.diff(days) < 0)
    if len(back):
        i = int(back[0])
        message = f"{labels[i]} ({stated[i]}) stands before {labels[i + 1]} ({stated[i + 1]})"
        raise RecordError(f"{message}; expected calibrations in the order of time")
    return days

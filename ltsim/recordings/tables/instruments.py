"""Kind of instrument that a table shows: a total station where a laser tracker cannot have written it."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import FACTOR
from ltsim.recordings.setup import Instrument
from ltsim.recordings.specification import LIKE_TOTAL_STATION, NO_NOISE, TOTAL_STATION
from ltsim.recordings.tables.header import DISTANCE
from ltsim.recordings.tables.meaning import ColumnInterpretation
from ltsim.recordings.tables.printed import PointingTable, decimal_places

TRACKER_RANGE_M = 160.0
"""[m] No laser tracker measures farther (makers' data sheets: 80 to 160)."""
COARSE_M = 0.5e-4
"""[m] Last digit of ranges that is coarser than a laser tracker's noise by far: trackers print micrometres."""

LEAST_RANGES = 6
"""Smallest number of ranges whose last digit is trusted: fewer may all end in zeros by chance."""


def is_total_station(table: PointingTable, meaning: ColumnInterpretation, readings: Floats) -> str:
    """Reason why the table is one of a total station; empty where it may be a laser tracker's.

    Heights over marks alone are none: trackers stand over marks too.
    """
    if table.holds_places:
        return ""
    ranges = readings[:, 0][np.isfinite(readings[:, 0])]
    if table.column(("flat",)) is not None:
        return "it holds horizontal distances"
    if not len(ranges):
        return ""
    if ranges.max() > TRACKER_RANGE_M:
        return f"its longest range is {ranges.max():.4g} m, beyond any laser tracker"
    columns = [digits for role, digits in table.pointings.numbers.items() if role in DISTANCE]
    places = np.concatenate([decimal_places(digits[digits != b""]) for digits in columns])
    if len(places) < LEAST_RANGES:
        return ""
    digit = 10.0 ** -int(places.max()) * FACTOR[meaning.length_unit]
    if digit > COARSE_M:
        return f"its ranges are written to {1e3 * digit:.2g} mm"
    if table.column(("instrument_height_mm",)) is not None and digit > COARSE_M / 10:
        return f"its ranges are written to {1e3 * digit:.2g} mm, with heights over marks"
    return ""


def instrument_of(reason: str) -> tuple[Instrument, str]:
    """Instrument of a table that states no noise, and the note about it."""
    return (TOTAL_STATION, LIKE_TOTAL_STATION.format(reason=reason)) if reason else (Instrument(), NO_NOISE)

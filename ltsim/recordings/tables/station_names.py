"""Detection of tables with several set-ups, or several points, that have no distinct names, by their readings.

If several set-ups have no names, ranges and elevations to one target differ.
"""

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.spreadsheets.header import title_words_and_unit
from ltsim.recordings.tables.pointing_table import PointingTable, distinct_with_indices

MAX_RANGE_AND_ELEVATION_SPREAD_OF_SETUP = (0.1, 0.02)
"""Median differences of the ranges [m] and of the elevations [rad] to one target, above which a table without station
names has several set-ups. Reflectors, faces and drifts cause smaller differences, different positions larger ones (0.02
rad is 0.1 m at 5 m)."""
MAX_SPREAD_RATIO_OF_STATION_COLUMN = 0.01
"""Largest ratio with which a column is the column of set-up names. It is the median difference of readings to one
target among rows with one text in the column, divided by that among all rows."""
MIN_ROWS_PER_SETUP = 3
"""Smallest mean number of rows for each different text of a column that may be the column of set-up names."""


class UnrecognisedStationColumnError(RecordError):
    """Error for a table in which a column with unknown title contains the names of set-ups."""


def require_single_unnamed_setup(table: PointingTable, readings: Floats, file: object) -> None:
    """Check that a table without station names has one set-up: ranges and elevations to each target agree.

    `readings` (n, 3) are ranges, azimuths and elevations of n pointings [m, rad, rad]. For several set-ups,
    UnrecognisedStationColumnError names the column that contains their names; without such a column RecordError is
    raised.
    """
    if not table.lacks_station_names:
        return
    targets = distinct_with_indices(table.pointings.target)[1]
    elevation = np.where(np.abs(readings[:, 2]) > np.pi / 2, np.pi - readings[:, 2], readings[:, 2])
    for values, limit, unit in zip(
        (readings[:, 0], elevation), MAX_RANGE_AND_ELEVATION_SPREAD_OF_SETUP, ("m", "rad"), strict=True
    ):
        spread = _median_spread(values, targets)
        if spread <= limit:
            continue
        names: list[tuple[int, bool, str]] = []
        for title, texts in table.pointings.additional_cells.items():
            distinct, of_value = distinct_with_indices(texts)
            groups = distinct_with_indices(zip(of_value.tolist(), targets.tolist(), strict=True))[1]
            if (
                1 < len(distinct) <= len(texts) / MIN_ROWS_PER_SETUP
                and _median_spread(values, groups) < MAX_SPREAD_RATIO_OF_STATION_COLUMN * spread
            ):
                names.append((len(distinct), bool(title_words_and_unit(title)[1]), title))
        quantity = "distances" if unit == "m" else "elevations"
        fault = f"names no station, but {quantity} to the same target differ by {spread:.3g} {unit}"
        if names:
            count, _, title = min(names)
            message = (
                f"{fault}; column '{safe_excerpt(title)}' may name {count} stations: give --columns \"station={title}\""
            )
            raise UnrecognisedStationColumnError(message, file=file)
        advice = "add a column station, or give --hint station=NAME if it is a single set-up"
        message = f"{fault}, so it has several set-ups; {advice}"
        raise RecordError(message, file=file)


def require_names_in_target_column(table: PointingTable, readings: Floats, file: object) -> None:
    """Check that the column of targets of several set-ups does not number the rows beside a column of names.

    No two rows then have the same target. The texts of a column of names recur at other stations, and the distances
    from a station to a text agree. `readings` (n, 3) are ranges, azimuths and elevations of n pointings [m, rad, rad].
    Raises RecordError, which names the column.
    """
    stations, numbers = table.pointings.station, table.column_with_role(("target",))
    if numbers is None or len({*stations}) == 1 or len({*table.pointings.target}) < len(stations):
        return
    for column in (c for c in table.columns if c.is_additional and not c.role and not c.unit):
        texts = table.pointings.additional_cell_texts(column.title)
        sights, groups = distinct_with_indices(zip(stations, texts, strict=True))
        if (
            1 < len({*texts}) < len(sights)
            and _median_spread(readings[:, 0], groups) <= MAX_RANGE_AND_ELEVATION_SPREAD_OF_SETUP[0]
        ):
            title = safe_excerpt(column.title)
            message = (
                f"column '{safe_excerpt(numbers.title)}' numbers the rows, so no two stations share a target; column "
                f"'{title}' may name the targets: give --columns \"target={title}\""
            )
            raise RecordError(message, file=file)


def ambiguous_target_name_notes(table: PointingTable, readings: Floats) -> list[str]:
    """Note, in a list, that names of targets denote several points, if ranges from a set-up differ; otherwise empty.

    Ranges must differ for most of the names. `readings` (n, 3) are ranges, azimuths and elevations of n pointings [m,
    rad, rad].
    """
    sights, groups = distinct_with_indices(zip(table.pointings.station, table.pointings.target, strict=True))
    spread = _median_spread(readings[:, 0], groups)
    if spread <= MAX_RANGE_AND_ELEVATION_SPREAD_OF_SETUP[0]:
        return []
    finite = np.isfinite(readings[:, 0])
    low, high = np.full(len(sights), np.inf), np.full(len(sights), -np.inf)
    np.minimum.at(low, groups[finite], readings[finite, 0])
    np.maximum.at(high, groups[finite], readings[finite, 0])
    worst_station = int(np.argmax(high - low))
    station, target = (safe_excerpt(name) for name in sights[worst_station])
    return [
        f"the name of a target stands for several positions: the distances from '{station}' to '{target}' differ by "
        f"{high[worst_station] - low[worst_station]:.3g} m; if it names a reflector that moved, name each point"
    ]


def _median_spread(values: Floats, groups: Ints) -> float:
    """Median, over groups of the n `values`, of the largest minus the smallest value in a group.

    `groups` (n,) is the index of the group of each value. Values that are not finite are ignored. The result is 0 if no
    group has several values.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return 0.0
    order = np.lexsort((values[finite], groups[finite]))
    values, groups = values[finite][order], groups[finite][order]
    first_indices = np.flatnonzero(np.diff(groups, prepend=-1))
    last_indices = np.append(first_indices[1:], len(groups)) - 1
    spreads = (values[last_indices] - values[first_indices])[last_indices > first_indices]
    return float(np.median(spreads)) if len(spreads) else 0.0

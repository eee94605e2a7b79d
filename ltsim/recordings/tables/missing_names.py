"""Missing and ambiguous names of set-ups and targets in tables, detected and completed from the readings.

If several set-ups have no names, ranges and elevations to one target differ. Targets without names are, for example,
the positions of a moving target (on a robot, a T-MAC).
"""

from itertools import product
from operator import add, sub

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.notation import names_text
from ltsim.geometry.polar import from_polar
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.hints import Hints
from ltsim.recordings.spreadsheets.cells import is_numeric
from ltsim.recordings.spreadsheets.header import title_words_and_unit
from ltsim.recordings.tables.pointing_table import PointingTable, UnconvertedPointings, distinct_with_indices

MAX_RANGE_AND_ELEVATION_SPREAD_OF_SETUP = (0.1, 0.02)
"""Limits of the median differences of the ranges [m] and of the elevations [rad] to one target. If they are exceeded, a
table without station names has several set-ups. Reflectors, faces and drifts cause smaller differences, different
positions larger ones (0.02 rad is 0.1 m at 5 m)."""
MAX_SPREAD_RATIO_OF_STATION_COLUMN = 0.01
"""Limit of the median difference of readings to one target among rows with one text in a column, divided by that among
all rows. If the ratio is smaller, the column contains the names of the set-ups."""
MIN_ROWS_PER_SETUP = 3
"""Smallest mean number of rows for each different text of a column that may be the column of set-up names."""
MAX_SAME_POSITION_DISTANCE_TO_RANGE = 3e-4
"""Largest distance of measured points that count as one position, divided by the largest range: 1 mm at 3 m, which is
more than the repeatability of a robot.
"""
MIN_ROWS_OF_MOVING_TARGET = 3
"""Smallest number of rows, and of different positions, with one target name that show a moving target."""
MAX_COINCIDENT_DISTANCE_M = 1e-3
"""Limit of the distance [m] between two targets. Below it they are one point, because reflectors have diameters of at
least 12.7 mm."""
MIN_COINCIDENT_POSITIONS = 3
"""Smallest number of positions with several targets that a note reports."""
MAX_COINCIDENT_NAMES_IN_NOTE = 4
"""Largest number of names of targets at one position in a note."""
MOVING_TARGET_TEXT = "as a moving target gives (on a robot, a T-MAC)"
"""Phrase that describes a table of positions without point names."""
STATION_OF_POSITIONS_ADVICE = (
    "if one station measured them in its frame, name the station: --format table --hint station=NAME"
)
"""Advice on positions without the name of a station."""
PLACEHOLDER_TARGET_NAME = "pose"
"""Temporary name of all targets of a table without point names, until their positions are computed and numbered."""


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
        message = f"{fault}, so it appears to have several set-ups; {advice}"
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


class UnnamedTargetsError(RecordError):
    """Error for a table of several set-ups without names of targets."""


def with_placeholder_target_name(table: PointingTable, hints: Hints, file: object) -> PointingTable:
    """Table with the target name `PLACEHOLDER_TARGET_NAME` in all rows, if no row names its target; changed in place.

    Raises UnnamedTargetsError for several set-ups, because their common targets are then unknown. Raises it also if a
    column may contain the names of targets, unless the hints name the station.
    """
    pointings = table.pointings
    if {*pointings.target} != {""}:
        return table
    if len({*pointings.station}) > 1:
        message = "names no points, so common targets of its set-ups are unknown; add a column target"
        raise UnnamedTargetsError(message, file=file)
    titles = [] if hints.station is not None else _possible_name_titles(table)
    if titles:
        titles_text = names_text([f"'{title}'" for title in titles], MAX_COINCIDENT_NAMES_IN_NOTE)
        message = (
            f'names no points, and {titles_text} may contain names; give --columns "target={titles[-1]}", or --hint '
            "station=NAME if one target moved and one set-up measured it"
        )
        raise UnnamedTargetsError(message, file=file)
    pointings.target = [PLACEHOLDER_TARGET_NAME] * len(pointings)
    table.has_unnamed_targets = True
    return table


def _possible_name_titles(table: PointingTable) -> list[str]:
    """Titles of columns that may name targets: no role or unit, and texts or whole numbers that partly repeat."""
    titles = []
    for column in table.columns:
        distinct = (
            {*table.pointings.additional_cell_texts(column.title)}
            if column.is_additional and not column.role
            else set()
        )
        are_names = all(text.isdigit() or not is_numeric(text) for text in distinct)
        if are_names and not column.unit and "" not in distinct and 1 < len(distinct) < len(table.pointings):
            titles.append(safe_excerpt(column.title))
    return titles


def name_targets_by_position(table: PointingTable, readings: Floats) -> PointingTable:
    """Table in which each position is a separate target, if all rows have one target name or none; changed in place.

    `readings` (n, 3) are raw ranges, azimuths and elevations [m, rad, rad] of n pointings in both faces.
    """
    names, stations = {*table.pointings.target}, {*table.pointings.station}
    if len(names) > 1:
        table.notes += _coincident_targets_notes(table.pointings, readings)
    if len(names) > 1 or len(stations) > 1:
        return table
    is_named = not table.has_unnamed_targets
    if is_named and len(table.pointings) < MIN_ROWS_OF_MOVING_TARGET:
        return table
    position_numbers = _position_numbers(readings)
    n_positions = int(position_numbers.max()) + 1
    if is_named and n_positions < MIN_ROWS_OF_MOVING_TARGET:
        return table
    table.pointings.target = [f"{PLACEHOLDER_TARGET_NAME}-{place + 1}" for place in position_numbers.tolist()]
    naming_text = f"has one name ('{safe_excerpt(names.pop())}') for all of its rows" if is_named else "names no points"
    table.notes.append(
        f"the table {naming_text}: its {len(position_numbers)} rows are {n_positions} positions of a target that moves "
        "(a robot, a T-MAC), "
        "each a target named pose-1, pose-2, ...; one set-up alone gives no information about the tracker"
    )
    return table


def _coincident_targets_notes(pointings: UnconvertedPointings, readings: Floats) -> list[str]:
    """Note, in a list, on targets at one position with different names (one name per shot); otherwise empty.

    `readings` (n, 3) are raw ranges, azimuths and elevations of n pointings [m, rad, rad].
    """
    points = from_polar(readings)
    tolerance = min(
        MAX_COINCIDENT_DISTANCE_M, MAX_SAME_POSITION_DISTANCE_TO_RANGE * float(np.nanmax(readings[:, 0], initial=0.0))
    )
    targets, target = distinct_with_indices(pointings.target)
    sights = np.column_stack([distinct_with_indices(pointings.station)[1], target])
    complete = np.isfinite(points).all(axis=1)
    if not complete.any() or not tolerance:
        return []
    sights, first = np.unique(sights[complete], axis=0, return_index=True)
    boxes = np.column_stack([sights[:, 0], np.round(points[complete][first] / tolerance).astype(np.int64)])
    _, box, count = np.unique(boxes, axis=0, return_inverse=True, return_counts=True)
    shared = np.flatnonzero(count > 1)
    if len(shared) < MIN_COINCIDENT_POSITIONS:
        return []
    examples = [targets[i] for i in sights[box == shared[0], 1].tolist()]
    names = names_text([f"'{safe_excerpt(name)}'" for name in examples], MAX_COINCIDENT_NAMES_IN_NOTE)
    return [
        f"separate targets have the same position at one set-up {len(shared)} times, such as {names}: if these are "
        "shots of one point, give them one name"
    ]


def _position_numbers(readings: Floats) -> Ints:
    """Number (n,), from 0, of the position that each of n pointings measured, in order of first measurement.

    `readings` (n, 3) are raw ranges, azimuths and elevations [m, rad, rad] in both faces.
    """
    ranges = readings[:, 0]
    longest = float(np.nanmax(ranges, initial=0.0)) or 1.0
    points = from_polar(np.stack([np.where(np.isnan(ranges), longest, ranges), *np.nan_to_num(readings[:, 1:]).T], 1))
    scaled = points / (MAX_SAME_POSITION_DISTANCE_TO_RANGE * longest)
    steps = list(product((0, -1, 1), repeat=scaled.shape[1]))
    first_positions: list[tuple[float, ...]] = []
    of_box: dict[tuple[int, ...], int] = {}  # no two places lie in one box of unit size
    numbers_of_places = []
    for row, box in zip(scaled.tolist(), np.floor(scaled).astype(np.int64).tolist(), strict=True):
        around = [of_box[other] for step in steps if (other := tuple(map(add, box, step))) in of_box]
        near = [i for i in around if max(map(abs, map(sub, row, first_positions[i]))) < 1.0]
        if not near:
            of_box[tuple(box)] = len(first_positions)
            first_positions.append(tuple(row))
        numbers_of_places.append(min(near, default=len(first_positions) - 1))
    return np.array(numbers_of_places)

"""Proposals for the option ``--columns`` if the titles of a table are unknown, derived from its cells."""

from collections.abc import Callable, Sequence
from decimal import Decimal
from functools import lru_cache
from itertools import accumulate, pairwise, takewhile

from ltsim.core.units import LENGTH_UNITS
from ltsim.recordings.conventions import FULL_CIRCLE_BY_UNIT
from ltsim.recordings.files import is_number, safe_excerpt
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.angle_cells import ANGLE_SYMBOLS, unreadable_angle_sentence
from ltsim.recordings.spreadsheets.header import (
    COORDINATE_ROLES,
    header_columns,
    normalised_title,
    title_role,
    title_words_and_unit,
)
from ltsim.recordings.spreadsheets.sheets import SheetRow, TableSheet
from ltsim.recordings.spreadsheets.title_units import unknown_unit_sentence
from ltsim.recordings.tables.angle_columns import are_packed_angles
from ltsim.recordings.tables.missing_names import MOVING_TARGET_TEXT, STATION_OF_POSITIONS_ADVICE
from ltsim.recordings.tables.pointing_table import to_digit_texts
from ltsim.recordings.transcription_errors import MAX_ANGLE_READ_AS_RADIANS, MIN_LONGEST_DISTANCE_MM

MAX_SAMPLE_ROWS = 400
"""Largest number of rows from which proposals are derived."""
MAX_TRIED_ASSIGNMENTS = 20
"""Largest number of proposals that are tested by reading the whole sheet, the most likely first."""
MAX_SAMPLE_CELLS = 100_000
"""Largest number of cells, in the first rows of a table, from which proposals are derived."""
MAX_LENGTH_READ_AS_METRES = MIN_LONGEST_DISTANCE_MM
"""Limit of the largest distance or coordinate of a column without unit. Below it, the unit is probably the metre,
otherwise the millimetre."""
CellsByColumn = Sequence[tuple[str, ...]]
"""Cells of a table, column by column."""
MAX_ANGLE_CHANGE_OF_REPEATS = Decimal("0.05")
"""Largest change of an angle, in the unit of the table, between repeated pointings to a target from one station."""
COLUMNS_TEMPLATE = (
    '--columns "station=HEADER,target=HEADER,azimuth=HEADER[deg],elevation=HEADER[deg],distance=HEADER[mm]"'
)
"""Option for a table with unknown titles; the user replaces each HEADER by a title."""


def unrecognised_header_sentence(sheet: TableSheet, is_readable_with: Callable[[str], bool]) -> str:
    """Sentence for the user on a header with unknown titles, with a proposal for the option ``--columns`` if any.

    `is_readable_with` returns True for a value of ``--columns`` with which the sheet can be read.
    """
    sample = sample_rows(sheet)
    header_row = next((row for row in sample if len(row.fields) > 2 and not row.n_numeric_fields), None)
    data_rows = [row.fields for row in sample if row.n_numeric_fields > 1]
    if not data_rows:
        return "contains no row with two or more numbers, and therefore no pointing"
    if header_row is not None and (unit_fault := unknown_unit_sentence(header_row.fields)):
        return unit_fault
    roles = {column.role for column in header_columns(header_row.fields)} if header_row is not None else set[str]()
    if {*COORDINATE_ROLES} <= roles and roles.isdisjoint(("station", "target")):
        n_positions = sum(not row.is_comment and row.n_numeric_fields > 2 for row in sheet.rows)
        positions = f"this is a table of {n_positions} positions without point names, {MOVING_TARGET_TEXT}"
        return f"{positions}; {STATION_OF_POSITIONS_ADVICE}"
    n_columns = max(map(len, data_rows))
    has_header = header_row is not None and len(header_row.fields) == n_columns
    header_fields = header_row.fields if header_row is not None and has_header else ("",) * n_columns
    titles = tuple(_column_reference(i, header_fields) for i in range(n_columns))
    header = f"the header {safe_excerpt(', '.join(header_fields), 80)}" if has_header else "a table without a header"
    assignments = _likely_assignments(titles, [row for row in data_rows if len(row) == n_columns][:MAX_SAMPLE_ROWS])
    advice = next(filter(is_readable_with, assignments[:MAX_TRIED_ASSIGNMENTS]), None)
    if advice is not None:
        sentence = f'{header} does not say what its columns contain; define them, for instance --columns "{advice}"'
        is_ambiguous = not has_header and advice != assignments[-1] and is_readable_with(assignments[-1])
        return f'{sentence}, or --columns "{assignments[-1]}"' if is_ambiguous else sentence
    reason = "no three columns look like two angles and a distance, or like coordinates"
    sentence = f"{header} does not say what its columns contain, and {reason}"
    first_angle = next((text for text in data_rows[0] if unreadable_angle_sentence(text)), None)
    if first_angle is not None:
        sentence += f"; found '{safe_excerpt(first_angle)}' ({unreadable_angle_sentence(first_angle)})"
        return f"{sentence}; then define the columns: {COLUMNS_TEMPLATE}"
    return f"{sentence}; define them if they are: {COLUMNS_TEMPLATE}"


def _column_reference(position: int, titles: Sequence[str]) -> str:
    """Title of the column at `position`, or its number if the title cannot be written in the option ``--columns``."""
    title = titles[position]
    is_usable = title and titles.count(title) == 1 and not any(sign in title for sign in ',+=[]"')
    return title if is_usable else str(position + 1)


def sample_rows(sheet: TableSheet) -> list[SheetRow]:
    """First rows of a sheet, with about `MAX_SAMPLE_CELLS` cells in total."""
    cells_before = accumulate((len(row.fields) for row in sheet.rows), initial=0)
    rows_and_counts = zip(sheet.rows, cells_before, strict=False)
    return [row for row, _ in takewhile(lambda pair: pair[1] < MAX_SAMPLE_CELLS, rows_and_counts)]


def _likely_assignments(titles: Sequence[str], first_rows: Sequence[Sequence[str]]) -> list[str]:
    """Proposals for ``--columns`` that agree with the cells, the most likely first.

    `titles` are the titles of all columns, `first_rows` the sample of rows. Each proposal assigns names, a face, and
    readings or coordinates.
    """
    columns: list[tuple[str, ...]] = list(zip(*first_rows, strict=True))
    time_columns = [
        i for i, column in enumerate(columns) if any(column) and all(cells.has_time_of_day(t) for t in column if t)
    ]
    columns_without_time = [i for i in range(len(columns)) if i not in time_columns and any(columns[i])]
    text_columns = [i for i in columns_without_time if not all(map(cells.is_numeric, columns[i]))]
    face_columns = [
        i
        for i in columns_without_time
        if i not in text_columns and len({*columns[i]}) == 2 and all(map(cells.parse_face, columns[i]))
    ]
    number_columns = [
        i
        for i in columns_without_time
        if i not in (*text_columns, *face_columns) and all(map(cells.is_numeric, columns[i]))
    ]
    angles = _angle_columns(number_columns, columns)
    name_columns = _name_columns(text_columns, number_columns, angles, columns, titles)
    names_and_faces = [f"{role}={titles[i]}" for role, i in name_columns.items()]
    names_and_faces += [f"face={titles[i]}" for i in face_columns[:1]]
    number_columns = [i for i in number_columns if i not in name_columns.values()]
    angles = [angle for angle in angles if not {*angle} & {*name_columns.values()}]
    polar = [
        [
            f"{circle}={_joined_titles(first, titles)}[{unit}]",
            f"{kind}={_joined_titles(other, titles)}[{unit}]",
            *length,
        ]
        for first, other in pairwise(angles)
        if len(first) == len(other) or (_is_sexagesimal(first, columns) and _is_sexagesimal(other, columns))
        for circle in ("horizontal" if normalised_title(titles[first[0]]).startswith(("hz", "hor")) else "azimuth",)
        for unit, kind in _possible_conventions(first, other, columns, titles)
        for length in (
            _distance_assignments("distance", [i for i in number_columns if i > other[-1]], titles, columns, first)
            or _distance_assignments(
                "distance", [i for i in number_columns if i < first[0]][-1:], titles, columns, first
            )
        )
    ]
    polar += [
        [f"horizontal={_joined_titles(first, titles)}[deg]", *length]
        for first in angles[:1]
        if _is_sexagesimal(first, columns) and not any(_is_sexagesimal(other, columns) for other in angles[1:])
        for length in _distance_assignments(
            "flat", [i for i in number_columns if i > first[-1]], titles, columns, first
        )
    ]
    axes = _axis_columns(number_columns, columns)
    unit = "m" if max((_largest_magnitude(columns[i]) for i in axes), default=0) < MAX_LENGTH_READ_AS_METRES else "mm"
    coordinate_readings = [f"{axis}={titles[i]}[{unit}]" for axis, i in zip(COORDINATE_ROLES, axes, strict=False)]
    is_polar = any(_has_sexagesimal_cells(columns[i]) for i in number_columns)
    is_complete = len(coordinate_readings) == len(COORDINATE_ROLES) and not is_polar
    readings_sets = [*polar, *([coordinate_readings] if is_complete else [])]
    return [",".join([*names_and_faces, *readings]) for readings in readings_sets]


def _name_columns(
    text_columns: Sequence[int],
    number_columns: Sequence[int],
    angles: Sequence[tuple[int, ...]],
    columns: CellsByColumn,
    titles: Sequence[str],
) -> dict[str, int]:
    """Positions of the columns that may name the stations and the targets, by role; a missing one has no entry.

    Known titles decide. Otherwise columns of texts are names, and if there is only one or none, also columns of whole
    numbers before the angles `angles` that do not count the rows. A column with more different names names the targets.
    """
    roles_of_titles = [title_role(title_words_and_unit(title)[0]) for title in titles]
    named_columns = {
        role: i
        for i, role in reversed([*enumerate(roles_of_titles)])
        if role in ("station", "target") and any(columns[i]) and not any(i in angle for angle in angles)
    }
    if len(named_columns) == len(("station", "target")):
        return {role: named_columns[role] for role in ("station", "target")}
    names = [i for i in text_columns if not roles_of_titles[i] or i in named_columns.values()]
    names.sort(key=_n_distinct(columns))
    end_of_names = min((angle[0] for angle in angles), default=max(len(columns) - len(COORDINATE_ROLES), 0))
    numbers = [
        i
        for i in number_columns
        if i < end_of_names and not roles_of_titles[i] and all(cell.isdigit() for cell in columns[i])
    ]
    counters = [i for i in numbers if _counts_rows(columns[i])]
    if len(names) == 1:
        names += [i for i in numbers if i not in counters and not _repeats_angles(names[0], angles, columns)][:1]
    elif not names:
        names = (numbers if len(numbers) < 3 else [i for i in numbers if i not in counters])[:2]
    chosen = sorted(names[-2:], key=_n_distinct(columns))
    return dict(zip(("station", "target")[-len(chosen) :], chosen, strict=False)) if chosen else {}


def _n_distinct(columns: CellsByColumn) -> Callable[[int], int]:
    """Function that returns the number of different cells of a column from its position."""
    return lambda position: len({*columns[position]})


def _counts_rows(column: tuple[str, ...]) -> bool:
    """True if the whole numbers in a column increase by one from row to row."""
    first = int(column[0])
    return list(map(int, column)) == list(range(first, first + len(column)))


def _repeats_angles(names: int, angles: Sequence[tuple[int, ...]], columns: CellsByColumn) -> bool:
    """True if most rows with one name have the same angles, as in rounds from one station.

    `names` is the position of the column of names.
    """
    first_cells: dict[str, tuple[Decimal, ...]] = {}
    n_same = n_different = 0
    numbers_by_angle = [_column_numbers(columns[angle[0]]) for angle in angles]
    if any(len(values) != len(columns[names]) for values in numbers_by_angle):
        return False
    for name, *values in zip(columns[names], *numbers_by_angle, strict=True):
        first = first_cells.setdefault(name, tuple(values))
        is_same = all(abs(a - b) < MAX_ANGLE_CHANGE_OF_REPEATS for a, b in zip(values, first, strict=True))
        n_same, n_different = n_same + is_same, n_different + (not is_same)
    return n_same > len(first_cells) and n_same > n_different


def _axis_columns(number_columns: Sequence[int], columns: CellsByColumn) -> list[int]:
    """Positions of the three columns of numbers that may be coordinates.

    They are the only three columns with fractions and a number beyond the full circle in gon, which angles of a joint
    or of a rotation do not have; otherwise the first three columns with fractions that are not in ascending order.
    """
    fractions = [i for i in number_columns if _has_fraction(columns[i]) and list(columns[i]) != sorted(columns[i])]
    large = [i for i in fractions if _largest_magnitude(columns[i]) > FULL_CIRCLE_BY_UNIT["gon"]]
    if len(large) == len(COORDINATE_ROLES):
        return large
    return (fractions if len(fractions) >= len(COORDINATE_ROLES) else [*number_columns])[: len(COORDINATE_ROLES)]


def _angle_columns(number_columns: Sequence[int], columns: CellsByColumn) -> list[tuple[int, ...]]:
    """Positions of the column of each possible angle, followed by those of its minutes and seconds if separate."""
    angles: list[tuple[int, ...]] = []
    used_columns: set[int] = set()
    for i in number_columns:
        part_columns = [i]
        while (
            len(part_columns) < len(ANGLE_SYMBOLS)
            and part_columns[-1] + 1 in number_columns
            and _is_minutes_or_seconds(columns[part_columns[-1] + 1])
        ):
            if _has_fraction(columns[part_columns[-1]]):
                break
            part_columns.append(part_columns[-1] + 1)
        is_angle_alone = _has_fraction(columns[i]) or _has_sexagesimal_cells(columns[i])
        if (
            i not in used_columns
            and _largest_magnitude(columns[i]) <= FULL_CIRCLE_BY_UNIT["gon"]
            and (is_angle_alone or len(part_columns) > 1)
        ):
            angles.append(tuple(part_columns))
            used_columns.update(part_columns)
    return angles


def _is_minutes_or_seconds(column: tuple[str, ...]) -> bool:
    """True if all numbers in a column are at least 0 and below 60, as numbers of minutes and seconds are."""
    return all(0 <= number < 60 for number in _column_numbers(column))


def _possible_conventions(
    horizontal: Sequence[int], vertical: Sequence[int], columns: CellsByColumn, titles: Sequence[str]
) -> list[tuple[str, str]]:
    """Pairs of angle unit and kind of vertical angle that agree with the cells and titles, the most likely first.

    `horizontal` and `vertical` are the positions of the columns of both angles.
    """
    vertical_angles = _column_numbers(columns[vertical[0]])
    max_value = max(_largest_magnitude(columns[horizontal[0]]), _largest_magnitude(columns[vertical[0]]))
    if _is_sexagesimal(horizontal, columns):
        units: tuple[str, ...] = ("deg",)
    elif _are_packed(columns[horizontal[0]], columns[vertical[0]]):
        units = ("dms",)
    elif max_value < MAX_ANGLE_READ_AS_RADIANS:
        units = ("rad",)
    else:
        units = ("deg", "gon") if max_value <= FULL_CIRCLE_BY_UNIT["deg"] else ("gon",)
    lowest = min(vertical_angles, default=Decimal(0))
    is_zenith = "zenit" in normalised_title(titles[vertical[0]])
    kind = "elevation" if lowest < 0 else "zenith" if is_zenith else "vertical"
    return [(unit, kind) for unit in units if lowest >= -FULL_CIRCLE_BY_UNIT["deg" if unit == "dms" else unit] / 4]


def _are_packed(*columns: tuple[str, ...]) -> bool:
    """True if the decimals of the angles in all columns can be minutes and seconds below 60."""
    texts = [cells.python_number_text(cell) for column in columns for cell in column if cell]
    return all(map(is_number, texts)) and are_packed_angles(to_digit_texts(texts))


def _distance_assignments(
    role: str, candidate_columns: Sequence[int], titles: Sequence[str], columns: CellsByColumn, angle: Sequence[int]
) -> list[list[str]]:
    """Assignment `role=title[unit]` for the first candidate column whose cells may be distances.

    The result is a list with one list, which has the assignment; it is empty if there is no such column. The unit is
    that in the title. Without one it is the metre if the column `angle` is in degrees, minutes and seconds; otherwise
    the size of the numbers decides.
    """
    candidates = [
        i
        for i in candidate_columns
        if _has_fraction(columns[i])
        and not _has_sexagesimal_cells(columns[i])
        and min(_column_numbers(columns[i]), default=Decimal(0)) > 0
    ]
    lengths = []
    for i in candidates[:1]:
        title_unit = title_words_and_unit(titles[i])[1]
        metres = _is_sexagesimal(angle, columns) or _largest_magnitude(columns[i]) < MAX_LENGTH_READ_AS_METRES
        unit = title_unit if title_unit in LENGTH_UNITS else "m" if metres else "mm"
        lengths.append([f"{role}={titles[i]}[{unit}]"])
    return lengths


def _is_sexagesimal(angle: Sequence[int], columns: CellsByColumn) -> bool:
    """True if the column or columns of an angle contain degrees, minutes and seconds."""
    return len(angle) > 1 or _has_sexagesimal_cells(columns[angle[0]])


@lru_cache(maxsize=1024)
def _has_sexagesimal_cells(column: tuple[str, ...]) -> bool:
    """True if a cell of a column is an angle in degrees, minutes and seconds."""
    return cells.plain_numbers(column) is None and any(map(cells.is_sexagesimal, column))


def _joined_titles(positions: Sequence[int], titles: Sequence[str]) -> str:
    """Titles of the columns at `positions`, joined by plus signs for the option ``--columns``."""
    return "+".join(titles[i] for i in positions)


@lru_cache(maxsize=1024)
def _column_numbers(column: tuple[str, ...]) -> list[Decimal]:
    """Numbers in the cells of a column."""
    return [number for cell in column if (number := cells.parse_number_or_angle(cell)) is not None]


def _largest_magnitude(column: tuple[str, ...]) -> Decimal:
    """Largest magnitude of the numbers in a column."""
    return max(map(abs, _column_numbers(column)), default=Decimal(0))


@lru_cache(maxsize=1024)
def _has_fraction(column: tuple[str, ...]) -> bool:
    """True if a number in a column is not an integer."""
    return any(number != int(number) for number in _column_numbers(column))

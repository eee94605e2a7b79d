"""Suggestions for ``--columns`` for a table whose header has no recognised titles, from the content of its columns."""

from collections.abc import Callable, Sequence
from decimal import Decimal
from functools import lru_cache
from itertools import accumulate, pairwise, takewhile

from ltsim.core.units import LENGTH_UNITS
from ltsim.recordings.conventions import FULL_CIRCLE_BY_UNIT, AngleUnit
from ltsim.recordings.files import quoted_text
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import (
    ANGLE_MARKS,
    COORDINATE_ROLES,
    normalised_title,
    title_words_and_unit,
    unknown_unit_sentence,
)
from ltsim.recordings.tables.sheets import SheetRow, TableSheet
from ltsim.recordings.transcription_errors import MAX_CIRCLE_RADIANS, MIN_DISTANCE_MM

MAX_SAMPLE_ROWS = 400
"""Largest number of rows in which the roles of columns are searched."""
MAX_TRIED_ASSIGNMENTS = 20
"""Largest number of assignments of columns that are tested on the whole sheet, the most likely first."""
MAX_SAMPLE_CELLS = 100_000
"""Number of cells, from the first rows of a table, that the suggestions are based on."""
MAX_LENGTH_IN_METRES = MIN_DISTANCE_MM
"""Number below which a distance or coordinate without unit is suggested in metres; in millimetres above."""
ColumnAssignment = Sequence[tuple[str, ...]]
COLUMNS_QUESTION = (
    '--columns "station=HEADER,target=HEADER,azimuth=HEADER[deg],elevation=HEADER[deg],distance=HEADER[mm]"'
)


def unrecognised_header_sentence(sheet: TableSheet, serves: Callable[[str], bool]) -> str:
    """Sentence for a header without recognised titles.

    `serves` returns True for ``--columns`` that can read the sheet.
    """
    sample = sample_rows(sheet)
    head = next((row for row in sample if len(row.fields) > 2 and not row.n_values), None)
    body = [row.fields for row in sample if row.n_values > 1]
    if not body:
        return "contains no row with two or more numbers, so no pointing"
    if head is not None and (unit_fault := unknown_unit_sentence(head.fields)):
        return unit_fault
    width = max(map(len, body))
    named = head is not None and len(head.fields) == width
    given = head.fields if head is not None and named else ("",) * width
    titles = tuple(_column_reference(i, given) for i in range(width))
    header = f"the header {quoted_text(', '.join(given), 80)}" if named else "a table without a header"
    advised = _likely_assignments(titles, [row for row in body if len(row) == width][:MAX_SAMPLE_ROWS])
    advice = next(filter(serves, advised[:MAX_TRIED_ASSIGNMENTS]), None)
    if advice is not None:
        sentence = f'{header} does not define its columns; define them, for instance --columns "{advice}"'
        is_ambiguous = not named and advice != advised[-1] and serves(advised[-1])
        return f'{sentence}, or --columns "{advised[-1]}"' if is_ambiguous else sentence
    reason = "no three of them can be two angles and a distance, or coordinates"
    return f"{header} does not define its columns, and {reason}; if they can, define them: {COLUMNS_QUESTION}"


def _column_reference(place: int, titles: Sequence[str]) -> str:
    """Title of a column in ``--columns``; its number if the title is empty, repeated or has a sign of this option."""
    title = titles[place]
    is_usable = title and titles.count(title) == 1 and not any(sign in title for sign in ',+=[]"')
    return title if is_usable else str(place + 1)


def sample_rows(sheet: TableSheet) -> list[SheetRow]:
    """First rows of a sheet, with `MAX_SAMPLE_CELLS` cells in total."""
    cells_before = accumulate((len(row.fields) for row in sheet.rows), initial=0)
    pairs = zip(sheet.rows, cells_before, strict=False)
    return [row for row, _ in takewhile(lambda pair: pair[1] < MAX_SAMPLE_CELLS, pairs)]


def _likely_assignments(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Assignments of columns that the values permit, most likely first: names, a face, then readings or coordinates."""
    columns: list[tuple[str, ...]] = list(zip(*rows, strict=True))
    times = [i for i, column in enumerate(columns) if any(column) and all(cells.has_clock(t) for t in column if t)]
    rest = [i for i in range(len(columns)) if i not in times and any(columns[i])]
    texts = [i for i in rest if not all(map(cells.is_value, columns[i]))]
    faces = [i for i in rest if i not in texts and len({*columns[i]}) == 2 and all(map(cells.parse_face, columns[i]))]
    numbers = [i for i in rest if i not in (*texts, *faces) and all(map(cells.is_value, columns[i]))]
    if not texts:  # points that have numbers for names come first
        texts = [i for i in numbers[:2] if all(cell.isdigit() for cell in columns[i])][: max(len(numbers) - 3, 0)]
    texts.sort(key=lambda i: len({*columns[i]}))
    names = texts[-2:] if len(texts) > 1 else texts
    names_and_faces = [
        f"{role}={titles[i]}" for role, i in zip(("station", "target")[-len(names) :], names, strict=False)
    ]
    names_and_faces += [f"face={titles[i]}" for i in faces[:1]]
    angles = _angle_columns(numbers, columns)
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
            _distance_columns("distance", [i for i in numbers if i > other[-1]], titles, columns, first)
            or _distance_columns("distance", [i for i in numbers if i < first[0]][-1:], titles, columns, first)
        )
    ]
    polar += [
        [f"horizontal={_joined_titles(first, titles)}[deg]", *length]
        for first in angles[:1]
        if _is_sexagesimal(first, columns) and not any(_is_sexagesimal(other, columns) for other in angles[1:])
        for length in _distance_columns("flat", [i for i in numbers if i > first[-1]], titles, columns, first)
    ]
    places = [i for i in numbers if _has_fraction(columns[i]) and list(columns[i]) != sorted(columns[i])]
    places = places[:3] if len(places) >= len(COORDINATE_ROLES) else numbers[:3]
    unit = "m" if max((_largest_magnitude(columns[i]) for i in places), default=0) < MAX_LENGTH_IN_METRES else "mm"
    as_places = [f"{axis}={titles[i]}[{unit}]" for axis, i in zip(COORDINATE_ROLES, places, strict=False)]
    is_polar = any(_has_marked_angles(columns[i]) for i in numbers)
    is_complete = len(as_places) == len(COORDINATE_ROLES) and not is_polar
    whole = [*polar, *([as_places] if is_complete else [])]
    return [",".join([*names_and_faces, *readings]) for readings in whole]


def _angle_columns(numbers: Sequence[int], columns: ColumnAssignment) -> list[tuple[int, ...]]:
    """Columns that may hold an angle, each alone or with the minutes and seconds in the next columns."""
    angles: list[tuple[int, ...]] = []
    taken: set[int] = set()
    for i in numbers:
        parts = [i]
        while (
            len(parts) < len(ANGLE_MARKS)
            and parts[-1] + 1 in numbers
            and _is_minutes_or_seconds(columns[parts[-1] + 1])
        ):
            if _has_fraction(columns[parts[-1]]):
                break
            parts.append(parts[-1] + 1)
        alone = _has_fraction(columns[i]) or _has_marked_angles(columns[i])
        if (
            i not in taken
            and _largest_magnitude(columns[i]) <= FULL_CIRCLE_BY_UNIT["gon"]
            and (alone or len(parts) > 1)
        ):
            angles.append(tuple(parts))
            taken.update(parts)
    return angles


def _is_minutes_or_seconds(column: tuple[str, ...]) -> bool:
    """True if all values are possible minutes or seconds, 0 to 60."""
    return all(0 <= number < 60 for number in _column_numbers(column))


def _possible_conventions(
    first: Sequence[int], angle_columns: Sequence[int], columns: ColumnAssignment, titles: Sequence[str]
) -> list[tuple[str, str]]:
    """Unit and kind of the vertical angle that the numbers and its title permit, most likely first."""
    vertical = _column_numbers(columns[angle_columns[0]])
    max_value = max(_largest_magnitude(columns[first[0]]), _largest_magnitude(columns[angle_columns[0]]))
    if _is_sexagesimal(first, columns):
        units: tuple[AngleUnit, ...] = ("deg",)
    elif max_value < MAX_CIRCLE_RADIANS:
        units = ("rad",)
    else:
        units = ("deg", "gon") if max_value <= FULL_CIRCLE_BY_UNIT["deg"] else ("gon",)
    lowest = min(vertical, default=Decimal(0))
    is_zenith = "zenit" in normalised_title(titles[angle_columns[0]])
    kind = "elevation" if lowest < 0 else "zenith" if is_zenith else "vertical"
    return [(unit, kind) for unit in units if lowest >= -FULL_CIRCLE_BY_UNIT[unit] / 4]


def _distance_columns(
    role: str, angle_columns: Sequence[int], titles: Sequence[str], columns: ColumnAssignment, angle: Sequence[int]
) -> list[list[str]]:
    """First column after the angles that can hold distances, as a list of one; an empty list if there is none.

    Its unit is that of its title; without one, metres where angles are in degrees, minutes and seconds.
    """
    candidates = [
        i
        for i in angle_columns
        if _has_fraction(columns[i])
        and not _has_marked_angles(columns[i])
        and min(_column_numbers(columns[i]), default=Decimal(0)) > 0
    ]
    lengths = []
    for i in candidates[:1]:
        title_unit = title_words_and_unit(titles[i])[1]
        metres = _is_sexagesimal(angle, columns) or _largest_magnitude(columns[i]) < MAX_LENGTH_IN_METRES
        unit = title_unit if title_unit in LENGTH_UNITS else "m" if metres else "mm"
        lengths.append([f"{role}={titles[i]}[{unit}]"])
    return lengths


def _is_sexagesimal(angle: Sequence[int], columns: ColumnAssignment) -> bool:
    return len(angle) > 1 or _has_marked_angles(columns[angle[0]])


@lru_cache(maxsize=1024)
def _has_marked_angles(column: tuple[str, ...]) -> bool:
    """True if a cell is an angle in degrees, minutes and seconds."""
    return cells.plain_numbers(column) is None and any(map(cells.is_sexagesimal, column))


def _joined_titles(places: Sequence[int], titles: Sequence[str]) -> str:
    return "+".join(titles[i] for i in places)


@lru_cache(maxsize=1024)
def _column_numbers(column: tuple[str, ...]) -> list[Decimal]:
    return [number for cell in column if (number := cells.parse_value(cell)) is not None]


def _largest_magnitude(column: tuple[str, ...]) -> Decimal:
    return max(map(abs, _column_numbers(column)), default=Decimal(0))


@lru_cache(maxsize=1024)
def _has_fraction(column: tuple[str, ...]) -> bool:
    """True if one of the numbers is not an integer."""
    return any(number != int(number) for number in _column_numbers(column))

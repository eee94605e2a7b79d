"""Angles in degrees, minutes and seconds that the header of a table does not show: in separate columns, or packed.

Columns of minutes and seconds may have no titles, as below merged cells of a header. The digits of a packed angle
contain minutes and seconds: 33.120747, or 331207.47, is 33° 12' 07.47".
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.hints import Hints
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.angle_cells import (
    ANGLE_SYMBOLS,
    parse_packed_degrees,
    parse_packed_integer_degrees,
)
from ltsim.recordings.spreadsheets.header import ANGLE_PART_ROLE, HORIZONTAL_ROLES, VERTICAL_ROLES, TableColumn
from ltsim.recordings.spreadsheets.sheets import SheetRow
from ltsim.recordings.tables.pointing_table import DigitTexts, PointingTable, to_digit_texts

N_ROWS_TESTED_FOR_ANGLE_PARTS = 100
"""Number of rows below a header whose cells decide whether columns are the minutes and seconds of an angle."""
MIN_PACKED_CELLS = 10
"""Smallest number of different angles in a column that can show packed angles: the decimals of all must be minutes and
seconds below 60. By chance this is so for a decimal angle with a probability of 36 %, for ten with 4e-5."""
MIN_PACKED_CELLS_FOR_QUESTION = 4
"""Smallest number of different angles for which the user is asked whether they are packed (degrees, minutes and seconds
as digits of one number). Random digits look like packed angles in so many cells with a probability of 2 %."""
MIN_PACKED_DIGITS = 4
"""Smallest number of decimals of a packed angle, for minutes and seconds."""
MIN_PACKED_INTEGER_DIGITS = 5
"""Smallest number of digits before the point that no angle in degrees or gon has, but a packed angle without a point
between degrees and minutes."""

N_CELLS_TESTED_FOR_PACKED_ANGLES = 1000
"""Number of cells of each column that are tested first, to save time; the rest is tested only if these can be packed
angles.
"""


def with_untitled_angle_parts(columns: Sequence[TableColumn], rows: Sequence[SheetRow]) -> list[TableColumn]:
    """Columns of a header; the degrees of an angle are joined with the minutes and seconds in the columns after them.

    A column of minutes or seconds has no title, or the title of the degrees again. The degrees and minutes before the
    last part are whole numbers, and minutes and seconds are below 60. `rows` are the rows below the header.
    """
    joined = list(columns)
    for place, column in enumerate(columns):
        if column.role not in (*HORIZONTAL_ROLES, *VERTICAL_ROLES) or column.unit not in ("", "deg"):
            continue
        if column.angle_part_positions:
            continue
        parts = [column.position]
        for other in columns[place + 1 : place + len(ANGLE_SYMBOLS)]:
            is_same_title = other.title in ("", f"{column.title} ({len(parts) + 1})") and not other.role
            if not is_same_title or not _can_be_parts_after(other.position, parts[-1], rows):
                break
            parts.append(other.position)
        if len(parts) > 1:
            joined[place] = replace(column, unit="deg", angle_part_positions=tuple(parts[1:]))
            for i, position in enumerate(parts[1:], start=place + 1):
                joined[i] = TableColumn(position, columns[i].title, ANGLE_PART_ROLE)
    return joined


def _can_be_parts_after(position: int, earlier_position: int, rows: Sequence[SheetRow]) -> bool:
    """True if the cells at `position` can be minutes or seconds after the whole numbers at `earlier_position`."""
    pairs = [(row.cell(earlier_position), row.cell(position)) for row in rows if not row.is_comment]
    numbers = [
        (whole, part)
        for earlier, cell in pairs
        if (whole := cells.parse_number(earlier)) is not None and (part := cells.parse_number(cell)) is not None
    ]
    n_filled = sum(cells.parse_number(earlier) is not None for earlier, _ in pairs)
    return bool(numbers) and len(numbers) == n_filled and all(w == int(w) and abs(p) < 60 for w, p in numbers)


def with_unpacked_angles(table: PointingTable, hints: Hints, file: object) -> PointingTable:
    """Table whose packed angles (33.120747 for 33° 12' 07.47") are converted to decimal degrees, in place.

    A column has packed angles if it declares no unit, and the digits of all cells can be minutes and seconds. Raises
    RecordError, which names `file`, if the angles are too few to decide.
    """
    columns = [c for c in table.columns if c.role in (*HORIZONTAL_ROLES, *VERTICAL_ROLES)]
    if hints.angle is not None or not columns or any(c.unit for c in columns):
        return table
    digit_texts_by_role = {
        c.role: table.pointings.digit_texts_by_role[c.role]
        for c in columns
        if c.role in table.pointings.digit_texts_by_role
    }
    first_values = [digits[:N_CELLS_TESTED_FOR_PACKED_ANGLES] for digits in digit_texts_by_role.values()]
    if not first_values or not are_packed_angles(np.concatenate(first_values), MIN_PACKED_CELLS_FOR_QUESTION):
        return table
    all_values = np.concatenate(list(digit_texts_by_role.values()))
    if not are_packed_angles(all_values):
        if are_packed_angles(all_values, MIN_PACKED_CELLS_FOR_QUESTION):
            raise RecordError(
                f"the angles in {_titles_text(columns)} may be decimal numbers or ddd.mmss: all {len(all_values)} have "
                "minutes and seconds below 60, but so few angles do not decide; give --hint angle=deg or --hint "
                f'angle=gon for decimal numbers, and --columns "{_packed_assignments_text(columns)}" for ddd.mmss',
                file=file,
            )
        return table
    table.pointings.digit_texts_by_role |= {
        role: _decimal_degrees(digits) for role, digits in digit_texts_by_role.items()
    }
    table.columns = [replace(c, unit="deg") if c in columns else c for c in table.columns]
    form = "ddd.mmss" if _packed_angle_parser(all_values) is parse_packed_degrees else "dddmmss"
    table.notes.append(
        f"the angles in {_titles_text(columns)} are interpreted as {form}: all {len(all_values)} have minutes and "
        "seconds below 60 (otherwise give --hint angle=deg or --hint angle=gon)"
    )
    return table


def are_packed_angles(digits: DigitTexts, min_angles: int = MIN_PACKED_CELLS) -> bool:
    """True if all angles have minutes and seconds below 60 in their digits, and enough of them are different.

    At least `min_angles` different angles have seconds that are not zero, unlike round numbers.
    """
    distinct = [text for text in np.unique(digits).astype(str).tolist() if text]
    parse = _packed_angle_parser(digits)
    n_with_seconds = sum(_has_packed_seconds(text, parse) for text in distinct)
    return n_with_seconds >= min_angles and all(parse(text) is not None for text in distinct)


def _has_packed_seconds(text: str, parse: Callable[[str], Decimal | None]) -> bool:
    """True if the digits of a packed angle, which `parse` converts, contain seconds that are not zero."""
    whole, _, decimals = text.partition(".")
    seconds = decimals[2:] if parse is parse_packed_degrees else whole[-2:] + decimals
    has_digits = parse is not parse_packed_degrees or len(decimals) >= MIN_PACKED_DIGITS
    return has_digits and bool(seconds.strip("0"))


def _decimal_degrees(digits: DigitTexts) -> DigitTexts:
    """Decimal degrees (n,) as digits, from n packed angles; an empty text for a missing angle."""
    parse = _packed_angle_parser(digits)
    return to_digit_texts([str(parse(text)) if text else "" for text in digits.astype(str).tolist()])


def _packed_angle_parser(digits: DigitTexts) -> Callable[[str], Decimal | None]:
    """Parser of packed angles, which have a point between degrees and minutes unless a number has too many digits."""
    lengths = [len(text.lstrip("+-").partition(".")[0]) for text in digits.astype(str).tolist()]
    has_no_point = max(lengths, default=0) >= MIN_PACKED_INTEGER_DIGITS
    return parse_packed_integer_degrees if has_no_point else parse_packed_degrees


def _packed_assignments_text(columns: list[TableColumn]) -> str:
    """Value of the option ``--columns`` that declares columns as packed angles."""
    return ",".join(f"{c.role}{c.face or ''}={safe_excerpt(c.title)}[dms]" for c in columns)


def _titles_text(columns: list[TableColumn]) -> str:
    """Titles of columns as text for a note."""
    return " and ".join(dict.fromkeys(f"'{safe_excerpt(c.title)}'" for c in columns))

"""Columns of minutes and seconds without titles, after the degrees of an angle, as below merged cells of a header."""

from collections.abc import Sequence
from dataclasses import replace

from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.angle_cells import ANGLE_SYMBOLS
from ltsim.recordings.spreadsheets.header import ANGLE_PART_ROLE, HORIZONTAL_ROLES, VERTICAL_ROLES, TableColumn
from ltsim.recordings.spreadsheets.sheets import SheetRow

N_ROWS_TESTED_FOR_ANGLE_PARTS = 100
"""Number of rows below a header whose cells decide whether columns are the minutes and seconds of an angle."""


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

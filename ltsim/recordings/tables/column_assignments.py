"""Option ``--columns``, with which the user assigns roles (contents) to columns of a table, by title or number."""

from collections.abc import Sequence
from dataclasses import replace

from ltsim.core.errors import RecordError
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.spreadsheets.angle_cells import ANGLE_SYMBOLS
from ltsim.recordings.spreadsheets.header import (
    ANGLE_PART_ROLE,
    SIGMA_ROLES,
    UNITS_BY_ROLE,
    TableColumn,
    header_columns,
    reading_kind,
    split_title_and_unit,
)
from ltsim.recordings.spreadsheets.title_words import TITLES_BY_ROLE

MAPPABLE_ROLES = tuple(dict.fromkeys((*TITLES_BY_ROLE, *SIGMA_ROLES.values())))
"""Roles (contents of a column, such as `azimuth`) that the option ``--columns`` accepts."""


def mapped_columns(fields: Sequence[str], assignments: str, file: object) -> list[TableColumn] | None:
    """Columns of a header with the roles that ``--columns`` assigns; None if the header lacks an assigned title.

    `fields` are the titles in the header, `assignments` is ``role=Header[unit],...``. A number in place of a title is
    the number of the column, from 1. ``role=Degrees+Minutes+Seconds`` joins columns. A column without assignment has
    the role that its title implies.

    Raises RecordError, which names `file`, for an unknown role or unit.
    """
    columns = header_columns(fields)
    assigned_columns: dict[int, TableColumn] = {}
    for role, face, title, unit in parse_assignments(assignments, file):
        position, *parts = _title_positions(fields, title) or (None,)
        if position is None:
            return None
        assigned_columns[position] = TableColumn(
            position, fields[position], role, unit or columns[position].unit, face, tuple(parts)
        )
        assigned_columns |= {part: TableColumn(part, fields[part], ANGLE_PART_ROLE) for part in parts}
    kinds = {reading_kind(column.role) for column in assigned_columns.values()}
    other_columns = [c if reading_kind(c.role) not in kinds else replace(c, role="", face=0) for c in columns]
    return [assigned_columns.get(c.position, c) for c in other_columns]


def parse_assignments(assignments: str, file: object = None) -> list[tuple[str, int, str, str]]:
    """Role, face (0 for both), title and unit ('' if not given) of each assignment such as ``role=Header[unit]``.

    Raises RecordError, which names `file`, for an unknown role or unit.
    """
    assignments_of_roles = []
    for part in filter(None, (p.strip() for p in assignments.split(","))):
        role, equals, title = part.partition("=")
        stem, face = role.strip().lower(), 0
        if stem[-1:] in ("1", "2"):
            stem, face = stem[:-1], int(stem[-1])
        if not equals or stem not in MAPPABLE_ROLES or not title.strip():
            message = (
                f"--columns {safe_excerpt(part, 60)}: expected ROLE=HEADER[UNIT] with a role among "
                f"{', '.join(MAPPABLE_ROLES)}"
            )
            raise RecordError(message, file=file)
        name, unit = split_title_and_unit(title.strip())
        if unit and unit not in UNITS_BY_ROLE.get(stem, ()):
            units = ", ".join(UNITS_BY_ROLE.get(stem, ("none",)))
            raise RecordError(
                f"--columns {safe_excerpt(part, 60)}: expected one of the units {units} for {stem}", file=file
            )
        assignments_of_roles.append((stem, face, name, unit))
    return assignments_of_roles


def _title_positions(fields: Sequence[str], title: str) -> tuple[int, ...] | None:
    """Positions among `fields` of a title, or of the titles of degrees, minutes and seconds joined by plus signs.

    None if a title is missing.
    """
    position = _title_position(fields, title)
    if position is not None or "+" not in title:
        return None if position is None else (position,)
    positions = [_title_position(fields, part) for part in title.split("+")[: len(ANGLE_SYMBOLS)]]
    return None if None in positions else tuple(p for p in positions if p is not None)


def _title_position(fields: Sequence[str], title: str) -> int | None:
    """Position of a title among `fields`; None if it is missing.

    The title may be given without its unit, or as the number of the column, from 1.
    """
    for fold in (str.strip, lambda text: split_title_and_unit(text)[0].casefold()):
        folded_title = fold(title)
        for position, field in enumerate(fields):
            if fold(field) == folded_title:
                return position
    return int(title) - 1 if title.isdigit() and 0 < int(title) <= len(fields) else None

"""Checks of the units in the titles of columns."""

from collections.abc import Sequence

from ltsim.core.units import LENGTH_UNITS
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.spreadsheets.header import (
    ANGLE_PART_UNITS,
    DISTANCE_ROLES,
    HORIZONTAL_ROLES,
    UNITS_BY_ROLE,
    VERTICAL_ROLES,
    TableColumn,
    reading_kind,
    title_role,
    title_words_and_unit,
)


def unknown_unit_sentence(titles: Sequence[str]) -> str:
    """Sentence for the user on the first title of a reading with an unknown unit; '' if there is none."""
    for title in titles:
        name, unit = title_words_and_unit(title)
        units = UNITS_BY_ROLE.get(title_role(name), ())
        is_polar = title_role(name) in (*HORIZONTAL_ROLES, *VERTICAL_ROLES, *DISTANCE_ROLES)
        if is_polar and unit and unit not in (*units, *ANGLE_PART_UNITS, *LENGTH_UNITS):
            wrong = f"column '{safe_excerpt(title)}' has the unknown unit '{safe_excerpt(unit)}'"
            return f"{wrong}; convert it to one of {', '.join(units)}"
    return ""


def require_readable_units(columns: Sequence[TableColumn], location: SourceLocation) -> None:
    """Check that no kind of reading is missing because its column has an unknown unit; raises RecordError."""
    kinds = {reading_kind(column.role) for column in columns}
    unknown_titles = [c.title for c in columns if not c.role]
    missing = [
        title for title in unknown_titles if reading_kind(title_role(title_words_and_unit(title)[0])) not in kinds
    ]
    if sentence := unknown_unit_sentence(missing):
        raise location.error(sentence)

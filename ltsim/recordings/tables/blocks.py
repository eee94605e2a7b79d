"""Lines between the pointings of a table: the station of a block, and heights that apply to all of its rows."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ltsim.core.units import LENGTH_UNITS
from ltsim.recordings.files import MAX_TEXT_LENGTH
from ltsim.recordings.tables.header import HEIGHT_ROLES, TableColumn, title_role, title_words_and_unit
from ltsim.recordings.tables.sheets import SheetRow

INSTRUMENT_WORDS = frozenset(
    ("instrument", "instrumentname", "tracker", "trackername", "device", "deviceid", "devicename")
)
"""Words of an instrument: they name a set-up if no line names a station."""
WORDS_BEFORE_SIGN = frozenset(("from", "fromstn", "fromstation", "frompoint", "frompointid", "von"))
"""Words that name a station only before a colon or an equals sign; elsewhere they are words of a text."""
MAX_KEY_WORDS = 4
"""Largest number of words of the name of a height."""
_SIGNED_PATTERN = re.compile(r"#?\s*([^:=]{1,60}?)\s*[:=]\s*(\S.*?)[\s;,]*")
"""Pattern of a value after a colon or an equals sign."""
_WORD_PATTERN = re.compile(r"#?\s*([^\W\d_]+)\s*[:=;,\t ]\s*(\S.*?)[\s;,]*")
"""Pattern of a value after one word."""
_HEIGHT_PATTERN = re.compile(r"(.*?)[\s:=;,]\s*(\d{1,5}(?:[.,]\d{1,6})?)\s*(mm|cm|m|ft|in)?[\s;,]*")
"""Pattern of a line that ends with a length."""


@dataclass
class TableBlock:
    """Block of rows of one sheet: its station, and heights above marks by role."""

    station: str = ""
    height_columns: list[TableColumn] = field(default_factory=list)
    """Columns of the heights, one per role, in the order of their first lines."""
    heights: dict[str, str] = field(default_factory=dict)
    """Cells of the heights of the current block, by role."""
    is_station_named: bool = False
    """True if a line named a station, not only an instrument."""

    def read_line(self, row: SheetRow) -> bool:
        """Station and heights of a line that is no pointing; False if it has neither."""
        line = " ".join(cell for cell in row.fields if cell).rstrip(" \t;,")
        if len(line) > MAX_TEXT_LENGTH:
            return False
        rest, heights = _split_heights(line)
        station = self._station_of(rest)
        if station is not None:
            self.station, self.heights = station, {}
        for column, text in heights:
            self.heights[column.role] = text
            if all(column.role != other.role for other in self.height_columns):
                self.height_columns.append(column)
        return station is not None or bool(heights)

    def height_columns_after(self, columns: Sequence[TableColumn]) -> list[TableColumn]:
        """Columns of the heights that follow the columns of a header; those whose role the header has are left out."""
        roles = {column.role for column in columns}
        extra = [column for column in self.height_columns if column.role not in roles]
        return [replace(column, position=len(columns) + i) for i, column in enumerate(extra)]

    def _station_of(self, line: str) -> str | None:
        """Name of the station that a line gives; None for any other line."""
        signed = _SIGNED_PATTERN.fullmatch(line)
        if signed is not None and title_role(signed[1]) == "station":
            word, name = title_words_and_unit(signed[1])[0], signed[2]
        else:
            start = _WORD_PATTERN.fullmatch(line)
            if start is None or title_role(start[1]) != "station":
                return None
            word, name = title_words_and_unit(start[1])[0], start[2]
            if word in WORDS_BEFORE_SIGN or (signed is not None and word in INSTRUMENT_WORDS):
                return None
        if word in INSTRUMENT_WORDS and self.is_station_named:
            return None
        self.is_station_named |= word not in INSTRUMENT_WORDS
        return name


def _split_heights(line: str) -> tuple[str, list[tuple[TableColumn, str]]]:
    """Line without the heights at its end, and these heights with their columns."""
    heights = []
    while (match := _HEIGHT_PATTERN.fullmatch(line)) is not None:
        words = match[1].rstrip(" \t:=;,").split()
        for count in range(min(MAX_KEY_WORDS, len(words)), 0, -1):
            title = " ".join(words[-count:]).lstrip("#(,; ")
            name, unit = title_words_and_unit(title)
            role = title_role(name)
            if role in HEIGHT_ROLES:
                unit = match[3] or (unit if unit in LENGTH_UNITS else "")
                heights.append((TableColumn(0, title, role, unit), match[2]))
                line = " ".join(words[:-count]).rstrip(" \t:=;,")
                break
        else:
            break
    return line, heights

"""Lines between the rows of a table that name the station, or give the heights, that apply to the rows below them."""

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
"""Words that precede the name of an instrument in a line; the set-up gets this name if no line names a station."""
STATION_WORDS_BEFORE_SIGN = frozenset(("from", "fromstn", "fromstation", "frompoint", "frompointid", "von"))
"""Words that precede the name of a station only before a colon or an equals sign; otherwise they belong to a text."""
MAX_HEIGHT_TITLE_WORDS = 4
"""Largest number of words before a height that are tested as its title."""
_WORDS_AND_VALUE_PATTERN = re.compile(r"#?+\s*+([^:=]{1,60}?)\s*+[:=]\s*+(\S.*+)")
"""Pattern of words and a value, separated by a colon or an equals sign. In the patterns of this module each run of
blanks matches a single repetition: with two, the time would grow with the square of the number of blanks.
"""
_SINGLE_WORD_AND_VALUE_PATTERN = re.compile(r"#?+\s*+([^\W\d_]++)(?:\s*+[:=;,]|(?=\s))\s*+(\S.*+)")
"""Pattern of a line with a single word and a value, such as ``Station S1``."""
_LINE_WITH_HEIGHT_PATTERN = re.compile(r"(.*?)(?<=[\s:=;,])(\d{1,5}(?:[.,]\d{1,6})?)\s*+(mm|cm|m|ft|in)?[\s;,]*+")
"""Pattern of a line that ends with a length and possibly its unit."""


@dataclass
class StationContext:
    """Station, and heights above survey marks, that apply to the next rows of a sheet.

    The object is updated by each line that names a station or gives a height.
    """

    station: str = ""
    height_columns: list[TableColumn] = field(default_factory=list)
    """Column for each kind of height that any line has given so far."""
    heights: dict[str, str] = field(default_factory=dict)
    """Text of each height that applies to the next rows, by the role of its column (such as `instrument_height_mm`)."""
    is_station_named: bool = False
    """True if a line has named a station, and not only an instrument."""

    def read_line(self, row: SheetRow) -> bool:
        """Update of station and heights by a line that is no pointing; False if the line contains neither."""
        line = " ".join(cell for cell in row.fields if cell).rstrip(" \t;,")
        if len(line) > MAX_TEXT_LENGTH:
            return False
        rest, heights = _split_heights(line)
        station = self._station_name(rest)
        if station is not None:
            self.station, self.heights = station, {}
        for column, text in heights:
            self.heights[column.role] = text
            if all(column.role != other.role for other in self.height_columns):
                self.height_columns.append(column)
        return station is not None or bool(heights)

    def missing_height_columns(self, columns: Sequence[TableColumn]) -> list[TableColumn]:
        """Columns of the heights that lines have given, positioned after the `columns` of a header that lacks them."""
        roles = {column.role for column in columns}
        further_columns = [column for column in self.height_columns if column.role not in roles]
        return [replace(column, position=len(columns) + i) for i, column in enumerate(further_columns)]

    def _station_name(self, line: str) -> str | None:
        """Name of the station in a line; None if the line names no station."""
        sign_match = _WORDS_AND_VALUE_PATTERN.fullmatch(line)
        if sign_match is not None and title_role(sign_match[1]) == "station":
            word, name = title_words_and_unit(sign_match[1])[0], sign_match[2]
        else:
            word_match = _SINGLE_WORD_AND_VALUE_PATTERN.fullmatch(line)
            if word_match is None or title_role(word_match[1]) != "station":
                return None
            word, name = title_words_and_unit(word_match[1])[0], word_match[2]
            if word in STATION_WORDS_BEFORE_SIGN or (sign_match is not None and word in INSTRUMENT_WORDS):
                return None
        if word in INSTRUMENT_WORDS and self.is_station_named:
            return None
        self.is_station_named |= word not in INSTRUMENT_WORDS
        return name


def _split_heights(line: str) -> tuple[str, list[tuple[TableColumn, str]]]:
    """Line without the heights at its end, and a list of the column and the text of each of these heights."""
    heights = []
    while (match := _LINE_WITH_HEIGHT_PATTERN.fullmatch(line)) is not None:
        words = match[1].rstrip(" \t:=;,").split()
        for count in range(min(MAX_HEIGHT_TITLE_WORDS, len(words)), 0, -1):
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

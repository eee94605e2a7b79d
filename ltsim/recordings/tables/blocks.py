"""Lines between the rows of a table that name a station or give heights; they apply to the rows below."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ltsim.core.units import LENGTH_UNITS
from ltsim.recordings.files import MAX_CELL_TEXT_LENGTH
from ltsim.recordings.spreadsheets.header import HEIGHT_ROLES, TableColumn, title_role, title_words_and_unit
from ltsim.recordings.spreadsheets.sheets import SheetRow

INSTRUMENT_WORDS = frozenset(
    ("instrument", "instrumentname", "tracker", "trackername", "device", "deviceid", "devicename")
)
"""Words that precede the name of an instrument in a line. It is also the name of the station if no line names a
station.
"""
STATION_WORDS_BEFORE_SIGN = frozenset(("from", "fromstn", "fromstation", "frompoint", "frompointid", "von"))
"""Words that precede the name of a station only if a colon or an equals sign follows; otherwise they are part of a
text."""
MAX_HEIGHT_TITLE_WORDS = 4
"""Largest number of words before a height that are tested as the title of the height."""
_WORDS_AND_VALUE_PATTERN = re.compile(r"#?+\s*+([^:=]{1,60}?)\s*+[:=]\s*+(\S.*+)")
"""Pattern of words and a value with a colon or an equals sign between them. In this module each sequence of blanks is
matched by one repetition only, so that the time does not grow with the square of its length."""
_SINGLE_WORD_AND_VALUE_PATTERN = re.compile(r"#?+\s*+([^\W\d_]++)(?:\s*+[:=;,]|(?=\s))\s*+(\S.*+)")
"""Pattern of a word and a value, such as ``Station S1``."""
_LINE_WITH_HEIGHT_PATTERN = re.compile(r"(.*?)(?<=[\s:=;,])(\d{1,5}(?:[.,]\d{1,6})?)\s*+(mm|cm|m|ft|in)?[\s;,]*+")
"""Pattern of a line that ends with a length, with or without its unit."""


@dataclass
class StationContext:
    """Station and heights above survey marks that apply to the next rows of a sheet.

    Each line that names a station or gives a height updates the object.
    """

    station: str = ""
    height_columns: list[TableColumn] = field(default_factory=list)
    """Columns for the heights that lines have given so far, one for each kind of height."""
    heights: dict[str, str] = field(default_factory=dict)
    """Heights that apply to the next rows, as texts, by name of their column (such as `instrument_height_mm`)."""
    is_station_named: bool = False
    """True if a line has named a station, not only an instrument."""

    def read_line(self, row: SheetRow) -> bool:
        """Update of station and heights by a line that is not a pointing; False if the line has neither."""
        line = " ".join(cell for cell in row.fields if cell).rstrip(" \t;,")
        if len(line) > MAX_CELL_TEXT_LENGTH:
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
        """Columns for heights that lines have given and the header lacks, with positions after those of `columns`."""
        roles = {column.role for column in columns}
        further_columns = [column for column in self.height_columns if column.role not in roles]
        return [replace(column, position=len(columns) + i) for i, column in enumerate(further_columns)]

    def _station_name(self, line: str) -> str | None:
        """Name of the station in a line; None if the line does not name one."""
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
    """Line without the heights at its end, and for each of these heights its column and its text."""
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

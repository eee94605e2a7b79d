"""Format: Sokkia SDR field books, SDR20 (SDR2x) and SDR33, also written by total stations of other makers.

A record is a line of fixed fields: two digits of kind, two letters of derivation. Understood are the header (00, with
the units), the instrument (01), stations (02), target heights (03) and observations on both faces (09F1, 09F2). The
dialects differ in the width of names and numbers: 4 and 10 characters, or 16 and 16. Angles are decimal, directions
clockwise.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.core.units import DEGREE, FACTOR, GON, MILLIMETRE
from ltsim.recordings.conventions import NO_HINTS, Hints
from ltsim.recordings.files import SourceLocation, read_lines, shown
from ltsim.recordings.formats.field_book import FieldBook
from ltsim.recordings.pointings import NAN
from ltsim.recordings.recording import Recording

_HEADER = re.compile(r"00NMSDR(20|33)", re.ASCII)
WIDTHS = {"20": (4, 10), "33": (16, 16)}
"""Widths in characters of a name and of a number, by dialect."""
ANGLE = {"1": DEGREE, "2": GON, "4": 2 * np.pi / 6400}
LENGTH = {"1": 1.0, "2": FACTOR["ft"]}
UNITS_AT = slice(40, 45)
ZERO_AT = 50
"""Columns of the units in the header record, and of the digit for the zero of vertical angles in
the instrument record.
"""
OBSERVED = ("09F1", "09F2")


@dataclass(frozen=True)
class _Dialect:
    """Dialect of a file: widths, units and orders from the header."""

    name: int
    number: int
    angle: float
    length: float
    north_first: bool

    @classmethod
    def of(cls, header: str, where: SourceLocation) -> "_Dialect":
        match = _HEADER.match(header)
        if match is None:
            raise where.error(f"'{shown(header)}' is not a header of SDR20 or SDR33, expected 00NMSDR20 or 00NMSDR33")
        units = header[UNITS_AT].ljust(5, "1")
        for digit, units_of, what in ((units[0], ANGLE, "angles"), (units[1], LENGTH, "distances")):
            if digit not in units_of:
                raise where.error(f"unit '{shown(digit)}' of {what}, expected one of {', '.join(units_of)}")
        return cls(*WIDTHS[match[1]], ANGLE[units[0]], LENGTH[units[1]], units[4] != "2")

    def fields(self, line: str, names: int, numbers: int) -> tuple[list[str], list[str]]:
        """The first names and numbers of a record, as text."""
        at = 4
        widths = [self.name] * names + [self.number] * numbers
        cells = []
        for width in widths:
            cells.append(line[at : at + width].strip())
            at += width
        return cells[:names], cells[names:]


def recognises(_: Path, head: str) -> bool:
    """True if the first line is the header of SDR20 or SDR33."""
    return _HEADER.match(head) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an SDR file.

    Raises RecordError for a malformed record, or for observations from an unknown station.
    """
    book = FieldBook(path)
    lines = read_lines(path, liberal=True)
    dialect = _Dialect.of(lines[0], SourceLocation(path, 1))
    height, from_horizon, skipped = NAN, False, 0
    for i, line in enumerate(lines[1:], start=2):
        where, kind = SourceLocation(path, i), line[:2]
        if kind == "01":
            from_horizon = line[ZERO_AT : ZERO_AT + 1] == "2"
        elif kind == "02":
            _stand(line, dialect, book, where)
        elif kind == "03":
            height = _number(line[4:].split()[0] if line[4:].split() else "", where) * dialect.length
        elif line[:4] in OBSERVED:
            _observe(line, dialect, book, where, height=height, from_horizon=from_horizon)
        elif kind == "09":
            skipped += 1
    notes = [f"{skipped} observations that the instrument corrected or averaged are not used"] if skipped else []
    return book.recording("an SDR file", *notes)


def _stand(line: str, dialect: _Dialect, book: FieldBook, where: SourceLocation) -> None:
    (name,), (first, second, up, height) = dialect.fields(line, 1, 4)
    plan = [_number(text, where) * dialect.length / MILLIMETRE for text in (first, second)]
    y, x = plan if dialect.north_first else plan[::-1]
    z = _number(up, where) * dialect.length / MILLIMETRE
    place = (x, y, z) if np.isfinite([x, y, z]).all() else None
    tall = _number(height, where)
    book.stand(name, 0.0 if np.isnan(tall) else tall * dialect.length, place, where)


def _observe(
    line: str, dialect: _Dialect, book: FieldBook, where: SourceLocation, *, height: float, from_horizon: bool
) -> None:
    (station, target), cells = dialect.fields(line, 2, 3)
    if book.station and station != book.setups[book.station][0]:
        raise where.error(f"is measured from '{shown(station)}', expected the station of the last record 02")
    distance, vertical, horizontal = (_number(cell, where) for cell in cells)
    vertical *= dialect.angle
    book.point(
        target,
        where,
        distance=distance * dialect.length,
        horizontal=horizontal * dialect.angle,
        zenith=np.pi / 2 - vertical if from_horizon else vertical,
        height=height,
    )


def _number(text: str, where: SourceLocation) -> float:
    return where.number(text) if text.strip() else NAN

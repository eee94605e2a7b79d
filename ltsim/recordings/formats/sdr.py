"""Format: Sokkia SDR field books, SDR20 (SDR2x) and SDR33, also written by total stations of other makers.

A record is a line with fields of fixed width. It begins with two digits for its kind and two letters for its origin.
The reader supports the header (00, with the units), instruments (01), stations (02), heights of targets (03) and
observations in both faces (09F1, 09F2). In SDR20 names have 4 characters and numbers 10; in SDR33 both have 16. Angles
are decimal, directions clockwise.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, GON, MILLIMETRE, SI_PER_UNIT
from ltsim.recordings.files import SourceLocation, read_lines, safe_excerpt
from ltsim.recordings.formats.field_book import FieldBook
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.pointings import NOT_MEASURED
from ltsim.recordings.recording import Recording

_HEADER_PATTERN = re.compile(r"00NMSDR(20|33)", re.ASCII)
"""Pattern of the beginning of a header record; group 1 is the version of the format (20 or 33)."""
FIELD_WIDTHS_BY_VERSION = {"20": (4, 10), "33": (16, 16)}
"""Number of characters of a name and of a number, by version of the format (SDR20 or SDR33)."""
SDR_ANGLE_FACTORS_BY_UNIT_CODE = {"1": DEGREE, "2": GON, "4": 2 * np.pi / 6400}
"""Factor to rad, by the code of the angle unit in the header record."""
SDR_LENGTH_FACTORS_BY_UNIT_CODE = {"1": 1.0, "2": SI_PER_UNIT["ft"]}
"""Factor to m, by the code of the length unit in the header record."""
UNIT_CODES_SLICE = slice(40, 45)
"""Character positions of the unit codes in the header record."""
VERTICAL_ZERO_CODE_POSITION = 50
"""Character position, in the instrument record, of the code for the zero direction of vertical angles (zenith or
horizon)."""
OBSERVATION_RECORD_PREFIXES = ("09F1", "09F2")
"""Beginnings of records with raw observations in face 1 and face 2."""


@dataclass(frozen=True)
class _Dialect:
    """Dialect of an SDR file: width of names and numbers, factors to rad and m, and order of the plan coordinates."""

    name_width: int
    number_width: int
    angle_factor: float
    length_factor: float
    is_north_first: bool

    @classmethod
    def from_header(cls, header: str, location: SourceLocation) -> "_Dialect":
        """Dialect that the header record declares; raises RecordError."""
        match = _HEADER_PATTERN.match(header)
        if match is None:
            raise location.error(
                f"'{safe_excerpt(header)}' is not a header of SDR20 or SDR33, expected 00NMSDR20 or 00NMSDR33"
            )
        units = header[UNIT_CODES_SLICE].ljust(5, "1")
        for digit, units_of, what in (
            (units[0], SDR_ANGLE_FACTORS_BY_UNIT_CODE, "angles"),
            (units[1], SDR_LENGTH_FACTORS_BY_UNIT_CODE, "distances"),
        ):
            if digit not in units_of:
                raise location.error(
                    f"found the unit '{safe_excerpt(digit)}' of {what}, expected one of {', '.join(units_of)}"
                )
        return cls(
            *FIELD_WIDTHS_BY_VERSION[match[1]],
            SDR_ANGLE_FACTORS_BY_UNIT_CODE[units[0]],
            SDR_LENGTH_FACTORS_BY_UNIT_CODE[units[1]],
            units[4] != "2",
        )

    def split_record(self, line: str, n_names: int, n_numbers: int) -> tuple[list[str], list[str]]:
        """Texts of the first `n_names` names in the record `line`, and of the `n_numbers` numbers after them."""
        start = 4
        widths = [self.name_width] * n_names + [self.number_width] * n_numbers
        cells = []
        for width in widths:
            cells.append(line[start : start + width].strip())
            start += width
        return cells[:n_names], cells[n_names:]


def recognises(_: Path, file_beginning: str) -> bool:
    """True if the first line is the header of SDR20 or SDR33."""
    return _HEADER_PATTERN.match(file_beginning) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from an SDR file.

    Raises RecordError for a malformed record, and for an observation from another station than the latest one.
    """
    book = FieldBook(path)
    lines = read_lines(path, replaces_undecodable=True)
    dialect = _Dialect.from_header(lines[0], SourceLocation(path, 1))
    height, is_from_horizon, skipped = NOT_MEASURED, False, 0
    shortest = min((len(line.rstrip()) for line in lines[:-1] if line[:4] in OBSERVATION_RECORD_PREFIXES), default=0)
    if lines[-1][:4] in OBSERVATION_RECORD_PREFIXES and len(lines[-1].rstrip()) < shortest:
        raise SourceLocation(path, len(lines)).error("the last line has no line break and is incomplete")
    for i, line in enumerate(lines[1:], start=2):
        where, kind = SourceLocation(path, i), line[:2]
        if kind == "01":
            is_from_horizon = line[VERTICAL_ZERO_CODE_POSITION : VERTICAL_ZERO_CODE_POSITION + 1] == "2"
        elif kind == "02":
            _read_setup(line, dialect, book, where)
        elif kind == "03":
            height = _parse_number(line[4:].split()[0] if line[4:].split() else "", where) * dialect.length_factor
        elif line[:4] in OBSERVATION_RECORD_PREFIXES:
            _read_observation(line, dialect, book, where, height=height, is_from_horizon=is_from_horizon)
        elif kind == "09":
            skipped += 1
    if skipped and not book.pointings:
        message = (
            f"holds {skipped} observations that the instrument corrected or averaged (such as 09MC), and no raw ones"
        )
        raise RecordError(f"{message}; export the readings of each face (09F1, 09F2)", file=path)
    del lines  # as much as a tenth of the pointings
    notes = [f"{skipped} observations that the instrument corrected or averaged are not used"] if skipped else []
    return book.make_recording("an SDR file", *notes)


def _read_setup(line: str, dialect: _Dialect, field_book: FieldBook, location: SourceLocation) -> None:
    """Addition of the set-up in a station record (02) to the field book."""
    (name,), (first, second, z_text, height) = dialect.split_record(line, 1, 4)
    plan_coordinates = [_parse_number(text, location) * dialect.length_factor / MILLIMETRE for text in (first, second)]
    y, x = plan_coordinates if dialect.is_north_first else plan_coordinates[::-1]
    z = _parse_number(z_text, location) * dialect.length_factor / MILLIMETRE
    coordinates_mm = (x, y, z) if np.isfinite([x, y, z]).all() else None
    instrument_height = _parse_number(height, location)
    field_book.add_setup(
        name,
        0.0 if np.isnan(instrument_height) else instrument_height * dialect.length_factor,
        coordinates_mm,
        location,
    )


def _read_observation(
    line: str,
    dialect: _Dialect,
    field_book: FieldBook,
    location: SourceLocation,
    *,
    height: float,
    is_from_horizon: bool,
) -> None:
    """Addition of the pointing in an observation record (09F1, 09F2) to the field book; raises RecordError.

    `height` is the height of the target [m]; `is_from_horizon` is True if vertical angles are elevations.
    """
    (station, target), cells = dialect.split_record(line, 2, 3)
    if field_book.station and station != field_book.setups[field_book.station][0]:
        raise location.error(
            f"the record names the station '{safe_excerpt(station)}', expected the station of the last record 02"
        )
    distance, vertical, horizontal = (_parse_number(cell, location) for cell in cells)
    vertical *= dialect.angle_factor
    field_book.add_pointing(
        target,
        location,
        distance=distance * dialect.length_factor,
        horizontal=horizontal * dialect.angle_factor,
        zenith=float(np.mod(np.pi / 2 - vertical, 2 * np.pi)) if is_from_horizon else vertical,
        height=height,
    )


def _parse_number(text: str, location: SourceLocation) -> float:
    """Number in a field of a record; NaN for an empty field."""
    return location.parse_number(text) if text.strip() else NOT_MEASURED

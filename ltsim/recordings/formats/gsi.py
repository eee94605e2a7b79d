"""Format: Leica GSI-8 and GSI-16, measurement blocks of theodolites, total stations and older trackers.

A block is a line of words. A word has an index of two digits, four characters of information, a sign, and 8 or 16
characters of data. The reader supports points (11), angles (21, 22), slope and horizontal distances (31, 32), heights
of target (87) and instrument (88), and coordinates of stations (84 to 86). In files without such coordinates, codes
(41) with the name of the station (42) and the height of the instrument (43) declare stations. Directions are clockwise,
word 22 is a zenith angle, and each word contains its unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, GON, MILLIMETRE
from ltsim.recordings.files import SourceLocation, read_lines, safe_excerpt
from ltsim.recordings.formats.field_book import FieldBook
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.pointings import NOT_MEASURED
from ltsim.recordings.recording import Recording

_WORD_PATTERN = re.compile(r"(\d\d)(.{4})([+-])(.{16}|.{8})", re.ASCII)
"""Pattern of a word: index, information, sign, and 16 or 8 characters of data."""
_SCALE_CORRECTION_WORD_PATTERN = re.compile(r"51.{4}[+-]\d{4,8}[+-]\d{3,7}", re.ASCII)
"""Pattern of word 51, which contains the scale correction and the prism constant."""
GSI_LENGTH_FACTORS_BY_UNIT_CODE = {"0": 1e-3, "1": 0.3048e-3, "6": 1e-4, "7": 0.3048e-4, "8": 1e-5, ".": 1e-3}
"""Factor from the data of a word to m, by the code of its unit (last character of the word's information)."""
GSI_ANGLE_FACTORS_BY_UNIT_CODE = {"2": 1e-5 * GON, "3": 1e-5 * DEGREE, "5": 1e-4 * 2 * np.pi / 6400}
"""Factor from the data of a word to rad, by the code of its unit (last character of the word's information).

Code 4 (degrees, minutes and seconds) has no factor, because its digits need a conversion.
"""


@dataclass(frozen=True)
class _GsiBlock:
    """Measurement block (line) of a GSI file: information and signed data of each word, by index of the word."""

    words: dict[str, tuple[str, str]]
    location: SourceLocation

    @classmethod
    def from_line(cls, line: str, location: SourceLocation) -> _GsiBlock:
        """Block from a line of the file; raises RecordError."""
        is_wide = line.startswith("*")
        words = {}
        for text in line.lstrip("*").split():
            match = _WORD_PATTERN.fullmatch(text)
            if _SCALE_CORRECTION_WORD_PATTERN.fullmatch(text):
                continue
            if match is None or (len(match[4]) == 16) != is_wide:
                raise location.error(f"'{safe_excerpt(text)}' is not a word of GSI-{16 if is_wide else 8}")
            words[match[1]] = (match[2], match[3] + match[4])
        return cls(words, location)

    def has_words(self, *keys: str) -> bool:
        """True if the block has all words with the indices `keys`."""
        return all(key in self.words for key in keys)

    def name_in_word(self, key: str) -> str:
        """Name in the word with index `key` (such as "11"), without leading zeros."""
        return self.words[key][1][1:].strip().lstrip("0") or "0"

    def _word_value(self, key: str) -> float:
        """Number in the word with index `key`, in units of its last digit; raises RecordError."""
        digits = self.words[key][1].replace(" ", "")
        if re.fullmatch(r"[+-]-+", digits):
            return NOT_MEASURED
        if re.fullmatch(r"[+-]\d+", digits, re.ASCII) is None:
            raise self.location.error(f"found '{safe_excerpt(self.words[key][1])}', expected digits")
        return float(digits)

    def length(self, key: str, default: float = 0.0) -> float:
        """Length [m] in the word with index `key`; `default` if the block lacks it. Raises RecordError."""
        if key not in self.words:
            return default
        unit = self.words[key][0][-1]
        if unit not in GSI_LENGTH_FACTORS_BY_UNIT_CODE:
            raise self.location.error(
                f"found the unit code '{safe_excerpt(unit)}' of a length, expected 0, 1, 6, 7 or 8"
            )
        return self._word_value(key) * GSI_LENGTH_FACTORS_BY_UNIT_CODE[unit]

    def angle(self, key: str) -> float:
        """Angle [rad] in the word with index `key`, from gon, degrees, degrees-minutes-seconds or mils (1/6400 circle).

        The result is NaN if the block lacks this word. Raises RecordError.
        """
        if key not in self.words:
            return NOT_MEASURED
        unit, value = self.words[key][0][-1], self._word_value(key)
        if unit == "4":
            degrees, rest = divmod(abs(value), 1e5)
            minutes, seconds = divmod(rest, 1e3)
            return float(np.sign(value) * (degrees + minutes / 60 + seconds / 36_000) * DEGREE)
        if unit not in GSI_ANGLE_FACTORS_BY_UNIT_CODE and not np.isnan(value):
            raise self.location.error(f"found the unit code '{safe_excerpt(unit)}' of an angle, expected 2, 3, 4 or 5")
        return value * GSI_ANGLE_FACTORS_BY_UNIT_CODE.get(unit, NOT_MEASURED)


def recognises(path: Path, file_beginning: str) -> bool:
    """True if the first line consists of GSI words."""
    first_line = next((line for line in file_beginning.splitlines() if line.strip()), "")
    return re.match(r"\*?(11|41)\d{4}[+-]", first_line) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from a GSI file.

    Raises RecordError for a malformed word, and for measurements before the first station; `hints.station` names a
    station for them.
    """
    field_book = FieldBook(path)
    if hints.station is not None:
        field_book.add_setup(hints.station, 0.0, None, SourceLocation(path))
    lines = read_lines(path)
    survey = _GsiFileProperties.from_blocks(_measurement_blocks(lines, path))
    setup_code = survey.setup_code(path, is_line_broken=not lines[-1].strip())
    for block in _measurement_blocks(lines, path):
        _process_block(block, field_book, setup_code)
    notes = (
        [f"{field_book.n_skipped} blocks are neither a station nor a measurement and are not used"]
        if field_book.n_skipped
        else []
    )
    return field_book.make_recording("a GSI file", *notes)


def _measurement_blocks(lines: Sequence[str], path: Path) -> Iterator[_GsiBlock]:
    """Iterator over the measurement blocks in the lines that are not blank.

    It yields one block at a time, because a block takes ten times the memory of its line.
    """
    return (
        _GsiBlock.from_line(line.strip(), SourceLocation(path, i + 1)) for i, line in enumerate(lines) if line.strip()
    )


@dataclass
class _GsiFileProperties:
    """Properties of a whole GSI file, which decide how each measurement block is read."""

    has_stations: bool = False
    """True if a block has the coordinates of a station."""
    has_directions: bool = False
    """True if a block has a horizontal direction (21)."""
    has_staff_readings: bool = False
    """True if a block has the reading of a levelling staff (33)."""
    code_of_first_block_with_height: str | None = None
    """Code (word 41) of the first block that has a code, a name (42) and a height (43)."""
    code_of_first_block_with_name: str | None = None
    """Code (word 41) of the first block that has a code and a name (42)."""
    last_block: _GsiBlock | None = None
    """Last block of the file."""
    word_indices_of_second_last_block: frozenset[str] = frozenset()
    """Indices of the words in the second-last block."""

    @classmethod
    def from_blocks(cls, blocks: Iterable[_GsiBlock]) -> _GsiFileProperties:
        """Properties of a file from all its blocks, in order."""
        facts = cls()
        for block in blocks:
            facts._add_block(block)
        return facts

    def _add_block(self, block: _GsiBlock) -> None:
        """Update of the properties by the next block of the file."""
        self.has_stations = self.has_stations or _is_station_block(block)
        self.has_directions = self.has_directions or block.has_words("21")
        self.has_staff_readings = self.has_staff_readings or block.has_words("33")
        if block.has_words("41", "42"):
            self.code_of_first_block_with_name = self.code_of_first_block_with_name or block.name_in_word("41")
            if block.has_words("43"):
                self.code_of_first_block_with_height = self.code_of_first_block_with_height or block.name_in_word("41")
        self.word_indices_of_second_last_block = (
            frozenset() if self.last_block is None else frozenset(self.last_block.words)
        )
        self.last_block = block

    def setup_code(self, path: Path, *, is_line_broken: bool) -> str | None:
        """Code (word 41) of the blocks that declare a set-up; None if there is no such code.

        It is the code of the first block with name and height, or else of the first block with a name; other codes
        describe points. If coordinates of stations declare the set-ups, all codes describe points. `is_line_broken` is
        True if the last line ends with a line break.

        Raises RecordError, which names `path`, for a file of a levelling instrument. Raises it also for an incomplete
        last line, which has no line break and lacks words of the line before.
        """
        if (
            self.last_block is not None
            and not is_line_broken
            and self.last_block.words.keys() != self.word_indices_of_second_last_block
        ):
            raise self.last_block.location.error("the last line has no line break and is incomplete")
        if self.has_staff_readings and not self.has_directions:
            raise RecordError(
                "the file comes from a level: it has staff readings (33) and no directions (21)", file=path
            )
        return None if self.has_stations else self.code_of_first_block_with_height or self.code_of_first_block_with_name


def _is_station_block(block: _GsiBlock) -> bool:
    """True for a block with the coordinates of a station."""
    return block.has_words("84", "85", "11") and not block.has_words("21")


def _process_block(block: _GsiBlock, field_book: FieldBook, setup_code: str | None) -> None:
    """Addition of a measurement block to the field book: a set-up, a pointing, or a skipped block."""
    if block.has_words("41", "42") and block.name_in_word("41") == setup_code:
        field_book.add_setup(block.name_in_word("42"), block.length("43"), None, block.location)
    elif _is_station_block(block):
        x, y, z = (block.length(key) / MILLIMETRE for key in ("84", "85", "86"))
        field_book.add_setup(block.name_in_word("11"), block.length("88"), (x, y, z), block.location)
    elif block.has_words("11") and any(block.has_words(key) for key in ("21", "22", "31", "32")):
        _add_pointing(block, field_book)
    else:
        field_book.n_skipped += 1


def _add_pointing(block: _GsiBlock, field_book: FieldBook) -> None:
    """Addition of the pointing in a measurement block to the field book."""
    is_horizontal_distance = not block.has_words("31")
    field_book.add_pointing(
        block.name_in_word("11"),
        block.location,
        distance=block.length("32" if is_horizontal_distance else "31", NOT_MEASURED),
        horizontal=block.angle("21"),
        zenith=block.angle("22"),
        height=block.length("87"),
        is_horizontal_distance=is_horizontal_distance,
    )

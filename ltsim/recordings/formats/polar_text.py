"""Format: plain polar text, ``station target horizontal vertical distance``, one pointing per line.

Columns are separated by blanks, tabs or commas; numbers have a decimal point or comma. Readings are raw, in one or two
faces. A line with four columns has no station. Lines that begin with ``#`` are comments; the reader interprets the
comments ``# Units: gon mm``, ``# Azimuth: clockwise`` and ``# Vertical: zenith``.
"""

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import get_args

import numpy as np

from ltsim.core.arrays import Ints
from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.recordings.files import read_lines, safe_excerpt, write_text
from ltsim.recordings.hints import NO_HINTS, AngleUnit, AzimuthSense, Hints, LengthUnit, VerticalKind
from ltsim.recordings.recording import Recording
from ltsim.recordings.spreadsheets.cells import is_numeric
from ltsim.recordings.spreadsheets.sheets import rows_of_file_beginning
from ltsim.recordings.tables import reader as tables

PERMITTED_CONVENTION_WORDS = {
    name: get_args(kind) for name, kind in (("angle", AngleUnit), ("vertical", VerticalKind), ("azimuth", AzimuthSense))
}
PERMITTED_CONVENTION_WORDS["length"] = get_args(LengthUnit)
"""Permitted words of each convention that a comment can declare."""
_CONVENTION_COMMENT_PATTERN = re.compile(
    r"#\s*(units|azimuth|vertical)\s*:\s*([\w-]+)(?:\s+(\w+))?\s*", re.IGNORECASE | re.ASCII
)
"""Pattern of a comment that declares units, the sense of the azimuth, or the kind of vertical angle."""
_POLAR_COMMENT_PATTERN = re.compile(r"^#.*(polar|spherical|azimuth)", re.IGNORECASE | re.MULTILINE)
"""Pattern of a comment that mentions polar data, by which the format is recognised."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True if each of the first lines has two names and three numbers, or one name after a comment on polar data."""
    data_rows = [row.fields for row in rows_of_file_beginning(file_beginning) if not row.is_comment]
    sample = data_rows[: max(1, min(6, len(data_rows) - 1))]
    field_counts = (4, 5) if _POLAR_COMMENT_PATTERN.search(file_beginning) else (5,)
    return bool(sample) and all(len(f) in field_counts and all(map(is_numeric, f[-3:])) for f in sample)


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from plain polar text.

    Raises RecordError for a malformed line, and if the data do not decide a convention, such as the unit of angles.
    """
    return tables.read(
        path, _hints_from_comments(read_lines(path, replaces_undecodable=True), hints, path), positional=True
    )


def _hints_from_comments(lines: list[str], hints: Hints, file: Path) -> Hints:
    """Hints of the user, completed by the conventions that comments of the file declare; raises RecordError."""
    for line in islice(lines, 50):
        match = _CONVENTION_COMMENT_PATTERN.fullmatch(line)
        if match is None:
            continue
        key, value, second = match.group(1).lower(), match.group(2).lower(), (match.group(3) or "").lower()
        settings: dict[str, str] = {"angle": value, "length": second} if key == "units" else {key: value}
        for name, word in settings.items():
            if word and word not in PERMITTED_CONVENTION_WORDS[name]:
                choices = ", ".join(PERMITTED_CONVENTION_WORDS[name])
                message = f"'{safe_excerpt(line)}' contains {safe_excerpt(word)}, expected one of {choices}"
                raise RecordError(message, file=file)
        undecided = {name: word for name, word in settings.items() if word and getattr(hints, name) is None}
        hints = replace(hints, **undecided)  # type: ignore[arg-type]
    return hints


def write(recording: Recording, path: Path) -> None:
    """Export as polar text: raw readings in degrees and millimetres, counter-clockwise azimuth, elevation.

    Raises RecordError for a pointing without all three readings and for a station whose name begins with ``#``, which
    this format does not support.
    """
    wrong_name = next((name for name in recording.stations if name.startswith("#")), None)
    if wrong_name is not None:
        raise RecordError(
            f"the name of the station '{safe_excerpt(wrong_name)}' begins with #, which starts a comment in polar text"
            "; rename it, or choose another format"
        )
    incomplete_rows = np.flatnonzero(~np.all(recording.is_measured, axis=1))
    if len(incomplete_rows):
        message = "a reading is missing here; polar text supports only pointings with all three readings"
        raise RecordError(message, row=int(incomplete_rows[0]) + 1)
    lines = ["# Units: deg mm", "# Azimuth: counter-clockwise", "# Vertical: elevation"]
    row_indices: Ints = np.arange(len(recording))
    for i in row_indices.tolist():
        distance, azimuth, elevation = recording.readings[i].tolist()
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        values = (azimuth / DEGREE, elevation / DEGREE, distance / MILLIMETRE)
        lines.append("\t".join([station, target, *(repr(v) for v in values)]))
    write_text(path, "\n".join(lines) + "\n")

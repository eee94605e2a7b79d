"""Format: plain polar text, ``station target horizontal vertical distance``, one pointing per line.

Separated by blanks, tabs or commas, decimal point or comma, raw readings on one or two faces. Lines that
begin with ``#`` are comments, of which ``# Units: gon mm``, ``# Azimuth: clockwise`` and ``# Vertical:
zenith`` are understood. Four columns leave the station out.
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
from ltsim.recordings.conventions import NO_HINTS, AngleUnit, AzimuthSense, Hints, LengthUnit, VerticalKind
from ltsim.recordings.files import quoted_text, read_lines, write_text
from ltsim.recordings.recording import Recording
from ltsim.recordings.tables import reader as tables
from ltsim.recordings.tables.cells import is_value
from ltsim.recordings.tables.sheets import head_rows

SETTING_WORDS = {
    name: get_args(kind) for name, kind in (("angle", AngleUnit), ("vertical", VerticalKind), ("azimuth", AzimuthSense))
}
SETTING_WORDS["length"] = get_args(LengthUnit)
_SETTING_PATTERN = re.compile(r"#\s*(units|azimuth|vertical)\s*:\s*([\w-]+)(?:\s+(\w+))?\s*", re.IGNORECASE | re.ASCII)
_POLAR_PATTERN = re.compile(r"^#.*(polar|spherical|azimuth)", re.IGNORECASE | re.MULTILINE)


def recognises(path: Path, head: str) -> bool:
    """True if the first lines are names and three numbers; without a station only if a comment declares polar text."""
    body = [row.fields for row in head_rows(head) if not row.is_comment]
    whole = body[: max(1, min(6, len(body) - 1))]
    columns = (4, 5) if _POLAR_PATTERN.search(head) else (5,)
    return bool(whole) and all(len(f) in columns and all(map(is_value, f[-3:])) for f in whole)


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of a polar text.

    Raises RecordError for a malformed line, or for a convention that the data do not decide.
    """
    return tables.read(
        path, _hints_from_comments(read_lines(path, replaces_undecodable=True), hints, path), positional=True
    )


def _hints_from_comments(lines: list[str], hints: Hints, file: Path) -> Hints:
    for line in islice(lines, 50):
        match = _SETTING_PATTERN.fullmatch(line)
        if match is None:
            continue
        key, value, second = match.group(1).lower(), match.group(2).lower(), (match.group(3) or "").lower()
        settings: dict[str, str] = {"angle": value, "length": second} if key == "units" else {key: value}
        for name, word in settings.items():
            if word and word not in SETTING_WORDS[name]:
                message = (
                    f"'{quoted_text(line)}' says {quoted_text(word)}, expected one of {', '.join(SETTING_WORDS[name])}"
                )
                raise RecordError(message, file=file)
        unsaid = {name: word for name, word in settings.items() if word and getattr(hints, name) is None}
        hints = replace(hints, **unsaid)  # type: ignore[arg-type]
    return hints


def write(recording: Recording, path: Path) -> None:
    """Polar text in degrees and millimetres with counter-clockwise azimuth and elevation, raw on both faces.

    Raises RecordError for a recording with incomplete pointings, which this format cannot hold.
    """
    missing = np.flatnonzero(~np.all(recording.is_measured, axis=1))
    if len(missing):
        message = "a reading is missing here; polar text holds complete pointings only"
        raise RecordError(message, row=int(missing[0]) + 1)
    lines = ["# Units: deg mm", "# Azimuth: counter-clockwise", "# Vertical: elevation"]
    index: Ints = np.arange(len(recording))
    for i in index.tolist():
        distance, azimuth, elevation = recording.readings[i].tolist()
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        values = (azimuth / DEGREE, elevation / DEGREE, distance / MILLIMETRE)
        lines.append("\t".join([station, target, *(repr(v) for v in values)]))
    write_text(path, "\n".join(lines) + "\n")

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
from ltsim.recordings.conventions import NO_HINTS, Angle, Azimuth, Hints, Length, Vertical
from ltsim.recordings.files import read_lines, shown, write_text
from ltsim.recordings.recording import Recording
from ltsim.recordings.tables import reader as tables
from ltsim.recordings.tables.cells import is_value
from ltsim.recordings.tables.sheets import rows_of_head

WORDS = {name: get_args(kind) for name, kind in (("angle", Angle), ("vertical", Vertical), ("azimuth", Azimuth))}
WORDS["length"] = get_args(Length)
_SETTING = re.compile(r"#\s*(units|azimuth|vertical)\s*:\s*([\w-]+)(?:\s+(\w+))?\s*", re.IGNORECASE | re.ASCII)
_POLAR = re.compile(r"^#.*(polar|spherical|azimuth)", re.IGNORECASE | re.MULTILINE)


def recognises(path: Path, head: str) -> bool:
    """True if the first lines are names and three numbers; without a station only if a comment declares polar text."""
    body = [row.fields for row in rows_of_head(head) if not row.comment]
    whole = body[: max(1, min(6, len(body) - 1))]
    columns = (4, 5) if _POLAR.search(head) else (5,)
    return bool(whole) and all(len(f) in columns and all(map(is_value, f[-3:])) for f in whole)


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of a polar text.

    Raises RecordError for a malformed line, or for a convention that the data do not decide.
    """
    return tables.read(path, _with_settings(read_lines(path, liberal=True), hints, path), positional=True)


def _with_settings(lines: list[str], hints: Hints, file: Path) -> Hints:
    for line in islice(lines, 50):
        match = _SETTING.fullmatch(line)
        if match is None:
            continue
        key, value, second = match.group(1).lower(), match.group(2).lower(), (match.group(3) or "").lower()
        settings: dict[str, str] = {"angle": value, "length": second} if key == "units" else {key: value}
        for name, word in settings.items():
            if word and word not in WORDS[name]:
                message = f"'{shown(line)}' says {shown(word)}, expected one of {', '.join(WORDS[name])}"
                raise RecordError(message, file=file)
        unsaid = {name: word for name, word in settings.items() if word and getattr(hints, name) is None}
        hints = replace(hints, **unsaid)  # type: ignore[arg-type]
    return hints


def write(recording: Recording, path: Path) -> None:
    """Polar text in degrees and millimetres with counter-clockwise azimuth and elevation, raw on both faces.

    Raises RecordError for a recording with incomplete pointings, which this format cannot hold.
    """
    missing = np.flatnonzero(~np.all(recording.measured, axis=1))
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

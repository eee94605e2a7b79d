"""Plain polar text: ``station target horizontal vertical distance``, one pointing a line.

Separated by blanks, tabs or commas, decimal point or comma, raw readings on one or two faces. Lines that
begin with ``#`` are comments, of which ``# Units: gon mm``, ``# Azimuth: clockwise`` and ``# Vertical:
zenith`` are understood. Four columns leave the station out.
"""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import get_args

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.errors import RecordError
from ltsim.geometry.polar import from_polar
from ltsim.recording.build import Pointing, indices, recording_of
from ltsim.recording.conventions import (
    NO_HINTS,
    NO_NOISE,
    Angle,
    Azimuth,
    Hints,
    Length,
    PolarTable,
    Vertical,
    angle_meaning,
    faces,
    known_sense,
    length_meaning,
    sense_unknown,
)
from ltsim.recording.files import comma_number, is_number, read_lines, shown, write_text
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Setup
from ltsim.units import DEGREE, MILLIMETRE

COMMENT = "#"
WORDS = {name: get_args(kind) for name, kind in (("angle", Angle), ("vertical", Vertical), ("azimuth", Azimuth))}
WORDS["length"] = get_args(Length)
_SETTING = re.compile(r"#\s*(units|azimuth|vertical)\s*:\s*([\w-]+)(?:\s+(\w+))?\s*", re.IGNORECASE | re.ASCII)
_POLAR = re.compile(r"^#.*(polar|spherical|azimuth)", re.IGNORECASE | re.MULTILINE)


def recognises(path: Path, head: str) -> bool:
    """Whether the first lines are names and three numbers; without a station only where a comment says polar."""
    lines = [line for line in head.splitlines() if line.strip() and not line.startswith(COMMENT)]
    whole = lines[: max(1, min(6, len(lines) - 1))]
    split = [_fields(line) for line in whole]
    columns = (4, 5) if _POLAR.search(head) else (5,)
    return bool(split) and all(
        len(f) in columns and all(is_number(x.replace(",", ".", 1)) for x in f[-3:]) for f in split
    )


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read polar text; raises RecordError for a malformed line, or asking for what the data do not decide."""
    lines = read_lines(path)
    if lines[-1]:
        raise RecordError("the last line has no line break: it was cut", file=path, row=len(lines))
    hints = _stated(lines, hints, path)
    rows = [(i + 1, _fields(s)) for i, s in enumerate(lines) if s.strip() and not s.startswith(COMMENT)]
    table, stations, targets, notes = _table(rows, hints, path)
    angle, vertical, said = angle_meaning(table, hints, path)
    length, more = length_meaning(table, hints)
    azimuth, why = _sense(table, targets, hints, path, table.readings(angle, vertical, "counter-clockwise", length))
    readings = table.readings(angle, vertical, azimuth, length)
    pointings = [
        Pointing(stations[s], targets[t], int(f), distance, turn, up, source=f"{path.name}, line {line}")
        for s, t, f, (distance, turn, up), (line, _) in zip(
            table.station, table.target, faces(readings), readings.tolist(), rows, strict=True
        )
    ]
    notes = [*notes, *said, *more, *why, NO_NOISE]
    return recording_of(pointings, Setup(title=path.stem), notes=notes, file=path)


def _fields(line: str) -> list[str]:
    if line.count("\t") in (3, 4):
        return [field.strip() for field in line.split("\t")]
    if line.count(",") in (3, 4) and not line.split(",")[-1].count(" "):
        return [field.strip() for field in line.split(",")]
    return line.split()


def _stated(lines: list[str], hints: Hints, file: Path) -> Hints:
    """Hints completed by the comments of the file."""
    for line in islice(lines, 50):
        found = _SETTING.fullmatch(line)
        if found is None:
            continue
        key, value, second = found.group(1).lower(), found.group(2).lower(), (found.group(3) or "").lower()
        said: dict[str, str] = {"angle": value, "length": second} if key == "units" else {key: value}
        for name, word in said.items():
            if word and word not in WORDS[name]:
                message = f"'{shown(line)}' says {shown(word)}, expected one of {', '.join(WORDS[name])}"
                raise RecordError(message, file=file)
        unsaid = {name: word for name, word in said.items() if word and getattr(hints, name) is None}
        hints = replace(hints, **unsaid)  # type: ignore[arg-type]
    return hints


def _table(
    rows: list[tuple[int, list[str]]], hints: Hints, file: Path
) -> tuple[PolarTable, tuple[str, ...], tuple[str, ...], list[str]]:
    """Numbers and names; `row` of errors is the line of the file."""
    numbers, names = [], []
    default = hints.station or "S1"
    for line, fields in rows:
        if len(fields) not in (4, 5) or len(fields) != len(rows[0][1]):
            message = f"{len(fields)} fields, expected station, target, two angles and a distance"
            raise RecordError(message, file=file, row=line)
        names.append(fields[:-3] if len(fields) == 5 else [default, fields[0]])
        values = [
            comma_number(text, file=file, row=line, column=column)
            for text, column in zip(fields[-3:], ("horizontal", "vertical", "distance"), strict=True)
        ]
        if not 0 < values[2] < 1e9:
            message = f"found {shown(fields[-1])}, expected a distance above 0"
            raise RecordError(message, file=file, row=line, column="distance")
        numbers.append(values)
    if not rows:
        raise RecordError("holds no pointings", file=file)
    stations, station = indices((n[0] for n in names), "station", file)
    targets, target = indices((n[1] for n in names), "target", file)
    notes = []
    if len(rows[0][1]) == 4 and hints.station is None:
        notes.append(f"the file names no station: all pointings are taken from one, called {default}")
    return PolarTable(station, target, *np.array(numbers).T), stations, targets, notes


def _sense(
    table: PolarTable, targets: tuple[str, ...], hints: Hints, file: Path, readings: Floats
) -> tuple[Azimuth, list[str]]:
    found = (hints.azimuth, []) if hints.azimuth else known_sense(from_polar(readings), table, targets, hints)
    if found is None:
        raise RecordError(sense_unknown(), file=file)
    return found


def write(recording: Recording, path: Path) -> None:
    """Write polar text in degrees and millimetres, azimuth counter-clockwise, elevation, raw on both faces.

    Raises
    ------
    RecordError
        For a recording with incomplete pointings, which this format cannot hold.
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

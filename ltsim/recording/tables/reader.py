"""Reading a recording from delimited text, a folder of such files, or a workbook."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ltsim.errors import RecordError
from ltsim.recording.build import NAN, Pointing, recording_of
from ltsim.recording.conventions import NO_HINTS, NO_NOISE, Hints
from ltsim.recording.files import MAX_TEXT, check_name, shown
from ltsim.recording.recording import KIND_COLUMN, Recording
from ltsim.recording.settings import read_setup
from ltsim.recording.setup import Setup
from ltsim.recording.tables import cells
from ltsim.recording.tables.dialect import SUFFIXES, WORKBOOK, Row, is_folder, separator_of, sheets_of, split
from ltsim.recording.tables.header import Column
from ltsim.recording.tables.meaning import meaning_of
from ltsim.recording.tables.rows import Printed, Table, header_of, table_of
from ltsim.units import FACTOR

SETUP = "setup.toml"
ANGLE_IN_ARCSEC = {"arcsec": 1.0, "cc": 0.324, "mgon": 3.24, "gon": 3240.0, "deg": 3600.0, "urad": 0.20626480624709636}
SIGMA_UNIT = {"sigma_distance_mm": {"mm": 1.0, "um": 1e-3, "m": 1e3}, "sigma_azimuth_arcsec": ANGLE_IN_ARCSEC}
SIGMA_UNIT["sigma_elevation_arcsec"] = ANGLE_IN_ARCSEC
MOST_SHOWN = 3


def recognises(path: Path, head: str) -> bool:
    """Whether this is a folder of tables, a workbook, or text of three columns and more with numbers in them."""
    if path.is_dir():
        return is_folder(path)
    if head.startswith(WORKBOOK.decode("latin-1")):
        return path.suffix.lower() == ".xlsx"
    if "\x00" in head or head.lstrip()[:1] in ("<", "{"):
        return False
    lines = [line for line in head.splitlines()[:-1][:60] if line.strip()]
    separator = separator_of(lines)
    rows = [Row(i, split(line.lstrip("# "), separator)) for i, line in enumerate(lines)]
    named = any(header_of(row, NO_HINTS) for row in rows)
    measured = sum(sum(map(cells.is_value, row.fields)) > 1 and len(row.fields) > 2 for row in rows)
    return measured > 0 and (named or (path.suffix.lower() in SUFFIXES and 2 * measured > len(rows)))


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read a table; raises RecordError."""
    table = table_of(sheets_of(path), hints, path)
    setup, notes = _setup(path, hints)
    meaning = meaning_of(table, setup, hints, path)
    readings = np.array([meaning.readings(p) for p in table.pointings])
    faces, reduced = _faces(table, readings)
    times, started, timed = _times(table, hints, path)
    if started and not setup.started:
        setup = setup.model_copy(update={"started": started})
    further, kept = _further(table)
    flat = table.column(("flat",)) is not None
    pointings = [
        Pointing(
            p.station,
            check_name(p.target, "target", file=p.file, row=p.line),
            face,
            distance,
            azimuth,
            elevation,
            time=time,
            covariates=covariates,
            labels={KIND_COLUMN: "horizontal", **labels} if flat else labels,
            source=f"{Path(str(p.file)).name}, line {p.line}",
        )
        for p, face, (distance, azimuth, elevation), time, (covariates, labels) in zip(
            table.pointings, faces, readings.tolist(), times, further, strict=True
        )
    ]
    said = [*table.notes, *meaning.notes, *reduced, *timed, *kept, *_left_out(table), *notes]
    return recording_of(pointings, setup, notes=said, file=path)


def _setup(path: Path, hints: Hints) -> tuple[Setup, list[str]]:
    """What is known beside the table: the file named, or a `setup.toml` in the same folder."""
    beside = (path if path.is_dir() else path.parent) / SETUP
    if hints.setup is None and not beside.is_file():
        return Setup(title=path.stem[:MAX_TEXT]), [NO_NOISE]
    file = hints.setup or beside
    file = file / SETUP if file.is_dir() else file
    return read_setup(file), [f"noise and what else is known are read from {file}"]


def _faces(table: Table, readings: np.ndarray) -> tuple[list[int], list[str]]:
    """Face of each pointing; readings of face 2 that were reduced to face 1 are turned back in place."""
    beyond = np.abs(readings[:, 2]) > np.pi / 2 + 1e-9
    stated = [p.face for p in table.pointings]
    faces = [int(b) + 1 if face is None else face for face, b in zip(stated, beyond, strict=True)]
    second = np.array(faces) == 2
    if not second.any() or beyond[second].any() or not np.isfinite(readings[second, 2]).any():
        return faces, []
    readings[second, 1] = np.mod(readings[second, 1] + np.pi, 2 * np.pi)
    readings[second, 2] = np.pi - readings[second, 2]
    return faces, ["readings of face 2 were reduced to face 1 and are turned back to what the circles showed"]


def _times(table: Table, hints: Hints, file: Path) -> tuple[list[float], str, list[str]]:
    """Time [s] of each pointing, the moment of 0 where it is known, and notes; NaN where times cannot be read."""
    column = table.column(("time",)) or table.column(("date",))
    texts = [p.moment for p in table.pointings]
    nothing = [NAN] * len(texts)
    if column is None or not any(texts):
        return nothing, "", []
    by_rows = "the order of the rows is taken as time"
    if not all(texts):
        return nothing, "", [f"column '{shown(column.title)}' is empty in places: {by_rows}"]
    numbers = [cells.value(text) for text in texts]
    if all(number is not None for number in numbers):
        factor = FACTOR[column.unit or "s"]
        return [float(number) * factor for number in numbers if number is not None], "", []
    found, start = cells.moments(texts, hints.date)
    if found is None and start:
        message = f"'{shown(texts[0])}' may be day and month or month and day; say which: --hint date=dmy or date=mdy"
        raise RecordError(message, file=file, row=table.pointings[0].line, column=shown(column.title))
    if found is None:
        unknown = f"column '{shown(column.title)}' holds no time that is known here ('{shown(texts[0])}')"
        return nothing, "", [f"{unknown}: {by_rows}"]
    return found, start, []


def _further(table: Table) -> tuple[list[tuple[dict[str, float], dict[str, str]]], list[str]]:
    """Further columns of each pointing: numbers as covariates, texts as labels."""
    columns = [c for c in table.columns if c.title and (not c.role or "_" in c.role)]
    numeric = {c.title for c in columns if _is_numeric(c, table.pointings)}
    names = {c.title: _name(c, c.title in numeric) for c in columns}
    factors = {c.title: SIGMA_UNIT.get(c.role, {}).get(c.unit, 1.0) for c in columns}
    found = []
    for p in table.pointings:
        values = {names[t]: _number(x) * factors[t] for t, x in p.further.items() if t in numeric}
        found.append((values, {names[t]: x for t, x in p.further.items() if t not in numeric}))
    kept = ", ".join(f"'{shown(names[c.title])}'" for c in columns)
    return found, [f"kept as further columns: {kept}"] if kept else []


def _is_numeric(column: Column, pointings: Sequence[Printed]) -> bool:
    texts = [p.further.get(column.title, "") for p in pointings]
    return any(texts) and all(cells.value(text) is not None for text in texts if text)


def _number(text: str) -> float:
    number = cells.value(text) if text else None
    return NAN if number is None else float(number)


def _name(column: Column, numeric: bool) -> str:
    """Name of a further column: that of the native format where the header means one, otherwise the header."""
    return column.role if column.role and numeric else column.title


def _left_out(table: Table) -> list[str]:
    notes = []
    if table.nameless:
        alone = "the table names no station: all such pointings are taken from one, called S1"
        notes.append(f"{alone} (--hint station=NAME)")
    if table.left_out:
        some = "; ".join(table.left_out[:MOST_SHOWN])
        more = len(table.left_out) - MOST_SHOWN
        notes.append(f"left out as free text: {some}" + (f" and {more} more lines" if more > 0 else ""))
    return notes

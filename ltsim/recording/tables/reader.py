"""Reading a recording from delimited text, a folder of such files, or a workbook."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.geometry.polar import to_face
from ltsim.recording.conventions import NO_HINTS, Hints, poses_of
from ltsim.recording.curvature import on_round_earth
from ltsim.recording.files import MAX_TEXT, shown
from ltsim.recording.pointings import NAN, Pointing, recording_of, states_noise
from ltsim.recording.recording import HEIGHT_COLUMNS, KIND_COLUMN, OCCUPATION_COLUMNS, SIGMA_COLUMNS, Recording
from ltsim.recording.settings import read_setup
from ltsim.recording.setup import Setup
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import ALLOWED, TableColumn, names_places
from ltsim.recording.tables.instruments import instrument_of, is_total_station
from ltsim.recording.tables.meaning import Meaning, readings_of, sigmas_of_places
from ltsim.recording.tables.poses import named_by_place
from ltsim.recording.tables.rows import PointingTable, Printed, header_of, table_of
from ltsim.recording.tables.setups import common_names, heights_not_applied, occupied, over_marks, split_occupations
from ltsim.recording.tables.sheets import SUFFIXES, WORKBOOK, is_folder, rows_of_head, sheets_of
from ltsim.recording.tables.times import times_of, with_clock
from ltsim.units import ARCSECOND, MILLIMETRE, ratio

SETUP = "setup.toml"
MOST_SHOWN = 3
HEADS_SIGMA_MM = 1.0
"""How well heads of one tripod, or of one pillar, stand at one height each time they are set up."""


def recognises(path: Path, head: str) -> bool:
    """Whether this is a folder of tables, a workbook, or text of three columns and more with numbers in them."""
    if path.is_dir():
        return is_folder(path)
    if head.startswith(WORKBOOK.decode("latin-1")):
        return path.suffix.lower() == ".xlsx"
    if "\x00" in head[2:] or head.lstrip()[:1] in ("<", "{"):
        return False
    rows = rows_of_head("\n".join(head.splitlines()[:-1]))  # the last line may be cut
    headers = [columns for row in rows if (columns := header_of(row, NO_HINTS))]
    if headers and names_places(headers[0]) and not any(c.role == "station" for c in headers[0]):
        return False  # a list of coordinates, unless its station is named
    measured = sum(row.values > 1 and len(row.fields) > 2 for row in rows)
    return measured > 0 and (bool(headers) or (path.suffix.lower() in SUFFIXES and 2 * measured > len(rows)))


def read(path: Path, hints: Hints = NO_HINTS, *, positional: bool = False) -> Recording:
    """Read a table; `positional` takes lines of names and three numbers without a header. Raises RecordError."""
    table = named_by_place(with_clock(table_of(sheets_of(path), hints, path, positional=positional)), path)
    renamed, named = common_names([(p.station, p.target) for p in table.pointings])
    table.pointings = [replace(p, target=name) for p, name in zip(table.pointings, renamed, strict=True)]
    table.notes += named
    setup = _setup(path, hints)
    poses = poses_of(setup or Setup(), tuple(dict.fromkeys(p.station for p in table.pointings)))
    meaning, readings = readings_of(table, poses, hints, path)
    if setup is not None:
        recording = assembled(table, meaning, readings, setup, hints, path)
        return recording.replace(
            notes=(f"noise and what else is known are read from {_setup_file(path, hints)}", *recording.notes)
        )
    instrument, noise = instrument_of(is_total_station(table, meaning, readings))
    setup = Setup(title=path.stem[:MAX_TEXT], instrument=instrument)
    recording = assembled(table, meaning, readings, setup, hints, path)
    return recording if states_noise(recording) else recording.replace(notes=(noise, *recording.notes))


def assembled(
    table: PointingTable, meaning: Meaning, readings: Floats, setup: Setup, hints: Hints, file: Path
) -> Recording:
    """The recording of a table whose readings (n, 3) are understood, in the order of its pointings."""
    sigmas = sigmas_of_places(table, readings, meaning.length_unit)
    covariates, labels, kept = _further(table, meaning)
    turns = np.array([values.get(SIGMA_COLUMNS[1], NAN) for values in covariates]) * ARCSECOND
    same_place, rounds = split_occupations(table, readings, turns)
    upright = bool(is_total_station(table, meaning, readings)) and table.column(("elevation",)) is None
    setup, over = over_marks(table, setup, readings, rounds=same_place, levelled=upright)
    faces, reduced = _faces(table, readings)
    times, started, timed = times_of(table, hints)
    if started and not setup.started:
        setup = setup.model_copy(update={"started": started})
    height = np.array([[values.get(name, NAN) for name in HEIGHT_COLUMNS] for values in covariates]) * MILLIMETRE
    unused = heights_not_applied(table, readings, height)
    if unused:
        covariates = [{k: x for k, x in values.items() if k not in HEIGHT_COLUMNS} for values in covariates]
        known = setup.heads_sigma_mm or HEADS_SIGMA_MM
        setup = setup.model_copy(update={"heads_sigma_mm": known, "curved": True})
        labels = [occupied(table, p) | own for p, own in zip(table.pointings, labels, strict=True)]
    dated = bool(timed) and table.column(("date",)) is not None  # kept as text where it is no clock
    pointings = []
    for i, (p, (distance, azimuth, elevation)) in enumerate(zip(table.pointings, readings.tolist(), strict=True)):
        flat = {KIND_COLUMN: "horizontal"} if "flat" in p.values else {}
        pointings.append(
            Pointing(
                p.station,
                p.where.name(p.target, "target"),
                faces[i],
                distance,
                azimuth,
                elevation,
                times[i],
                covariates[i] | (sigmas[i] if sigmas else {}),
                labels[i] | ({"date": p.moment} if dated else {}) | flat,
                f"{Path(str(p.where.file)).name}, line {p.where.row}",
            )
        )
    said = [table.notes, meaning.notes, rounds, over, reduced, timed, kept, unused, _left_out(table)]
    recording = recording_of(pointings, setup, notes=[note for notes in said for note in notes], file=file)
    return on_round_earth(recording)


def _setup_file(path: Path, hints: Hints) -> Path:
    """The file named for noise and gauge, or a `setup.toml` in the same folder."""
    file = hints.setup or (path if path.is_dir() else path.parent) / SETUP
    return file / SETUP if file.is_dir() else file


def _setup(path: Path, hints: Hints) -> Setup | None:
    """What a file states of noise and set-ups in addition to the table; None where there is none."""
    file = _setup_file(path, hints)
    return read_setup(file) if hints.setup is not None or file.is_file() else None


def _faces(table: PointingTable, readings: Floats) -> tuple[list[int], list[str]]:
    """Face of each pointing; readings of face 2 that were reduced to face 1 are turned back in place."""
    beyond = np.abs(readings[:, 2]) > np.pi / 2 + 1e-9
    stated = [p.face for p in table.pointings]
    faces = [int(b) + 1 if face is None else face for face, b in zip(stated, beyond, strict=True)]
    second = np.array(faces) == 2
    if not second.any() or beyond[second].any() or not np.isfinite(readings[second, 2]).any():
        return faces, []
    readings[:] = to_face(readings, np.array(faces))
    readings[second, 1] %= 2 * np.pi
    return faces, ["readings of face 2 were reduced to face 1 and are turned back to what the circles showed"]


def _further(table: PointingTable, meaning: Meaning) -> tuple[list[dict[str, float]], list[dict[str, str]], list[str]]:
    """Further columns of each pointing: numbers as covariates, texts as labels, and what is said of them.

    Sigmas and heights have names and units of their own, those of the readings where their header states none.
    """
    columns = [c for c in table.columns if c.is_further]
    words = {c.title for c in columns if c.role in OCCUPATION_COLUMNS}
    values = [c for c in columns if c.title not in words]
    numeric = {c.title: number for c in values if (number := _factor(c, table.pointings, meaning)) is not None}
    named = words | {c.title for c in values if "_" in c.role and c.title in numeric}
    names = {c.title: c.role if c.title in named else c.title for c in columns}
    rows = [p.further for p in table.pointings]
    covariates = [{names[t]: _number(p, t) * f for t, f in numeric.items() if t in p.further} for p in table.pointings]
    labels = [{names[t]: text for t, text in row.items() if t not in numeric} for row in rows]
    own = {c.title for c in columns if c.role in HEIGHT_COLUMNS or c.role.startswith("sigma_")}
    said = [
        f"'{shown(c.title)}' taken as {c.role}" + ("" if c.unit else f", in {_unit(c, meaning)} as its reading")
        for c in columns
        if c.title in own and c.title in numeric
    ]
    kept = ", ".join(f"'{shown(names[c.title])}'" for c in columns if c.title not in own)
    return covariates, labels, [*said, *([f"kept as further columns: {kept}"] if kept else [])]


def _unit(column: TableColumn, meaning: Meaning) -> str:
    return column.unit or meaning.unit_of(column.role)


def _factor(column: TableColumn, pointings: Sequence[Printed], meaning: Meaning) -> float | None:
    """What the numbers of a column are multiplied by; None for a column of text."""
    texts = [(p.further.get(column.title, ""), p.grouping) for p in pointings]
    numeric = any(t for t, _ in texts) and all(cells.quantity(t, grouping) is not None for t, grouping in texts if t)
    if not numeric:
        return None
    wanted = column.role.rpartition("_")[2]
    if wanted not in ("mm", "arcsec"):
        return 1.0
    unit = _unit(column, meaning)
    return float(ratio(unit, wanted)) if unit in (*ALLOWED[column.role], "dms") else 1.0


def _number(p: Printed, title: str) -> float:
    text = p.further[title]
    number = cells.quantity(text, p.grouping) if text else None
    return NAN if number is None else float(number)


def _left_out(table: PointingTable) -> list[str]:
    notes = []
    if table.nameless:
        alone = "the table names no station: all such pointings are taken from one, called S1"
        notes.append(f"{alone} (--hint station=NAME)")
    if table.left_out:
        some = "; ".join(table.left_out[:MOST_SHOWN])
        more = len(table.left_out) - MOST_SHOWN
        notes.append(f"left out as free text: {some}" + (f" and {more} more lines" if more > 0 else ""))
    return notes

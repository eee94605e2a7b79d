"""SpatialAnalyzer's instrument report (``Instruments - CompositeReport``) exported as text.

Blocks of a set-up: its pose (``Transform``), then its observations. Semicolons and decimal commas, or
commas and points; units stand in the headings. The column called elevation may hold a zenith angle: its
values tell. Poses tell the sense of the azimuth, and which points of one name in different groups are one
point.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.arrays import Floats
from ltsim.errors import RecordError
from ltsim.geometry.polar import from_polar
from ltsim.recording.build import NAN, Pointing, indices, recording_of
from ltsim.recording.conventions import (
    CIRCLE,
    NO_HINTS,
    NO_NOISE,
    Angle,
    Hints,
    PolarTable,
    angle_meaning,
    faces,
    sense_by_poses,
)
from ltsim.recording.files import check_name, check_text, comma_number, read_lines, shown
from ltsim.recording.recording import Recording
from ltsim.recording.setup import Instrument, Setup, Station
from ltsim.recording.tables.cells import moments
from ltsim.units import ANGLES, FACTOR, LENGTHS, NAMED

TITLE = "CompositeReport"
SAME_POINT = 2e-3
_HEADING = re.compile(r"^\"?Collection\"?[;,\t]\"?Group\"?[;,\t]\"?Target", re.MULTILINE)
_UNIT = re.compile(r"(.+?)\s*\((.+)\)")


@dataclass
class Block:
    """One set-up: its heading, pose in the units printed, announced count and rows (line, fields)."""

    collection: str
    number: str
    model: str
    count: int | None = None
    position: Floats | None = None
    rotation: Floats | None = None
    header: list[str] = field(default_factory=list)
    rows: list[tuple[int, list[str]]] = field(default_factory=list)


def recognises(path: Path, head: str) -> bool:
    """Whether the report's title or the heading of its observations stands at its beginning."""
    return TITLE in head or _HEADING.search(head) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Read an instrument report.

    Raises
    ------
    RecordError
        For a malformed or cut report, or asking for what the data do not decide.
    """
    blocks = [b for b in _blocks(path) if b.header]
    if not blocks:
        raise RecordError("holds no block of observations", file=path)
    names = _station_names(blocks)
    notes: list[str] = []
    rows = [_Row(names[i], block, line, fields, path) for i, block in enumerate(blocks) for line, fields in block.rows]
    switched_off = [row for row in rows if not row.active]
    if switched_off:
        notes.append(f"{len(switched_off)} observations are switched off in the report and left out")
    rows = [row for row in rows if row.active]
    if not rows:
        raise RecordError("holds no active observations", file=path)
    poses = {name: _pose(block) for name, block in zip(names, blocks, strict=True)}
    readings, more = _readings(rows, poses, hints, path)
    targets, split = _targets(rows, readings, poses)
    pointings = [
        Pointing(
            row.station, target, int(f), r[0], r[1], r[2], time, row.offsets, {"group": row.group},
            f"{path.name}, line {row.line}",
        )
        for row, target, f, r, time in zip(rows, targets, faces(readings), readings.tolist(), _times(rows), strict=True)
    ]  # fmt: skip
    return recording_of(pointings, _setup(blocks, names, path), notes=[*notes, *more, *split, NO_NOISE], file=path)


class _Row:
    """One observation, its cells by the names of their column."""

    def __init__(self, station: str, block: Block, line: int, fields: list[str], file: Path) -> None:
        cells = dict(zip(block.header, fields, strict=False))
        by_stem = {(_UNIT.fullmatch(k) or [k, k])[1].strip(): (k, v) for k, v in cells.items()}

        def value(stem: str) -> float:
            column, text = by_stem[stem]
            return comma_number(text, file=file, row=line, column=column)

        self.station, self.line = station, line
        self.group = check_text(cells.get("Group", ""), file=file, row=line, column="Group")
        self.name = check_name(cells["Target"], "target", file=file, row=line, column="Target")
        self.active = cells.get("Active", "Yes").strip().lower() != "no"
        self.stamp = cells.get("Date & Time", "")
        length = FACTOR[_unit(by_stem["Distance"][0], LENGTHS, file)]
        self.horizontal, self.vertical = value("Azimuth"), value("Elevation")
        self.distance = value("Distance") * length
        if self.distance <= 0:
            raise RecordError("expected a distance above 0", file=file, row=line, column="Distance")
        self.angle: Angle = _unit(by_stem["Azimuth"][0], ANGLES, file)  # type: ignore[assignment]
        self.offsets = {
            f"{stem.lower()}_mm": value(stem) * FACTOR[_unit(by_stem[stem][0], LENGTHS, file)] * 1e3
            for stem in ("Offset1", "Offset2")
            if stem in by_stem and by_stem[stem][1]
        }


def _unit(heading: str, known: Sequence[str], file: Path) -> str:
    """The unit in brackets of a heading, which has to be one of `known`."""
    found = _UNIT.fullmatch(heading)
    said = found.group(2).strip() if found else ""
    if NAMED.get(said.lower(), said) not in known:
        message = f"unit '{shown(said)}' in this heading, expected one of {', '.join(known)}"
        raise RecordError(message, file=file, column=shown(heading))
    return NAMED.get(said.lower(), said)


def _cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of every row that holds something."""
    lines = read_lines(path)
    heading = next((line for line in lines if _HEADING.match(line)), None)
    if heading is None:
        raise RecordError("holds no heading 'Collection, Group, Target, ...': it was cut, or is no report", file=path)
    separator = heading.replace('"', "")[len("Collection")]
    reader = csv.reader((line + "\n" for line in lines), delimiter=separator, strict=True)
    try:
        for fields in reader:
            if any(f.strip() for f in fields):
                yield reader.line_num, [f.strip() for f in fields]
    except csv.Error as problem:
        raise RecordError(f"is not a table here ({problem})", file=path, row=reader.line_num) from None


def _blocks(path: Path) -> list[Block]:
    """The set-ups of a report in their order; a pose repeated on a further page changes nothing."""
    blocks: dict[tuple[str, str], Block] = {}
    current: Block | None = None
    what = ""
    for line, fields in _cells(path):
        first = fields[0].split("\n")[0]
        if first in ("Transform", "Observations"):
            collection, number, model = _heading(fields[0], path, line)
            current = blocks.setdefault((collection, number), Block(collection, number, model))
            what = first
        elif current is not None and what == "Transform":
            _read_pose(current, fields, path, line)
        elif current is not None and first == "Collection":
            current.header = fields
            _check_heading(fields, path, line)
        elif current is not None and current.header:
            _read_row(current, fields, path, line)
    for block in blocks.values():
        if block.header and block.count is not None and len(block.rows) != block.count:
            message = f"set-up {shown(block.number)} announces {block.count} observations and holds {len(block.rows)}"
            raise RecordError(f"{message}: the report was cut or edited", file=path)
    return list(blocks.values())


def _heading(cell: str, file: Path, line: int) -> tuple[str, str, str]:
    """Collection, number and model from ``A::0 - Leica AT960``."""
    parts = re.fullmatch(r"(?:(.*)::)?(.+?)(?: - (.*))?", cell.partition("\n")[2].strip())
    if parts is None:
        raise RecordError("a block without the name of its set-up", file=file, row=line)
    return parts.group(1) or "", parts.group(2), parts.group(3) or ""


def _read_pose(block: Block, fields: list[str], file: Path, line: int) -> None:
    if fields[0] == "# Meas." and len(fields) > 1:
        block.count = int(comma_number(fields[1], file=file, row=line, column="# Meas."))
    unit = NAMED.get(fields[0].strip("()").lower(), "")
    if fields[0].startswith("(") and len(fields) > 3:
        values = np.array([comma_number(text, file=file, row=line) for text in fields[1:4]])
        if unit in LENGTHS:
            block.position = values * FACTOR[unit]
        elif unit in ANGLES:
            block.rotation = values * FACTOR[unit]
        else:
            raise RecordError(f"unit '{shown(fields[0].strip('()'))}' of a pose is not known", file=file, row=line)


def _check_heading(fields: list[str], file: Path, line: int) -> None:
    stems = [(_UNIT.fullmatch(f) or [f, f])[1].strip() for f in fields]
    for wanted in ("Target", "Azimuth", "Elevation", "Distance"):
        if stems.count(wanted) != 1:
            message = f"the heading holds {stems.count(wanted)} columns called {wanted}, expected one"
            raise RecordError(message, file=file, row=line)


def _read_row(block: Block, fields: list[str], file: Path, line: int) -> None:
    if len(fields) != len(block.header):
        if len(fields) == 1:
            return
        message = f"{len(fields)} fields, expected {len(block.header)} as in the heading"
        raise RecordError(message, file=file, row=line)
    block.rows.append((line, fields))


def _station_names(blocks: list[Block]) -> list[str]:
    """``Instrument_0`` where numbers are unique, otherwise with the collection."""
    numbers = [block.number for block in blocks]
    if len(set(numbers)) == len(numbers):
        return [f"Instrument_{number}" for number in numbers]
    return [f"{block.collection}::{block.number}" for block in blocks]


def _pose(block: Block) -> tuple[Floats, Floats] | None:
    """Rotation about the fixed axes x, y, z in this order, and position."""
    if block.position is None or block.rotation is None:
        return None
    from scipy.spatial.transform import Rotation

    rotation: Floats = Rotation.from_euler("xyz", block.rotation).as_matrix()
    return rotation, block.position


def _readings(
    rows: list[_Row], poses: dict[str, tuple[Floats, Floats] | None], hints: Hints, file: Path
) -> tuple[Floats, list[str]]:
    """Raw readings (n, 3) and what had to be decided."""
    angle = rows[0].angle
    if any(row.angle != angle for row in rows):
        raise RecordError("angles in different units in one report", file=file)
    stations, station = indices((row.station for row in rows), "station", file)
    _, target = indices((row.name for row in rows), "target", file)
    printed = np.array([[row.horizontal, row.vertical, row.distance] for row in rows])
    table = PolarTable(station, target, *printed.T)
    known = Hints(angle=angle, vertical=hints.vertical, azimuth=hints.azimuth)
    once = replace(table, horizontal=np.mod(table.horizontal, CIRCLE[angle]))
    _, vertical, notes = angle_meaning(once, known, file)
    local = from_polar(table.readings(angle, vertical, "counter-clockwise", "m"))
    placed = {i: pose for i, name in enumerate(stations) if (pose := poses[name]) is not None}
    azimuth = hints.azimuth or sense_by_poses(local, table, placed)
    if azimuth is None:
        azimuth = "clockwise"
        notes.append("azimuths taken as clockwise, as SpatialAnalyzer reports them; this file alone cannot show it")
    elif hints.azimuth is None:
        notes.append(f"azimuths taken as {azimuth}: so the set-ups see the same points from the poses given")
    return table.readings(angle, vertical, azimuth, "m"), notes


def _targets(
    rows: list[_Row], readings: Floats, poses: dict[str, tuple[Floats, Floats] | None]
) -> tuple[list[str], list[str]]:
    """Names of the points: with a group in front where one name stands for points in different places."""
    local = from_polar(readings)
    seen: dict[str, list[tuple[_Row, Floats]]] = {}
    for row, point in zip(rows, local, strict=True):
        pose = poses[row.station]
        seen.setdefault(row.name, []).append((row, point if pose is None else pose[0] @ point + pose[1]))
    renamed: dict[tuple[str, str], str] = {}
    for name, sightings in seen.items():
        renamed |= {(name, group): new for group, new in _names_by_place(name, sightings).items()}
    split = sorted({name for (name, _), new in renamed.items() if new != name})
    notes = []
    if split:
        few = ", ".join(split[:4])
        notes.append(f"{len(split)} names stand for points in different places ({few}, ...): the group is added there")
    return [renamed[row.name, row.group] for row in rows], notes


def _names_by_place(name: str, sightings: list[tuple[_Row, Floats]]) -> dict[str, str]:
    """Name for each group: the place seen from most stations, then most often, keeps the name as it is."""
    groups: dict[str, list[tuple[_Row, Floats]]] = {}
    for row, point in sightings:
        groups.setdefault(row.group, []).append((row, point))
    clusters: list[tuple[Floats, list[str]]] = []
    for group, members in groups.items():
        centre = np.median([point for _, point in members], axis=0)
        near = next((c for c in clusters if np.linalg.norm(c[0] - centre) < SAME_POINT), None)
        if near is None:
            clusters.append((centre, [group]))
        else:
            near[1].append(group)

    def weight(cluster: tuple[Floats, list[str]]) -> tuple[int, int]:
        members = [row for group in cluster[1] for row, _ in groups[group]]
        return len({row.station for row in members}), len(members)

    clusters.sort(key=weight, reverse=True)
    plain = len(clusters) == 1 or weight(clusters[0]) > weight(clusters[1])
    return {
        group: name if plain and i == 0 else f"{together[0]}:{name}"
        for i, (_, together) in enumerate(clusters)
        for group in together
    }


def _times(rows: list[_Row]) -> list[float]:
    """Seconds since the first stamp; NaN throughout where the stamps are missing or not understood."""
    found, _ = moments([row.stamp for row in rows], "dmy")
    return [NAN] * len(rows) if found is None else found


def _setup(blocks: list[Block], names: list[str], file: Path) -> Setup:
    """Rough poses and, where the report names several, one instrument a model."""
    models = {block.model.replace("/", "-").strip() for block in blocks if block.model}
    stations = {}
    for name, block in zip(names, blocks, strict=True):
        pose = _pose(block)
        model = block.model.replace("/", "-").strip()
        position = None if pose is None else tuple((pose[1] * 1e3).round(6).tolist())
        yaw = None
        if pose is not None and pose[0][2, 2] > 0.9:
            yaw = float(np.degrees(np.arctan2(pose[0][1, 0], pose[0][0, 0])))
        stations[name] = Station(position_mm=position, yaw_deg=yaw, instrument=model or None)
    instruments = {check_name(model, "instrument", file=file): Instrument() for model in sorted(models)}
    return Setup(title=file.stem, instruments=instruments, stations=stations)

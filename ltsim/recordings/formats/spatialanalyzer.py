"""Format: instrument report of SpatialAnalyzer (``Instruments - CompositeReport``) exported as text.

Blocks of a set-up: its pose (``Transform``), then its observations, which are a table like any other with columns that
are known. Semicolons and decimal commas, or commas and points; units stand in the headings. The column called elevation
may hold a zenith angle: its values tell. Poses tell the sense of the azimuth, and which points of one name in different
groups are one point.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.units import ANGLE_UNITS, LENGTH_UNITS, SI_PER_UNIT, UNITS_BY_SPELLING
from ltsim.geometry.polar import from_polar
from ltsim.recordings.conventions import NO_HINTS, Hints, StationPoseArrays
from ltsim.recordings.files import SourceLocation, quoted_text, read_lines
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Setup, Station
from ltsim.recordings.specification import NO_NOISE_NOTE
from ltsim.recordings.tables.header import title_words_and_unit
from ltsim.recordings.tables.meaning import interpret_readings
from ltsim.recordings.tables.printed import PointingTable
from ltsim.recordings.tables.reader import assemble_recording
from ltsim.recordings.tables.rows import read_pointing_table
from ltsim.recordings.tables.sheets import SheetRow, TableSheet

REPORT_TITLE = "CompositeReport"
MAX_SAME_POINT_DISTANCE = 2e-3
"""Largest distance [m] between the centres of two groups of points that count as one target."""
SPATIALANALYZER_COLUMN_MAP = "target=Target,horizontal=Azimuth,vertical=Elevation,distance=Distance"
"""Roles of the columns of a block, as in the option --columns."""
PERMITTED_UNITS = {"target": None, "azimuth": ANGLE_UNITS, "elevation": ANGLE_UNITS, "distance": LENGTH_UNITS}
"""Columns that a block must have, with their permitted units."""
RETAINED_COLUMNS = (*PERMITTED_UNITS, "datetime", "offset1", "offset2")
"""Columns of a report that are read; others are ignored."""
_HEADING_PATTERN = re.compile(r"^\"?Collection\"?[;,\t]\"?Group\"?[;,\t]\"?Target", re.MULTILINE)


@dataclass
class _Block:
    """Block of a set-up: heading, pose in units of the file, announced number of rows, and rows with the heading."""

    collection: str
    number: str
    model: str
    count: int | None = None
    position: Floats | None = None
    rotation: Floats | None = None
    rows: list[SheetRow] = field(default_factory=list)

    def cell(self, row: SheetRow, title: str) -> str:
        """Cell of a row by the title of its column; empty without such a column."""
        titles = self.rows[0].fields
        return row.cell(titles.index(title)) if title in titles else ""

    @property
    def pose(self) -> StationPoseArrays | None:
        """Rotation about the fixed axes x, y, z in this order, and position; None without a pose."""
        if self.position is None or self.rotation is None:
            return None
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("xyz", self.rotation).as_matrix(), self.position


def recognises(path: Path, head: str) -> bool:
    """True if the file begins with the title of the report or the heading of its observations."""
    return REPORT_TITLE in head or _HEADING_PATTERN.search(head) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording of an instrument report.

    Raises RecordError for a malformed or truncated report, or for a convention that the data do not decide.
    """
    blocks = [block for block in _read_blocks(path) if block.rows]
    if not blocks:
        raise RecordError("contains no block of observations", file=path)
    names = _station_names(blocks)
    used = [[row for row in b.rows[1:] if b.cell(row, "Active").lower() != "no"] for b in blocks]
    remarks, off = [NO_NOISE_NOTE], sum(len(b.rows) - 1 - len(rows) for b, rows in zip(blocks, used, strict=True))
    if off:
        remarks.append(f"{off} observations are switched off in the report and not used")
    hints = replace(hints, columns=SPATIALANALYZER_COLUMN_MAP, date=hints.date or "dmy")
    table = read_pointing_table(
        [
            _sheet_of_block(*block_parts, path)
            for block_parts in zip(blocks, names, used, strict=True)
            if block_parts[2]
        ],
        hints,
        path,
    )
    groups = {row.line: b.cell(row, "Group") for b, rows in zip(blocks, used, strict=True) for row in rows}
    group = [groups[line] for line in table.pointings.line]
    for i, name in enumerate(group):
        table.pointings.source_location(i).text(name, "Group")
    poses = {name: block.pose for name, block in zip(names, blocks, strict=True)}
    order = dict.fromkeys(table.pointings.station)
    placed = {i: pose for i, name in enumerate(order) if (pose := poses[name]) is not None}
    meaning, readings = interpret_readings(table, placed, hints, path)
    table.notes += _prefix_ambiguous_points(table, group, readings, poses)
    recording = assemble_recording(table, meaning, readings, _setup(blocks, names, path), hints, path)
    return recording.replace(labels={**recording.labels, "group": tuple(group)}, notes=(*recording.notes, *remarks))


def _read_cells(path: Path) -> Iterator[SheetRow]:
    """Every row that is not empty, with the line where it ends."""
    lines = read_lines(path)
    heading = next((line for line in lines if _HEADING_PATTERN.match(line)), None)
    if heading is None:
        raise RecordError("contains no heading 'Collection, Group, Target, ...': it is incomplete", file=path)
    separator = heading.replace('"', "")[len("Collection")]
    reader = csv.reader((line + "\n" for line in lines), delimiter=separator, strict=True)
    try:
        for fields in reader:
            if any(f.strip() for f in fields):
                yield SheetRow(reader.line_num, tuple(f.strip() for f in fields))
    except csv.Error as problem:
        raise SourceLocation(path, reader.line_num).error(f"is not a table here ({problem})") from None


def _read_blocks(path: Path) -> list[_Block]:
    """Set-ups of a report in order; a pose repeated on a further page is ignored."""
    blocks: dict[tuple[str, str], _Block] = {}
    current: _Block | None = None
    what = ""
    for row in _read_cells(path):
        where, first = SourceLocation(path, row.line), row.fields[0].split("\n")[0]
        if first in ("Transform", "Observations"):
            what, heading = first, _parse_heading(row.fields[0], where)
            current = blocks.setdefault(heading[:2], _Block(*heading))
        elif current is not None and what == "Transform":
            _read_pose(current, row.fields, where)
        elif current is not None and first == "Collection":
            _check_heading(row.fields, where)
            current.rows = current.rows or [row]
        elif current is not None and current.rows and len(row.fields) > 1:
            row.check_width(len(current.rows[0].fields), path)
            current.rows.append(row)
    for block in blocks.values():
        if block.rows and block.count not in (None, len(block.rows) - 1):
            held = f"{block.count} observations and holds {len(block.rows) - 1}"
            message = f"set-up {quoted_text(block.number)} announces {held}: the report is incomplete or edited"
            raise RecordError(message, file=path)
    return list(blocks.values())


def _parse_heading(cell: str, location: SourceLocation) -> tuple[str, str, str]:
    """Collection, number and model of the instrument from ``A::0 - Leica AT960``."""
    match = re.fullmatch(r"(?:(.*)::)?(.+?)(?: - (.*))?", cell.partition("\n")[2].strip())
    if match is None:
        raise location.error("a block without the name of its set-up")
    return match[1] or "", match[2], (match[3] or "").replace("/", "-").strip()


def _read_pose(block: _Block, fields: Sequence[str], location: SourceLocation) -> None:
    if fields[0] == "# Meas." and len(fields) > 1:
        block.count = int(location.number(fields[1], "# Meas.", comma=True))
    if fields[0].startswith("(") and len(fields) > 3:
        values = np.array([location.number(text, comma=True) for text in fields[1:4]])
        unit = UNITS_BY_SPELLING.get(fields[0].strip("()").lower(), "")
        if unit in LENGTH_UNITS:
            block.position = values * SI_PER_UNIT[unit]
        elif unit in ANGLE_UNITS:
            block.rotation = values * SI_PER_UNIT[unit]
        else:
            raise location.error(f"unit '{quoted_text(fields[0].strip('()'))}' of a pose is not known")


def _check_heading(fields: Sequence[str], location: SourceLocation) -> None:
    """Check of the headings.

    Raises RecordError for a required column that is missing, repeated, or in an unknown unit.
    """
    named = [title_words_and_unit(field) for field in fields]
    for wanted, allowed in PERMITTED_UNITS.items():
        units = [unit for word, unit in named if word == wanted]
        if len(units) != 1:
            message = f"the heading has {len(units)} columns called {wanted.capitalize()}, expected one"
            raise location.error(message)
        if allowed is not None and units[0] not in allowed:
            message = f"unit '{quoted_text(units[0])}' in this heading, expected one of {', '.join(allowed)}"
            raise location.error(message, wanted.capitalize())


def _sheet_of_block(block: _Block, name: str, rows: list[SheetRow], file: Path) -> TableSheet:
    """Columns of a set-up's table that a recording retains; offsets have their unit in their name."""
    titles = {}
    for place, title in enumerate(block.rows[0].fields):
        word, unit = title_words_and_unit(title)
        if word in RETAINED_COLUMNS:
            titles[place] = f"{word}_{unit}" if word.startswith("offset") else title
    body = [SheetRow(row.line, tuple(row.cell(place) for place in titles)) for row in rows]
    return TableSheet(file, (SheetRow(block.rows[0].line, tuple(titles.values())), *body), name)


def _station_names(blocks: Sequence[_Block]) -> list[str]:
    """Names of the stations: ``Instrument_0`` if numbers are unique, otherwise with the collection."""
    numbers = [block.number for block in blocks]
    if len(set(numbers)) == len(numbers):
        return [f"Instrument_{number}" for number in numbers]
    return [f"{block.collection}::{block.number}" for block in blocks]


def _prefix_ambiguous_points(
    table: PointingTable, group: Sequence[str], readings: Floats, poses: dict[str, StationPoseArrays | None]
) -> list[str]:
    """Prefixing (in place) of point names that occur at several places with their group; returns notes."""
    sightings: dict[str, dict[str, list[tuple[str, Floats]]]] = {}
    printed = table.pointings
    for station, target, member_of, point in zip(
        printed.station, printed.target, group, from_polar(readings), strict=True
    ):
        pose = poses[station]
        place = point if pose is None else pose[0] @ point + pose[1]
        sightings.setdefault(target, {}).setdefault(member_of, []).append((station, place))
    names = {name: _names_by_place(name, groups) for name, groups in sightings.items()}
    several = sorted(name for name, of in names.items() if any(new != name for new in of.values()))
    printed.target = [names[target][member_of] for target, member_of in zip(printed.target, group, strict=True)]
    if not several:
        return []
    few = ", ".join(several[:4])
    return [f"{len(several)} names stand for points in different places ({few}, ...): the group is added there"]


def _names_by_place(name: str, groups: dict[str, list[tuple[str, Floats]]]) -> dict[str, str]:
    """Name for each group: the place seen from most stations (then with most pointings) keeps the plain name."""
    clusters: list[tuple[Floats, list[str]]] = []
    for group, members in groups.items():
        centre = np.median([place for _, place in members], axis=0)
        near = next((c for c in clusters if np.linalg.norm(c[0] - centre) < MAX_SAME_POINT_DISTANCE), None)
        if near is None:
            clusters.append((centre, [group]))
        else:
            near[1].append(group)

    def weight(cluster: tuple[Floats, list[str]]) -> tuple[int, int]:
        stations = [station for group in cluster[1] for station, _ in groups[group]]
        return len({*stations}), len(stations)

    clusters.sort(key=weight, reverse=True)
    plain = len(clusters) == 1 or weight(clusters[0]) > weight(clusters[1])
    return {
        group: name if plain and i == 0 else f"{together[0]}:{name}"
        for i, (_, together) in enumerate(clusters)
        for group in together
    }


def _setup(blocks: Sequence[_Block], names: Sequence[str], file: Path) -> Setup:
    """Set-up with rough poses and, if the report names several, one instrument per model."""
    stations = {}
    for name, block in zip(names, blocks, strict=True):
        position = yaw = None
        if (pose := block.pose) is not None:
            position = tuple((pose[1] * 1e3).round(6).tolist())
            if pose[0][2, 2] > 0.9:
                yaw = float(np.degrees(np.arctan2(pose[0][1, 0], pose[0][0, 0])))
        stations[name] = Station(position_mm=position, yaw_deg=yaw, instrument=block.model or None)
    models = sorted({block.model for block in blocks if block.model})
    instruments = {SourceLocation(file).name(model, "instrument"): Instrument() for model in models}
    return Setup(title=file.stem, instruments=instruments, stations=stations)

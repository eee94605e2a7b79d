"""Format: instrument report of SpatialAnalyzer (``Instruments - CompositeReport``) exported as text.

The report has a section for each set-up: its pose (``Transform``), then a table of observations. Cells are separated by
semicolons (with decimal commas) or by commas (with decimal points). Headings contain the units. The column with the
title elevation may contain zenith angles, which the values show. The poses determine the sense of the azimuth. They
also show whether points with one name in different groups are one point.
"""

import csv
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.units import ANGLE_UNITS, LENGTH_UNITS, SI_PER_UNIT, UNIT_BY_SPELLING
from ltsim.geometry.polar import from_polar
from ltsim.recordings.conventions import StationPoseArrays
from ltsim.recordings.files import SourceLocation, read_lines, safe_excerpt
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.recording import Recording
from ltsim.recordings.setup import Instrument, Setup, Station
from ltsim.recordings.specification import ASSUMED_TRACKER_NOISE_NOTE
from ltsim.recordings.spreadsheets.header import title_words_and_unit
from ltsim.recordings.spreadsheets.sheets import SheetRow, TableSheet
from ltsim.recordings.tables.interpretation import interpret_readings
from ltsim.recordings.tables.pointing_table import PointingTable
from ltsim.recordings.tables.reader import assemble_recording
from ltsim.recordings.tables.rows import read_pointing_table

REPORT_TITLE = "CompositeReport"
"""Word in the title of a report, by which the format is recognised."""
MAX_SAME_POINT_DISTANCE = 2e-3
"""Limit of the distance [m] of points with one name in two groups. Points at a smaller distance are one target."""
MAX_REPORT_OBSERVATIONS = 150_000
"""Largest permitted number of observations in a report; each takes 2.4 kB of memory and 0.1 ms."""
SPATIALANALYZER_COLUMN_MAP = "target=Target,horizontal=Azimuth,vertical=Elevation,distance=Distance"
"""Contents (roles) of the columns in the table of a set-up, in the notation of the option `--columns`."""
PERMITTED_UNITS_BY_COLUMN = {"target": None, "azimuth": ANGLE_UNITS, "elevation": ANGLE_UNITS, "distance": LENGTH_UNITS}
"""Columns that the table of a set-up must have, with their permitted units; None for a column without unit."""
USED_REPORT_COLUMNS = (*PERMITTED_UNITS_BY_COLUMN, "datetime", "offset1", "offset2")
"""Titles of the columns that are read from the table of a set-up; other columns are ignored."""
_HEADING_PATTERN = re.compile(r"^\"?Collection\"?[;,\t]\"?Group\"?[;,\t]\"?Target", re.MULTILINE)
"""Pattern of the heading of a table of observations."""


@dataclass
class _SetupSection:
    """Section of a report about one set-up: collection, number and model of the instrument, pose, observations."""

    collection: str
    number: str
    model: str
    n_declared_observations: int | None = None
    """Number of observations that the section declares; None if it declares none."""
    position: Floats | None = None
    """Position (3,) [m] of the instrument."""
    rotation_angles: Floats | None = None
    """Rotation angles (3,) [rad] of the instrument about the fixed axes x, y, z."""
    table_rows: list[SheetRow] = field(default_factory=list)
    """Heading row and data rows of the table of observations."""

    def cell_text(self, row: SheetRow, title: str) -> str:
        """Text of the cell of `row` in the column with this title; '' if the table has no such column."""
        titles = self.table_rows[0].fields
        return row.cell(titles.index(title)) if title in titles else ""

    @property
    def pose(self) -> StationPoseArrays | None:
        """Pose of the set-up: rotation (3, 3) to the network frame, position (3,) [m]; None if the section has none."""
        if self.position is None or self.rotation_angles is None:
            return None
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("xyz", self.rotation_angles).as_matrix(), self.position


def recognises(path: Path, file_beginning: str) -> bool:
    """True if the file begins with the title of a report or with the heading of its observations."""
    return REPORT_TITLE in file_beginning or _HEADING_PATTERN.search(file_beginning) is not None


def read(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from an instrument report.

    Raises RecordError for a malformed or truncated report, and if the data do not decide a convention.
    """
    sections = [section for section in _read_setup_sections(path) if section.table_rows]
    if not sections:
        raise RecordError("the file contains no section of observations", file=path)
    names = _station_names(sections)
    active_rows = [
        [row for row in section.table_rows[1:] if section.cell_text(row, "Active").lower() != "no"]
        for section in sections
    ]
    report_notes, n_inactive = (
        [ASSUMED_TRACKER_NOISE_NOTE],
        sum(len(section.table_rows) - 1 - len(rows) for section, rows in zip(sections, active_rows, strict=True)),
    )
    if n_inactive:
        report_notes.append(f"{n_inactive} observations are not active in the report and are not used")
    hints = replace(hints, columns=SPATIALANALYZER_COLUMN_MAP, date=hints.date or "dmy")
    table = read_pointing_table(
        [
            _table_sheet_of_section(*section_parts, path)
            for section_parts in zip(sections, names, active_rows, strict=True)
            if section_parts[2]
        ],
        hints,
        path,
    )
    group_by_line = {
        row.line: section.cell_text(row, "Group")
        for section, rows in zip(sections, active_rows, strict=True)
        for row in rows
    }
    group_names = [group_by_line[line] for line in table.pointings.line]
    for i, name in enumerate(group_names):
        table.pointings.source_location(i).checked_text(name, "Group")
    poses = {name: section.pose for name, section in zip(names, sections, strict=True)}
    ordered_names = dict.fromkeys(table.pointings.station)
    pose_by_index = {i: pose for i, name in enumerate(ordered_names) if (pose := poses[name]) is not None}
    meaning, readings = interpret_readings(table, pose_by_index, hints, path)
    table.notes += _prefix_ambiguous_points(table, group_names, readings, poses)
    recording = assemble_recording(table, meaning, readings, _setup_from_poses(sections, names, path), hints, path)
    return recording.replace(
        labels={**recording.labels, "group": tuple(group_names)}, notes=(*recording.notes, *report_notes)
    )


def _read_sheet_rows(path: Path) -> Iterator[SheetRow]:
    """Rows of the file that are not empty, each with the number of its last line; raises RecordError."""
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
        raise SourceLocation(path, reader.line_num).error(
            f"the table cannot be read on from this line ({problem})"
        ) from None


def _read_setup_sections(path: Path) -> list[_SetupSection]:
    """Sections of a report, one per set-up, in order; a section that continues on another page is joined.

    Raises RecordError.
    """
    sections: dict[tuple[str, str], _SetupSection] = {}
    section_of_row: _SetupSection | None = None
    part_title, n_observations = "", 0
    for row in _read_sheet_rows(path):
        where, first = SourceLocation(path, row.line), row.fields[0].split("\n")[0]
        if first in ("Transform", "Observations"):
            part_title, heading = first, _parse_heading(row.fields[0], where)
            section_of_row = sections.setdefault(heading[:2], _SetupSection(*heading))
        elif section_of_row is not None and part_title == "Transform":
            _read_pose(section_of_row, row.fields, where)
        elif section_of_row is not None and first == "Collection":
            _check_heading(row.fields, where)
            section_of_row.table_rows = section_of_row.table_rows or [row]
        elif section_of_row is not None and section_of_row.table_rows and len(row.fields) > 1:
            row.check_width(len(section_of_row.table_rows[0].fields), path)
            n_observations += 1
            if n_observations > MAX_REPORT_OBSERVATIONS:
                expected = f"expected at most {MAX_REPORT_OBSERVATIONS}; export the instruments separately"
                raise where.error(f"more observations than a report may hold, {expected}")
            section_of_row.table_rows.append(row)
    for section in sections.values():
        if section.table_rows and section.n_declared_observations not in (None, len(section.table_rows) - 1):
            held = f"{section.n_declared_observations} observations, but contains {len(section.table_rows) - 1}"
            message = f"set-up {safe_excerpt(section.number)} declares {held}: the report is incomplete or was edited"
            raise RecordError(message, file=path)
    return list(sections.values())


def _parse_heading(cell: str, location: SourceLocation) -> tuple[str, str, str]:
    """Collection, number and model of the instrument from a heading such as ``A::0 - Leica AT960``."""
    text = cell.partition("\n")[2].strip()
    if not text or "\n" in text:
        raise location.error("the section has no name of its set-up")
    end = text.rfind("::", 0, len(text) - 1)
    instrument = text if end < 0 else text[end + 2 :]
    number, _, model = instrument[1:].partition(" - ")
    return text[: max(end, 0)], instrument[0] + number, model.replace("/", "-").strip()


def _read_pose(section: _SetupSection, fields: Sequence[str], location: SourceLocation) -> None:
    """Addition of the position or the rotation in a line of the pose to the section of its set-up."""
    if fields[0] == "# Meas." and len(fields) > 1:
        section.n_declared_observations = int(location.parse_number(fields[1], "# Meas.", allows_decimal_comma=True))
    if fields[0].startswith("(") and len(fields) > 3:
        values = np.array([location.parse_number(text, allows_decimal_comma=True) for text in fields[1:4]])
        unit = UNIT_BY_SPELLING.get(fields[0].strip("()").lower(), "")
        if unit in LENGTH_UNITS:
            section.position = values * SI_PER_UNIT[unit]
        elif unit in ANGLE_UNITS:
            section.rotation_angles = values * SI_PER_UNIT[unit]
        else:
            raise location.error(f"the unit '{safe_excerpt(fields[0].strip('()'))}' of the pose is not supported")


def _check_heading(fields: Sequence[str], location: SourceLocation) -> None:
    """Check that the heading of a table has each required column once, in a permitted unit; raises RecordError."""
    titles_and_units = [title_words_and_unit(field) for field in fields]
    for required_title, permitted in PERMITTED_UNITS_BY_COLUMN.items():
        units = [unit for word, unit in titles_and_units if word == required_title]
        if len(units) != 1:
            message = f"the heading has {len(units)} columns called {required_title.capitalize()}, expected one"
            raise location.error(message)
        if permitted is not None and units[0] not in permitted:
            message = (
                f"found the unit '{safe_excerpt(units[0])}' in this heading, expected one of {', '.join(permitted)}"
            )
            raise location.error(message, required_title.capitalize())


def _table_sheet_of_section(section: _SetupSection, name: str, sheet_rows: list[SheetRow], file: Path) -> TableSheet:
    """Table with the rows `sheet_rows` of the set-up `name`, reduced to the columns in `USED_REPORT_COLUMNS`.

    Titles of columns with offsets of reflectors are changed to end with the unit.
    """
    titles = {}
    for place, title in enumerate(section.table_rows[0].fields):
        word, unit = title_words_and_unit(title)
        if word in USED_REPORT_COLUMNS:
            titles[place] = f"{word}_{unit}" if word.startswith("offset") else title
    body = [SheetRow(row.line, tuple(row.cell(place) for place in titles)) for row in sheet_rows]
    return TableSheet(file, (SheetRow(section.table_rows[0].line, tuple(titles.values())), *body), name)


def _station_names(sections: Sequence[_SetupSection]) -> list[str]:
    """Station name of each section: ``Instrument_0`` if instrument numbers are unique, otherwise ``COLLECTION::0``."""
    instrument_numbers = [section.number for section in sections]
    if len(set(instrument_numbers)) == len(instrument_numbers):
        return [f"Instrument_{number}" for number in instrument_numbers]
    return [f"{section.collection}::{section.number}" for section in sections]


def _prefix_ambiguous_points(
    table: PointingTable, group_names: Sequence[str], readings: Floats, poses: dict[str, StationPoseArrays | None]
) -> list[str]:
    """Addition, in place, of the group to names of targets that denote several points; the result is a list of notes.

    `group_names` is the group of each of n pointings, `readings` (n, 3) [m, rad, rad] are their ranges, azimuths and
    elevations. `poses` are the poses of the stations by name.
    """
    sightings: dict[str, dict[str, list[tuple[str, Floats]]]] = {}
    pointings = table.pointings
    for station, target, group_name, point in zip(
        pointings.station, pointings.target, group_names, from_polar(readings), strict=True
    ):
        pose = poses[station]
        position = point if pose is None else pose[0] @ point + pose[1]
        sightings.setdefault(target, {}).setdefault(group_name, []).append((station, position))
    names = {name: _new_names_by_group(name, groups) for name, groups in sightings.items()}
    ambiguous_names = sorted(name for name, of in names.items() if any(new != name for new in of.values()))
    pointings.target = [
        names[target][group_name] for target, group_name in zip(pointings.target, group_names, strict=True)
    ]
    if not ambiguous_names:
        return []
    examples = ", ".join(ambiguous_names[:4])
    n_ambiguous = len(ambiguous_names)
    return [
        f"{n_ambiguous} names stand for points at different positions ({examples}, ...): their group is added to the "
        "name"
    ]


def _new_names_by_group(name: str, groups: dict[str, list[tuple[str, Floats]]]) -> dict[str, str]:
    """New name, by group, for different points in several groups that all have the name `name`.

    `groups` contains, by group, the station and the position (3,) [m] of each pointing. The point measured from most
    stations keeps the name; among several of these, the one with most pointings.
    """
    clusters: list[tuple[Floats, list[str]]] = []
    indices_by_cell: defaultdict[tuple[float, ...], list[int]] = defaultdict(list)
    """Indices of the clusters of positions, by cell of a cubic grid; a cluster near a position is in its cell or an
    adjacent one.
    """
    for group, members in groups.items():
        centre = np.median([position for _, position in members], axis=0)
        cell = np.floor(centre / MAX_SAME_POINT_DISTANCE).tolist()
        adjacent = product(*((value - 1, value, value + 1) for value in cell)) if clusters else ()
        candidates = sorted(index for place in adjacent for index in indices_by_cell.get(place, ()))
        near = next((i for i in candidates if math.dist(clusters[i][0], centre) < MAX_SAME_POINT_DISTANCE), None)
        if near is None:
            indices_by_cell[tuple(cell)].append(len(clusters))
            clusters.append((centre, [group]))
        else:
            clusters[near][1].append(group)

    def n_stations_and_pointings(cluster: tuple[Floats, list[str]]) -> tuple[int, int]:
        stations = [station for group in cluster[1] for station, _ in groups[group]]
        return len({*stations}), len(stations)

    clusters.sort(key=n_stations_and_pointings, reverse=True)
    is_unique_best = len(clusters) == 1 or n_stations_and_pointings(clusters[0]) > n_stations_and_pointings(clusters[1])
    return {
        group: name if is_unique_best and i == 0 else f"{groups_at_place[0]}:{name}"
        for i, (_, groups_at_place) in enumerate(clusters)
        for group in groups_at_place
    }


def _setup_from_poses(sections: Sequence[_SetupSection], names: Sequence[str], file: Path) -> Setup:
    """Set-up with the poses of the report as approximate poses, and one instrument for each model."""
    stations = {}
    for name, section in zip(names, sections, strict=True):
        position = yaw = None
        if (pose := section.pose) is not None:
            position = tuple((pose[1] * 1e3).round(6).tolist())
            if pose[0][2, 2] > 0.9:
                yaw = float(np.degrees(np.arctan2(pose[0][1, 0], pose[0][0, 0])))
        stations[name] = Station(position_mm=position, yaw_deg=yaw, instrument=section.model or None)
    models = sorted({section.model for section in sections if section.model})
    instruments = {SourceLocation(file).checked_name(model, "instrument"): Instrument() for model in models}
    return Setup(title=file.stem, instruments=instruments, stations=stations)

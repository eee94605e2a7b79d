"""Conventions of a table: units, zenith angle or elevation, sense of the circle, coordinates in place of readings.

An explicit header is used; otherwise the data (`ltsim.recordings.conventions`) or a question to the user decide. Data
without known positions cannot decide the sense of the circle, because the mirror image of a network is also a network.
The titles do: `Hz`, `HA` are the horizontal circle of a theodolite, clockwise; azimuth and elevation are the spherical
coordinates of a tracker, counter-clockwise. An azimuth with a zenith angle can be either and needs a hint.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.units import ARCSECOND, DEGREE, MILLIMETRE, SI_PER_UNIT, unit_ratio
from ltsim.geometry.polar import from_polar, to_polar, unit_vectors
from ltsim.recordings.conventions import (
    SENSE_UNKNOWN_NOTE,
    AzimuthSense,
    Hints,
    PolarReadings,
    StationPoseArrays,
    VerticalKind,
    angle_convention,
    azimuth_sense_from_points,
    azimuth_sense_from_poses,
    length_meaning,
)
from ltsim.recordings.files import quoted_text
from ltsim.recordings.pointings import index_names
from ltsim.recordings.recording import SIGMA_COLUMNS
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import (
    COORDINATE_ROLES,
    DISTANCE_ROLES,
    HEIGHT_ROLES,
    HORIZONTAL_ROLES,
    SIGMA_ROLES,
    VERTICAL_ROLES,
    TableColumn,
)
from ltsim.recordings.tables.printed import PointingTable, PrintedPointings, apply_exactly, to_floats
from ltsim.recordings.tables.title_words import COMMON_SIGMA_ROLE
from ltsim.recordings.transcription_errors import MIN_DISTANCE_MM

FULL_CIRCLE_DEG = 360
"""Full circle [deg]."""
QUARTER_CIRCLE_DEG = 90
"""Quarter circle [deg]."""
HEIGHT_RANGE_M = (0.2, 3.0)
"""Range [m] of heights of instruments and targets above their marks, which distinguishes metres from millimetres."""
PLAUSIBLE_HEIGHTS = (("m", 0.2, 5.0), ("mm", 100.0, 5000.0))
"""Ranges of heights above marks, by unit: as a length in the other unit they are below 5 mm or above 100 m."""
MAX_AMBIGUOUS_MM = 1000.0
"""Longest distance [mm] up to which a distance without unit could be in metres."""
MAX_COMMON_FRAME_DIFFERENCE_M = 2e-3
"""Difference [m] of common targets up to which two set-ups count as already in one frame."""
COORDINATES_NOTE = (
    "coordinates in the axes of each set-up are converted to distance, azimuth and elevation; the declared noise "
    "applies to single readings, in both faces"
)


@dataclass(frozen=True)
class ColumnInterpretation:
    """Conversion of the numbers of a table to raw readings; `notes` lists the decisions."""

    horizontal_unit: str
    vertical_unit: str
    length_unit: str
    vertical: VerticalKind
    azimuth: AzimuthSense
    notes: tuple[str, ...] = ()

    def readings(self, pointings: PrintedPointings) -> Floats:
        """Raw ranges [m], azimuths and elevations [rad] (n, 3), equal to those of a native file."""
        clockwise, zenith = self.azimuth == "clockwise", self.vertical == "zenith"

        def azimuth(turn: Any, degree: Any) -> Any:
            return -turn % (FULL_CIRCLE_DEG * degree) if clockwise else turn

        def elevation(rise: Any, degree: Any) -> Any:
            up = QUARTER_CIRCLE_DEG * degree - rise if zenith else rise
            return np.where(up < -QUARTER_CIRCLE_DEG * degree, up + FULL_CIRCLE_DEG * degree, up)

        polar = [
            apply_exactly(pointings.digits_of_roles(DISTANCE_ROLES), unit_ratio(self.length_unit, "mm")),
            apply_exactly(
                pointings.digits_of_roles(HORIZONTAL_ROLES), unit_ratio(self.horizontal_unit, "deg"), azimuth
            ),
            apply_exactly(pointings.digits_of_roles(VERTICAL_ROLES), unit_ratio(self.vertical_unit, "deg"), elevation),
        ]
        return np.stack(polar, axis=1) * [MILLIMETRE, DEGREE, DEGREE]

    def unit_of(self, role: str, values: Floats) -> str:
        """Unit of a column of sigmas or heights (n,) without unit: that of its reading.

        Heights that are implausible in this unit and plausible in the other of metres and millimetres are in that one.
        """
        if role in HEIGHT_ROLES and self.length_unit in ("m", "mm"):
            sizes = np.abs(values[np.isfinite(values) & (values != 0)])
            height = float(np.median(sizes)) if len(sizes) else 0.0
            for unit, low, high in PLAUSIBLE_HEIGHTS:
                if unit != self.length_unit and low < height < high:
                    return unit
        return {"sigma_azimuth_arcsec": self.horizontal_unit, "sigma_elevation_arcsec": self.vertical_unit}.get(
            role, self.length_unit
        )


def interpret_readings(
    table: PointingTable, poses: Mapping[int, StationPoseArrays], hints: Hints, file: Path
) -> tuple[ColumnInterpretation, Floats]:
    """Interpretation of the numbers of a table, and its raw readings (n, 3) [m, rad].

    Rough `poses` of stations, by their order in the table, decide the sense of the circle.

    Raises RecordError, with the option to type, if neither header nor data decide.
    """
    if table.has_coordinates:
        return _readings_from_coordinates(table, hints, file)
    columns = {kind[0]: table.column(kind) for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES)}
    unit_of = {kind: c.unit if c is not None else "" for kind, c in columns.items()}
    pointings = table.pointings
    _, station = index_names(pointings.station, "station", file)
    _, target = index_names(pointings.target, "target", file)
    polar = PolarReadings(
        station,
        target,
        *(to_floats(pointings.digits_of_roles(kind)) for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES)),
    )
    units, vertical, notes = _angle_conventions(columns, unit_of, polar, hints, file)
    length, more = _length_convention(unit_of["distance"], polar, table, hints, file)
    meaning = ColumnInterpretation(*units, length, vertical, "counter-clockwise")
    azimuth, why = _azimuth_sense(table, meaning, polar, poses, hints, file)
    meaning = replace(meaning, azimuth=azimuth, notes=(*notes, *more, *why))
    return meaning, meaning.readings(pointings)


def _angle_conventions(
    columns: Mapping[str, TableColumn | None],
    unit_by_column: Mapping[str, str],
    polar: PolarReadings,
    hints: Hints,
    file: Path,
) -> tuple[tuple[str, str], VerticalKind, list[str]]:
    column = columns["vertical"]
    role = column.role if column is not None else ""
    declared: VerticalKind | None = "zenith" if role == "zenith" else "elevation" if role == "elevation" else None
    if column is None:
        declared = "elevation"
    turn_unit, rise_unit = unit_by_column["horizontal"], unit_by_column["vertical"]
    unit = turn_unit or rise_unit or hints.angle or ""
    # The data are asked in one unit: angles in different ones are brought to degrees first.
    asked, common_unit = polar, None
    if unit:
        turns = [float(unit_ratio(u or unit, "deg")) for u in (turn_unit, rise_unit)]
        asked = replace(polar, horizontal=polar.horizontal * turns[0], vertical=polar.vertical * turns[1])
        common_unit = "deg"
    if common_unit and (declared or hints.vertical):
        return (turn_unit or unit, rise_unit or unit), hints.vertical or declared or "elevation", []
    answer = replace(hints, angle=common_unit or hints.angle, vertical=hints.vertical or declared)  # type: ignore[arg-type]
    angle, vertical, notes = angle_convention(asked, answer, file)
    if common_unit and column is not None:
        notes = [f"'{column.title}' is interpreted as {vertical} angles ({note.rpartition('(')[2]}" for note in notes]
    return (turn_unit or unit or angle, rise_unit or unit or angle), vertical, notes


def _length_convention(
    declared_unit: str, polar: PolarReadings, table: PointingTable, hints: Hints, file: Path
) -> tuple[str, list[str]]:
    """Unit of the distances, with notes: declared, or from heights in the table, their size, or a hint."""
    if declared_unit or not np.isfinite(polar.distance).any():
        return declared_unit or hints.length or "mm", []
    longest = float(np.nanmax(polar.distance))
    if hints.length is not None or not MIN_DISTANCE_MM <= longest < MAX_AMBIGUOUS_MM:
        return length_meaning(polar.distance, hints)
    if table.column(("flat",)) is not None:
        return "m", ["distances are interpreted as m (horizontal distances are written in metres)"]
    column = next((c for c in table.columns if c.role in HEIGHT_ROLES and not c.unit), None)
    texts = table.pointings.additional_cells.get(column.title, []) if column is not None else []
    tall = [abs(float(height)) for height in map(cells.parse_value, texts) if height]
    if column is not None and tall and HEIGHT_RANGE_M[0] < float(np.median(tall)) < HEIGHT_RANGE_M[1]:
        return "m", [
            f"distances are interpreted as m ('{quoted_text(column.title)}' in the same table contains "
            "heights in metres)"
        ]
    message = f"distances of up to {longest:.6g} may be metres or millimetres; give --hint length=m or"
    raise RecordError(f"{message} --hint length=mm", file=file)


def _azimuth_sense(
    table: PointingTable,
    interpretation: ColumnInterpretation,
    polar: PolarReadings,
    poses: Mapping[int, StationPoseArrays],
    hints: Hints,
    file: Path,
) -> tuple[AzimuthSense, list[str]]:
    """Sense of the circle, with notes: from a hint, known positions, or the titles of the header."""
    if hints.azimuth is not None or not np.isfinite(polar.horizontal).any():
        return hints.azimuth or "counter-clockwise", []
    if hints.points is not None or len(poses) > 1:
        local = from_polar(interpretation.readings(table.pointings))
        if hints.points is not None:
            return azimuth_sense_from_points(local, polar, list(dict.fromkeys(table.pointings.target)), hints.points)
        azimuth = azimuth_sense_from_poses(local, polar, poses)
        if azimuth is not None:
            return azimuth, [
                f"azimuths are interpreted as {azimuth}: read so, all stations agree at their approximate positions"
            ]
    column = table.column(HORIZONTAL_ROLES)
    if table.positional or column is None:
        raise RecordError(SENSE_UNKNOWN_NOTE, file=file)
    if column.role == "horizontal":
        circle = f"'{column.title}' is interpreted as a horizontal circle, clockwise"
        return "clockwise", [
            f"{circle}, which this file alone cannot show (otherwise give --hint azimuth=counter-clockwise)"
        ]
    if interpretation.vertical == "elevation":
        spherical = (
            "azimuths with elevations are interpreted as counter-clockwise (otherwise give --hint azimuth=clockwise)"
        )
        return "counter-clockwise", [spherical]
    raise RecordError(SENSE_UNKNOWN_NOTE, file=file)


def _readings_from_coordinates(table: PointingTable, hints: Hints, file: Path) -> tuple[ColumnInterpretation, Floats]:
    """Coordinates converted to readings on face 1.

    Raises RecordError if a coordinate is missing, or if all set-ups are in one frame.
    """
    coordinates = np.stack([to_floats(table.pointings.digits_of_roles((axis,))) for axis in COORDINATE_ROLES], axis=1)
    rows, axes = np.nonzero(np.isnan(coordinates))
    if len(rows):
        raise table.pointings.source_location(int(rows[0])).error(
            f"the coordinate {COORDINATE_ROLES[axes[0]]} is missing"
        )
    length = next((c.unit for c in table.columns if c.role in COORDINATE_ROLES and c.unit), "")
    notes: list[str] = []
    if not length:
        length, notes = length_meaning(np.linalg.norm(coordinates, axis=1), hints)
    readings = to_polar(coordinates * SI_PER_UNIT[length])
    near_indices = np.flatnonzero(readings[:, 0] < MILLIMETRE)
    if len(near_indices):
        raise table.pointings.source_location(int(near_indices[0])).error(
            "coincides with the instrument, expected another point"
        )
    _require_separate_frames(table, coordinates * SI_PER_UNIT[length], file)
    return ColumnInterpretation(
        "rad", "rad", length, "elevation", "counter-clockwise", (*notes, COORDINATES_NOTE)
    ), readings


def _require_separate_frames(table: PointingTable, points: Floats, file: Path) -> None:
    """Check that coordinates were not transformed into one frame, in which they contain no information on a network.

    Raises RecordError.
    """
    first: dict[str, tuple[str, Floats]] = {}
    gaps = []
    for here, target, point in zip(table.pointings.station, table.pointings.target, points, strict=True):
        station, place = first.setdefault(target, (here, point))
        if station != here:
            gaps.append(float(np.linalg.norm(point - place)))
    if len(gaps) > 2 and float(np.median(gaps)) < MAX_COMMON_FRAME_DIFFERENCE_M:
        message = (
            f"{len(gaps)} targets have the same coordinates from several set-ups: they are already in one frame; "
            "export them in the axes of each instrument"
        )
        raise RecordError(message, file=file)


def sigmas_from_coordinates(table: PointingTable, readings: Floats, length: str) -> dict[str, Floats]:
    """Standard deviations (n,) of the readings (n, 3), by column, from those of x, y, z if the table has them."""
    columns = [table.column((SIGMA_ROLES[axis],)) or table.column((COMMON_SIGMA_ROLE,)) for axis in COORDINATE_ROLES]
    titles = [(c.title, SI_PER_UNIT[c.unit or length]) for c in columns if c is not None]
    if not table.has_coordinates or len(titles) < len(COORDINATE_ROLES):
        return {}
    pointings = table.pointings
    columns_of_numbers = [map(cells.parse_value, pointings.texts(title), pointings.grouping) for title, _ in titles]
    pointings.additional_cells = {
        title: column for title, column in pointings.additional_cells.items() if title not in dict(titles)
    }
    sizes = [[float(s) if s is not None and s > 0 else np.nan for s in column] for column in columns_of_numbers]
    variance = (np.stack(sizes, axis=1) * [factor for _, factor in titles]) ** 2
    range_, azimuth, elevation = readings.T
    ways = np.stack(unit_vectors(azimuth, elevation), axis=1) ** 2
    level = np.maximum(range_ * np.cos(elevation), 1e-9)
    units = np.stack([np.full(len(range_), MILLIMETRE), level * ARCSECOND, range_ * ARCSECOND], axis=1)
    sigma = np.sqrt(np.einsum("nki,ni->nk", ways, variance)) / units
    sigma[np.isnan(sigma[:, 0])] = np.nan
    return {} if np.isnan(sigma).all() else dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))

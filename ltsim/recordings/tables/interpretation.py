"""Conventions of a table: units, zenith angle or elevation, sense of the circle, coordinates in place of readings.

The header decides if it is explicit; otherwise the data decide (`ltsim.recordings.conventions`), or an error asks the
user for a hint. Data without known positions cannot decide the sense of the circle, because the mirror image of a
network fits equally well. The titles then decide it: `Hz` and `HA` are the horizontal circle of a theodolite,
clockwise; azimuth and elevation are the spherical coordinates of a tracker, counter-clockwise. An azimuth with a zenith
angle can be either and needs a hint.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.units import (
    ANGLE_UNITS,
    ARCSECOND,
    DEGREE,
    LENGTH_UNITS,
    MILLIMETRE,
    SI_PER_UNIT,
    UNIT_BY_SPELLING,
    unit_ratio,
)
from ltsim.geometry.polar import from_polar, to_polar, unit_vectors
from ltsim.recordings.conventions import (
    AZIMUTH_SENSE_UNKNOWN_NOTE,
    AzimuthSense,
    Hints,
    PolarReadings,
    StationPoseArrays,
    VerticalKind,
    angle_convention,
    azimuth_sense_from_points,
    azimuth_sense_from_poses,
    length_unit_from_size,
)
from ltsim.recordings.files import safe_excerpt
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
from ltsim.recordings.tables.pointing_table import PointingTable, UnconvertedPointings, apply_exactly, to_floats
from ltsim.recordings.tables.title_words import COMMON_SIGMA_ROLE
from ltsim.recordings.transcription_errors import MIN_LONGEST_DISTANCE_MM

FULL_CIRCLE_DEG = 360
"""Full circle [deg]."""
QUARTER_CIRCLE_DEG = 90
"""Quarter circle [deg]."""
MEDIAN_HEIGHT_RANGE_IN_METRES = (0.2, 3.0)
"""Smallest and largest median of heights above survey marks, as numbers without unit, between which they show that the
table is in metres."""
PLAUSIBLE_HEIGHT_RANGES = (("m", 0.2, 5.0), ("mm", 100.0, 5000.0))
"""Unit, smallest and largest plausible height above a survey mark in this unit; no such number fits both units."""
MAX_AMBIGUOUS_DISTANCE_MM = 1000.0
"""Number below which the longest distance of a table without unit may be in metres or millimetres: a hint is needed."""
MAX_COMMON_FRAME_DIFFERENCE_M = 2e-3
"""Median distance [m] between the points that two set-ups give for a common target, below which the coordinates count
as transformed into one frame."""
COORDINATES_NOTE = (
    "coordinates in the axes of each set-up are converted to distance, azimuth and elevation; the declared noise "
    "is that of single readings in both faces"
)
"""Note to the user on a table of coordinates in place of readings."""


@dataclass(frozen=True)
class ColumnInterpretation:
    """Units of directions, vertical angles and lengths in a table, kind of vertical angle, sense of the azimuth.

    `notes` reports to the user how each was decided.
    """

    horizontal_unit: str
    vertical_unit: str
    length_unit: str
    vertical_kind: VerticalKind
    azimuth_sense: AzimuthSense
    notes: tuple[str, ...] = ()

    def readings(self, pointings: UnconvertedPointings) -> Floats:
        """Raw ranges, azimuths and elevations (n, 3) [m, rad, rad] of n pointings, converted without rounding."""
        clockwise, zenith = self.azimuth_sense == "clockwise", self.vertical_kind == "zenith"

        def azimuth(reading: Any, units_per_degree: Any) -> Any:
            return -reading % (FULL_CIRCLE_DEG * units_per_degree) if clockwise else reading

        def elevation(reading: Any, units_per_degree: Any) -> Any:
            up = QUARTER_CIRCLE_DEG * units_per_degree - reading if zenith else reading
            return np.where(up < -QUARTER_CIRCLE_DEG * units_per_degree, up + FULL_CIRCLE_DEG * units_per_degree, up)

        polar = [
            apply_exactly(pointings.digit_texts_of_roles(DISTANCE_ROLES), unit_ratio(self.length_unit, "mm")),
            apply_exactly(
                pointings.digit_texts_of_roles(HORIZONTAL_ROLES), unit_ratio(self.horizontal_unit, "deg"), azimuth
            ),
            apply_exactly(
                pointings.digit_texts_of_roles(VERTICAL_ROLES), unit_ratio(self.vertical_unit, "deg"), elevation
            ),
        ]
        return np.stack(polar, axis=1) * [MILLIMETRE, DEGREE, DEGREE]

    def unit_of(self, role: str, column_values: Floats) -> str:
        """Unit of a column of standard deviations or heights that declares none: in general that of the readings.

        `role` is that of the column, `column_values` (n,) are its n numbers. Heights have millimetres or metres
        instead, if the unit of the readings makes them implausible.
        """
        if role in HEIGHT_ROLES and self.length_unit in ("m", "mm"):
            sizes = np.abs(column_values[np.isfinite(column_values) & (column_values != 0)])
            height = float(np.median(sizes)) if len(sizes) else 0.0
            for unit, low, high in PLAUSIBLE_HEIGHT_RANGES:
                if unit != self.length_unit and low < height < high:
                    return unit
        return {"sigma_azimuth_arcsec": self.horizontal_unit, "sigma_elevation_arcsec": self.vertical_unit}.get(
            role, self.length_unit
        )


def interpret_readings(
    table: PointingTable, poses: Mapping[int, StationPoseArrays], hints: Hints, file: Path
) -> tuple[ColumnInterpretation, Floats]:
    """Interpretation of the numbers in a table of n pointings, and its raw readings (n, 3) [m, rad, rad].

    Rough `poses` of stations, by index of the station in the table, can decide the sense of the circle.

    Raises RecordError with the option to type if neither the header nor the data decide.
    """
    if table.has_coordinates:
        return _readings_from_coordinates(table, hints, file)
    columns = {kind[0]: table.column(kind) for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES)}
    unit_by_kind = {kind: c.unit if c is not None else "" for kind, c in columns.items()}
    pointings = table.pointings
    station, target = pointings.name_indices("station"), pointings.name_indices("target")
    polar = PolarReadings(
        station,
        target,
        *(
            to_floats(pointings.digit_texts_of_roles(kind))
            for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES)
        ),
    )
    units, vertical, notes = _angle_conventions(columns, unit_by_kind, polar, hints, file)
    length, length_notes = _length_convention(unit_by_kind["distance"], polar, table, hints, file)
    interpretation = ColumnInterpretation(*units, length, vertical, "counter-clockwise")
    azimuth_sense, sense_notes = _azimuth_sense(table, interpretation, polar, poses, hints, file)
    all_notes = (*_missing_readings_notes(table), *notes, *length_notes, *sense_notes)
    interpretation = replace(interpretation, azimuth_sense=azimuth_sense, notes=all_notes)
    return interpretation, interpretation.readings(pointings)


def _missing_readings_notes(table: PointingTable) -> list[str]:
    """Notes that the table lacks vertical angles or distances, if unrecognised columns have a unit of these."""
    notes = []
    for kind, name, units in (
        (VERTICAL_ROLES, "vertical angles", ANGLE_UNITS),
        (DISTANCE_ROLES, "distances", LENGTH_UNITS),
    ):
        columns = [c for c in table.columns if c.is_additional and not c.role and _unit_in_title(c) in units]
        if columns and table.column(kind) is None:
            title, titles = columns[0].title, ", ".join(f"'{safe_excerpt(c.title)}'" for c in columns)
            notes.append(
                f"no column is recognised as {name}, so the recording contains none; if {titles} contains them, give "
                f'--columns "{kind[0]}={safe_excerpt(title)}"'
            )
    return notes


def _unit_in_title(column: TableColumn) -> str:
    """Unit in the title of a column, in brackets or after an underscore; '' for none."""
    return column.unit or UNIT_BY_SPELLING.get(column.title.rpartition("_")[2].casefold(), "")


def _angle_conventions(
    columns: Mapping[str, TableColumn | None],
    unit_by_column: Mapping[str, str],
    polar: PolarReadings,
    hints: Hints,
    file: Path,
) -> tuple[tuple[str, str], VerticalKind, list[str]]:
    """Units of directions and of vertical angles, kind of vertical angle, and notes; raises RecordError.

    `columns` are the columns, and `unit_by_column` their units, by kind of reading; a unit that the header does not
    declare is ''. `polar` are the readings in the units of the table.
    """
    column = columns["vertical"]
    role = column.role if column is not None else ""
    declared: VerticalKind | None = "zenith" if role == "zenith" else "elevation" if role == "elevation" else None
    if column is None:
        declared = "elevation"
    direction_unit, vertical_unit = unit_by_column["horizontal"], unit_by_column["vertical"]
    unit = direction_unit or vertical_unit or hints.angle or ""
    # The data decide in one unit: angles with different units are converted to degrees first.
    converted, common_unit = polar, None
    if unit:
        factors = [float(unit_ratio(u or unit, "deg")) for u in (direction_unit, vertical_unit)]
        converted = replace(
            polar,
            horizontal_angles=polar.horizontal_angles * factors[0],
            vertical_angles=polar.vertical_angles * factors[1],
        )
        common_unit = "deg"
    if common_unit and (declared or hints.vertical):
        return (direction_unit or unit, vertical_unit or unit), hints.vertical or declared or "elevation", []
    completed_hints = replace(hints, angle=common_unit or hints.angle, vertical=hints.vertical or declared)  # type: ignore[arg-type]
    angle, vertical, notes = angle_convention(converted, completed_hints, file)
    if common_unit and column is not None:
        notes = [f"'{column.title}' is interpreted as {vertical} angles ({note.rpartition('(')[2]}" for note in notes]
    return (direction_unit or unit or angle, vertical_unit or unit or angle), vertical, notes


def _length_convention(
    declared_unit: str, polar: PolarReadings, table: PointingTable, hints: Hints, file: Path
) -> tuple[str, list[str]]:
    """Unit of the distances, and notes on it: as declared, from a hint, from their size, or from heights in the table.

    Raises RecordError if none of these decides.
    """
    if declared_unit or not np.isfinite(polar.distance).any():
        return declared_unit or hints.length or "mm", []
    longest = float(np.nanmax(polar.distance))
    if hints.length is not None or not MIN_LONGEST_DISTANCE_MM <= longest < MAX_AMBIGUOUS_DISTANCE_MM:
        return length_unit_from_size(polar.distance, hints)
    if table.column(("flat",)) is not None:
        return "m", ["distances are interpreted as m (horizontal distances are written in metres)"]
    column = next((c for c in table.columns if c.role in HEIGHT_ROLES and not c.unit), None)
    height_texts = table.pointings.additional_cells.get(column.title, []) if column is not None else []
    heights = [abs(float(height)) for height in map(cells.parse_number_or_angle, height_texts) if height]
    if (
        column is not None
        and heights
        and MEDIAN_HEIGHT_RANGE_IN_METRES[0] < float(np.median(heights)) < MEDIAN_HEIGHT_RANGE_IN_METRES[1]
    ):
        return "m", [
            f"distances are interpreted as m ('{safe_excerpt(column.title)}' in the same table contains "
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
    """Sense of the circle, and notes on it: from a hint, from known positions, or from the titles of the header.

    Raises RecordError if none of these decides.
    """
    if hints.azimuth is not None or not np.isfinite(polar.horizontal_angles).any():
        return hints.azimuth or "counter-clockwise", []
    if hints.points is not None or len(poses) > 1:
        local = from_polar(interpretation.readings(table.pointings))
        if hints.points is not None:
            return azimuth_sense_from_points(local, polar, list(dict.fromkeys(table.pointings.target)), hints.points)
        azimuth = azimuth_sense_from_poses(local, polar, poses)
        if azimuth is not None:
            return azimuth, [
                f"azimuths are interpreted as {azimuth}, because all stations at their approximate positions then agree"
            ]
    column = table.column(HORIZONTAL_ROLES)
    if table.is_positional or column is None:
        raise RecordError(AZIMUTH_SENSE_UNKNOWN_NOTE, file=file)
    if column.role == "horizontal":
        circle = f"'{column.title}' is interpreted as a horizontal circle, clockwise"
        return "clockwise", [
            f"{circle}, which this file alone cannot show (otherwise give --hint azimuth=counter-clockwise)"
        ]
    if interpretation.vertical_kind == "elevation":
        spherical = (
            "azimuths in tables with elevations are read as counter-clockwise (otherwise give --hint azimuth=clockwise)"
        )
        return "counter-clockwise", [spherical]
    raise RecordError(AZIMUTH_SENSE_UNKNOWN_NOTE, file=file)


def _readings_from_coordinates(table: PointingTable, hints: Hints, file: Path) -> tuple[ColumnInterpretation, Floats]:
    """Interpretation of a table of n measured points, and corresponding readings (n, 3) [m, rad, rad] on face 1.

    Raises RecordError if a coordinate is missing, or if the coordinates of several set-ups are in one frame.
    """
    coordinates = np.stack(
        [to_floats(table.pointings.digit_texts_of_roles((axis,))) for axis in COORDINATE_ROLES], axis=1
    )
    rows, axes = np.nonzero(np.isnan(coordinates))
    if len(rows):
        raise table.pointings.source_location(int(rows[0])).error(
            f"the coordinate {COORDINATE_ROLES[axes[0]]} is missing"
        )
    length_unit = next((c.unit for c in table.columns if c.role in COORDINATE_ROLES and c.unit), "")
    notes: list[str] = []
    if not length_unit:
        length_unit, notes = length_unit_from_size(np.linalg.norm(coordinates, axis=1), hints)
    readings = to_polar(coordinates * SI_PER_UNIT[length_unit])
    coincident_rows = np.flatnonzero(readings[:, 0] < MILLIMETRE)
    if len(coincident_rows):
        raise table.pointings.source_location(int(coincident_rows[0])).error(
            "the point coincides with the instrument, expected another point"
        )
    _require_separate_frames(table, coordinates * SI_PER_UNIT[length_unit], file)
    return ColumnInterpretation(
        "rad", "rad", length_unit, "elevation", "counter-clockwise", (*notes, COORDINATES_NOTE)
    ), readings


def _require_separate_frames(table: PointingTable, points: Floats, file: Path) -> None:
    """Check that n points (n, 3) [m] of several set-ups were not transformed into one frame; raises RecordError.

    Coordinates in one frame contain no information on the network.
    """
    first_point: dict[str, tuple[str, Floats]] = {}
    distances = []
    for station_of_row, target, point in zip(table.pointings.station, table.pointings.target, points, strict=True):
        station, place = first_point.setdefault(target, (station_of_row, point))
        if station != station_of_row:
            distances.append(float(np.linalg.norm(point - place)))
    if len(distances) > 2 and float(np.median(distances)) < MAX_COMMON_FRAME_DIFFERENCE_M:
        message = (
            f"{len(distances)} targets have the same coordinates from several set-ups: they are already in one frame; "
            "export them in the axes of each instrument"
        )
        raise RecordError(message, file=file)


def sigmas_from_coordinates(table: PointingTable, readings: Floats, length: str) -> dict[str, Floats]:
    """Standard deviations (n,) of n ranges, azimuths and elevations by column name, from those of x, y, z.

    `readings` (n, 3) are the corresponding readings [m, rad, rad]; `length` is the unit of columns that declare none.
    The result is empty if the table has no coordinates or no standard deviations.
    """
    columns = [table.column((SIGMA_ROLES[axis],)) or table.column((COMMON_SIGMA_ROLE,)) for axis in COORDINATE_ROLES]
    titles = [(c.title, SI_PER_UNIT[c.unit or length]) for c in columns if c is not None]
    if not table.has_coordinates or len(titles) < len(COORDINATE_ROLES):
        return {}
    pointings = table.pointings
    columns_of_numbers = [
        map(cells.parse_number_or_angle, pointings.texts(title), pointings.thousands_separator) for title, _ in titles
    ]
    pointings.additional_cells = {
        title: column for title, column in pointings.additional_cells.items() if title not in dict(titles)
    }
    sigmas = [[float(s) if s is not None and s > 0 else np.nan for s in column] for column in columns_of_numbers]
    variance = (np.stack(sigmas, axis=1) * [factor for _, factor in titles]) ** 2
    range_, azimuth, elevation = readings.T
    squared_directions = np.stack(unit_vectors(azimuth, elevation), axis=1) ** 2
    horizontal_length = np.maximum(range_ * np.cos(elevation), 1e-9)
    units = np.stack([np.full(len(range_), MILLIMETRE), horizontal_length * ARCSECOND, range_ * ARCSECOND], axis=1)
    sigma = np.sqrt(np.einsum("nki,ni->nk", squared_directions, variance)) / units
    sigma[np.isnan(sigma[:, 0])] = np.nan
    return {} if np.isnan(sigma).all() else dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))

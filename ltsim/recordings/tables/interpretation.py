"""Conventions of a table: units, zenith angle or elevation, sense of the horizontal circle, coordinates or readings.

An explicit header decides. Otherwise the data decide (`ltsim.recordings.conventions`), or an error asks the user for a
hint. Without known positions, data cannot decide the sense of the circle, because the mirror image of a network fits
equally well. Then the titles decide: `Hz` and `HA` denote the horizontal circle of a theodolite, which is clockwise.
Azimuth and elevation denote the spherical coordinates of a tracker, which are counter-clockwise. Azimuth with a zenith
angle is ambiguous and needs a hint.
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
    unit_ratio,
)
from ltsim.geometry.polar import beam_frame_axes, from_polar, to_polar
from ltsim.recordings.conventions import (
    AZIMUTH_SENSE_UNKNOWN_NOTE,
    PolarReadings,
    StationPoseArrays,
    angle_convention,
    azimuth_sense_from_points,
    azimuth_sense_from_poses,
    distance_unit_from_size,
)
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.hints import AzimuthSense, Hints, VerticalKind
from ltsim.recordings.recording import SIGMA_COLUMNS
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import (
    COORDINATE_ROLES,
    DISTANCE_ROLES,
    HEIGHT_ROLES,
    HORIZONTAL_ROLES,
    SIGMA_ROLES,
    VERTICAL_ROLES,
    TableColumn,
)
from ltsim.recordings.spreadsheets.title_words import COMMON_SIGMA_ROLE
from ltsim.recordings.tables.height_differences import height_differences, is_raw_second_face, unit_in_title
from ltsim.recordings.tables.pointing_table import PointingTable, UnconvertedPointings, apply_exactly, to_floats
from ltsim.recordings.transcription_errors import MIN_LONGEST_DISTANCE_MM

FULL_CIRCLE_DEG = 360
"""Full circle in degrees."""
QUARTER_CIRCLE_DEG = 90
"""Quarter of a circle in degrees."""
MEDIAN_HEIGHT_RANGE_IN_METRES = (0.2, 3.0)
"""Smallest and largest median of heights above survey marks, as numbers without unit, in a table with lengths in
metres."""
PLAUSIBLE_HEIGHT_RANGES = (("m", 0.2, 5.0), ("mm", 100.0, 5000.0))
"""Unit, and smallest and largest plausible height above a survey mark in this unit; a number can fit only one unit."""
MAX_AMBIGUOUS_DISTANCE_MM = 1000.0
"""Limit of the longest distance of a table without unit. Below it, the unit may be the metre or the millimetre, so that
a hint is needed."""
MAX_COMMON_FRAME_DIFFERENCE_M = 2e-3
"""Limit of the median distance [m] between coordinates of a target from two set-ups. Below it, the coordinates are
already in one common frame."""
CONVERTED_COORDINATES_NOTE = (
    "coordinates in the axes of each set-up are converted to distance, azimuth and elevation; each row is used as one "
    "pointing with the declared noise, also if it is the mean of several readings"
)
"""Note for the user on a table with coordinates in place of readings."""


@dataclass(frozen=True)
class TableConventions:
    """Conventions of a table: units of directions, vertical angles and lengths, kind of vertical angle, azimuth sense.

    `notes` are sentences for the user on how each convention was decided.
    """

    horizontal_unit: str
    vertical_unit: str
    length_unit: str
    vertical_kind: VerticalKind
    azimuth_sense: AzimuthSense
    notes: tuple[str, ...] = ()
    elevation_rounding_sigmas: Floats | None = None
    """Standard deviations (n,) [rad] of elevations due to the rounding of the height differences from which they are
    computed; None for measured elevations."""

    def readings(self, pointings: UnconvertedPointings) -> Floats:
        """Raw ranges, azimuths and elevations (n, 3) [m, rad, rad] of n pointings, converted exactly."""
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

    def assumed_unit(self, role: str, column_values: Floats) -> str:
        """Unit of a column of standard deviations or heights that declares none, normally the unit of the readings.

        `role` is the role of the column, `column_values` (n,) are its n numbers. Heights are in millimetres or metres
        instead, if they are implausible in the unit of the readings.
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
) -> tuple[TableConventions, Floats]:
    """Conventions of a table of n pointings, and its raw readings (n, 3) [m, rad, rad].

    `poses` are approximate poses by index of the station; they can decide the sense of the circle. Raises RecordError,
    with the option to type, if neither header nor data decide.
    """
    if table.has_coordinates:
        return _readings_from_coordinates(table, hints, file)
    _require_no_nadir_angles(table, file)
    columns = {kind[0]: table.column_with_role(kind) for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES)}
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
    interpretation = TableConventions(*units, length, vertical, "counter-clockwise")
    azimuth_sense, sense_notes = _azimuth_sense(table, interpretation, polar, poses, hints, file)
    all_notes = (*_missing_readings_notes(table), *notes, *length_notes, *sense_notes)
    interpretation = replace(interpretation, azimuth_sense=azimuth_sense, notes=all_notes)
    readings = interpretation.readings(pointings)
    if heights := height_differences(table, length, interpretation.assumed_unit):
        interpretation = replace(
            interpretation,
            elevation_rounding_sigmas=heights.rounding_sigmas(readings[:, 0]),
            notes=(*interpretation.notes, heights.note),
        )
        elevations, sights = heights.elevations(readings[:, 0]), station * (target.max(initial=0) + 1) + target
        is_second_face = is_raw_second_face(readings[:, 1], sights, np.array(pointings.face))
        readings[:, 2] = np.where(is_second_face, np.pi - elevations, elevations)
    return interpretation, readings


def _require_no_nadir_angles(table: PointingTable, file: Path) -> None:
    """Check that no column contains nadir angles, which would be read upside down; raises RecordError.

    A column that `--columns` declares as zenith angles or elevations is accepted.
    """
    for column in table.columns:
        is_vertical = column.role == "vertical" or (column.is_additional and unit_in_title(column) in ANGLE_UNITS)
        if "nadir" in column.title.lower() and is_vertical:
            raise RecordError(
                f"column '{safe_excerpt(column.title)}' contains nadir angles, which are not read; write zenith angles "
                "(a half circle minus the nadir angle), or give --columns if it contains zenith angles or elevations",
                file=file,
            )


def _missing_readings_notes(table: PointingTable) -> list[str]:
    """Notes on kinds of reading that the table lacks, although columns with unknown titles have their units."""
    notes = []
    for kind, name, units in (
        (HORIZONTAL_ROLES, "azimuths", ANGLE_UNITS),
        (VERTICAL_ROLES, "vertical angles", ANGLE_UNITS),
        (DISTANCE_ROLES, "distances", LENGTH_UNITS),
    ):
        columns = [c for c in table.columns if c.is_additional and not c.role and unit_in_title(c) in units]
        if columns and table.column_with_role(kind) is None:
            title, titles = columns[0].title, ", ".join(f"'{safe_excerpt(c.title)}'" for c in columns)
            notes.append(
                f"no column is recognised as {name}, so the recording contains none; if {titles} contains them, give "
                f'--columns "{kind[0]}={safe_excerpt(title)}"'
            )
    return notes


def _angle_conventions(
    columns: Mapping[str, TableColumn | None],
    unit_by_column: Mapping[str, str],
    polar: PolarReadings,
    hints: Hints,
    file: Path,
) -> tuple[tuple[str, str], VerticalKind, list[str]]:
    """Units of directions and of vertical angles, kind of vertical angle, and notes; raises RecordError.

    `columns` are the columns by kind of reading, and `unit_by_column` their units ('' if not declared). `polar` are the
    readings in the units of the table.
    """
    column = columns["vertical"]
    role = column.role if column is not None else ""
    declared: VerticalKind | None = "zenith" if role == "zenith" else "elevation" if role == "elevation" else None
    if column is None or not np.isfinite(polar.vertical_angles).any():
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
    """Unit of the distances, and notes about it: as declared, from a hint, from their size, or from heights.

    Raises RecordError if none of these decides.
    """
    if declared_unit or not np.isfinite(polar.distance).any():
        return declared_unit or hints.length or "mm", []
    longest = float(np.nanmax(polar.distance))
    if hints.length is not None or not MIN_LONGEST_DISTANCE_MM <= longest < MAX_AMBIGUOUS_DISTANCE_MM:
        return distance_unit_from_size(polar.distance, hints)
    if table.column_with_role(("flat",)) is not None:
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
    interpretation: TableConventions,
    polar: PolarReadings,
    poses: Mapping[int, StationPoseArrays],
    hints: Hints,
    file: Path,
) -> tuple[AzimuthSense, list[str]]:
    """Sense of the horizontal circle, and notes about it: from a hint, from known positions, or from titles.

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
    column = table.column_with_role(HORIZONTAL_ROLES)
    if table.is_positional or column is None:
        raise RecordError(AZIMUTH_SENSE_UNKNOWN_NOTE, file=file)
    if column.role == "horizontal":
        circle = f"'{column.title}' is interpreted as a horizontal circle, clockwise"
        return "clockwise", [
            f"{circle}, although the file does not show the sense (otherwise give --hint azimuth=counter-clockwise)"
        ]
    if interpretation.vertical_kind == "elevation":
        spherical = (
            "azimuths in tables with elevations are read as counter-clockwise (otherwise give --hint azimuth=clockwise)"
        )
        return "counter-clockwise", [spherical]
    raise RecordError(AZIMUTH_SENSE_UNKNOWN_NOTE, file=file)


def _readings_from_coordinates(table: PointingTable, hints: Hints, file: Path) -> tuple[TableConventions, Floats]:
    """Conventions of a table of n measured points, and readings (n, 3) [m, rad, rad] in face 1 computed from them.

    Raises RecordError for a missing coordinate, and if coordinates from several set-ups are in one frame.
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
        length_unit, notes = distance_unit_from_size(np.linalg.norm(coordinates, axis=1), hints)
    readings = to_polar(coordinates * SI_PER_UNIT[length_unit])
    coincident_rows = np.flatnonzero(readings[:, 0] < MILLIMETRE)
    if len(coincident_rows):
        raise table.pointings.source_location(int(coincident_rows[0])).error(
            "the point coincides with the instrument, expected another point"
        )
    _require_separate_frames(table, coordinates * SI_PER_UNIT[length_unit], file)
    return TableConventions(
        "rad", "rad", length_unit, "elevation", "counter-clockwise", (*notes, CONVERTED_COORDINATES_NOTE)
    ), readings


def _require_separate_frames(table: PointingTable, points: Floats, file: Path) -> None:
    """Check that `points` (n, 3) [m] from several set-ups were not transformed into one frame; raises RecordError.

    Such coordinates contain no information on the relation of the stations.
    """
    first_point: dict[str, tuple[str, Floats]] = {}
    distances = []
    for station_of_row, target, point in zip(table.pointings.station, table.pointings.target, points, strict=True):
        station, place = first_point.setdefault(target, (station_of_row, point))
        if station != station_of_row:
            distances.append(float(np.linalg.norm(point - place)))
    if len(distances) > 2 and float(np.median(distances)) < MAX_COMMON_FRAME_DIFFERENCE_M:
        message = (
            f"{len(distances)} targets have equal coordinates from several set-ups, which are thus in one frame; "
            "export them in the axes of each instrument"
        )
        raise RecordError(message, file=file)


def sigmas_from_coordinates(table: PointingTable, readings: Floats, length: str) -> dict[str, Floats]:
    """Standard deviations (n,) of n ranges, azimuths and elevations, by column name, from those of x, y, z.

    `readings` (n, 3) are the readings [m, rad, rad] computed from the coordinates. `length` is the unit of columns that
    declare none. The result is empty without coordinates or without standard deviations.
    """
    columns = [
        table.column_with_role((SIGMA_ROLES[axis],)) or table.column_with_role((COMMON_SIGMA_ROLE,))
        for axis in COORDINATE_ROLES
    ]
    titles = [(c.title, SI_PER_UNIT[c.unit or length]) for c in columns if c is not None]
    if not table.has_coordinates or len(titles) < len(COORDINATE_ROLES):
        return {}
    pointings = table.pointings
    columns_of_numbers = [
        map(cells.parse_number_or_angle, pointings.additional_cell_texts(title), pointings.thousands_separator)
        for title, _ in titles
    ]
    pointings.additional_cells = {
        title: column for title, column in pointings.additional_cells.items() if title not in dict(titles)
    }
    sigmas = [[float(s) if s is not None and s > 0 else np.nan for s in column] for column in columns_of_numbers]
    variance = (np.stack(sigmas, axis=1) * [factor for _, factor in titles]) ** 2
    range_, azimuth, elevation = readings.T
    squared_directions = np.stack(beam_frame_axes(azimuth, elevation), axis=1) ** 2
    horizontal_length = np.maximum(range_ * np.cos(elevation), 1e-9)
    units = np.stack([np.full(len(range_), MILLIMETRE), horizontal_length * ARCSECOND, range_ * ARCSECOND], axis=1)
    sigma = np.sqrt(np.einsum("nki,ni->nk", squared_directions, variance)) / units
    sigma[np.isnan(sigma[:, 0])] = np.nan
    return {} if np.isnan(sigma).all() else dict(zip(SIGMA_COLUMNS, sigma.T, strict=True))

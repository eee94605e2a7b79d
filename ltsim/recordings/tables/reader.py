"""Reader of recordings from a file of delimited text, a folder of such files, or a workbook."""

import os
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import ARCSECOND, MILLIMETRE, SI_PER_UNIT, unit_ratio
from ltsim.geometry.polar import swap_front_and_raw
from ltsim.recordings.air import NO_AIR_UNCERTAINTY
from ltsim.recordings.conventions import floor_plan_poses
from ltsim.recordings.curvature import with_earth_curvature
from ltsim.recordings.files import MAX_CELL_TEXT_LENGTH, safe_excerpt
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.occupations import check_centring_tables
from ltsim.recordings.pointings import NOT_MEASURED, PointingColumns, has_all_sigma_columns, recording_from_columns
from ltsim.recordings.recording import (
    DISTANCE_KIND_COLUMN,
    HEIGHT_COLUMNS,
    OCCUPATION_COLUMNS,
    SIGMA_COLUMNS,
    Recording,
)
from ltsim.recordings.resolution import (
    FOOT_DISPLAY_STEPS,
    LENGTH_DISPLAY_STEPS,
    display_step_of_readings,
    total_station_with_assumed_noise,
)
from ltsim.recordings.settings import read_setup
from ltsim.recordings.setup import Instrument, Setup
from ltsim.recordings.specification import ASSUMED_TRACKER_NOISE_NOTE
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.spreadsheets.header import DISTANCE_ROLES, UNITS_BY_ROLE, TableColumn, has_named_coordinates
from ltsim.recordings.spreadsheets.sheets import (
    TABLE_SUFFIXES,
    ZIP_SIGNATURE,
    is_table_folder,
    read_sheets,
    rows_of_file_beginning,
)
from ltsim.recordings.tables.angle_columns import with_unpacked_angles
from ltsim.recordings.tables.clock_columns import pointing_times, with_time_column
from ltsim.recordings.tables.heights import covariates_with_instrument_heights, unapplied_heights_notes
from ltsim.recordings.tables.interpretation import TableConventions, interpret_readings, sigmas_from_coordinates
from ltsim.recordings.tables.missing_names import (
    ambiguous_target_name_notes,
    name_targets_by_position,
    require_names_in_target_column,
    require_single_unnamed_setup,
    with_placeholder_target_name,
)
from ltsim.recordings.tables.pointing_table import PointingTable, UnconvertedPointings, decimal_places
from ltsim.recordings.tables.rows import parse_header, read_pointing_table
from ltsim.recordings.tables.setups import (
    common_target_names,
    marks_with_other_spelling,
    occupation_columns,
    split_occupations,
    with_setups_over_marks,
)

SETUP_FILE = "setup.toml"
MAX_ROWS_IN_NOTE = 3
"""Largest number of rows that a note lists."""
DEFAULT_HEAD_HEIGHT_SIGMA_MM = 1.0
"""Assumed standard deviation [mm] of the height of a tracker head above its survey mark, for tables whose heights are
not applied because the readings refer to the heads."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True for a folder of tables, a workbook, and text with a header of readings or with columns of numbers."""
    if path.is_dir():
        return is_table_folder(path)
    if file_beginning.startswith(ZIP_SIGNATURE.decode("latin-1")):
        return path.suffix.lower() == ".xlsx"
    if "\x00" in file_beginning[2:] or file_beginning.lstrip()[:1] in ("<", "{"):
        return False
    first_rows = rows_of_file_beginning(
        file_beginning if file_beginning.endswith("\n") else "\n".join(file_beginning.splitlines()[:-1])
    )  # the last may be cut
    headers = [columns for row in first_rows if (columns := parse_header(row, NO_HINTS))]
    if headers and has_named_coordinates(headers[0]) and not any(c.role == "station" for c in headers[0]):
        return False  # a list of coordinates, unless its station is named
    n_measured_rows = sum(row.n_numeric_fields > 1 and len(row.fields) > 2 for row in first_rows)
    return bool(headers) or (path.suffix.lower() in TABLE_SUFFIXES and 2 * n_measured_rows > len(first_rows))


def read(path: Path, hints: Hints = NO_HINTS, *, positional: bool = False) -> Recording:
    """Recording from a table, a folder of tables or a workbook.

    With `positional`, a table without header may also have lines with names and three numbers. Raises RecordError.
    """
    pointing_table = read_pointing_table(read_sheets(path), hints, path, positional=positional)
    table = with_unpacked_angles(with_time_column(pointing_table), hints, path)
    table = with_placeholder_target_name(table, hints, path)
    table.pointings.target, name_notes = common_target_names(table.pointings)
    table.notes += name_notes
    table.mark_by_setup = marks_with_other_spelling(table.pointings.station, table.pointings.target)
    setup = _read_setup(path, hints)
    poses = floor_plan_poses(setup or Setup(), tuple(dict.fromkeys(table.pointings.station)))
    interpretation, readings = interpret_readings(table, poses, hints, path)
    table = name_targets_by_position(table, readings)
    require_single_unnamed_setup(table, readings, path)
    require_names_in_target_column(table, readings, path)
    table.notes += ambiguous_target_name_notes(table, readings)
    if setup is not None:
        recording = assemble_recording(table, interpretation, readings, setup, hints, path)
        if not hints.is_growing:
            check_centring_tables(recording, _setup_path(path, hints))
        return recording.replace(
            notes=(f"noise and set-ups are read from {_setup_path(path, hints)}", *recording.notes)
        )
    reason = total_station_reason(table, interpretation, readings)
    instrument, noise = (
        total_station_with_assumed_noise(readings, reason) if reason else (Instrument(), ASSUMED_TRACKER_NOISE_NOTE)
    )
    air = NO_AIR_UNCERTAINTY if reason else None
    setup = Setup(title=path.stem[:MAX_CELL_TEXT_LENGTH], instrument=instrument, air=air)
    recording = assemble_recording(table, interpretation, readings, setup, hints, path)
    return recording if has_all_sigma_columns(recording) else recording.replace(notes=(noise, *recording.notes))


def assemble_recording(
    table: PointingTable, interpretation: TableConventions, readings: Floats, setup: Setup, hints: Hints, file: Path
) -> Recording:
    """Recording from a table of n pointings and their readings (n, 3) [m, rad, rad], in the order of the table.

    `interpretation` are the units and conventions. `setup` is the prior knowledge, which the table completes.
    """
    pointings, missing_values = table.pointings, np.full(len(table.pointings), NOT_MEASURED)
    sigmas = sigmas_from_coordinates(table, readings, interpretation.length_unit)
    if interpretation.elevation_rounding_sigmas is not None:
        elevation_noise = setup.instrument.noise.elevation_arcsec
        sigmas[SIGMA_COLUMNS[2]] = np.hypot(elevation_noise, interpretation.elevation_rounding_sigmas / ARCSECOND)
    covariates, labels, column_notes = _additional_columns(table, interpretation)
    azimuth_sigma = covariates.get(SIGMA_COLUMNS[1], missing_values) * ARCSECOND
    is_total_station = bool(total_station_reason(table, interpretation, readings))
    has_circle = is_total_station or table.column_with_role(("horizontal",)) is not None
    first_setup_of_occupation, occupation_notes = split_occupations(
        table, readings, azimuth_sigma, has_circle=has_circle
    )
    is_levelled = is_total_station and table.column_with_role(("elevation",)) is None
    setup, level_notes = with_setups_over_marks(
        table, setup, readings, rounds=first_setup_of_occupation, levelled=is_levelled
    )
    faces, face_notes = _pointing_faces(table, readings)
    times, start_moment, time_notes = pointing_times(table, hints)
    if start_moment and not setup.started:
        setup = setup.model_copy(update={"started": start_moment})
    covariates, height_notes = covariates_with_instrument_heights(table, covariates, first_setup_of_occupation)
    height = np.stack([covariates.get(name, missing_values) for name in HEIGHT_COLUMNS], axis=1) * MILLIMETRE
    unapplied_notes = unapplied_heights_notes(table, readings, height)
    if unapplied_notes:
        height_notes = []
        covariates = {name: column for name, column in covariates.items() if name not in HEIGHT_COLUMNS}
        sigma_mm = setup.height_above_mark_sigma_mm or DEFAULT_HEAD_HEIGHT_SIGMA_MM
        setup = setup.model_copy(update={"height_above_mark_sigma_mm": sigma_mm, "curved": True})
        labels = _merged_labels(occupation_columns(table), labels)
    if time_notes and table.column_with_role(("date",)) is not None:  # a text where it is no clock
        labels["date"] = pointings.date_and_time
    if "flat" in pointings.digit_texts_by_role:
        slope = pointings.digit_texts_of_roles(("distance",))
        labels[DISTANCE_KIND_COLUMN] = np.where(
            (pointings.digit_texts_by_role["flat"] != b"") & (slope == b""), "horizontal", ""
        ).tolist()
    note_groups = [
        table.notes,
        interpretation.notes,
        occupation_notes,
        level_notes,
        face_notes,
        time_notes,
        column_notes,
        height_notes,
        unapplied_notes,
        _unread_lines_notes(table),
    ]
    columns = PointingColumns(
        pointings.station,
        pointings.target,
        np.array(faces, dtype=np.int64),
        readings,
        np.array(times),
        covariates | sigmas,
        labels,
        pointings.sources,
    )
    return with_earth_curvature(
        recording_from_columns(columns, setup, notes=[n for notes in note_groups for n in notes], file=file)
    )


def _merged_labels(default_labels: dict[str, list[str]], priority_labels: dict[str, list[str]]) -> dict[str, list[str]]:
    """Labels of both dictionaries by column; `default_labels` fill the empty entries of `priority_labels`."""
    merged_labels = {
        name: [upper or other for upper, other in zip(priority_labels[name], column, strict=True)]
        if name in priority_labels
        else column
        for name, column in default_labels.items()
    }
    return {**priority_labels, **merged_labels}


def _setup_path(path: Path, hints: Hints) -> Path:
    """Path of the `setup.toml` for a table: in the hints, otherwise in the folder of the table."""
    file = hints.setup or (path if path.is_dir() else path.parent) / SETUP_FILE
    return file / SETUP_FILE if file.is_dir() else file


def _read_setup(path: Path, hints: Hints) -> Setup | None:
    """Set-up from the `setup.toml` for a table; None if there is none."""
    file = _setup_path(path, hints)
    return read_setup(file) if hints.setup is not None or os.path.lexists(file) else None


def _pointing_faces(table: PointingTable, readings: Floats) -> tuple[list[int], list[str]]:
    """Face (1 or 2) of each pointing, and notes.

    Readings (n, 3) [m, rad, rad] of face 2 that the file reduced to face 1 become raw readings again, in place.
    """
    beyond_zenith = np.abs(readings[:, 2]) > np.pi / 2 + 1e-9
    faces = [face or int(b) + 1 for face, b in zip(table.pointings.face, beyond_zenith.tolist(), strict=True)]
    is_second_face = np.array(faces) == 2
    if (
        not is_second_face.any()
        or beyond_zenith[is_second_face].any()
        or not np.isfinite(readings[is_second_face, 2]).any()
    ):
        return faces, []
    readings[:] = swap_front_and_raw(readings, np.array(faces))
    readings[is_second_face, 1] %= 2 * np.pi
    return faces, ["readings of face 2 were reduced to face 1 and are converted back to circle readings"]


def _additional_columns(
    table: PointingTable, interpretation: TableConventions
) -> tuple[dict[str, Floats], dict[str, list[str]], list[str]]:
    """Covariates (columns of numbers) by name, labels (columns of texts) by name, and notes.

    Columns of standard deviations and heights get the names of the native format. Without a unit in their titles, their
    numbers are in the unit of the readings.
    """
    columns = [c for c in table.columns if c.is_additional]
    label_titles = {c.title for c in columns if c.role in OCCUPATION_COLUMNS}
    value_columns = [c for c in columns if c.title not in label_titles]
    converted = {c.title: _covariate_values(c, table.pointings, interpretation) for c in value_columns}
    numeric = {title: numbers for title, numbers in converted.items() if numbers is not None}
    used_titles = label_titles | {c.title for c in value_columns if "_" in c.role and c.title in numeric}
    names = {c.title: c.role if c.title in used_titles else c.title for c in columns}
    covariates = {names[title]: column for title, (column, _) in numeric.items()}
    labels = {
        names[title]: column for title, column in table.pointings.additional_cells.items() if title not in numeric
    }
    with_units = {c.title for c in columns if c.role in HEIGHT_COLUMNS or c.role.startswith("sigma_")}
    units = [
        f"'{safe_excerpt(c.title)}' is interpreted as {c.role}"
        + ("" if c.unit else f", in {numeric[c.title][1]}{_unit_reason(c.role, numeric[c.title][1], interpretation)}")
        for c in columns
        if c.title in with_units and c.title in numeric
    ]
    covariate_names = ", ".join(f"'{safe_excerpt(names[c.title])}'" for c in columns if c.title not in with_units)
    return (
        covariates,
        labels,
        [
            *units,
            *([f"additional columns are read as covariates and labels: {covariate_names}"] if covariate_names else []),
        ],
    )


def _unit_reason(role: str, unit: str, interpretation: TableConventions) -> str:
    """Reason, as the end of a note, why a column without declared unit has this `unit`."""
    of_reading = role not in HEIGHT_COLUMNS or unit == interpretation.length_unit
    return (
        " as the readings" if of_reading else f", because heights in {interpretation.length_unit} would be implausible"
    )


def _covariate_values(
    column: TableColumn, pointings: UnconvertedPointings, interpretation: TableConventions
) -> tuple[Floats, str] | None:
    """Numbers (n,) in the cells of a column, in the unit of its role, and unit of the cells; None if a cell has a text.

    The number of an empty cell is NaN.
    """
    texts = pointings.additional_cells.get(column.title, [])
    if not any(texts):
        return None
    bare_texts, cell_unit = cells.split_common_unit(texts) if column.role in UNITS_BY_ROLE else (texts, "")
    column_numbers = cells.plain_numbers(bare_texts) if not any(pointings.thousands_separator) else None
    if column_numbers is None:
        column_numbers = np.full(len(texts), NOT_MEASURED)
        numbers = cells.exact_numbers(bare_texts, pointings.thousands_separator)
        for i, (text, number) in enumerate(zip(bare_texts, numbers, strict=True)):
            if text and text not in cells.MISSING_VALUE_TEXTS:
                if number is None and column.role in HEIGHT_COLUMNS:
                    message = f"found '{safe_excerpt(texts[i])}', expected a height, with the same unit in all cells"
                    raise pointings.source_location(i).error(message, safe_excerpt(column.title))
                if number is None:
                    return None
                column_numbers[i] = number
    unit = cell_unit or column.unit or interpretation.assumed_unit(column.role, column_numbers)
    target_unit = column.role.rpartition("_")[2]
    if target_unit in ("mm", "arcsec") and unit in (*UNITS_BY_ROLE[column.role], "dms"):
        column_numbers = column_numbers * float(unit_ratio(unit, target_unit))
    return column_numbers, unit


def _unread_lines_notes(table: PointingTable) -> list[str]:
    """Notes on a table without station names, and on lines of the file that are not used."""
    notes = []
    if table.lacks_station_names:
        assumption = "the table names no station: all its pointings are assigned to one station, S1"
        notes.append(f"{assumption} (give another name with --hint station=NAME)")
    if table.unread_lines:
        examples = "; ".join(table.unread_lines[:MAX_ROWS_IN_NOTE])
        more = len(table.unread_lines) - MAX_ROWS_IN_NOTE
        notes.append(f"free text is not used: {examples}" + (f" and {more} more lines" if more > 0 else ""))
    return notes


MAX_TRACKER_RANGE_M = 160.0
"""Limit of the range [m] of a tracker, because data sheets of trackers give 80 to 160 m. Longer ranges are from a total
station."""
MIN_LAST_DIGIT_OF_TOTAL_STATION_M = 0.5e-4
"""Smallest value [m] of the last digit of the ranges of a total station; trackers give micrometres."""
MIN_DISPLAYED_LAST_DIGIT_M = 0.5e-9
"""Smallest value [m] of the last digit of ranges that an instrument displayed; smaller digits come from a computation.
"""

MIN_RANGES_FOR_RESOLUTION = 6
"""Smallest number of ranges whose last digits show the resolution of the instrument; fewer may end in zeros by chance.
"""


def total_station_reason(table: PointingTable, interpretation: TableConventions, readings: Floats) -> str:
    """Reason, as text, why a table is from a total station; empty if it may be from a laser tracker.

    Heights above survey marks are not sufficient, because trackers are set up over marks too.
    """
    if table.has_coordinates:
        return ""
    ranges = readings[:, 0][np.isfinite(readings[:, 0])]
    if table.column_with_role(("flat",)) is not None:
        return "the table contains horizontal distances"
    if not len(ranges):
        return ""
    if ranges.max() > MAX_TRACKER_RANGE_M:
        return f"the longest range is {ranges.max():.4g} m, beyond any laser tracker"
    columns = [digits for role, digits in table.pointings.digit_texts_by_role.items() if role in DISTANCE_ROLES]
    n_decimals = np.concatenate([decimal_places(digits[digits != b""]) for digits in columns])
    if len(n_decimals) < MIN_RANGES_FOR_RESOLUTION:
        return ""
    digit = 10.0 ** -int(n_decimals.max()) * SI_PER_UNIT[interpretation.length_unit]
    digit = max(
        digit,
        display_step_of_readings(
            ranges, FOOT_DISPLAY_STEPS if digit > MIN_DISPLAYED_LAST_DIGIT_M else LENGTH_DISPLAY_STEPS
        ),
    )
    if digit > MIN_LAST_DIGIT_OF_TOTAL_STATION_M:
        return f"the ranges are written to {1e3 * digit:.2g} mm"
    if table.column_with_role(("instrument_height_mm",)) is not None and digit > MIN_LAST_DIGIT_OF_TOTAL_STATION_M / 10:
        return f"the ranges are written to {1e3 * digit:.2g} mm, with heights over marks"
    return ""

"""Reading and writing of recordings (observations with their set-up) in all supported file formats."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

from pydantic import ValidationError

from ltsim.core.errors import RecordError, unknown_name_error
from ltsim.core.notation import names_text
from ltsim.recordings import coordinates, native
from ltsim.recordings.conventions import (
    NO_HINTS,
    Hints,
    mirror_image_warnings,
    vertical_sight_notes,
)
from ltsim.recordings.face_units import face_unit_warnings
from ltsim.recordings.files import read_file_beginning, safe_excerpt, with_unix_line_ends
from ltsim.recordings.formats import cern_lgc, gama, gama_writer, gsi, openindy, polar_text, sdr, spatialanalyzer
from ltsim.recordings.formats.unsupported import UNSUPPORTED_FORMATS
from ltsim.recordings.recording import Recording
from ltsim.recordings.settings import validation_sentence
from ltsim.recordings.setup import Setup
from ltsim.recordings.spreadsheets.cells import has_time_of_day, is_numeric
from ltsim.recordings.tables import reader as tables
from ltsim.recordings.tables.pose_titles import (
    MIN_ADDITIONAL_COLUMNS_OF_POSES,
    are_row_numbers,
    titles_of_joints_or_rotations,
)
from ltsim.recordings.tables.station_names import UnrecognisedStationColumnError
from ltsim.recordings.tables.unnamed_targets import (
    MOVING_TARGET_TEXT,
    STATION_OF_POSITIONS_ADVICE,
    UnnamedTargetsError,
)
from ltsim.recordings.times import time_unit_questions

RecordingSource = Recording | str | Path
"""Recording, or path of a file or folder from which a recording is read."""
MAX_FORMAT_RECOGNITION_BYTES = 16_384
"""Number of bytes at the beginning of a file that are read to recognise its format."""
MAX_NOTES_PER_FILE = 100
"""Largest number of notes of a reader on one file; without this limit a file of unknown keywords could cause 200,000
notes.
"""
MIN_ROWS_SHOWING_MOVING_TARGET = 2
"""Smallest number of rows, with a name used before and different coordinates, that shows a moving target instead of a
list of points. The number must also be at least the number of different names."""
TRIAL_STATION_NAME = "S1"
"""Station name for a test whether a list of coordinates can be read as the positions that one station measured."""
MAX_REPEATED_POINT_DISTANCE_M = 1e-3
"""Largest distance [m] between repeated measurements of one point, given as rows with one name; rows with a larger
distance contradict each other."""
NATIVE_FORMAT_DESCRIPTION = "folder with observations.csv and setup.toml"
POLAR_TEXT_FORMAT_DESCRIPTION = "plain text: station, target, azimuth, zenith or elevation, distance"
POINT_LIST_FORMAT_DESCRIPTION = "names and coordinates, which are not a recording"
TABLE_FORMAT_DESCRIPTION = "delimited text with a header, a folder with one file per station, or a workbook"


WriteFunction = Callable[[Recording, Path], None]
"""Function that writes a recording to a path."""


@dataclass(frozen=True)
class FileFormat:
    """File format of recordings: test by which it is recognised, reader, and writer (None if it cannot be written).

    `recognises` tests the path and the first characters of a file. `description` is for lists of formats. If a
    beginning fits several formats, `suffixes` of file names, such as ".csv", decide, unless a format has a signature:
    `has_signature` is True if no other format can begin in this way.
    """

    name: str
    description: str
    suffixes: tuple[str, ...]
    recognises: Callable[[Path, str], bool]
    read: Callable[[Path, Hints], Recording]
    write: WriteFunction | None = None
    has_signature: bool = False


def _make_format(
    module: ModuleType,
    name: str,
    description: str,
    *suffixes: str,
    write: WriteFunction | None = None,
    has_signature: bool = False,
) -> FileFormat:
    """File format that is implemented by the functions `recognises` and `read` of `module`.

    `name` and `description` are for users; `suffixes` of file names and `has_signature` help to recognise the format.
    `write` is None for a format that is only read.
    """
    return FileFormat(name, description, suffixes, module.recognises, module.read, write, has_signature)


def _is_list_of_points(path: Path, file_beginning: str) -> bool:
    """True if the file is a list of points (names with coordinates), not a recording."""
    return path.is_file() and not file_beginning.startswith(("<", "PK")) and coordinates.is_point_list(file_beginning)


def _refuse_point_list(path: Path, hints: Hints) -> Recording:
    """RecordError for a list of points, which is not a recording; the function always raises an error."""
    point_list = coordinates.read_points(path, refuses_contradictions=False)
    n_points, n_repeated = len(point_list.names), point_list.n_contradictory_rows
    if n_repeated:
        for station in (None, TRIAL_STATION_NAME):
            try:
                tables.read(path, replace(hints, station=station))
            except (UnrecognisedStationColumnError, UnnamedTargetsError):
                raise
            except RecordError:
                pass  # it is no table of several set-ups
    names = "one name" if n_points == 1 else f"{n_points} names"
    titles = list(point_list.additional_columns)
    is_numbered = are_row_numbers(point_list.names) and len(titles) >= MIN_ADDITIONAL_COLUMNS_OF_POSES
    if all(has_time_of_day(name) or (is_numeric(name) and not name.isdigit()) for name in point_list.names) or (
        is_numbered
    ):
        message = f"this is a table of {n_points + n_repeated} positions without point names, {MOVING_TARGET_TEXT}; it "
        message += "is not a list of points"
    elif pose_titles := titles_of_joints_or_rotations(titles):
        first_name, titles_text = safe_excerpt(point_list.names[0]), names_text([*map(safe_excerpt, pose_titles)])
        message = f"this is a table of {n_points + n_repeated} poses ('{first_name}') with the angles of joints or "
        message += f"rotations {titles_text}, {MOVING_TARGET_TEXT}; it is not a list of points"
    elif n_repeated and point_list.max_repeated_point_distance_m < MAX_REPEATED_POINT_DISTANCE_M:
        message = f"this is a list of {n_points} points in {n_points + n_repeated} rows, without instrument readings"
    elif n_repeated >= max(n_points, MIN_ROWS_SHOWING_MOVING_TARGET):
        rows = f"{n_points + n_repeated} positions under {names} ('{point_list.names[0]}')"
        message = f"this is a table of {rows}, {MOVING_TARGET_TEXT}; it is not a list of points"
    else:
        message = f"this is a list of {n_points} points without instrument readings (nominal or reference coordinates)"
    raise RecordError(f"{message} ({STATION_OF_POSITIONS_ADVICE})", file=path)


FORMATS: tuple[FileFormat, ...] = (
    FileFormat(
        "native",
        NATIVE_FORMAT_DESCRIPTION,
        ("", ".csv"),
        native.recognises,
        native.read_recording,
        native.write_recording,
    ),
    _make_format(
        spatialanalyzer, "spatialanalyzer", "SpatialAnalyzer instrument report (CompositeReport)", ".csv", ".txt"
    ),
    _make_format(cern_lgc, "cern-lgc", "input file of CERN's LGC", ".lgc", ".lgc2"),
    _make_format(gama, "gama-local", "input file of GNU Gama", ".gkf", ".xml", write=gama_writer.write),
    _make_format(openindy, "openindy", "OpenIndy project", ".xml"),
    _make_format(gsi, "gsi", "Leica GSI-8 and GSI-16", ".gsi", has_signature=True),
    _make_format(sdr, "sdr", "Sokkia SDR20 and SDR33", ".sdr", has_signature=True),
    _make_format(
        polar_text, "polar-text", POLAR_TEXT_FORMAT_DESCRIPTION, ".txt", ".dat", ".asc", write=polar_text.write
    ),
    FileFormat(
        "point-list", POINT_LIST_FORMAT_DESCRIPTION, (".txt", ".xyz", ".csv"), _is_list_of_points, _refuse_point_list
    ),
    _make_format(tables, "table", TABLE_FORMAT_DESCRIPTION, ".csv", ".tsv", ".txt", ".xlsx"),
)
"""Supported formats, in the order in which a file is tested for them."""


def read(path: str | Path, *, format: str | None = None, hints: Hints | None = None) -> Recording:  # noqa: A002
    """Recording from a file or folder in any supported format.

    Parameters
    ----------
    path : str or Path
        File or folder.
    format : str, optional
        Name of the format; by default recognised by the content, then by the suffix of the file name.
    hints : Hints, optional
        Hints on what the file does not determine, such as units or names.

    Raises
    ------
    RecordError
        Error with its location in the file, or the hint that is needed.
    """
    path = Path(path)
    hints = hints or NO_HINTS
    format = "table" if format is None and hints.columns is not None and path.exists() else format  # noqa: A001
    file_format = recognise_format(path) if format is None else _format_by_name(format, FORMATS)
    try:
        recording = file_format.read(path, hints)
    except ValidationError as problem:
        raise RecordError(validation_sentence(problem.errors()[0], Setup), file=path) from None
    notes = (
        *recording.notes,
        *mirror_image_warnings(recording),
        *face_unit_warnings(recording),
        *time_unit_questions(recording),
        *vertical_sight_notes(recording),
    )
    n_unlisted = len(notes) - MAX_NOTES_PER_FILE
    return recording.replace(
        notes=notes if n_unlisted <= 0 else (*notes[:MAX_NOTES_PER_FILE], f"{n_unlisted} further notes are not listed")
    )


def is_supported_recording(path: Path) -> bool:
    """True if the file or folder is in one of the supported formats."""
    try:
        recognise_format(path)
    except RecordError:
        return False
    return True


def load_recording(source: RecordingSource) -> Recording:
    """Recording from `source`, which is a recording or the path of one; raises RecordError for any other object."""
    if not isinstance(source, Recording | str | Path):
        raise RecordError(f"expected a recording or the path of one, found a {type(source).__name__}")
    return source if isinstance(source, Recording) else read(source)


def recognise_format(path: Path) -> FileFormat:
    """Format of a file or folder; raises RecordError if it does not exist or has no supported format."""
    if not path.exists():
        raise RecordError("there is no such file or folder", file=path)
    if not (path / native.OBSERVATIONS_FILE).is_file() and (
        inside := sorted(path.glob(f"*/{native.OBSERVATIONS_FILE}"))
    ):
        advice = f"a recording; give {inside[0].parent}"
        if len(inside) > 1:
            advice = f"{len(inside)} recordings; give one of them, such as {inside[0].parent}"
        raise RecordError(f"the folder is not a recording, but contains {advice}", file=path)
    beginning = ""
    if not path.is_dir():
        beginning = with_unix_line_ends(read_file_beginning(path, MAX_FORMAT_RECOGNITION_BYTES))
    unread_format = next((f for f in UNSUPPORTED_FORMATS if f.pattern.match(beginning)), None)
    if unread_format is not None:
        raise RecordError(
            f"the file is {unread_format.name}, which ltsim does not read; {unread_format.export_advice}", file=path
        )
    fitting_formats = [f for f in FORMATS if f.recognises(path, beginning)]
    if not fitting_formats:
        formats = "; ".join(f"{f.name} ({f.description})" for f in FORMATS)
        raise RecordError(f"the file is in none of the formats that ltsim reads: {formats}", file=path)
    return next(
        (f for f in fitting_formats if f.has_signature or path.suffix.lower() in f.suffixes), fitting_formats[0]
    )


def write(recording: Recording, path: Path | str, format: str = "native") -> None:  # noqa: A002
    """Export of a recording to a file or folder, in the format with the given name.

    Raises RecordError if the format has no writer or cannot represent the recording, or if the path is not writable. No
    incomplete file remains.
    """
    writable_formats = tuple(f for f in FORMATS if f.write is not None)
    writer = _format_by_name(format, writable_formats).write
    if writer is not None:
        writer(recording, Path(path))


def _format_by_name(name: str, formats: tuple[FileFormat, ...]) -> FileFormat:
    """Format in `formats` with this name; raises RecordError for an unknown name."""
    format_by_name = {f.name: f for f in formats}
    if name not in format_by_name:
        raise RecordError(str(unknown_name_error("format", name, format_by_name)))
    return format_by_name[name]

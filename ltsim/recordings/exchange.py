"""Reading and writing of recordings (observations with their set-up) in all supported file formats."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from pydantic import ValidationError

from ltsim.core.errors import RecordError, unknown_name_error
from ltsim.recordings import native
from ltsim.recordings.conventions import mirror_image_warnings, vertical_sight_notes
from ltsim.recordings.face_units import face_unit_warnings
from ltsim.recordings.files import read_file_beginning, with_unix_line_ends
from ltsim.recordings.formats import (
    cern_lgc,
    gama,
    gama_writer,
    gsi,
    openindy,
    point_list,
    polar_text,
    sdr,
    spatialanalyzer,
)
from ltsim.recordings.formats.unsupported import UNSUPPORTED_FORMATS
from ltsim.recordings.hints import Hints, HintsArgument, hints_from_argument
from ltsim.recordings.recording import Recording
from ltsim.recordings.settings import validation_sentence
from ltsim.recordings.setup import Setup
from ltsim.recordings.tables import reader as tables
from ltsim.recordings.times import time_unit_questions

RecordingSource = Recording | str | Path
"""Recording, or path of a file or folder from which a recording is read."""
MAX_FORMAT_RECOGNITION_BYTES = 16_384
"""Number of bytes at the beginning of a file that are read to recognise its format."""
MAX_NOTES_PER_FILE = 100
"""Largest number of notes of a reader on one file; without this limit a file of unknown keywords could cause 200,000
notes.
"""


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
    suffixes: str,
    *,
    write: WriteFunction | None = None,
    has_signature: bool = False,
) -> FileFormat:
    """File format that is implemented by the functions `recognises` and `read` of `module`.

    `name` and `description` are for users; `suffixes` of file names, separated by blanks, and `has_signature` help to
    recognise the format. `write` is None for a format that is only read.
    """
    return FileFormat(name, description, tuple(suffixes.split()), module.recognises, module.read, write, has_signature)


FORMATS: tuple[FileFormat, ...] = (
    FileFormat(
        "native",
        "folder with observations.csv and setup.toml",
        ("", ".csv"),
        native.recognises,
        native.read_recording,
        native.write_recording,
    ),
    _make_format(
        spatialanalyzer, "spatialanalyzer", "SpatialAnalyzer instrument report (CompositeReport)", ".csv .txt"
    ),
    _make_format(cern_lgc, "cern-lgc", "input file of CERN's LGC", ".lgc .lgc2"),
    _make_format(gama, "gama-local", "input file of GNU Gama", ".gkf .xml", write=gama_writer.write),
    _make_format(openindy, "openindy", "OpenIndy project", ".xml"),
    _make_format(gsi, "gsi", "Leica GSI-8 and GSI-16", ".gsi", has_signature=True),
    _make_format(sdr, "sdr", "Sokkia SDR20 and SDR33", ".sdr", has_signature=True),
    _make_format(
        polar_text,
        "polar-text",
        "plain text: station, target, azimuth, zenith or elevation, distance",
        ".txt .dat .asc",
        write=polar_text.write,
    ),
    _make_format(point_list, "point-list", "names and coordinates, which are not a recording", ".txt .xyz .csv"),
    _make_format(
        tables,
        "table",
        "delimited text with a header, a folder with one file per station, or a workbook",
        ".csv .tsv .txt .xlsx",
    ),
)
"""Supported formats, in the order in which a file is tested for them."""


def read(path: str | Path, *, format: str | None = None, hints: HintsArgument = None) -> Recording:  # noqa: A002
    """Recording from a file or folder in any supported format.

    Parameters
    ----------
    path : str or Path
        File or folder.
    format : str, optional
        Name of the format; by default recognised by the content, then by the suffix of the file name.
    hints : Hints or mapping, optional
        Hints on what the file does not determine, such as units or names.

    Raises
    ------
    RecordError
        Error with its location in the file, or the hint that is needed.
    InputError
        If a hint is invalid.
    """
    path = Path(path)
    hints = hints_from_argument(hints)
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
